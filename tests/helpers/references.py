"""Reference files in the formats of CRDS, as small as they can be."""

import hashlib

import numpy as np
from astropy.io import fits
from numpy.polynomial import Polynomial

from miricigale.detector import Ramp
from miricigale.instrument import DQ, flat_field, photmjsr, reference_pixel_mask

__all__ = ["KINDS", "POINTED", "imager_keywords", "nameless", "write_cache", "write_reference"]

#: Reference types and the extension of their arrays.
KINDS = dict.fromkeys(
    ["saturation", "superbias", "reset", "dark", "gain", "readnoise", "flat"], "SCI"
)
KINDS |= {"mask": None, "linearity": "COEFFS"}


#: Where a file of the imager points.
POINTED = {"RA_REF": 214.9, "DEC_REF": 52.9, "ROLL_REF": 120.0}


def imager_keywords(**changes):
    """What a file of the imager needs in its header, but for these."""
    known = {
        "INSTRUME": "MIRI", "EXP_TYPE": "MIR_IMAGE", "FILTER": "F770W", "READPATT": "FASTR1",
        "SUBARRAY": "SUB64", "NINTS": 1, "NGROUPS": 4,
    }  # fmt: skip
    return known | changes


def write_reference(path, kind, exposure, array=None, *, dq=None, legend=None, **keywords):
    """
    Write an array (or flags) that covers the sub-array of an exposure.

    ``legend`` are the names of the bits in ``dq``, lowest first; those of JWST if not given.
    """
    part = exposure.aperture
    header = fits.Header(
        {
            "TELESCOP": "JWST",
            "INSTRUME": "MIRI",
            "DETECTOR": "MIRIMAGE",
            "REFTYPE": kind.upper(),
            "SUBARRAY": part.name,
            "SUBSTRT1": part.origin[0] + 1,
            "SUBSTRT2": part.origin[1] + 1,
            "SUBSIZE1": part.shape[1],
            "SUBSIZE2": part.shape[0],
            **keywords,
        }
    )
    hdus = [fits.PrimaryHDU(header=header)]
    if array is not None:
        hdus.append(fits.ImageHDU(np.asarray(array, np.float32), name=KINDS[kind]))
    if dq is not None:
        hdus.append(fits.ImageHDU(np.asarray(dq, np.uint32), name="DQ"))
        names = [flag.name for flag in DQ if flag and flag < 2**32] if legend is None else legend
        bits = (
            [flag.value.bit_length() - 1 for flag in DQ if flag and flag < 2**32]
            if legend is None
            else range(len(names))
        )
        rows = [(bit, 1 << bit, name, "") for bit, name in zip(bits, names, strict=True)]
        columns = [("BIT", "<i4"), ("VALUE", "<u4"), ("NAME", "S40"), ("DESCRIPTION", "S80")]
        hdus.append(fits.BinTableHDU(np.array(rows, columns), name="DQ_DEF"))
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def write_photom(path, rows, *, times=None):
    """Write a photom reference: rows (filter, sub-array, MJy/sr per DN/s); tables of time by name."""
    columns = [("filter", "S12"), ("subarray", "S17"), ("photmjsr", "<f4"), ("uncertainty", "<f4")]
    table = np.array([(*row, 0.0) for row in rows], columns)
    primary = fits.PrimaryHDU()
    primary.header.update({"INSTRUME": "MIRI", "DETECTOR": "MIRIMAGE", "REFTYPE": "PHOTOM"})
    hdus = [primary, fits.BinTableHDU(table, name="PHOTOM")]
    for name, values in (times or {}).items():
        columns = [("filter", "S12"), ("subarray", "S17"), *((key, "<f4") for key in values)]
        data = np.array([(*row[:2], *values.values()) for row in rows], columns)
        hdus.append(fits.BinTableHDU(data, name=name))
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def write_references(folder, exposure, detector, bad):
    """Write the references of a simulated detector; their paths by the names of `ReferenceFiles`."""
    ones, part = np.ones(exposure.shape), exposure.subarray
    # as CRDS has it for MIRI, a polynomial of raw DN
    raw = Polynomial(detector.nonlinearity)(Polynomial([-detector.bias, 1.0])) + detector.bias
    step = exposure.group_time.to_value("s") * detector.dark_current / detector.gain
    sees = ~reference_pixel_mask(subarray=part)
    arrays = {
        "saturation": ones * (detector.bias + 0.98 * detector.saturation_dn),
        "linearity": raw.coef[:, None, None] * ones,
        "dark": (step * np.arange(1, exposure.n_groups + 11)[:, None, None] * sees)[None],
        "gain": ones * detector.gain,
        # CRDS keeps the noise of a difference of two reads
        "readnoise": ones * np.sqrt(2) * detector.read_noise,
        "flat": flat_field(exposure.filter, subarray=part),
    }
    for kind, array in arrays.items():
        write_reference(folder / f"{kind}.fits", kind, exposure, array)
    write_reference(folder / "mask.fits", "mask", exposure, dq=bad, legend=["DO_NOT_USE"])
    band, conversion = exposure.filter[5:].upper(), photmjsr(exposure.filter, gain=detector.gain)
    write_photom(folder / "photom.fits", [(band, "FULL", 9.0), (band, part, conversion)])
    names = {kind: kind for kind in ("mask", "photom", *arrays) if kind != "readnoise"}
    return {
        name: folder / f"{kind}.fits" for name, kind in {**names, "read_noise": "readnoise"}.items()
    }


