"""Images of the reduction as files from which the official pipeline goes on."""

import numpy as np
from astropy.io import fits

from miricigale.instrument.product_files import write_product
from miricigale.reduction.images.files import ImageFile, shared_meta
from miricigale.reduction.images.images import flagged_image, plain_flags, plain_mask, sigma
from miricigale.utils.exceptions import argument_error


def write_image(image, path, *, planes=None, overwrite=False):
    """
    Write an image as a FITS file that JWST's tools, photutils and DS9 open.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`, `ImageFile` or list of one of them
        Rate, calibrated image or mosaic; of a list, the integrations of an exposure, all planes
        are cubes (``_rateints``). Its WCS, with distortion, goes to the header of SCI; its
        meta dictionary, as JSON, to the keyword META, by which `read_images` restores it.
    path : path-like
        The file.
    planes : dict of str to `~numpy.ndarray`, optional
        Further planes by name (`ImageFile`), such as ``WHT``, ``CON`` (numbers of images)
        and ``BKG`` (what was subtracted), beside those of an `ImageFile`.
    overwrite : bool, optional
        Whether an existing file is replaced.

    Returns
    -------
    path : `pathlib.Path`

    Raises
    ------
    OSError
        If the file exists and ``overwrite`` is False.
    ValueError
        If a plane has another name or shape, integrations do not belong together, or the file is named as a
        product that the image is not, such as ramps (``x_uncal.fits``).

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> exposure = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> from miricigale.reduction import write_image
    >>> rates = Reducer().fit_integrations(ramp, planes=True)
    >>> path = write_image(rates, "sub64_rateints.fits")  # doctest: +SKIP
    """
    image, planes, wcs = _joined(image, planes or {})
    return write_product(image, path, planes=planes, wcs=wcs, overwrite=overwrite)


def _joined(image, planes):
    """Return the image, planes and WCS that are written of an image, of one with planes, or of integrations."""
    is_cube = isinstance(image, (list, tuple))
    files = []
    for part in image if is_cube else [image]:
        if isinstance(part, ImageFile):
            files.append(part)
        else:
            files.append(ImageFile(part, {}, fits.Header()))
    first = None
    if files:
        first = files[0].image
    alike = all(
        file.image.shape == first.shape
        and file.image.unit == first.unit
        and file.image.uncertainty is not None
        and set(file.planes) == set(files[0].planes)
        for file in files
    )
    if not files or (is_cube and not alike):
        wanted = "integrations of one shape and unit, with errors and the same planes"
        raise argument_error("image", wanted, f"{len(files)} others")
    if not is_cube:
        return first, {**files[0].planes, **planes}, first.wcs

    def cube(values):
        return np.array([values(file) for file in files])

    joined = flagged_image(
        cube(lambda file: file.image.data),
        first.unit,
        error=cube(lambda file: sigma(file.image)),
        flags=cube(lambda file: plain_flags(file.image)),
        wcs=None,
        meta=shared_meta(first),
        mask=cube(lambda file: plain_mask(file.image)),
    )
    cubes = {name: cube(lambda file, n=name: file.planes[n]) for name in files[0].planes}
    return joined, {**cubes, **planes}, first.wcs
