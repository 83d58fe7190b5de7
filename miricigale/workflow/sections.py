"""Sections of a run's configuration: every key with its default, limits and a line of documentation."""

import dataclasses

from miricigale.filters import SURVEYS
from miricigale.instrument import CEERS_FILTERS
from miricigale.photometry import YANG2021_DEPTHS
from miricigale.workflow.background import LEVELS_DOC
from miricigale.workflow.options import option, require
from miricigale.workflow.truths import ALL, CATALOG, EFFECTS, EXPERIMENTS, FIELD, SETS, VARIANTS


@dataclasses.dataclass(frozen=True)
class RunSection:
    """What the run is called and how it goes."""

    name: str = option("study", "Name of the run; its folder unless --output is given.")
    seed: int = option(20210211, "Seed of every random draw.", low=0)
    threads: int = option(0, "Threads; 0 for as many as there are cores.", low=0)
    memory: float = option(0.0, "Memory (GB) of steps side by side; 0 for half of all.", low=0.0)
    keep_level1b: bool = option(False, "Whether the level-1b (uncal) files are kept.")


@dataclasses.dataclass(frozen=True)
class CatalogSection:
    """The real sources that are simulated."""

    source: str = option("catalog.goodss", "Resource name or path of the catalog.")
    columns: tuple[str, ...] = option(
        (), 'Our names of its columns and the file\'s: "redshift=z_best", "wfc3.f160w=FLUX_H".'
    )
    units: tuple[str, ...] = option(
        (),
        'Units where the file gives none: "flux=mJy" for all fluxes, "flux=ABmag" for magnitudes, '
        '"ra=hourangle".',
    )
    survey: str = option(
        "",
        "Names and units of its columns as in catalogs of a survey; columns and units come first.",
        choices=("", *SURVEYS),
    )
    missing: tuple[float, ...] = option(
        (),
        "Further numbers that stand for no value in fluxes and errors, besides -99 and the like.",
    )
    factor: str = option(
        "", "Column of factors on all fluxes of a source, such as from an aperture to the total."
    )
    mag_limit: float = option(26.6, "Faint limit in the magnitude column.", low=10.0, high=40.0)
    mag_column: str = option(
        "mag_f160w",
        "Column that the limit applies to; without it the flux of the high-resolution band counts.",
    )


@dataclasses.dataclass(frozen=True)
class PointingSection:
    """Where the telescope looks."""

    ra: float = option(53.13440, "Right ascension of the field center in degrees.", low=0, high=360)
    dec: float = option(-27.83444, "Declination of the field center in degrees.", low=-90, high=90)
    roll: float = option(0.0, "Position angle of V3 in degrees.", low=-360, high=360)
    tiles: tuple[int, ...] = option(
        (1, 1), "Pointings side by side along the imager's x and y axes.", low=1, high=30
    )
    overlap: float = option(
        0.1, "Share of its side that a tile has in common with the next.", low=0.0, high=0.9
    )
    centers: tuple[str, ...] = option(
        (), 'Centers of several pointings in degrees, "RA Dec", instead of ra, dec and tiles.'
    )

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


@dataclasses.dataclass(frozen=True)
class SedSection:
    """How the input SEDs are fitted and what AGN is added."""

    axes: str = option("galaxy", "Grid of the input fit.", choices=("galaxy", "quick"))
    catalog_error: float = option(
        0.05, "Relative error of fluxes whose band has no column of errors.", low=1e-4, high=1.0
    )
    max_wavelength: float = option(
        3.0,
        "Longest pivot wavelength (um) of the bands without errors that are fitted.",
        low=0.3,
        high=30.0,
    )
    alpha: tuple[float, ...] = option(
        (1.5, 2.5), "Range from which the dust's alpha is drawn where no band shows it."
    )
    alpha_draw: str = option(
        "uniform",
        "How it is drawn: uniform, or nodes: from those of the fit's grid within the range, where "
        "best fits on that grid lie.",
        choices=("uniform", "nodes"),
    )
    frac_agn: tuple[float | str, ...] = option(
        (0.0,),
        "fracAGN of the injected sources, one simulated sky for each; the first gives the error "
        "functions. 'field' draws AGN from a luminosity function, 'catalog' takes its column frac_agn.",
        low=0.0,
        high=0.99,
        choices=(FIELD, CATALOG),
        single=True,
    )
    infrared: str = option(
        "fit",
        "Dust luminosity: by energy balance of the fit, or of the star-forming main sequence.",
        choices=("fit", "main-sequence"),
    )


