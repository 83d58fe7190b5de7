"""PSFs of NIRCam's wide filters, for priors of shorter wavelength."""

import astropy.units as u

from miricigale.filters.band_names import known_filter
from miricigale.psf.effects import detector_response
from miricigale.psf.model import make_psf
from miricigale.psf.optics import jwst_constants
from miricigale.psf.telescope import Telescope, checked_grid, odd_cells
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE

#: Pixel in arcsec of the wide filters, of the short- and the long-wavelength channel.
_PIXELS = dict.fromkeys((f"nircam.f{n}w" for n in ("070", "090", "115", "150", "200")), 0.031)
_PIXELS |= dict.fromkeys((f"nircam.f{n}w" for n in (277, 356, 444)), 0.063)
NIRCAM_FILTERS = tuple(_PIXELS)


@takes_other_keywords
def nircam_psf(filter, *, oversampling=4, fov=None, wavefront_error=75 * u.nm, seed=1):
    """
    Return the PSF of a wide filter of NIRCam, by the optics of `miri_psf`.

    Telescope, jitter and the pixel's response: no interpixel capacitance, no charge
    diffusion, no aberrations of NIRCam itself beyond the wavefront error of the whole, no
    dependence on the field. It is for simulated and approximate priors; for photometry on a
    real image take PSFs of its stars (`psf_from_stars`) or those that come with the mosaic.

    Parameters
    ----------
    filter : str or `~miricigale.filters.Filter`
        F070W, F090W, F115W, F150W, F200W, F277W, F356W or F444W.
    oversampling : int, optional
        Cells per pixel of 0.031 arcsec (to F200W) or 0.063 arcsec.
    fov : `~astropy.units.Quantity`, optional
        Width of the grid; 6 arcsec to F200W, 10 arcsec beyond by default.
    wavefront_error, seed
        As for `miri_psf`: the same seed is the same telescope.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        In the detector frame, whose +y is taken along V3. A mosaic's: `psf_mosaic`.

    Raises
    ------
    KeyError
        If there is no such filter.
    ValueError
        If an option is out of its range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import nircam_psf
    >>> nircam_psf("nircam.f444w", fov=4 * u.arcsec).includes
    ('jitter', 'pixel')
    """
    name = known_filter(filter, _PIXELS, "PSF for the filter")
    scale = _PIXELS[name]
    oversampling, width = checked_grid(oversampling, fov, 6.0 if scale < 0.05 else 10.0)
    # the detectors' axes stand within 0.6 deg of the telescope's
    telescope = Telescope.of(name, 0.0, wavefront_error, seed)
    cell = scale / oversampling
    data = telescope.image(cell, odd_cells(width, cell))
    jitter = jwst_constants()["jitter"] / scale
    data = detector_response(data, oversampling=oversampling, jitter=jitter)
    form = {"pixel_scale": scale * ANGLE, "oversampling": oversampling, "frame": "detector"}
    form |= {
        "filter": name,
        "total_known": True,
        "meta": {"instrument": "NIRCam", **telescope.meta},
    }
    return make_psf(data * oversampling**2, includes=("jitter", "pixel"), **form)
