"""Patches of a study: they tile the field, see what the whole sees, and measure the same."""

import shutil

import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.figures import no_pictures
from miricigale.instrument.image_files import read_image
from miricigale.workflow import load_config, run_study
from miricigale.workflow.stage_list import study_stages
from miricigale.workflow.stages.exposures import study_exposures
from miricigale.workflow.stages.grids import (
    by_patch,
    grid_of,
    patch_exposures,
    patch_grid,
    shown_patch,
    study_patches,
)
from miricigale.workflow.stages.images import patch_noise

FINE, NATIVE = 0.06, 0.11
#: Side of the cores (arcsec) of the study that is run.
SIZE, BAND = 70.0, "miri.f770w"


def config_of(size, *bands, **sections):
    """One pointing as rates, once in each band."""
    bands = bands or ("miri.f770w", "miri.f1500w")
    each = {
        key: [n] * len(bands)
        for key, n in (("n_groups", 12), ("n_integrations", 1), ("n_dithers", 1))
    }
    exposures = {"filters": bands, "kind": "rates", **each}
    values = {
        "catalog": {"mag_limit": 23.0},
        "photometry": {"threshold": 1.0, "n_pixels": 20},
        "patches": {"size": size},
        "exposures": exposures,
        "sed": {"axes": "quick"},
        "fit": {"axes": "quick", "min_detected": 1},
        "point_sources": {"enabled": False},
        "report": {"pictures": 5, "dpi": 40},
    }
    return load_config("goodss", overrides=values | sections)


def run_config(size=SIZE):
    """The study that is run, whole by a size of 0; with pixels of the prior that are not the finest."""
    return config_of(size, BAND, highres={"pixel_scale": 0.09})


@pytest.fixture(scope="module")
def tiled():
    return config_of(40.0, pointing={"tiles": [2, 1], "overlap": 0.1})


def test_each_pixel_of_an_exposure_is_in_one_core(tiled):
    grid, patches = patch_grid(tiled), study_patches(tiled)
    whole, n_seen = grid_of(tiled, FINE), {name: set() for name in patches}
    for name, exposure in study_exposures(tiled).items():
        y, x = np.mgrid[0 : exposure.shape[0] : 16, 0 : exposure.shape[1] : 16]
        xy = np.transpose(
            whole.all_world2pix(*exposure.wcs.all_pix2world(x.ravel(), y.ravel(), 0), 0)
        )
        for core in np.unique(grid.holder(xy)):
            n_seen[grid.names[core]].add(name)
    for name, patch in patches.items():
        # the exposures of the core are among those of the patch, and give its bands
        assert n_seen[name] <= set(patch.exposures)
        assert {study_exposures(tiled)[one].filter for one in n_seen[name]} <= set(patch.bands)
        assert list(patch_exposures(tiled, "miri.f1500w", name)) == [
            one for one in patch.exposures if one.startswith("miri.f1500w")
        ]


@pytest.mark.parametrize("scale", [FINE, NATIVE])
def test_pixels_are_those_of_the_whole_grid(tiled, scale):
    whole, name = grid_of(tiled, scale), shown_patch(tiled)
    part, core = grid_of(tiled, scale, name), patch_grid(tiled).size * FINE
    nx, ny = part.pixel_shape
    # at an edge of the field there is less around the core
    for n in (nx, ny):
        assert core + 10.0 - 2 * scale <= n * scale <= core + 20.0 + 2 * (scale + FINE)
    x, y = np.array([0, nx - 1, 5]), np.array([0, ny - 1, 9])
    first = whole.world_to_pixel(part.pixel_to_world(x, y))
    shift = np.subtract(first, (x, y))
    assert_allclose(shift, np.rint(shift[:, :1]) * [[1, 1, 1]], atol=1e-6)


def test_noise_of_patches_is_one_image(tiled):
    boxes = {name: patch.box for name, patch in study_patches(tiled).items()}
    one, other = list(boxes)[:2]
    noise = {name: patch_noise(tiled, name, 7) for name in (one, other)}
    low, high = boxes[other][1].start, boxes[one][1].stop
    assert high - low > 300
    left = noise[one][:, low - boxes[one][1].start :]
    assert_array_equal(left, noise[other][:, : high - low])
    assert_allclose([left.mean(), left.std()], [0, 1], atol=5 / np.sqrt(left.size))
    # rows do not repeat each other
    flat = noise[one][:500, :500].ravel(), noise[one][100:600, :500].ravel()
    assert abs(np.corrcoef(*flat)[0, 1]) < 0.02