@dataclasses.dataclass(frozen=True)
class ExposureSection:
    """What is exposed, and for how long."""

    filters: tuple[str, ...] = option(CEERS_FILTERS, "MIRI filters.")
    plan: str = option("ceers", "Exposure plan.", choices=("ceers", "quick"))
    kind: str = option(
        "ramps",
        "ramps: every group is simulated; rates: slopes with the noise of the ramps, 30 times faster.",
        choices=("ramps", "rates"),
    )
    n_groups: tuple[int, ...] = option((), "Groups of each filter instead of the plan's.")
    n_integrations: tuple[int, ...] = option((), "Integrations of each filter, likewise.")
    n_dithers: tuple[int, ...] = option((), "Dithers of each filter, likewise.")
    dithers: tuple[str, ...] = option(
        (),
        "Where they are, for all filters or for each: a pattern's name, or a file of offsets (.pointing of APT, "
        "or a table with x_offset and y_offset). Without any the pattern is 'ceers'.",
        single=True,
    )
    dither_observation: int = option(
        0, "Observation of a .pointing file that has several; 0 for its only one.", low=0
    )
    dither_exposures: tuple[int, ...] = option(
        (), "Exposure of a .pointing file (column Exp) of each filter, where their dithers differ."
    )


@dataclasses.dataclass(frozen=True)
class SceneSection:
    """The sky behind the sources."""

    background: tuple[str, ...] = option(("low",), LEVELS_DOC, single=True)
    background_of: str = option(
        "sky",
        "Of what names of zodiacal light are percentiles: the whole sky, or the days on which the pointing can "
        "be seen.",
        choices=("sky", "pointing"),
    )
    background_date: str = option(
        "", "Day, such as 2027-03-01, whose zodiacal light at the pointing is taken (needs zodipy)."
    )
    background_scale: float = option(1.0, "Factor on the background.", low=0.0, high=100.0)
    background_gradient: float = option(0.05, "Relative gradient per arcmin.", low=0.0, high=1.0)
    gradient_angle: float = option(45.0, "Position angle of the gradient in degrees.")


@dataclasses.dataclass(frozen=True)
class HighresSection:
    """The high-resolution image that is the prior."""

    filter: str = option("wfc3.f160w", "Its filter.")
    pixel_scale: float = option(0.06, "Pixel scale in arcsec.", low=0.01, high=0.2)
    depth: float = option(27.6, "5-sigma AB depth of a point source.", low=20.0, high=35.0)


@dataclasses.dataclass(frozen=True)
class DetectorSection:
    """What the detector does to the light."""

    cosmic_rays: bool = option(True, "Whether cosmic rays hit.")
    residual: float | str = option(
        0.0,
        "Fraction of the light that stays as a fixed pattern (flat, sky), or that of the exposure "
        "time calculator.",
        low=0.0,
        high=0.1,
        choices=("etc",),
    )


@dataclasses.dataclass(frozen=True)
class ReductionSection:
    """How ramps become mosaics."""

    backend: str = option(
        "native",
        "Who fits the ramps: own, or the steps of the official pipeline (jwst, to be installed).",
        choices=("native", "jwst"),
    )
    jump_threshold: float = option(5.0, "Jump detection threshold in sigma.", low=2.0, high=50.0)
    residual_cosmic_rays: bool = option(
        False, "Whether hits that ramps kept are searched on single images (L.A.Cosmic)."
    )
    background: str = option(
        "masked",
        "Background: about masked sources, the plain mesh of sep, or that of the other dithers (three or more).",
        choices=("masked", "sep", "dithers"),
    )
    background_box: int = option(64, "Box of the background mesh in pixels.", low=8, high=512)
    background_filter: int = option(3, "Median filter of the mesh in cells.", low=1, high=15)
    background_plane: bool = option(True, "Whether a plane is taken off before the mesh.")
    negative_threshold: float = option(
        10.0, "Pixels so many sigma below the background are masked.", low=3.0, high=1e6
    )
    negative_noise: str = option(
        "larger",
        "That sigma: the larger of a pixel's error and the noise of the background, or the latter.",
        choices=("larger", "background"),
    )
    pixel_scale: float = option(0.11, "Pixel scale of the mosaics in arcsec.", low=0.02, high=0.5)
    pixfrac: float = option(1.0, "Drop size of the drizzling.", low=0.1, high=1.0)


@dataclasses.dataclass(frozen=True)
class PhotometrySection:
    """How sources are found and measured."""

    method: str = option(
        "package", "Forced photometry: own, or Yang et al. 2021.", choices=("package", "yang2021")
    )
    threshold: float = option(
        0.25, "Detection threshold in sigma of a pixel.", low=0.01, high=100.0
    )
    n_pixels: int = option(
        60, "Least number of connected pixels of a detection.", low=1, high=10000
    )
    regularization: str = option(
        "auto", "Regularization of the matching kernels: auto, yang2021 (0.03) or a number."
    )
    match_radius: float = option(
        0.5, "Radius of the match to the truth in arcsec.", low=0.05, high=3.0
    )
    rivals: bool = option(
        False,
        "Whether the first sky is measured by the other method and as by Source Extractor too.",
    )


