"""
Sections of a run's configuration: every key with its default, its limits and what it means.

What a docstring says of a key is its comment in files of configurations and its entry in the reference.
"""

from miricigale.filters import SURVEYS
from miricigale.instrument import CEERS_FILTERS, imager_filters
from miricigale.photometry import YANG2021_DEPTHS
from miricigale.workflow.options import Section, option, require
from miricigale.workflow.truths import ALL, CATALOG, EFFECTS, EXPERIMENTS, FIELD, SETS, VARIANTS


class RunBasics(Section):
    """
    What runs and plans have in common.

    Parameters
    ----------
    name
        Name of the run; its folder unless --output is given.
    seed
        Seed of every random draw.
    threads
        Threads; 0 for as many as there are cores.
    """

    name: str = "study"
    seed: int = option(20210211, low=0)
    threads: int = option(0, low=0)


class RunSection(RunBasics):
    """
    What the run is called and how it goes.

    Parameters
    ----------
    memory
        Memory (GB) of steps side by side; 0 for half of all.
    keep_level1b
        Whether the level-1b (uncal) files are kept.
    """

    memory: float = option(0.0, low=0.0)
    keep_level1b: bool = False


class CatalogSection(Section):
    """
    The real sources that are simulated.

    Parameters
    ----------
    source
        Resource name or path of the catalog.
    columns
        Our names of its columns and the file's: "redshift=z_best", "wfc3.f160w=FLUX_H".
    units
        Units where the file gives none: "flux=mJy" for all fluxes, "flux=ABmag" for magnitudes,
        "ra=hourangle".
    survey
        Names and units of its columns as in catalogs of a survey; columns and units come first.
    missing
        Further numbers that stand for no value in fluxes and errors, besides -99 and the like.
    factor
        Column of factors on all fluxes of a source, such as from an aperture to the total.
    mag_limit
        Faint limit in the magnitude column.
    mag_column
        Column that the limit applies to; without it the flux of the high-resolution band counts.
    """

    source: str = "catalog.goodss"
    columns: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    survey: str = option("", choices=("", *SURVEYS))
    missing: tuple[float, ...] = ()
    factor: str = ""
    mag_limit: float = option(26.6, low=10.0, high=40.0)
    mag_column: str = "mag_f160w"

    def __post_init__(self):
        for key in ("columns", "units"):
            pairs = getattr(self, key)
            good = all(len(pair.split("=")) == 2 and all(pair.split("=")) for pair in pairs)
            require(good, "catalog", key, "must have the form 'name=value'", list(pairs))


class PointingSection(Section):
    """
    Where the telescope looks.

    Parameters
    ----------
    ra
        Right ascension of the field center in degrees.
    dec
        Declination of the field center in degrees.
    roll
        Position angle of V3 in degrees.
    tiles
        Pointings side by side along the imager's x and y axes.
    overlap
        Share of its side that a tile has in common with the next.
    centers
        Centers of several pointings in degrees, "RA Dec", instead of ra, dec and tiles.
    """

    ra: float = option(53.13440, low=0, high=360)
    dec: float = option(-27.83444, low=-90, high=90)
    roll: float = option(0.0, low=-360, high=360)
    tiles: tuple[int, ...] = option((1, 1), low=1, high=30)
    overlap: float = option(0.1, low=0.0, high=0.9)
    centers: tuple[str, ...] = ()

    def __post_init__(self):
        pair = len(self.tiles) == 2
        require(pair, "pointing", "tiles", "must be two numbers", list(self.tiles))
        alone = not self.centers or self.tiles == (1, 1)
        require(alone, "pointing", "tiles", "must be [1, 1] with centers", list(self.tiles))
        for text in self.centers:
            wanted = "must have the form 'RA Dec' in degrees"
            require(_is_position(text), "pointing", "centers", wanted, repr(text))


def _is_position(text):
    try:
        ra, dec = (float(word) for word in text.split())
    except ValueError:
        return False
    return 0 <= ra <= 360 and -90 <= dec <= 90


class SedSection(Section):
    """
    How the input SEDs are fitted and what AGN is added.

    Parameters
    ----------
    axes
        Grid of the input fit.
    catalog_error
        Relative error of fluxes whose band has no column of errors.
    max_wavelength
        Longest pivot wavelength (um) of the bands without errors that are fitted.
    alpha
        Range from which the dust's alpha is drawn where no band shows it.
    alpha_draw
        How it is drawn: uniform, or nodes: from those of the fit's grid within the range, where best fits
        on that grid lie.
    frac_agn
        fracAGN of the injected sources, one simulated sky for each; the first gives the error functions.
        'field' draws AGN from a luminosity function, 'catalog' takes its column frac_agn.
    infrared
        Dust luminosity and colors: ceers draws those of real MIRI colors where no band of the fit shows the
        dust; fit keeps the energy balance of the fit; main-sequence has at least those of the star-forming
        main sequence.
    """

    axes: str = option("galaxy", choices=("galaxy", "quick"))
    catalog_error: float = option(0.05, low=1e-4, high=1.0)
    max_wavelength: float = option(3.0, low=0.3, high=30.0)
    alpha: tuple[float, ...] = (1.5, 2.5)
    alpha_draw: str = option("uniform", choices=("uniform", "nodes"))
    frac_agn: tuple[float | str, ...] = option(
        (0.0,), low=0.0, high=0.99, choices=(FIELD, CATALOG), single=True, unique=True
    )
    infrared: str = option("ceers", choices=("ceers", "fit", "main-sequence"))

    def __post_init__(self):
        good = len(self.alpha) == 2 and 0 < self.alpha[0] <= self.alpha[1] <= 4
        wanted = "must be two numbers in order, above 0 to 4"
        require(good, "sed", "alpha", wanted, list(self.alpha))


