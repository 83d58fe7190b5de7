"""Sections of a study's configuration on what is done with the images: photometry, errors, fits, checks, page."""

from miricigale.photometry import YANG2021_DEPTHS
from miricigale.workflow.options import Section, option, require
from miricigale.workflow.truths import ALL, CATALOG, EFFECTS, EXPERIMENTS, FIELD, SETS, VARIANTS


class PhotometrySection(Section):
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
    regularization: float | str = option(
        "auto",
        "Regularization of the matching kernels: a number, auto, or yang2021 (0.03).",
        low=1e-6,
        choices=("auto", "yang2021"),
    )
    match_radius: float = option(
        0.5, "Radius of the match to the truth in arcsec.", low=0.05, high=3.0
    )
    rivals: bool = option(
        False,
        "Whether the first sky is measured by the other method and as by Source Extractor too.",
    )


class ErrorSection(Section):
    """How the error function is made."""

    statistic: str = option("mad", "Scatter statistic.", choices=("mad", "median_abs"))
    bin_size: int = option(30, "Sources per bin.", low=5, high=1000)
    coverage: bool = option(
        True,
        "Whether errors follow the exposure time at each source; otherwise the flux alone.",
    )


class FitBasics(Section):
    """The fits."""

    bands: tuple[str, ...] = option(
        tuple(YANG2021_DEPTHS),
        "Existing bands.",
    )
    depths: tuple[float, ...] = option(
        tuple(YANG2021_DEPTHS.values()), "Their 5-sigma AB depths.", low=10.0, high=40.0
    )
    axes: str = option("fit", "Grid of the fit.", choices=("fit", "quick"))
    model_error: float = option(0.1, "Relative model error.", low=0.0, high=1.0)
    min_detected: int = option(
        2, "MIRI bands in which a source must be detected to count.", low=0, high=9
    )
    dust_excess: tuple[float, ...] = option(
        (0.25, 1.0, 2.5),
        "Dust luminosities of the grid over what attenuation takes. Without any there "
        "is energy balance, as in the paper; real galaxies do not keep it (``[sed] "
        'infrared = "ceers"``).',
        low=0.001,
        high=1000.0,
    )

    def __post_init__(self):
        n = len(self.bands)
        wanted = f"must have one number per band ({n})"
        require(len(self.depths) in (0, n), "fit", "depths", wanted, len(self.depths))


class FitSection(FitBasics):
    """The final fits, with and without MIRI."""

    bands: tuple[str, ...] = option(
        (),
        "Existing bands: by default all of the catalog that are not simulated, and of "
        "the bundled catalogs those of Yang et al. 2021.",
    )
    depths: tuple[float, ...] = option(
        (),
        "Their 5-sigma AB depths; without any each source has the errors of the "
        "catalog, and no flux where it has none.",
        low=10.0,
        high=40.0,
    )
    min_redshift: float = option(
        0.0,
        "Least redshift, by the catalog, of the sources that count. Those that this "
        "and the next three leave out keep their light in the images, but are in no "
        "fit and no share.",
        low=0.0,
        high=10.0,
    )
    min_mass: float = option(
        0.0, "Least stellar mass (Msun) by the input fit, likewise.", low=0.0, high=1e13
    )
    max_chi2: float = option(
        0.0, "Largest reduced chi2 of the input fit, likewise; 0 for any.", low=0.0, high=1e4
    )
    redshift_quality: tuple[str, ...] = option(
        (),
        "What columns of the catalog must say of a redshift, likewise: "
        '"redshift_source=spec", "q_z<=3".',
        single=True,
    )
    sets: tuple[str, ...] = option(
        ("all", "none"),
        "Sets of the MIRI bands that are fitted with the existing ones.",
        choices=SETS,
        unique=True,
    )
    experiments: tuple[str, ...] = option(
        (), "Further fits of each sample with all MIRI bands.", choices=EXPERIMENTS, unique=True
    )
    skies: int = option(
        200,
        "Skies of a truth 'field' whose AGN are drawn and fitted without images, for "
        "purity and completeness.",
        low=0,
        high=10000,
    )


class PointSourceSection(Section):
    """The check with bright point sources on a grid."""

    enabled: bool = option(
        True,
        "Whether the check is made.",
    )
    spacing: float = option(15.0, "Spacing of the grid in arcsec.", low=6.0, high=60.0)
    signal_to_noise: float = option(1000.0, "Approximate S/N of each.", low=20.0, high=1e5)


class PerturbSection(Section):
    """In what the sky differs from what the analysis takes it for: one more sky for each effect."""

    effects: tuple[str, ...] = option(
        (),
        "Effects; 'all' are those that the skies allow.",
        choices=EFFECTS + (ALL,),
        single=True,
        unique=True,
    )
    together: bool = option(
        True,
        "Whether one more sky has all of them.",
    )
    of: tuple[float | str, ...] = option(
        (),
        "fracAGN of the skies that are perturbed, out of [sed] frac_agn; without any the first.",
        low=0.0,
        high=0.99,
        choices=(FIELD, CATALOG),
        single=True,
        unique=True,
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
        "Image (FITS, background subtracted) of the real galaxies whose light those "
        "of 'cutouts' have.",
    )
    cutouts_psf: str = option(
        "",
        "Its PSF (FILE[EXTENSION,PLANE] of a cube), if its filter has no model.",
    )
    cutouts_of: str = option(
        "own",
        "own: the galaxy at the place of the source; any: a drawn one, scaled to its size.",
        choices=("own", "any"),
    )


class VariantSection(Section):
    """Further images of the first sky, by rates, to see what sets the limits of the fluxes."""

    images: tuple[str, ...] = option(
        (),
        "What they have otherwise, one thing at a time: the calculator's residual "
        "noise, the gradient of the background, the plane that is taken off before "
        "the mesh.",
        choices=(*VARIANTS, ALL),
        single=True,
        unique=True,
    )


class ReportSection(Section):
    """The page at the end."""

    dpi: int = option(110, "Resolution of the figures.", low=40, high=400)
    pictures: int = option(
        5000,
        "Sources of a truth with pictures in the pages of sources: those fitted, then "
        "the brightest.",
        low=0,
    )
