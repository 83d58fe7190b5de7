"""
Make a small CRDS cache, with which the official pipeline (jwst) reduces simulated exposures.

Observatory references describe the observatory's detector. Simulated counts belong to
another one, whose figures and maps are those of `miricigale.instrument`; this script
writes them as reference files of CRDS, with the mappings that select them, so that the
pipeline runs as it is and needs no network::

    pip install ".[jwst]"
    python tools/make_crds.py crds --filters miri.f770w --groups 25
    . crds/environment.sh
    strun calwebb_detector1 simulated_uncal.fits

What our detector does not do (electromagnetic interference; reset anomaly and first groups
unless asked for with ``--reset-anomaly`` and ``--skip-first``), and what its PSF holds
(interpixel capacitance), is ``N/A`` in the cache: the pipeline skips these steps.
"""

import argparse
import os
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.modeling.models import Mapping, Polynomial2D, Shift
from numpy.polynomial import Polynomial

from miricigale.detector import ResetAnomaly
from miricigale.instrument import (
    aperture,
    bad_pixel_mask,
    field_mask,
    flat_field,
    frame_time,
    imager_filters,
    imager_wcs,
    miri_detector,
    photmjsr,
    pixel_area_map,
    pixel_to_v2v3,
    reference_pixel_mask,
    subarrays,
)
from miricigale.psf import encircled_energy, miri_psf, radius_of_encircled_energy

CONTEXT = "jwst_9999.pmap"
USEAFTER = "2000-01-01 00:00:00"
ARCSEC2 = u.arcsec.to(u.rad) ** 2

#: Bits of JWST data quality that the references use.
DQ_BITS = {"DO_NOT_USE": 0, "NON_SCIENCE": 9, "REFERENCE_PIXEL": 31}

#: Encircled energies of the source catalog's three apertures (its defaults).
FRACTIONS = (0.3, 0.5, 0.7)

#: Order of the polynomials: that of the SIAF's distortion, and of its inverse.
_FORWARD, _INVERSE = 4, 8


def _dq(**masks):
    """Bits set where the masks are true, and the table that explains them."""
    dq = np.zeros(aperture("FULL").shape, np.uint32)
    for name, mask in masks.items():
        dq[mask] |= np.uint32(1 << DQ_BITS[name])
    columns = [("BIT", "<u4"), ("VALUE", "<u4"), ("NAME", "S40"), ("DESCRIPTION", "S80")]
    rows = [(bit, 1 << bit, name.encode(), b"") for name, bit in DQ_BITS.items()]
    return dq, np.array(rows, dtype=columns)


def _polynomial(x, y, values, order):
    """Least-squares polynomial, fitted with both coordinates scaled to about 1."""
    scale = max(np.abs(x).max(), np.abs(y).max())
    model = Polynomial2D(order)
    powers = [tuple(map(int, name[1:].split("_"))) for name in model.param_names]
    design = np.stack([(x / scale) ** i * (y / scale) ** j for i, j in powers], axis=-1)
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    model.parameters = [c / scale ** (i + j) for (i, j), c in zip(powers, solution, strict=True)]
    return model


def distortion():
    """
    Transform from pixels (0-based, full frame) to V2, V3 in arcsec, with its inverse.

    The forward polynomial is that of the SIAF (degree 4, exact to rounding), the inverse
    one good to better than 0.001 pixels in every pixel.
    """
    full = aperture("FULL")
    ny, nx = full.shape
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(0, nx - 1, 60), np.linspace(0, ny - 1, 60)))
    v2, v3 = pixel_to_v2v3(x, y)
    dx, dy = x - full.reference[0], y - full.reference[1]
    dv2, dv3 = v2 - full.v2, v3 - full.v3
    to_sky = [_polynomial(dx, dy, v, _FORWARD) for v in (dv2, dv3)]
    to_pixels = [_polynomial(dv2, dv3, d, _INVERSE) for d in (dx, dy)]
    worst = max(np.abs(p(dv2, dv3) - d).max() for p, d in zip(to_pixels, (dx, dy), strict=True))
    if worst > 1e-3:
        msg = f"the inverse of the distortion is wrong by {worst:.2g} pixels"
        raise ValueError(msg)
    pixel = Shift(-full.reference[0]) & Shift(-full.reference[1])
    telescope = Shift(full.v2) & Shift(full.v3)
    both = Mapping((0, 1, 0, 1))
    model = pixel | both | to_sky[0] & to_sky[1] | telescope
    model.inverse = telescope.inverse | both | to_pixels[0] & to_pixels[1] | pixel.inverse
    model.name = "miri_imager"
    model.inputs, model.outputs = ("x", "y"), ("v2", "v3")
    return model


