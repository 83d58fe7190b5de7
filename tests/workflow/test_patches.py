"""Photometry in patches: the same sources and fluxes as of whole images, resumed to the same bytes."""

import os
import signal
import subprocess
import sys
import time
import types
from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.mosaics import CENTER, FINE, HI, LO, disks, kernel, lattice, places, render
from miricigale.cli import main
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.instrument.image_files import read_image
from miricigale.photometry import ForcedFlags, MosaicFile, measure_files
from miricigale.photometry.commands.patches import PatchGrid, own_rows
from miricigale.workflow import measure_patches

BAND, OTHER = "irac.ch4", "irac.ch3"


@pytest.fixture(scope="module")
def mosaics(tmp_path_factory):
    """Points of known flux on a prior, and on a turned image that reaches beyond it on one side."""
    folder = tmp_path_factory.mktemp("mosaics")
    rng = np.random.default_rng(5)
    sky = places(*lattice(rng, 9, 4.2, 1.0))
    flux = 10 ** rng.uniform(0, 1.5, len(sky))
    grids = {
        "prior": (north_up_wcs(CENTER, FINE * u.arcsec, (700, 700)), (700, 700), HI, 0.002),
        "image": (north_up_wcs(places(-6.0), 0.11 * u.arcsec, (420, 430)), (420, 430), LO, 0.005),
    }
    # another band, of a corner alone
    grids["corner"] = north_up_wcs(places(8.0, 8.0), 0.11 * u.arcsec, (90, 90)), (90, 90), LO, 0.005
    grids["image"][0].wcs.pc = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    for name, (wcs, shape, width, noise) in grids.items():
        each = pixel_area_map(wcs, shape) * 1e12
        data = render(sky, flux, width, wcs, shape) * each
        header = wcs.to_header()
        header.update(BUNIT="uJy", FILTER="F430M", INSTRUME="NIRCAM" if name == "prior" else "")
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.float32(data), header, name="SCI")]
        hdus.append(fits.ImageHDU(np.full(shape, np.float32(noise)), header, name="ERR"))
        for kind in ("exact", "noisy"):
            fits.HDUList(hdus).writeto(folder / f"{name}-{kind}.fits")
            hdus[1].data = np.float32(data + rng.normal(0, noise, shape))
    kernel.write(folder / "kernel.fits")
    prior = grids["prior"][0]
    labels = disks(sky, prior, (700, 700), 8, 1000 + 3 * np.arange(len(sky)))
    fits.PrimaryHDU(labels, prior.to_header()).writeto(folder / "segments.fits")

    def files(kind):
        image = MosaicFile(folder / f"image-{kind}.fits", filter=BAND)
        return image, folder / f"prior-{kind}.fits"

    return types.SimpleNamespace(folder=folder, sky=sky, files=files)


def test_each_position_is_in_one_core_and_lines_stay_where_they_are():
    def image(shift):
        wcs = north_up_wcs(CENTER, 0.1 * u.arcsec, (450, 610))
        wcs.wcs.crpix += [shift, 0]
        return types.SimpleNamespace(wcs=wcs, shape=(450, 610))

    grid, wider = (PatchGrid.over(image(0), one, 200, 50) for one in ([], [image(130)]))
    assert (grid.shape, wider.shape, wider.first) == ((3, 4), (3, 5), (0, -1))
    xy = np.random.default_rng(1).uniform(-0.5, 449.5, (1000, 2))
    xy[:4] = [[199.5, 199.5], [199.49, 199.5], [-0.5, 0], [399.5, 449.49]]
    assert_array_equal(np.sum([grid.is_near(k, xy, 0.0) for k in range(12)], axis=0), 1)
    assert_array_equal(grid.holder(xy[:4]), [5, 4, 0, 10])
    # the same lines, whatever the images are
    names = [[one.names[k] for k in one.holder(xy)] for one in (grid, wider)]
    assert all(a[:3] == b[:3] and int(b[4:]) == int(a[4:]) + 1 for a, b in zip(*names, strict=True))
    y, x = grid.box(5)
    assert (y.start, y.stop, x.start, x.stop) == (150, 450, 150, 450)