def write_cache(folder, rules, *, context="jwst_0001.pmap"):
    """
    Write the mappings of a CRDS cache.

    ``rules`` has, by reference type, the text of an rmap after ``'parkey' :`` and that of its
    selector.
    """
    mappings = folder / "mappings" / "jwst"
    mappings.mkdir(parents=True, exist_ok=True)
    (folder / "references" / "jwst" / "miri").mkdir(parents=True, exist_ok=True)

    def write(name, header, selector):
        text = "".join(f"    {key!r} : {value},\n" for key, value in header.items())
        text = f"header = {{\n{text}}}\n\nselector = {selector}\n"
        # crds sums up all other lines
        lines = [line for line in text.splitlines(keepends=True) if "'sha1sum'" not in line]
        known = hashlib.sha1("".join(lines).encode()).hexdigest()
        (mappings / name).write_text(text.replace("0" * 40, known))

    names = {}
    for kind, (parkey, selector, *extra) in rules.items():
        names[kind] = f"jwst_miri_{kind}_0001.rmap"
        header = {
            "derived_from": "'test'", "filekind": repr(kind.upper()), "instrument": "'MIRI'",
            "mapping": "'REFERENCE'", "name": repr(names[kind]), "observatory": "'JWST'",
            "parkey": parkey, "sha1sum": repr("0" * 40), **(extra[0] if extra else {}),
        }  # fmt: skip
        write(names[kind], header, selector)
    imap = context.replace("jwst_", "jwst_miri_").replace(".pmap", ".imap")
    header = {
        "derived_from": "'test'", "instrument": "'MIRI'", "mapping": "'INSTRUMENT'",
        "name": repr(imap), "observatory": "'JWST'", "parkey": "('REFTYPE',)", "sha1sum": repr("0" * 40),
    }  # fmt: skip
    lines = "".join(f"    {kind!r} : {name!r},\n" for kind, name in names.items())
    write(imap, header, f"{{\n{lines}    'area' : 'N/A',\n}}")
    header |= {
        "mapping": "'PIPELINE'",
        "name": repr(context),
        "parkey": "('META.INSTRUMENT.NAME',)",
    }
    del header["instrument"]
    write(context, header, f"{{\n    'MIRI' : {imap!r},\n}}")
    return folder


def nameless(ramp, folder):
    """A ramp from a file that does not tell who made it."""
    with fits.open(ramp.write(folder / "jw_uncal.fits")) as hdus:
        kept = fits.HDUList([hdu for hdu in hdus if not hdu.name.startswith("SIM_")])
        kept[0].header["ORIGIN"] = "STSCI"
        kept.writeto(folder / "other_uncal.fits")
    return Ramp.read(folder / "other_uncal.fits")
