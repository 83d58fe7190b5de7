"""Sections of a study's configuration on what is done with the images: photometry, errors, fits, checks, page."""

from miricigale.photometry import YANG2021_DEPTHS
from miricigale.workflow.options import Section, option, require
from miricigale.workflow.truths import ALL, CATALOG, EFFECTS, EXPERIMENTS, FIELD, SETS, VARIANTS


class PhotometrySection(Section):
    """
    How sources are found and measured.

    Parameters
    ----------
    method
        Forced photometry: own, or Yang et al. 2021.
    threshold
        Detection threshold in sigma of a pixel.
    n_pixels
        Least number of connected pixels of a detection.
    regularization
        Regularization of the matching kernels: a number, auto, or yang2021 (0.03).
    match_radius
        Radius of the match to the truth in arcsec.
    rivals
        Whether the first sky is measured by the other method and as by Source Extractor too.
    """

    method: str = option("package", choices=("package", "yang2021"))
    threshold: float = option(0.25, low=0.01, high=100.0)
    n_pixels: int = option(60, low=1, high=10000)
    regularization: float | str = option("auto", low=1e-6, choices=("auto", "yang2021"))
    match_radius: float = option(0.5, low=0.05, high=3.0)
    rivals: bool = False


class ErrorSection(Section):
    """
    How the error function is made.

    Parameters
    ----------
    statistic
        Scatter statistic.
    bin_size
        Sources per bin.
    coverage
        Whether errors follow the exposure time at each source; otherwise the flux alone.
    """

    statistic: str = option("mad", choices=("mad", "median_abs"))
    bin_size: int = option(30, low=5, high=1000)
    coverage: bool = True


class FitBasics(Section):
    """
    The fits.

    Parameters
    ----------
    bands
        Existing bands.
    depths
        Their 5-sigma AB depths.
    axes
        Grid of the fit.
    model_error
        Relative model error.
    min_detected
        MIRI bands in which a source must be detected to count.
    dust_excess
        Dust luminosities of the grid over what attenuation takes. Without any there is energy balance, as in the
        paper; real galaxies do not keep it (``[sed] infrared = "ceers"``).
    """

    bands: tuple[str, ...] = tuple(YANG2021_DEPTHS)
    depths: tuple[float, ...] = option(tuple(YANG2021_DEPTHS.values()), low=10.0, high=40.0)
    axes: str = option("fit", choices=("fit", "quick"))
    model_error: float = option(0.1, low=0.0, high=1.0)
    min_detected: int = option(2, low=0, high=9)
    dust_excess: tuple[float, ...] = option((0.25, 1.0, 2.5), low=0.001, high=1000.0)

    def __post_init__(self):
        n = len(self.bands)
        wanted = f"must have one number per band ({n})"
        require(len(self.depths) in (0, n), "fit", "depths", wanted, len(self.depths))


class FitSection(FitBasics):
    """
    The final fits, with and without MIRI.

    Parameters
    ----------
    bands
        Existing bands: by default all of the catalog that are not simulated, and of the bundled catalogs
        those of Yang et al. 2021.
    depths
        Their 5-sigma AB depths; without any each source has the errors of the catalog, and no flux where it has
        none.
    min_redshift
        Least redshift, by the catalog, of the sources that count. Those that this and the next three leave
        out keep their light in the images, but are in no fit and no share.
    min_mass
        Least stellar mass (Msun) by the input fit, likewise.
    max_chi2
        Largest reduced chi2 of the input fit, likewise; 0 for any.
    redshift_quality
        What columns of the catalog must say of a redshift, likewise: "redshift_source=spec", "q_z<=3".
    sets
        Sets of the MIRI bands that are fitted with the existing ones.
    experiments
        Further fits of each sample with all MIRI bands.
    skies
        Skies of a truth 'field' whose AGN are drawn and fitted without images, for purity and completeness.
    """

    bands: tuple[str, ...] = ()
    depths: tuple[float, ...] = option((), low=10.0, high=40.0)
    min_redshift: float = option(0.0, low=0.0, high=10.0)
    min_mass: float = option(0.0, low=0.0, high=1e13)
    max_chi2: float = option(0.0, low=0.0, high=1e4)
    redshift_quality: tuple[str, ...] = option((), single=True)
    sets: tuple[str, ...] = option(("all", "none"), choices=SETS, unique=True)
    experiments: tuple[str, ...] = option((), choices=EXPERIMENTS, unique=True)
    skies: int = option(200, low=0, high=10000)


class PointSourceSection(Section):
    """
    The check with bright point sources on a grid.

    Parameters
    ----------
    enabled
        Whether the check is made.
    spacing
        Spacing of the grid in arcsec.
    signal_to_noise
        Approximate S/N of each.
    """

    enabled: bool = True
    spacing: float = option(15.0, low=6.0, high=60.0)
    signal_to_noise: float = option(1000.0, low=20.0, high=1e5)


class PerturbSection(Section):
    """
    In what the sky differs from what the analysis takes it for: one more sky for each effect.

    Parameters
    ----------
    effects
        Effects; 'all' are those that the skies allow.
    together
        Whether one more sky has all of them.
    of
        fracAGN of the skies that are perturbed, out of [sed] frac_agn; without any the first.
    psf_width
        Relative width of the PSF, + or - by band.
    flat
        Share of the flat field that is another detector's, pixel by pixel.
    gain
        Relative gain.
    linearity
        Relative signal near a full well.
    zero_point
        Relative flux of the MIRI bands, + or - by band.
    zero_point_existing
        Relative flux of the existing bands, likewise.
    astrometry
        Shift against the prior in arcsec, in a direction of each band.
    clumps
        Share of the light of disks that is in made-up clumps.
    cutouts
        Image (FITS, background subtracted) of the real galaxies whose light those of 'cutouts' have.
    cutouts_psf
        Its PSF (FILE[EXTENSION,PLANE] of a cube), if its filter has no model.
    cutouts_of
        own: the galaxy at the place of the source; any: a drawn one, scaled to its size.
    """

    effects: tuple[str, ...] = option((), choices=(*EFFECTS, ALL), single=True, unique=True)
    together: bool = True
    of: tuple[float | str, ...] = option(
        (), low=0.0, high=0.99, choices=(FIELD, CATALOG), single=True, unique=True
    )
    psf_width: float = option(0.02, low=0.0, high=0.2)
    flat: float = option(1.0, low=0.0, high=1.0)
    gain: float = option(0.01, low=-0.2, high=0.2)
    linearity: float = option(0.01, low=-0.1, high=0.1)
    zero_point: float = option(0.02, low=0.0, high=0.5)
    zero_point_existing: float = option(0.02, low=0.0, high=0.5)
    astrometry: float = option(0.03, low=0.0, high=1.0)
    clumps: float = option(0.2, low=0.0, high=0.9)
    cutouts: str = ""
    cutouts_psf: str = ""
    cutouts_of: str = option("own", choices=("own", "any"))


class VariantSection(Section):
    """
    Further images of the first sky, by rates, to see what sets the limits of the fluxes.

    Parameters
    ----------
    images
        What they have otherwise, one thing at a time: the calculator's residual noise, the gradient of the
        background, the plane that is taken off before the mesh.
    """

    images: tuple[str, ...] = option((), choices=(*VARIANTS, ALL), single=True, unique=True)


class ReportSection(Section):
    """
    The page at the end.

    Parameters
    ----------
    dpi
        Resolution of the figures.
    pictures
        Sources of a truth with pictures in the pages of sources: those fitted, then the brightest.
    """

    dpi: int = option(110, low=40, high=400)
    pictures: int = option(5000, low=0)
