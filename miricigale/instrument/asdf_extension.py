"""The extension ASDF of JWST's files, in which world coordinates are a gwcs."""

import importlib.util
import io

import numpy as np
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling.models import (
    Identity,
    Mapping,
    Polynomial2D,
    RotationSequence3D,
    Scale,
    Shift,
)

from miricigale.instrument.siaf import attitude_matrix, unit_vector, vector_angles
from miricigale.instrument.sky_axes import pixel_to_radec
from miricigale.instrument.wcs import chebyshev_pixels, scaled_fit
from miricigale.utils.exceptions import file_errors
from miricigale.utils.optional_packages import require

#: By which the official pipeline recognizes a file; it says nothing.
_STUB = (
    b"#ASDF 1.0.0\n#ASDF_STANDARD 1.6.0\n%YAML 1.1\n%TAG ! tag:stsci.edu:asdf/\n"
    b"--- !core/asdf-1.1.0\nmeta: {}\n...\n"
)

#: Orders of the polynomials from pixels to the telescope frame and back.
_FORWARD = 5
_INVERSE = 8

#: Keywords of the reference point: on the sky, and in the telescope frame.
_REFERENCE = ("RA_REF", "DEC_REF", "ROLL_REF", "V2_REF", "V3_REF")


def read_gwcs(hdus):
    """
    Read the gwcs in the extension ASDF of JWST's pipeline.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The file, with an extension ASDF.

    Returns
    -------
    exact : `gwcs.WCS` or None
        None if the extension has none.

    Raises
    ------
    ImportError
        If gwcs is not installed.
    `~miricigale.utils.exceptions.DataError`
        If the extension cannot be read.
    """
    require("gwcs", extra="gwcs")
    asdf = require("asdf", extra="gwcs")
    content = np.asarray(hdus["ASDF"].data["ASDF_METADATA"][0]).tobytes()
    refused = file_errors(hdus.filename(), "has no gwcs in its extension ASDF")
    with refused, asdf.open(io.BytesIO(content)) as tree:
        return tree.tree.get("meta", {}).get("wcs")


def asdf_wcs(header, hdus):
    """The gwcs in the extension ASDF, if it has one (`read_gwcs`), as FITS polynomials good to 0.01 pixels."""
    from astropy.wcs import WCS

    exact = read_gwcs(hdus)
    if exact is None:
        return None
    box = tuple((-0.5, header[f"NAXIS{k}"] - 0.5) for k in (1, 2))
    return WCS(exact.to_fits_sip(bounding_box=box, max_pix_error=0.01))


def bytes_table(text, column, name):
    """Return the extension that holds bytes in one column."""
    array = np.frombuffer(text, np.uint8)[None]
    fields = [fits.Column(name=column, format=f"{array.size}B", array=array)]
    return fits.BinTableHDU.from_columns(fields, name=name)


def asdf_extension(wcs=None, shape=None, header=None):
    """
    Return the extension without which the official pipeline does not go on with a file.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`, optional
        World coordinates of an array of the imager. With the package ``gwcs`` they are written as `imager_gwcs`
        gives them.
    shape : tuple of int, optional
        ``(ny, nx)`` of the array.
    header : mapping, optional
        With the keywords of the reference point; without them, or without ``gwcs``, the extension is a stub,
        from which the pipeline's calwebb_image2 goes on and calwebb_image3 does not.

    Returns
    -------
    hdu : `~astropy.io.fits.BinTableHDU`
    """
    content = _STUB
    has_reference = wcs is not None and all(header.get(name) is not None for name in _REFERENCE)
    if has_reference and importlib.util.find_spec("gwcs") is not None:
        content = _asdf_bytes({"meta": {"wcs": imager_gwcs(wcs, shape, header)}})
    return bytes_table(content, "ASDF_METADATA", "ASDF")


def _extension_name(entry):
    """By what the entries of a history are put in order."""
    return entry.get("extension_uri") or "", entry["extension_class"]


