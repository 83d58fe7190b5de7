"""
Sections of a run's configuration: every key with its default, its limits and what it means.

The sentence on a key is its comment in files of configurations and its entry in the reference.
"""

from pathlib import Path

from miricigale.filters import SURVEYS
from miricigale.instrument import CEERS_FILTERS, imager_filters
from miricigale.workflow.options import Section, option, require
from miricigale.workflow.truths import CATALOG, FIELD


class RunBasics(Section):
    """What runs and plans have in common."""

    name: str = option(
        "study", "Name of the run; its folder unless --output is given.", folder=True
    )
    seed: int = option(20210211, "Seed of every random draw.", low=0)
    threads: int = option(0, "Threads; 0 for as many as there are cores.", low=0, high=10000)


def memory_of(work):
    """Return the option of a run that limits the memory of pieces of its work."""
    text = f"Memory (GB) of {work} side by side on a machine; 0 for half of all."
    return option(0.0, text, low=0.0, high=1e5)


class RunSection(RunBasics):
    """What the run is called and how it goes."""

    memory: float = memory_of("steps")
    keep_level1b: bool = option(
        False,
        "Whether the level-1b (uncal) files are kept.",
    )


class CatalogSection(Section):
    """The real sources that are simulated."""

    source: str = option(
        "catalog.goodss",
        "Resource name or path of the catalog.",
    )
    columns: tuple[str, ...] = option(
        (),
        'Our names of its columns and the file\'s: "redshift=z_best", "wfc3.f160w=FLUX_H".',
    )
    units: tuple[str, ...] = option(
        (),
        'Units where the file gives none: "flux=mJy" for all fluxes, "flux=ABmag" for '
        'magnitudes, "ra=hourangle".',
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
        "",
        "Column of factors on all fluxes of a source, such as from an aperture to the total.",
    )
    mag_limit: float = option(26.6, "Faint limit in the magnitude column.", low=10.0, high=40.0)
    mag_column: str = option(
        "mag_f160w",
        "Column that the limit applies to; without it the flux of the high-resolution band counts.",
    )

    def __post_init__(self):
        for key in ("columns", "units"):
            pairs = getattr(self, key)
            for pair in pairs:
                parts = pair.split("=")
                good = len(parts) == 2 and all(parts)
                require(good, "catalog", key, "must have the form 'name=value'", list(pairs))


class PointingSection(Section):
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
        (),
        'Centers of several pointings in degrees, "RA Dec", instead of ra, dec and '
        "tiles; or a table of them with the columns ra and dec and, where these "
        "differ, roll, bands and time (s, all dithers); or the .pointing file of APT, "
        "of which the exposures of the full imager are used.",
        single=True,
    )

    def __post_init__(self):
        pair = len(self.tiles) == 2
        require(pair, "pointing", "tiles", "must be two numbers", list(self.tiles))
        good = not self.centers or self.tiles == (1, 1)
        require(good, "pointing", "tiles", "must be [1, 1] with centers", list(self.tiles))
        if self.table is None:
            for text in self.centers:
                wanted = "must have the form 'RA Dec' in degrees, or be a file"
                require(_is_position(text), "pointing", "centers", wanted, repr(text))

    @property
    def table(self):
        """Path of the table of pointings; None without one."""
        if len(self.centers) != 1:
            return None
        path = Path(self.centers[0]).expanduser()
        if path.is_file():
            return path
        return None


def _is_position(text):
    """Tell whether a text is right ascension and declination in degrees."""
    try:
        ra, dec = map(float, text.split())
    except ValueError:
        return False
    return 0 <= ra <= 360 and -90 <= dec <= 90


class SedSection(Section):
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
        (1.5, 2.5),
        "Range from which the dust's alpha is drawn where no band shows it.",
    )
    alpha_draw: str = option(
        "uniform",
        "How it is drawn: uniform, or nodes: from those of the fit's grid within the "
        "range, where best fits on that grid lie.",
        choices=("uniform", "nodes"),
    )
    frac_agn: tuple[float | str, ...] = option(
        (0.0,),
        "fracAGN of the injected sources, one simulated sky for each; the first gives "
        "the error functions. 'field' draws AGN from a luminosity function, 'catalog' "
        "takes its column frac_agn.",
        low=0.0,
        high=0.99,
        choices=(FIELD, CATALOG),
        single=True,
        unique=True,
    )
    infrared: str = option(
        "ceers",
        "Dust luminosity and colors: ceers draws those of real MIRI colors where no "
        "band of the fit shows the dust; fit keeps the energy balance of the fit; "
        "main-sequence has at least those of the star-forming main sequence.",
        choices=("ceers", "fit", "main-sequence"),
    )

    def __post_init__(self):
        good = len(self.alpha) == 2 and 0 < self.alpha[0] <= self.alpha[1] <= 4
        require(
            good, "sed", "alpha", "must be two numbers in order, above 0 to 4", list(self.alpha)
        )


