"""A run of made-up products: what the stages after the photometry read."""

import itertools

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.table import QTable

from miricigale.instrument import north_up_wcs
from miricigale.psf import MatchingKernel
from miricigale.sed import SEDModel
from miricigale.workflow import Context
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.labels import end_bands
from miricigale.workflow.stage_list import study_stages
from miricigale.workflow.stages.exposures import study_exposures
from miricigale.workflow.stages.inputs import existing_bands, pieces
from miricigale.workflow.stages.truth import add_agn, add_field_agn
from miricigale.workflow.truths import CATALOG, FIELD, study_truths

STAGES = {stage.name: stage for stage in study_stages()}
CENTER = SkyCoord(53.13440 * u.deg, -27.83444 * u.deg)
SCALE = 0.11
#: Pixels of the made-up images, and the rim that is masked.
SHAPE, RIM = (130, 170), 15
AREA = 100 * 140 * SCALE**2 / 3600


def sky_image(scale, shape, data, *, rim=0):
    """A north-up image about the pointing of the default configuration."""
    wcs = north_up_wcs(CENTER, scale * u.arcsec, shape)
    mask = np.zeros(shape, bool)
    if rim:
        mask = np.ones(shape, bool)
        mask[rim:-rim, rim:-rim] = False
    return CCDData(data, wcs=wcs, mask=mask, unit="MJy/sr")


def noise_image(seed=0, *, rim=RIM, scale=SCALE, shape=SHAPE):
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape)
    light = 20 * np.exp(-((x - shape[1] / 2) ** 2 + (y - shape[0] / 2) ** 2) / 30)
    return sky_image(scale, shape, light + rng.normal(size=shape), rim=rim), light


def made_up_kernel(pixels=31):
    """A kernel between two Gaussians."""
    place = np.arange(pixels) - pixels // 2
    wide, sharp, kernel = (
        np.exp(-0.5 * (place[:, None] ** 2 + place**2) / width**2) / (2 * np.pi * width**2)
        for width in (3.0, 1.8, 2.4)
    )
    return MatchingKernel(kernel, 0.06 * u.arcsec, source=sharp, target=wide)


def save_exposure(made, name, unit):
    """Slopes and calibrated image of a small sub-array."""
    rng = np.random.default_rng(3)
    shape = (64, 72)
    rate = sky_image(SCALE, shape, 30 + rng.normal(size=shape))
    rate.unit = "adu / s"
    rate.meta.update(filter=name, subarray="SUB64", steps=["dark"])
    made.save_image(f"{unit}_rate.fits", rate)
    made.save_image(f"{unit}_cal.fits", sky_image(SCALE, shape, rng.normal(size=shape), rim=4))


def small_config(filters, *, points=False, frac_agn=(0.0,), sets=("all", "none"), skies=0):
    n = len(filters)
    return StudyConfig.from_dict(
        {
            "run": {"name": "made up"},
            "exposures": {
                "filters": filters,
                "n_groups": [7] * n,
                "n_integrations": [1] * n,
                "n_dithers": [1] * n,
            },
            "sed": {"axes": "quick", "frac_agn": frac_agn},
            "errors": {"bin_size": 8},
            "fit": {
                "bands": ["megacam.r", "wfc3.f160w", "irac.ch1"],
                "depths": [27.0, 27.0, 24.0],
                "axes": "quick",
                "min_detected": 1,
                "sets": sets,
                "skies": skies,
            },
            "point_sources": {"enabled": points},
            "report": {"dpi": 40},
        }
    )


def one_band(band, *, n_groups=7, n_integrations=1, kind="ramps", **sections):
    """A configuration of one exposure of one band."""
    exposures = {
        "filters": [band], "kind": kind, "n_groups": [n_groups], "n_integrations": [n_integrations],
        "n_dithers": [1],
    }  # fmt: skip
    return StudyConfig.from_dict({"exposures": exposures, "fit": {"min_detected": 1}, **sections})


def do_stage(config, folder, name, unit=""):
    STAGES[name].function(Context(config, folder, stage=STAGES[name], unit=unit), unit)