class ExposureSection(Section):
    """
    What is exposed, and for how long.

    Parameters
    ----------
    filters
        MIRI filters.
    plan
        Exposure plan.
    kind
        ramps: every group is simulated; rates: slopes with the noise of the ramps, 30 times faster.
    n_groups
        Groups of each filter instead of the plan's.
    n_integrations
        Integrations of each filter, likewise.
    n_dithers
        Dithers of each filter, likewise.
    dithers
        Where they are, for all filters or for each: a pattern's name, or a file of offsets (.pointing of
        APT, or a table with x_offset and y_offset). Without any the pattern is 'ceers'.
    dither_observation
        Observation of a .pointing file that has several; 0 for its only one.
    dither_exposures
        Exposure of a .pointing file (column Exp) of each filter, where their dithers differ.
    """

    filters: tuple[str, ...] = option(CEERS_FILTERS, choices=imager_filters(), unique=True)
    plan: str = option("ceers", choices=("ceers", "quick"))
    kind: str = option("ramps", choices=("ramps", "rates"))
    n_groups: tuple[int, ...] = option((), low=1)
    n_integrations: tuple[int, ...] = option((), low=1)
    n_dithers: tuple[int, ...] = option((), low=1)
    dithers: tuple[str, ...] = option((), single=True)
    dither_observation: int = option(0, low=0)
    dither_exposures: tuple[int, ...] = option((), low=1)


class SceneSection(Section):
    """
    The sky behind the sources.

    Parameters
    ----------
    background
        Zodiacal light (low, medium, high) or surface brightness ('12.5 MJy/sr'); one for all filters, or one
        for each.
    background_of
        Of what names of zodiacal light are percentiles: the whole sky, or the days on which the pointing
        can be seen.
    background_date
        Day, such as 2027-03-01, whose zodiacal light at the pointing is taken (needs zodipy).
    background_scale
        Factor on the background.
    background_gradient
        Relative gradient per arcmin.
    gradient_angle
        Position angle of the gradient in degrees.
    """

    background: tuple[str, ...] = option(("low",), single=True)
    background_of: str = option("sky", choices=("sky", "pointing"))
    background_date: str = ""
    background_scale: float = option(1.0, low=0.0, high=100.0)
    background_gradient: float = option(0.05, low=0.0, high=1.0)
    gradient_angle: float = 45.0


class HighresSection(Section):
    """
    The high-resolution image that is the prior.

    Parameters
    ----------
    filter
        Its filter.
    pixel_scale
        Pixel scale in arcsec.
    depth
        5-sigma AB depth of a point source.
    """

    filter: str = "wfc3.f160w"
    pixel_scale: float = option(0.06, low=0.01, high=0.2)
    depth: float = option(27.6, low=20.0, high=35.0)


class DetectorSection(Section):
    """
    What the detector does to the light.

    Parameters
    ----------
    cosmic_rays
        Whether cosmic rays hit.
    residual
        Fraction of the light that stays as a fixed pattern (flat, sky), or that of the exposure time
        calculator.
    """

    cosmic_rays: bool = True
    residual: float | str = option(0.0, low=0.0, high=0.1, choices=("etc",))


class ReductionSection(Section):
    """
    How ramps become mosaics.

    Parameters
    ----------
    backend
        Who fits the ramps: own, or the steps of the official pipeline (jwst, to be installed).
    jump_threshold
        Jump detection threshold in sigma.
    background
        Background: about masked sources, the plain mesh of sep, or that of the other dithers (three or
        more).
    background_box
        Box of the background mesh in pixels.
    background_filter
        Median filter of the mesh in cells.
    background_plane
        Whether a plane is taken off before the mesh.
    negative_threshold
        Pixels so many sigma below the background are masked.
    negative_noise
        That sigma: the larger of a pixel's error and the noise of the background, or the latter.
    pixel_scale
        Pixel scale of the mosaics in arcsec.
    pixfrac
        Drop size of the drizzling.
    """

    backend: str = option("native", choices=("native", "jwst"))
    jump_threshold: float = option(5.0, low=2.0, high=50.0)
    background: str = option("masked", choices=("masked", "sep", "dithers"))
    background_box: int = option(64, low=8, high=512)
    background_filter: int = option(3, low=1, high=15)
    background_plane: bool = True
    negative_threshold: float = option(10.0, low=3.0, high=1e6)
    negative_noise: str = option("larger", choices=("larger", "background"))
    pixel_scale: float = option(0.11, low=0.02, high=0.5)
    pixfrac: float = option(1.0, low=0.1, high=1.0)


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