def _asdf_bytes(tree):
    """
    Return a tree as the bytes of an ASDF file, the same in every process.

    asdf 6.0 lists the extensions that it used in the order of a set. Those that a tree names already keep their
    place, so that it is written once more with them in order.
    """
    asdf = require("asdf", extra="gwcs")
    draft = io.BytesIO()
    final = io.BytesIO()
    asdf.AsdfFile(tree).write_to(draft)
    draft.seek(0)
    with asdf.open(draft) as written:
        extensions = written.tree["history"]["extensions"]
        ordered = sorted(extensions, key=_extension_name)
        asdf.AsdfFile({**tree, "history": {"extensions": ordered}}).write_to(final)
    return final.getvalue()


def _polynomials(begin, end, order):
    """Return the model of positions by others, about the first of each."""
    offsets = end - end[:, :1]
    models = []
    for table in scaled_fit(*(begin - begin[:, :1]), offsets.T, order):
        powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
        models.append(Polynomial2D(order, **{f"c{i}_{j}": table[i, j] for i, j in powers}))
    before, after = (Shift(float(a)) & Shift(float(b)) for a, b in (-begin[:, 0], end[:, 0]))
    return before | Mapping((0, 1, 0, 1)) | models[0] & models[1] | after


def imager_gwcs(wcs, shape, header):
    """
    Return the world coordinates of the imager with the frames of JWST: detector, telescope (V2, V3), sky.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        Of the image.
    shape : tuple of int
        ``(ny, nx)``.
    header : mapping
        Keywords RA_REF, DEC_REF, ROLL_REF, V2_REF and V3_REF of the reference point.

    Returns
    -------
    exact : `gwcs.WCS`
        Equal to ``wcs`` to 1e-4 pixels for the polynomials of fifth order that JWST has.

    References
    ----------
    JWST-STScI-001550, "Description and use of the JWST Science Instrument Aperture File".
    """
    gwcs = require("gwcs", extra="gwcs")
    from gwcs.coordinate_frames import CelestialFrame, Frame2D
    from gwcs.geometry import CartesianToSpherical, SphericalToCartesian

    ra, dec, roll, v2, v3 = (float(header[name]) for name in _REFERENCE)
    ny, nx = shape
    # the first is the middle, from which the polynomials count
    pixel = np.stack([np.append(nodes.mean(), nodes) for nodes in chebyshev_pixels(shape)])
    matrix = attitude_matrix(ra, dec, roll, v2=v2, v3=v3)
    sky_lon, sky_lat = np.radians(pixel_to_radec(wcs, pixel[0], pixel[1]))
    v2v3 = np.degrees(vector_angles(matrix.T @ unit_vector(sky_lon, sky_lat))) * 3600
    distortion = _polynomials(pixel, v2v3, _FORWARD)
    distortion.inverse = _polynomials(v2v3, pixel, _INVERSE)
    to_sky = (
        Scale(1 / 3600) & Scale(1 / 3600)
        | SphericalToCartesian(wrap_lon_at=180)
        | RotationSequence3D([v2 / 3600, -v3 / 3600, roll, dec, -ra], axes_order="zyxyz")
        | CartesianToSpherical(wrap_lon_at=360)
    )
    names = "detector", "v2v3", "v2v3vacorr"
    units = ("pix", "pix"), ("arcsec", "arcsec"), ("arcsec", "arcsec")
    frames = [Frame2D(name=name, unit=unit) for name, unit in zip(names, units, strict=True)]
    frames.append(CelestialFrame(reference_frame=ICRS(), name="world"))
    exact = gwcs.WCS(list(zip(frames, (distortion, Identity(2), to_sky, None), strict=True)))
    exact.bounding_box = (-0.5, nx - 0.5), (-0.5, ny - 0.5)
    exact.pixel_shape = nx, ny
    return exact