def test_a_source_on_a_line_is_there_once_however_patches_see_it():
    grid = PatchGrid(100, 20, (0, 0), (2, 2))
    # in both cores or in none, at a corner of four, two near each other, and one that one patch alone sees
    seen = [
        (0, 99.4, 30), (1, 99.6, 30), (0, 99.6, 60), (1, 99.4, 60), (0, 99.4, 99.4), (1, 99.6, 99.4),
        (2, 99.4, 99.6), (3, 99.6, 99.6), (0, 98.0, 10), (0, 101.0, 10), (1, 98.1, 10), (1, 101.1, 10),
        (0, 101.0, 80),
    ]  # fmt: skip
    patch, xy = np.array([one[0] for one in seen]), np.array([one[1:] for one in seen])
    kept = own_rows(patch, grid, xy)
    assert_array_equal(np.flatnonzero(kept), [0, 2, 4, 8, 11])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*noise on the sky is")
@pytest.mark.parametrize("given", ["detection", "segments", "catalog"])
def test_patches_have_the_sources_and_fluxes_of_the_whole(mosaics, tmp_path, given):
    # what does not depend on what else is in the patch
    more = {"kernel": [mosaics.folder / "kernel.fits"] * 2, "second_pass": False}
    more |= {"template": "psf", "background_order": None}
    image, prior = mosaics.files("exact")
    images = [image, MosaicFile(mosaics.folder / "corner-exact.fits", filter=OTHER)]
    if given == "segments":
        more["segmentation"] = mosaics.folder / "segments.fits"
    if given == "catalog":
        # as it comes: one without a position, one far off, one on the image beyond the prior
        beyond, order = places(-24.0), np.random.default_rng(3).permutation(len(mosaics.sky) + 3)
        ids = np.append(100 + np.arange(len(mosaics.sky)), [7, 9, 8])
        ra = np.append(mosaics.sky.ra.deg, [np.nan, 10.0, beyond.ra.deg])
        dec = np.append(mosaics.sky.dec.deg, [0.0, 10.0, beyond.dec.deg])
        more["catalog"] = tmp_path / "catalog.fits"
        QTable({"id": ids[order], "ra": ra[order], "dec": dec[order]}).write(more["catalog"])
    whole = measure_files(images, prior, **more)
    patches = {"patch_size": 250, "overlap": 4 * u.arcsec, "pages": False, **more}
    found = measure_patches(images, prior, tmp_path / "run", **patches)
    if given == "catalog":
        assert_array_equal(found["id"], ids[order])
        lost = np.isin(found["id"], [7, 9])
        assert_array_equal(found[f"{BAND}_flags"][lost] & int(ForcedFlags.NO_DATA) != 0, True)
        assert set(found["patch"][lost]) == {"none"}
        assert np.isfinite(found[BAND][found["id"] == 8])
        found, whole = found[~lost], whole[~np.isin(whole["id"], [7, 9])]
    elif given == "segments":
        assert_array_equal(np.sort(found["id"]), np.sort(whole["id"]))
    assert len(found) == len(whole) == 81 + (given == "catalog")
    index, apart, _ = whole["sky"].match_to_catalog_sky(found["sky"])
    assert len(set(index)) == len(whole)
    assert apart.max() < 1 * u.mas
    # light from beyond the overlap
    for band, n in ((BAND, 79), (OTHER, 3)):
        bright = whole[band] > 0.5 * u.uJy
        assert bright.sum() >= n
        assert_allclose(found[band][index][bright], whole[band][bright], rtol=1e-3)
        assert_array_equal(np.isnan(found[band][index]), np.isnan(whole[band]))
    assert len(set(found["patch"])) >= 9


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*noise on the sky is", "ignore:.*segments that reach beyond")
def test_a_segment_larger_than_the_overlap_is_there_once_and_flagged(mosaics, tmp_path):
    """Three points and what is between them, as one galaxy that no patch of a small overlap sees whole."""
    image, prior = mosaics.files("noisy")
    labels, header = fits.getdata(mosaics.folder / "segments.fits", header=True)
    x, y = north_up_wcs(CENTER, FINE * u.arcsec, (700, 700)).world_to_pixel(mosaics.sky)
    left, right = (np.argmin(np.hypot(x - at, y - 350)) for at in (210, 350))
    rows = np.sort(np.rint([y[left], y[right]]).astype(int)) + [-9, 10]
    part = labels[slice(*rows), int(x[left]) - 8 : int(x[right]) + 9]
    lost = np.unique(part[part > 0])
    part[:] = 999
    labels[np.isin(labels, lost)] = 0
    path = tmp_path / "segments.fits"
    fits.PrimaryHDU(labels, header).writeto(path)
    more = {"kernel": [mosaics.folder / "kernel.fits"], "second_pass": False, "segmentation": path}
    more |= {"template": "cutout", "background_order": None, "pages": False, "patch_size": 250}
    # profiles beyond the segments change nothing of what is cut
    more["wings"] = False
    found = measure_patches(image, prior, tmp_path / "small", overlap=1 * u.arcsec, **more)
    assert_array_equal(np.sort(found["id"]), np.unique(labels[labels > 0]))
    cut = found[f"{BAND}_flags"] & int(ForcedFlags.CUT) > 0
    assert_array_equal(found["id"][cut], [999])
    whole = measure_patches(image, prior, tmp_path / "large", overlap=10 * u.arcsec, **more)
    assert not np.any(whole[f"{BAND}_flags"] & int(ForcedFlags.CUT))
    flux = whole[BAND][whole["id"] == 999]
    assert found[BAND][cut] < 0.9 * flux