def _linearity(detector):
    """Coefficients from raw to linear DN; ours count from the bias, the pipeline's from zero."""
    series = Polynomial(detector.nonlinearity)(Polynomial([-detector.bias, 1.0])) + detector.bias
    return series.coef


class Cache:
    """A CRDS cache that grows by reference files and is closed with its mappings."""

    def __init__(self, folder):
        self.folder = Path(folder).resolve()
        self._rules = {}
        for part in (self.references, self.mappings, self.config):
            part.mkdir(parents=True, exist_ok=True)

    @property
    def references(self):
        return self.folder / "references/jwst/miri"

    @property
    def mappings(self):
        return self.folder / "mappings/jwst"

    @property
    def config(self):
        return self.folder / "config/jwst"

    def add(self, model, reftype, *, filter=None, frame=None):
        """
        Write a reference file.

        Parameters
        ----------
        model : `~stdatamodels.jwst.datamodels.JwstDataModel`
            What is in it.
        reftype : str
            Such as ``"flat"``.
        filter : str, optional
            Filter for which it holds; all if not given.
        frame : str, optional
            Sub-array that its arrays cover.
        """
        meta = model.meta
        meta.instrument.name, meta.instrument.detector = "MIRI", "MIRIMAGE"
        meta.reftype, meta.author, meta.pedigree = reftype.upper(), "miricigale", "DUMMY"
        meta.useafter = USEAFTER.replace(" ", "T")
        meta.description = "of the detector that miricigale simulates"
        meta.telescope = "JWST"
        if filter is not None:
            meta.instrument.filter = filter
        if frame is not None:
            part = aperture(frame)
            for name, value in {
                "name": frame,
                "xstart": part.origin[0] + 1,
                "ystart": part.origin[1] + 1,
                "xsize": part.shape[1],
                "ysize": part.shape[0],
                "fastaxis": 1,
                "slowaxis": 2,
            }.items():
                setattr(meta.subarray, name, value)
        stem = reftype if filter is None else f"{reftype}_{filter.lower()}"
        suffix = "asdf" if reftype in ("distortion", "filteroffset", "abvegaoffset") else "fits"
        path = self.references / f"jwst_miri_{stem}_9999.{suffix}"
        model.save(str(path))
        self._rules.setdefault(reftype, {})[filter] = path.name

    def _write(self, name, header, selector):
        common = {"derived_from": "miricigale", "name": name, "observatory": "JWST"}
        header = {**common, **header, "sha1sum": "0" * 40}
        lines = "".join(f"    {key!r} : {value!r},\n" for key, value in sorted(header.items()))
        path = self.mappings / name
        path.write_text(f"header = {{\n{lines}}}\n\nselector = {selector}\n")
        return path

    def close(self):
        """Write mappings, configuration and the shell's environment."""
        from crds.refactoring.checksum import update_checksum

        paths = []
        for reftype, files in self._rules.items():
            keys = ["META.INSTRUMENT.DETECTOR"]
            if None not in files:
                keys.append("META.INSTRUMENT.FILTER")
            cases = ""
            for filter_, name in files.items():
                case = "MIRIMAGE" if filter_ is None else ("MIRIMAGE", filter_)
                cases += f"    {case!r} : UseAfter({{\n        {USEAFTER!r} : {name!r},\n    }}),\n"
            header = {
                "classes": ("Match", "UseAfter"),
                "filekind": reftype.upper(),
                "instrument": "MIRI",
                "mapping": "REFERENCE",
                "parkey": (tuple(keys), ("META.OBSERVATION.DATE", "META.OBSERVATION.TIME")),
            }
            rmap = f"jwst_miri_{reftype}_9999.rmap"
            paths.append(self._write(rmap, header, f"Match({{\n{cases}}})"))
        rules = {
            name: f"jwst_miri_{name}_9999.rmap" if name in self._rules else "N/A"
            for name in sorted(reference_types() | set(self._rules))
        }
        header = {"instrument": "MIRI", "mapping": "INSTRUMENT", "parkey": ("REFTYPE",)}
        lines = "".join(f"    {key!r} : {value!r},\n" for key, value in rules.items())
        paths.append(self._write("jwst_miri_9999.imap", header, f"{{\n{lines}}}"))
        header = {"mapping": "PIPELINE", "parkey": ("META.INSTRUMENT.NAME",)}
        paths.append(self._write(CONTEXT, header, "{\n    'MIRI' : 'jwst_miri_9999.imap',\n}"))
        self._configure(paths)
        os.environ.update(environment(self.folder))
        for path in paths:
            update_checksum(str(path))

    def _configure(self, mappings):
        # what the CRDS server would have said when the cache was last synchronised
        info = {
            "observatory": "jwst",
            "operational_context": CONTEXT,
            "latest_context": CONTEXT,
            "edit_context": CONTEXT,
            "connected": False,
            "bad_files": "",
            "bad_files_list": [],
            "effective_mode": "local",
            "crds_version": {"str": "14.0.0"},
            "last_synced": "never",
            "status": "cache",
            "mappings": [path.name for path in mappings],
        }
        (self.config / "server_config").write_text(repr(info))
        lines = [f"export {key}='{value}'\n" for key, value in environment(self.folder).items()]
        (self.folder / "environment.sh").write_text("".join(lines))