class ExposureSection(Section):
    """What is exposed, and for how long."""

    filters: tuple[str, ...] = option(
        CEERS_FILTERS, "MIRI filters.", choices=imager_filters(), unique=True
    )
    plan: str = option("ceers", "Exposure plan.", choices=("ceers", "quick"))
    kind: str = option(
        "ramps",
        "ramps: every group is simulated; rates: slopes with the noise of the ramps, "
        "30 times faster.",
        choices=("ramps", "rates"),
    )
    n_groups: tuple[int, ...] = option(
        (), "Groups of each filter instead of the plan's.", low=1, high=10000
    )
    n_integrations: tuple[int, ...] = option(
        (), "Integrations of each filter, likewise.", low=1, high=10000
    )
    n_dithers: tuple[int, ...] = option((), "Dithers of each filter, likewise.", low=1, high=1000)
    dithers: tuple[str, ...] = option(
        (),
        "Where they are, for all filters or for each: a pattern's name, or a file of "
        "offsets (.pointing of APT, or a table with x_offset and y_offset). Without "
        "any the pattern is 'ceers'.",
        single=True,
    )
    dither_observation: int = option(
        0, "Observation of a .pointing file that has several; 0 for its only one.", low=0
    )
    dither_exposures: tuple[int, ...] = option(
        (),
        "Exposure of a .pointing file (column Exp) of each filter, where their dithers differ.",
        low=1,
    )


class SceneSection(Section):
    """The sky behind the sources."""

    background: tuple[str, ...] = option(
        ("low",),
        "Zodiacal light (low, medium, high) or surface brightness ('12.5 MJy/sr'); "
        "one for all filters, or one for each.",
        single=True,
    )
    background_of: str = option(
        "sky",
        "Of what names of zodiacal light are percentiles: the whole sky, or the days "
        "on which the pointing can be seen.",
        choices=("sky", "pointing"),
    )
    background_date: str = option(
        "",
        "Day, such as 2027-03-01, whose zodiacal light at the pointing is taken (needs zodipy).",
    )
    background_scale: float = option(1.0, "Factor on the background.", low=0.0, high=100.0)
    background_gradient: float = option(0.05, "Relative gradient per arcmin.", low=0.0, high=1.0)
    gradient_angle: float = option(
        45.0,
        "Position angle of the gradient in degrees.",
    )


class HighresSection(Section):
    """The high-resolution image that is the prior."""

    filter: str = option(
        "wfc3.f160w",
        "Its filter.",
    )
    pixel_scale: float = option(0.06, "Pixel scale in arcsec.", low=0.01, high=0.2)
    depth: float = option(27.6, "5-sigma AB depth of a point source.", low=20.0, high=35.0)


class DetectorSection(Section):
    """What the detector does to the light."""

    cosmic_rays: bool = option(
        True,
        "Whether cosmic rays hit.",
    )
    residual: float | str = option(
        0.0,
        "Fraction of the light that stays as a fixed pattern (flat, sky), or that of "
        "the exposure time calculator.",
        low=0.0,
        high=0.1,
        choices=("etc",),
    )


class ReductionSection(Section):
    """How ramps become mosaics."""

    backend: str = option(
        "native",
        "Who fits the ramps: own, or the steps of the official pipeline (jwst, to be installed).",
        choices=("native", "jwst"),
    )
    jump_threshold: float = option(5.0, "Jump detection threshold in sigma.", low=2.0, high=50.0)
    background: str = option(
        "masked",
        "Background: about masked sources, the plain mesh of sep, or that of the "
        "other dithers (three or more).",
        choices=("masked", "sep", "dithers"),
    )
    background_box: int = option(64, "Box of the background mesh in pixels.", low=8, high=512)
    background_filter: int = option(3, "Median filter of the mesh in cells.", low=1, high=15)
    background_plane: bool = option(
        True,
        "Whether a plane is taken off before the mesh.",
    )
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


class PatchesSection(Section):
    """Patches of the sky, for fields too large to be measured in one: each has mosaics, prior and photometry."""

    size: float = option(
        0.0, "Side of their cores in arcsec; 0 for the whole field in one.", low=0.0, high=3600.0
    )
    overlap: float = option(10.0, "Arcsec that each sees around its core.", low=1.0, high=120.0)
