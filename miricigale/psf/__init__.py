"""
Point spread functions as photutils models, and the kernels between them.

Every PSF says what it includes, its pixel scale, its frame and angle.
"""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "_stpsf": ("stpsf_grid", "stpsf_psf"),
        "by_filter": ("MODEL_FILTERS", "checked_psf", "filter_psf"),
        "effects": ("EFFECTS", "cruciform_fraction"),
        "energy": ("encircled_energy", "fwhm", "psf_table", "radius_of_encircled_energy"),
        "field": ("grid_weights", "miri_psf_grid", "psf_at", "psf_grid"),
        "kernel_field": ("KernelField",),
        "kernels": ("REGULARIZATIONS", "MatchingKernel"),
        "files": ("read_psf",),
        "hst": ("hst_psf",),
        "miri": ("MIRI_PIXEL_SCALE", "miri_psf"),
        "model": ("InstrumentPSF", "PSFGrid", "from_photutils", "instrument_psf", "make_psf"),
        "nircam": ("nircam_psf",),
        "optics": ("Pupil", "hst_pupil", "jwst_pupil"),
        "resample": ("average_psf", "psf_image", "psf_mosaic", "rotate_psf"),
        "shapes": ("gaussian_psf", "moffat_psf"),
        "stars": ("psf_from_stars",),
    },
)