def make_run(folder, filters, *, mass=3e10, points=False, report=True, text_ids=False, **options):
    """Make up what the stage ``report`` reads, and run it unless it is not wanted."""
    config = small_config(filters, points=points, **options)
    made = Context(config, folder)
    rng = np.random.default_rng(1)
    count = 24
    step = rng.uniform([[-7.0], [-5.0]], [[7.0], [5.0]], size=(2, count)) * u.arcsec
    sky = CENTER.spherical_offsets_by(*step)
    parameters = QTable({"id": np.arange(1, count + 1), "redshift": np.linspace(0.3, 2.5, count)})
    if text_ids:
        parameters["id"] = [f"src-{key}" for key in parameters["id"]]
    parameters["mass"] = np.geomspace(mass, 10 * mass, count) * u.Msun
    made.save_image("f160w.fits", noise_image(9, rim=0)[0])
    catalog = QTable({"id": parameters["id"], "sky": sky, "star": np.zeros(count, bool)})
    catalog["redshift"] = parameters["redshift"]
    light = SEDModel.yang2021(agn=False).fluxes(parameters, ["wfc3.f160w"])
    catalog["wfc3.f160w"] = light["wfc3.f160w"]
    made.save_table("catalog.ecsv", catalog)
    for piece in pieces(count):
        do_stage(config, folder, "seds", piece)
    for name in filters:
        made.save_result(f"kernel_{name}.fits", made_up_kernel())
        bright = QTable({"flux_true": np.full(5, 100.0) * u.uJy})
        bright["flux"] = bright["flux_true"] * np.array([0.98, 0.99, 1.0, 1.01, 5.0])
        bright["in_field"] = np.ones(5, bool)
        bright.meta.update(f_scaling=0.9987, f_scaling_err=0.001, f_aper=1.14)
        bright["sky"] = sky[:5]
        made.save_table(f"points/{name}.ecsv", bright)
        if name in end_bands(filters):
            made.save_image(f"points/{name}_mosaic.fits", noise_image(5)[0])
    for one in study_truths(config).values():
        _save_truth(made, one, parameters, sky, rng)
    do_stage(config, folder, "errors")
    for name in study_truths(config):
        do_stage(config, folder, "matches", name)
        for unit in itertools.product([name], config.fit.sets, pieces(count)):
            do_stage(config, folder, "fits", "/".join(filter(None, unit)))
    for unit in STAGES["skies"].unit_names(config):
        do_stage(config, folder, "skies", unit)
    if report:
        do_stage(config, folder, "report")
    return folder / "report"


def _save_truth(made, one, parameters, sky, rng):
    """The products of one truth: its sources, exposures, mosaics and photometry."""
    config, filters, count = made.config, made.config.exposures.filters, len(parameters)
    parameters = parameters.copy()
    if one.frac_agn == FIELD:
        add_field_agn(parameters, SEDModel.yang2021(), filters[0], 1)
    elif one.frac_agn == CATALOG:
        add_agn(parameters, np.linspace(0, 0.9, count), 1)
    elif one.frac_agn > 0:
        add_agn(parameters, one.frac_agn, 1)
    bands = [*existing_bands(config), *filters]
    truth = SEDModel.yang2021(agn=one.frac_agn != 0).fluxes(parameters, bands)
    truth["sky"], truth["star"] = sky, np.zeros(count, bool)
    truth["profile"], truth["sersic_index"] = "sersic", np.linspace(0.5, 4, count)
    truth["frac_agn"] = np.zeros(count)
    for name in parameters.colnames:
        truth[name] = parameters[name]
    truth.meta.clear()
    truth.meta.update(version="1.2", citations=["Somebody 2001", "Somebody 2001, with page"])
    made.save_table(f"{one.name}/truth.ecsv", truth)
    for unit, exposure in study_exposures(config).items():
        table = QTable({"sky_fraction": [0.31], "n_pixels": [4]})
        made.save_table(f"{one.name}/exposures/{unit}_forecast.ecsv", table)
        save_exposure(made, exposure.filter, f"{one.name}/exposures/{unit}")
    for k, name in enumerate(filters):
        image, light = noise_image(k)
        model = sky_image(SCALE, SHAPE, light)
        seen = np.ones(image.shape, np.uint8)
        made.save_image(f"{one.name}/mosaic_{name}.fits", image, n_images=seen)
        made.save_image(f"{one.name}/photometry/{name}_model.fits", model)
        residual = sky_image(SCALE, SHAPE, image.data - light, rim=RIM)
        made.save_image(f"{one.name}/photometry/{name}_residual.fits", residual)
        # one more than there are sources, which no source is near; the first is at the edge
        table = QTable({"id": np.arange(1, count + 2), "sky": _with_one_more(sky)})
        flux = np.append(truth[name].value + rng.normal(0, 0.2, count), 5.0)
        table["flux"] = flux * u.uJy
        table["flux_err"] = np.full(count + 1, 0.2) * u.uJy
        table["flags"] = np.append(1, np.zeros(count, int))
        made.save_table(f"{one.name}/photometry/{name}.ecsv", table)


def thicker_half(folder, name, n):
    """Let the left half of a mosaic of `make_run` have ``n`` exposures; the numbers of all pixels."""
    made = Context(small_config([name]), folder)
    image = made.image(f"agn00/mosaic_{name}.fits")
    n_images = np.ones(image.shape, np.uint8)
    n_images[:, : image.shape[1] // 2] = n
    made.save_image(f"agn00/mosaic_{name}.fits", image, n_images=n_images)
    return n_images


def _with_one_more(sky):
    far = CENTER.spherical_offsets_by(0 * u.arcsec, 5.4 * u.arcsec)
    return SkyCoord([*sky.ra.deg, far.ra.deg] * u.deg, [*sky.dec.deg, far.dec.deg] * u.deg)