def environment(folder):
    """Variables by which the pipeline finds the cache, and looks nowhere else."""
    return {
        "CRDS_PATH": str(Path(folder).resolve()),
        "CRDS_OBSERVATORY": "jwst",
        "CRDS_CONTEXT": CONTEXT,
        # no server: this address stands for "serverless" in crds and is never opened
        "CRDS_SERVER_URL": "https://crds-serverless-mode.stsci.edu",
    }


def reference_types():
    """All reference types that the three imaging pipelines ask for."""
    from jwst.pipeline import Detector1Pipeline, Image2Pipeline, Image3Pipeline

    types = set()
    for pipeline in (Detector1Pipeline, Image2Pipeline, Image3Pipeline):
        types.add(f"pars-{pipeline.__name__.lower()}")
        for step in pipeline.step_defs.values():
            types.add(f"pars-{step.__name__.lower()}")
            types.update(step.reference_file_types)
    return types


def add_ramp_references(cache, detector, *, n_groups, readout="FASTR1", subarray="FULL"):
    """Add what calwebb_detector1 asks for."""
    from stdatamodels.jwst import datamodels

    ny, nx = shape = aperture("FULL").shape
    reference = reference_pixel_mask()

    def full(value):
        return np.full(shape, value, np.float32)

    good = np.zeros(shape, np.uint32)
    dq, dq_def = _dq(DO_NOT_USE=bad_pixel_mask(), REFERENCE_PIXEL=reference, NON_SCIENCE=reference)
    cache.add(datamodels.MaskModel(dq=dq, dq_def=dq_def), "mask", frame="FULL")

    # a group that is full reads the well give or take the noise: the limit lies below it
    limit = detector.bias + detector.saturation_dn - 10 * detector.read_noise
    limit = min(limit, 2.0**detector.adc_bits - 1)
    model = datamodels.SaturationModel(data=full(limit), dq=good)
    cache.add(model, "saturation", frame="FULL")

    coefficients = _linearity(detector)
    planes = np.broadcast_to(coefficients[:, None, None], (len(coefficients), ny, nx))
    model = datamodels.LinearityModel(coeffs=planes.astype(np.float32), dq=good)
    cache.add(model, "linearity", frame="FULL")

    cache.add(datamodels.GainModel(data=full(detector.gain)), "gain", frame="FULL")
    # by convention the noise of a difference of two reads; rounding adds 1/12 DN^2 to each
    noise = np.sqrt(2 * (detector.read_noise**2 + 1 / 12))
    cache.add(datamodels.ReadnoiseModel(data=full(noise)), "readnoise", frame="FULL")

    # the pipeline cuts all these to a sub-array, but not the dark: it has its own times too
    step = frame_time(readout, subarray).to_value("s") * detector.dark_current / detector.gain
    dark = np.zeros((1, n_groups, *aperture(subarray).shape), np.float32)
    dark += (step * np.arange(1, n_groups + 1, dtype=np.float32))[:, None, None]
    dark[:, :, reference_pixel_mask(subarray=subarray)] = 0
    model = datamodels.DarkMIRIModel(data=dark)
    model.dq = np.zeros((1, 1, *aperture(subarray).shape), np.uint32)
    exposure = model.meta.exposure
    exposure.readpatt, exposure.nframes, exposure.groupgap = readout, 1, 0
    exposure.nints, exposure.ngroups = 1, n_groups
    exposure.average_dark_current = 0.0
    cache.add(model, "dark", frame=subarray)