SCRIPT = f"""
import sys, pathlib
import astropy.units as u
from miricigale.photometry import MosaicFile
from miricigale.utils.parallel import process_pool
from miricigale.workflow import measure_patches
run, folder = sys.argv[1], pathlib.Path(sys.argv[2])
image = MosaicFile(folder / "image-noisy.fits", filter={BAND!r})
with process_pool(2) as executor:
    measure_patches(image, folder / "prior-noisy.fits", run, kernel=folder / "kernel.fits",
                    patch_size=360, overlap=4 * u.arcsec, pages=False, executor=executor, n_threads=2)
"""


@pytest.mark.slow
def test_killed_and_resumed_on_any_workers_to_the_same_bytes(mosaics, tmp_path):
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "killed"), mosaics.folder]
    run = subprocess.Popen(command, start_new_session=True)
    patches = tmp_path / "killed" / "patches"
    while run.poll() is None and len(list(patches.glob("y*.ecsv"))) < 2:
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL
    assert not (tmp_path / "killed" / "table.fits").exists()
    files, kernel_file = mosaics.files("noisy"), mosaics.folder / "kernel.fits"
    options = {"patch_size": 360, "overlap": 4 * u.arcsec, "kernel": kernel_file, "pages": False}
    measure_patches(*files, tmp_path / "killed", n_threads=1, **options)
    with ThreadPoolExecutor(2) as executor:
        measure_patches(*files, tmp_path / "threads", executor=executor, n_threads=2, **options)
    made = [
        {path.name: path.read_bytes() for kind in ("*.fits", "*/*.ecsv") for path in run.glob(kind)}
        for run in (tmp_path / "killed", tmp_path / "threads")
    ]
    assert len(made[0]) >= 5
    assert made[0] == made[1]


@pytest.mark.slow
def test_the_command_refuses_what_is_beyond_the_memory_and_measures_it_in_patches(
    mosaics, tmp_path, monkeypatch, capsys
):
    image, prior = mosaics.files("noisy")
    output, run = tmp_path / "a.ecsv", tmp_path / "run"
    given = ["photometry", str(image.path), str(prior), "--filter", BAND, "--no-progress"]
    given += ["--kernel", str(mosaics.folder / "kernel.fits"), "-o", str(output)]
    with monkeypatch.context() as small:
        small.setattr("miricigale.utils.parallel.available_memory", lambda: 100_000_000)
        assert main(given) == 2
    assert "--patches FOLDER" in capsys.readouterr().err
    for one in (["--redo"], ["--overlap", "5"], ["--patch-size", "300"]):
        assert main([*given, *one]) == 2
        assert f"{one[0]} must be left out without --patches" in capsys.readouterr().err
    given += ["--patches", str(run), "--threads", "1"]
    assert main([*given, "--page", "a.html"]) == 2
    assert "left out with --patches" in capsys.readouterr().err
    # the whole of this prior takes less than 2 GB
    assert main(given) == 0
    assert f"sources in {output}; page: {run / 'index.html'}" in capsys.readouterr().out
    assert set(QTable.read(output)["patch"]) == {"y00x00"}
    assert "patches/y00x00.html" in (run / "index.html").read_text()
    assert "Forced photometry" in (run / "patches" / "y00x00.html").read_text()
    # rounded far below the noise
    parts = [read_image(*(run / "patches").glob(f"*_{one}.fits")) for one in ("model", "residual")]
    whole, good = image.read(), ~parts[1].mask
    assert good.mean() > 0.5
    noise = np.median(whole.uncertainty.array[good])
    assert_allclose(sum(one.data for one in parts)[good], whole.data[good], atol=0.05 * noise)
    assert main([*given, "--overwrite", "--confidence", "0.9"]) == 2
    assert "--redo to replace it" in capsys.readouterr().err