def test_positions_belong_to_one_patch(tiled):
    wcs = grid_of(tiled, FINE)
    rng = np.random.default_rng(2)
    nx, ny = wcs.pixel_shape
    xy = rng.uniform(0, (nx, ny), (500, 2))
    found = by_patch(tiled, wcs.pixel_to_world(*xy.T))
    rows = np.concatenate([rows for _, rows in found])
    assert len(set(rows.tolist())) == len(rows)
    size = patch_grid(tiled).size
    for name, own in found:
        assert_array_equal(
            np.floor((xy[own] + 0.5) / size)[:, ::-1], [(int(name[1:3]), int(name[4:6]))] * len(own)
        )


@pytest.mark.parametrize(
    ("sections", "named"),
    [
        ({"photometry": {"rivals": True}}, "photometry.*rivals"),
        ({"photometry": {"method": "yang2021"}}, "photometry.*method"),
        ({"variants": {"images": "all"}}, "variants.*images"),
        ({"patches": {"size": 5.0, "overlap": 10.0}}, "patches.*size"),
    ],
)
def test_what_needs_the_whole_field_is_refused(sections, named):
    with pytest.raises(ValueError, match=named):
        config_of(40.0, **sections)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same study whole and in patches; catalog, SEDs, truth and exposures are the same."""
    folders = {size: tmp_path_factory.mktemp("study") / "run" for size in (0.0, SIZE)}
    whole = run_study(run_config(0.0), folders[0.0], until="matches").parent.parent
    shutil.copytree(whole, folders[SIZE])
    before = (folders[SIZE] / "agn00/exposures/miri.f770w-0_cal.fits").stat().st_mtime_ns
    with no_pictures():
        run_study(run_config(), folders[SIZE], redo=True)
    after = (folders[SIZE] / "agn00/exposures/miri.f770w-0_cal.fits").stat().st_mtime_ns
    assert before == after
    return folders[0.0], folders[SIZE]


@pytest.mark.slow
def test_patches_measure_what_the_whole_field_does(runs):
    tables = [QTable.read(folder / "agn00/matched.ecsv") for folder in runs]
    flux, error, seen = (
        np.array([np.asarray(table[name]) for table in tables])
        for name in (BAND, f"{BAND}_formal_err", f"{BAND}_time")
    )
    # detected in both, but for sources at the limit of the prior
    known = np.isfinite(flux).all(axis=0)
    assert np.count_nonzero(np.isfinite(flux).any(axis=0) & ~known) <= 0.1 * known.sum()
    assert known.sum() > 30
    # the noise of the prior is another, hence shapes and blends
    apart = np.abs(flux[0] - flux[1])[known] / np.hypot(*error[:, known])
    assert np.median(apart) < 0.15
    assert np.quantile(apart, 0.9) < 1.0
    assert_allclose(seen[0], seen[1], atol=0.35 * seen.max())
    assert_allclose(np.median(error[1, known] / error[0, known]), 1.0, atol=0.03)


@pytest.mark.slow
def test_mosaics_of_patches_are_parts_of_the_whole(runs):
    config = run_config()
    whole = grid_of(config, NATIVE)
    full = read_image(runs[0] / f"agn00/mosaic_{BAND}.fits")
    name = shown_patch(config)
    part = read_image(runs[1] / f"agn00/mosaic_{BAND}_{name}.fits")
    x, y = (int(np.rint(v)) for v in whole.world_to_pixel(part.wcs.pixel_to_world(0, 0)))
    ny, nx = part.shape
    cut = full.data[y : y + ny, x : x + nx]
    both = np.isfinite(cut) & np.isfinite(part.data) & ~part.mask
    difference, error = (part.data - cut)[both], part.uncertainty.array[both]
    # the second pass of the background is that of the patch
    assert both.mean() > 0.3
    assert np.std(difference / error) < 0.1


def test_the_page_says_which_patch_it_shows(runs):
    page = (runs[1] / "report/index.html").read_text()
    assert f"the images are of patch {shown_patch(run_config())}" in page
    every = QTable.read(runs[1] / "detections.ecsv")
    assert len(set(every["id"].tolist())) == len(every)
    patches = set(np.asarray(every["patch"]).tolist())
    assert patches == set(study_patches(run_config()))


def test_a_patch_reads_its_own_exposures_only():
    config = config_of(30.0, pointing={"tiles": [2, 1], "overlap": 0.0})
    stages = {one.name: one for one in study_stages()}
    from miricigale.workflow.engine.stage import Units

    units = {name: Units(one.unit_names(config)) for name, one in stages.items()}
    last = list(study_patches(config))[-1]
    needed = stages["mosaics"].needed(config, f"agn00/miri.f770w/{last}", units)["exposures"]
    assert 0 < len(needed) < len(study_exposures(config)) / 2