def add_reset_references(
    cache, *, anomaly, skip_first, n_groups, readout="FASTR1", subarray="FULL"
):
    """Add what the steps reset and rscd ask for; either is left out where there is nothing."""
    from stdatamodels.jwst import datamodels

    if anomaly is not None:
        offsets = anomaly.offsets(len(anomaly.amplitudes), n_groups)
        # up to the last group in which more than a thousandth of a DN is left
        count = max(1, int(np.count_nonzero(np.abs(offsets).max(axis=0) > 1e-3)))
        offsets = offsets[:, :count].astype(np.float32)
        # like the dark, this one is not cut by the pipeline
        sees = ~reference_pixel_mask(subarray=subarray)
        model = datamodels.ResetModel(data=offsets[:, :, None, None] * sees.astype(np.float32))
        model.dq = np.zeros(sees.shape, np.uint32)
        exposure = model.meta.exposure
        exposure.readpatt, exposure.nframes, exposure.groupgap = readout, 1, 0
        exposure.nints, exposure.ngroups = offsets.shape
        cache.add(model, "reset", frame=subarray)
    if skip_first:
        row = (subarray.encode(), readout.encode(), skip_first, skip_first)
        columns = [("subarray", "S17"), ("readpatt", "S12")]
        columns += [(name, "<i4") for name in ("group_skip1", "group_skip")]
        model = datamodels.RSCDModel(rscd_group_skip_table=np.array([row], dtype=columns))
        cache.add(model, "rscd")


def add_image_references(cache, detector, filters):
    """Add what calwebb_image2 asks for."""
    from stdatamodels.jwst import datamodels

    shape = aperture("FULL").shape
    # through the coronagraphs' masks the sky is not seen
    hidden = ~field_mask()
    dq, dq_def = _dq(DO_NOT_USE=hidden, NON_SCIENCE=hidden)
    for name in filters:
        model = datamodels.FlatModel(data=flat_field(name).copy(), dq=dq, dq_def=dq_def)
        model.err = np.zeros(shape, np.float32)
        cache.add(model, "flat", filter=_short(name), frame="FULL")

    # a nominal area, that of the reference pixel; what is conserved is brightness times the
    # local area, which the map gives relative to it
    areas = pixel_area_map(imager_wcs(SkyCoord(0, 0, unit="deg"), 0 * u.deg), shape)
    x, y = (round(r) for r in aperture("FULL").reference)
    nominal = float(areas[y, x])
    rows = [
        (_short(name).encode(), part.encode(), photmjsr(name, gain=detector.gain), 0.0)
        for name in filters
        for part in subarrays()
    ]
    columns = [("filter", "S12"), ("subarray", "S15"), ("photmjsr", "<f4"), ("uncertainty", "<f4")]
    photom = datamodels.MirImgPhotomModel(phot_table=np.array(rows, dtype=columns))
    area = datamodels.PixelAreaModel(data=(areas / nominal).astype(np.float32))
    for model, reftype in ((photom, "photom"), (area, "area")):
        model.meta.photometry.pixelarea_steradians = nominal
        model.meta.photometry.pixelarea_arcsecsq = nominal / ARCSEC2
        model.meta.exposure.type = "MIR_IMAGE"
        cache.add(model, reftype)

    model = datamodels.DistortionModel(model=distortion(), input_units=u.pix, output_units=u.arcsec)
    model.meta.exposure.type = "MIR_IMAGE"
    model.meta.exposure.p_exptype = "MIR_IMAGE|"
    cache.add(model, "distortion")
    model = datamodels.FilteroffsetModel()
    model.meta.exposure.type = "MIR_IMAGE"
    model.filters = [
        {"filter": _short(name), "pupil": "N/A", "row_offset": 0.0, "column_offset": 0.0}
        for name in filters
    ]
    cache.add(model, "filteroffset")


