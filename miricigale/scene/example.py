"""A small simulated field, for examples and first tries."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.filters import find_filter
from miricigale.instrument import north_up_wcs
from miricigale.psf import filter_psf
from miricigale.scene.catalog_files import read_catalog
from miricigale.scene.highres import highres_image
from miricigale.sed import SEDModel
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import positive

_CENTER = SkyCoord(53.129, -27.842, unit="deg")
#: Depths (5 sigma in an aperture of 0.2"; AB): about those of deep surveys.
_DEPTHS = {"wfc3": 27.6, "nircam": 28.5, "miri": 26.0}
_SCALES = {"wfc3": 0.06 * u.arcsec, "nircam": 0.06 * u.arcsec, "miri": 0.11 * u.arcsec}
_GALAXY = {"tau": 1 * u.Gyr, "age": 1 * u.Gyr, "ebv": 0.2, "alpha": 2.0}


@dataclass(frozen=True)
class ExampleField:
    """
    Images of one simulated field; `example_field` makes it.

    Attributes
    ----------
    images : dict of str to `~astropy.nddata.CCDData`
        By filter, in MJy/sr with uncertainties and WCS, north up.
    psfs : dict of str to `~photutils.psf.ImagePSF`
        PSFs of the images, the pixel and drizzling included.
    truth : `~astropy.table.QTable`
        Positions, redshifts, shapes and total fluxes of the galaxies.

    Examples
    --------
    >>> from miricigale.scene import example_field
    >>> field = example_field(["F770W"])
    >>> field.images["miri.f770w"].shape
    (273, 273)
    """

    images: dict
    psfs: dict
    truth: QTable


@takes_other_keywords
def example_field(filters=("wfc3.f160w", "miri.f770w"), *, size=30 * u.arcsec, seed=1):
    """
    Return the simulated images of a part of GOODS-S, with noise, for examples and first tries.

    Positions, redshifts, shapes and F160W fluxes are those of real galaxies (the bundled catalog);
    the other bands follow from one model of a star-forming galaxy at each redshift. The noise is
    Gaussian, without correlation between pixels. It is not a forecast: see `miricigale.planning`.

    Parameters
    ----------
    filters : sequence of str, optional
        Of WFC3/IR and NIRCam (pixels of 0.06") and MIRI (0.11").
    size : `~astropy.units.Quantity`, optional
        Width and height of the images, 1" to 120".
    seed : int, optional
        Seed of the noise.

    Returns
    -------
    field : `ExampleField`

    Raises
    ------
    ValueError
        If the size is out of range or there is no model PSF for a filter.

    Examples
    --------
    >>> from miricigale.scene import example_field
    >>> field = example_field(["F160W", "F1500W"])
    >>> list(field.images)
    ['wfc3.f160w', 'miri.f1500w']
    >>> field.truth["miri.f1500w"].unit
    Unit("uJy")
    """
    width = positive(size, u.arcsec, "size")
    check_that(1 <= width <= 120, "size", "1 to 120 arcsec", size)
    names = [find_filter(name) for name in filters]
    catalog = read_catalog("catalog.goodss")
    east, north = _CENTER.spherical_offsets_to(catalog["sky"])
    # light of galaxies outside of the field counts too
    reach = (width / 2 + 3) * u.arcsec
    inside = (abs(east) < reach) & (abs(north) < reach)
    galaxies = catalog[inside & ~catalog["star"] & (catalog["redshift"] > 0)]

    model = SEDModel.yang2021(agn=False)
    rows = QTable({"id": galaxies["id"], "redshift": galaxies["redshift"]})
    for name, value in _GALAXY.items():
        rows[name] = np.full(len(rows), 1.0) * value
    light = model.fluxes(rows, list(dict.fromkeys(["wfc3.f160w"] + list(names))))
    scale = galaxies["wfc3.f160w"] / light["wfc3.f160w"]
    shapes = ["profile", "half_light_radius", "sersic_index", "axis_ratio", "position_angle"]
    truth = galaxies["id", "sky", "redshift", *shapes]
    images = {}
    psfs = {}
    for name in names:
        truth[name] = light[name] * scale
        camera = name.split(".")[0]
        pixel = _SCALES[camera]
        n_pixels = round(width / pixel.value)
        psfs[name] = filter_psf(name, pixel_scale=pixel, pa=0 * u.deg)
        wcs = north_up_wcs(_CENTER, pixel, (n_pixels, n_pixels))
        depth = _DEPTHS[camera] * u.ABmag
        images[name] = highres_image(
            truth, seed=seed, filter=name, wcs=wcs, psf=psfs[name], depth=depth
        )
    return ExampleField(images, psfs, truth)