@dataclasses.dataclass(frozen=True)
class ErrorSection:
    """How the error function is made."""

    statistic: str = option("mad", "Scatter statistic.", choices=("mad", "median_abs"))
    bin_size: int = option(30, "Sources per bin.", low=5, high=1000)
    coverage: bool = option(
        True, "Whether errors follow the exposure time at each source; otherwise the flux alone."
    )


@dataclasses.dataclass(frozen=True)
class FitBasics:
    """The fits."""

    bands: tuple[str, ...] = option(tuple(YANG2021_DEPTHS), "Existing bands.")
    depths: tuple[float, ...] = option(tuple(YANG2021_DEPTHS.values()), "Their 5-sigma AB depths.")
    axes: str = option("fit", "Grid of the fit.", choices=("fit", "quick"))
    model_error: float = option(0.1, "Relative model error.", low=0.0, high=1.0)
    min_detected: int = option(
        2, "MIRI bands in which a source must be detected to count.", low=0, high=9
    )


@dataclasses.dataclass(frozen=True)
class FitSection(FitBasics):
    """The final fits, with and without MIRI."""

    sets: tuple[str, ...] = option(
        ("all", "none"),
        "Sets of the MIRI bands that are fitted with the existing ones.",
        choices=SETS,
    )
    experiments: tuple[str, ...] = option(
        (), "Further fits of each sample with all MIRI bands.", choices=EXPERIMENTS
    )


@dataclasses.dataclass(frozen=True)
class PointSourceSection:
    """The check with bright point sources on a grid."""

    enabled: bool = option(True, "Whether the check is made.")
    spacing: float = option(15.0, "Spacing of the grid in arcsec.", low=6.0, high=60.0)
    signal_to_noise: float = option(1000.0, "Approximate S/N of each.", low=20.0, high=1e5)


@dataclasses.dataclass(frozen=True)
class PerturbSection:
    """In what the sky differs from what the analysis takes it for: one more sky for each effect."""

    effects: tuple[str, ...] = option(
        (), "Effects; 'all' are those that the skies allow.", choices=(*EFFECTS, ALL), single=True
    )
    together: bool = option(True, "Whether one more sky has all of them.")
    of: tuple[float | str, ...] = option(
        (),
        "fracAGN of the skies that are perturbed, out of [sed] frac_agn; without any the first.",
        low=0.0,
        high=0.99,
        choices=(FIELD, CATALOG),
        single=True,
    )
    psf_width: float = option(0.02, "Relative width of the PSF, + or - by band.", low=0.0, high=0.2)
    flat: float = option(
        1.0,
        "Share of the flat field that is another detector's, pixel by pixel.",
        low=0.0,
        high=1.0,
    )
    gain: float = option(0.01, "Relative gain.", low=-0.2, high=0.2)
    linearity: float = option(0.01, "Relative signal near a full well.", low=-0.1, high=0.1)
    zero_point: float = option(
        0.02, "Relative flux of the MIRI bands, + or - by band.", low=0.0, high=0.5
    )
    zero_point_existing: float = option(
        0.02, "Relative flux of the existing bands, likewise.", low=0.0, high=0.5
    )
    astrometry: float = option(
        0.03, "Shift against the prior in arcsec, in a direction of each band.", low=0.0, high=1.0
    )
    clumps: float = option(
        0.2, "Share of the light of disks that is in made-up clumps.", low=0.0, high=0.9
    )
    cutouts: str = option(
        "",
        "Image (FITS, background subtracted) of the real galaxies whose light those of 'cutouts' have.",
    )
    cutouts_psf: str = option(
        "", "Its PSF (FILE[EXTENSION,PLANE] of a cube), if its filter has no model."
    )
    cutouts_of: str = option(
        "own",
        "own: the galaxy at the place of the source; any: a drawn one, scaled to its size.",
        choices=("own", "any"),
    )


@dataclasses.dataclass(frozen=True)
class VariantSection:
    """Further images of the first sky, by rates, to see what sets the limits of the fluxes."""

    images: tuple[str, ...] = option(
        (),
        "What they have otherwise, one thing at a time: the calculator's residual noise, the gradient of the "
        "background, the plane that is taken off before the mesh.",
        choices=(*VARIANTS, ALL),
        single=True,
    )


@dataclasses.dataclass(frozen=True)
class ReportSection:
    """The page at the end."""

    dpi: int = option(110, "Resolution of the figures.", low=40, high=400)
    pictures: int = option(
        5000,
        "Sources of a truth with pictures in the pages of sources: those fitted, then the brightest.",
        low=0,
    )