def add_catalog_references(cache, filters):
    """Add what the source catalog of calwebb_image3 asks for."""
    from astropy.table import Table
    from stdatamodels.jwst import datamodels

    rows = []
    for name in filters:
        psf = miri_psf(name)
        pixel = psf.pixel_scale
        sky = (radius_of_encircled_energy(psf, 0.8) / pixel).value * np.array([2.0, 3.0])
        # the sky is taken where the wings still have light
        wings = np.diff(encircled_energy(psf, sky * pixel)) / np.diff(np.pi * sky**2)
        for fraction in FRACTIONS:
            radius = (radius_of_encircled_energy(psf, fraction) / pixel).value
            corrected = float(1 / (fraction - wings[0] * np.pi * radius**2))
            rows += [
                (_short(name).encode(), part.encode(), fraction, radius, corrected, *sky)
                for part in subarrays()
            ]
    columns = [("filter", "S12"), ("subarray", "S15")]
    columns += [(c, "<f4") for c in ("eefraction", "radius", "apcorr", "skyin", "skyout")]
    model = datamodels.MirImgApcorrModel(apcorr_table=np.array(rows, dtype=columns))
    model.meta.exposure.type = "MIR_IMAGE"
    cache.add(model, "apcorr")
    # none of ours: the catalog's Vega magnitudes are AB magnitudes
    names = [_short(name) for name in filters]
    model = datamodels.ABVegaOffsetModel()
    model.abvega_offset = Table({"filter": names, "abvega_offset": np.zeros(len(names), "f4")})
    cache.add(model, "abvegaoffset")


def _short(name):
    return name.rsplit(".", 1)[-1].upper()


def build(
    folder,
    *,
    n_groups,
    filters=None,
    readout="FASTR1",
    subarray="FULL",
    detector=None,
    reset_anomaly=None,
    skip_first=0,
):
    """
    Make the cache.

    Parameters
    ----------
    folder : path-like
        Where; made if it is not there.
    n_groups : int
        Most groups in an integration (the dark covers so many; it is the largest file).
    filters : iterable of str, optional
        Such as ``["miri.f770w"]``; all nine if not given.
    readout, subarray : str, optional
        Of the exposures.
    detector : `~miricigale.instrument.DetectorProperties`, optional
        The detector that made them; `~miricigale.instrument.miri_detector` if not given.
    reset_anomaly : `~miricigale.detector.ResetAnomaly`, optional
        That of the detector, if it has one: the step reset takes it off.
    skip_first : int, optional
        Groups that the step rscd flags at the start of each integration: 1 for a detector
        with `~miricigale.detector.FirstFrame`. (The pipeline always leaves out the last.)

    Returns
    -------
    variables : dict
        Environment variables by which the pipeline finds the cache.
    """
    filters = imager_filters() if filters is None else tuple(filters)
    detector = miri_detector() if detector is None else detector
    cache = Cache(folder)
    with warnings.catch_warnings():
        # the data models speak of optional keywords that no step reads
        warnings.simplefilter("ignore")
        add_ramp_references(cache, detector, n_groups=n_groups, readout=readout, subarray=subarray)
        add_reset_references(
            cache,
            anomaly=reset_anomaly,
            skip_first=skip_first,
            n_groups=n_groups,
            readout=readout,
            subarray=subarray,
        )
        add_image_references(cache, detector, filters)
        add_catalog_references(cache, filters)
        cache.close()
    return environment(folder)


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("folder", help="where the cache is made")
    parser.add_argument("--groups", type=int, required=True, help="most groups of an integration")
    parser.add_argument("--filters", nargs="+", metavar="NAME", help="all nine if not given")
    parser.add_argument("--readout", default="FASTR1")
    parser.add_argument("--subarray", default="FULL")
    parser.add_argument(
        "--reset-anomaly", action="store_true", help="the detector has ResetAnomaly()"
    )
    parser.add_argument(
        "--skip-first",
        type=int,
        default=0,
        metavar="N",
        help="leave out the first N groups: 1 if the detector has FirstFrame()",
    )
    options = parser.parse_args()
    build(
        options.folder,
        n_groups=options.groups,
        filters=options.filters,
        readout=options.readout,
        subarray=options.subarray,
        reset_anomaly=ResetAnomaly() if options.reset_anomaly else None,
        skip_first=options.skip_first,
    )
    print(f"made {options.folder}; now:  . {options.folder}/environment.sh")


if __name__ == "__main__":
    main()
