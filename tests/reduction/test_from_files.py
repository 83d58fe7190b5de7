"""Files at several stages and of two filters to mosaics, from the command line."""

import shutil

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.exposures import exposure_of, sky_of
from miricigale.cli import main
from miricigale.detector import Detector, Ramp
from miricigale.instrument import background_level
from miricigale.reduction import (
    BackgroundSettings,
    Reducer,
    ReferenceFiles,
    read_images,
    reduce_files,
    write_image,
)
from miricigale.reduction.images.images import sigma
from miricigale.reduction.images.repeats import ExposureRecord
from miricigale.utils.exceptions import MiricigaleWarning


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Three dithers of F770W, one a rate; one of F1000W; and a file that is none."""
    folder = tmp_path_factory.mktemp("exposures")
    paths = []
    for name, n_dithers in (("miri.f770w", 3), ("miri.f1000w", 1)):
        for dither in range(n_dithers):
            pointing = SkyCoord(53.1344 + 1e-4 * dither, -27.8344, unit="deg")
            options = {"n_groups": 10, "subarray": "SUB64", "dither": dither}
            exposure = exposure_of(name, pointing=pointing, **options)
            light = np.full(exposure.shape, background_level(name).value)
            light[30:33, 40:43] += 500
            ramp = Detector.miri_imager().expose(sky_of(exposure, light), exposure, seed=1)
            stem = f"{name[5:]}_{dither}"
            if dither == 1:
                rate = Reducer().fit_ramp(ramp)
                paths.append(write_image(rate, folder / f"{stem}_rate.fits"))
            else:
                paths.append(ramp.write(folder / f"{stem}_uncal.fits"))
    broken = folder / "broken_uncal.fits"
    broken.write_bytes(paths[0].read_bytes()[:30000])
    return [*paths, broken]


def level_of(file):
    """What was exposed, of a mosaic."""
    return file.image.data + file.planes["BKG"]


@pytest.mark.pictures
@pytest.mark.slow
def test_all_stages_and_filters_in_one_go(files, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["reduce", *map(str, files), "-o", str(out), "--no-progress"]
    # the broken file is told, and the others are there
    assert main(arguments) == 1
    assert "broken_uncal.fits" in capsys.readouterr().out
    table = Table.read(out / "files.ecsv")
    assert list(table["status"]) == ["reduced"] * 4 + ["failed"] + ["reduced"] * 2
    assert "truncated" in table["reason"][4]
    assert table["reason"][5].startswith("a single dither: outliers cannot be rejected")
    assert table["reason"][6] in ("", None, np.ma.masked)
    page = (out / "index.html").read_text()
    assert "broken_uncal.fits" in page
    assert page.count("<img") == 2

    # the mosaic is that of the classes
    (file,) = read_images(out / "mosaic_f770w.fits")
    result = Reducer().run(files[:3])
    assert_allclose(file.image.data, result.mosaic.data, rtol=1e-5, atol=1e-5)
    assert_array_equal(file.planes["CON"][0], result.n_images)
    assert_allclose(file.planes["WHT"], result.weight, rtol=1e-6)
    assert_allclose(file.planes["BKG"], result.subtracted, rtol=1e-5)
    # the parts of the variance, as the pipeline has them, make up the errors; a rate has none here
    assert "VAR_POISSON" not in file.planes
    (other,) = read_images(out / "mosaic_f1000w.fits")
    parts, error = other.planes["VAR_POISSON"] + other.planes["VAR_RNOISE"], sigma(other.image)
    assert_allclose(parts[~other.image.mask], error[~other.image.mask] ** 2, rtol=1e-3)
    # levels stand on the page with their errors
    level, error = (file.image.meta[key][0] for key in ("background", "background_error"))
    assert f"{level:.4g} ± {error:.1g}" in page
    # with what was subtracted it is the mosaic of what was exposed, however much that is
    left = tmp_path / "left"
    assert main([*arguments[:-2], str(left), "--background", "none", "--no-progress"]) == 1
    (whole,) = read_images(left / "mosaic_f770w.fits")
    both = ~file.image.mask & ~whole.image.mask
    assert both.mean() > 0.5
    apart = level_of(whole)[both] / level_of(file)[both] - 1
    assert np.percentile(np.abs(apart), 99) < 1e-4
    assert np.abs(whole.planes["BKG"][both]).max() < 0.1 * np.abs(file.planes["BKG"][both]).max()
    (cal,) = read_images(out / "f770w_0_cal.fits")
    level = background_level("miri.f770w").value
    assert np.median(cal.planes["BKG"]) == pytest.approx(level, rel=0.1)

    # again, nothing is done; with another file, only what it changes
    times = {path.name: path.stat().st_mtime_ns for path in out.glob("*.fits")}
    assert main(arguments) == 1
    assert times == {path.name: path.stat().st_mtime_ns for path in out.glob("*.fits")}
    assert set(Table.read(out / "files.ecsv")["status"]) == {"kept", "failed"}
    table = reduce_files([*files[:2], files[3]], out)
    assert list(table["status"]) == ["kept"] * 3 + ["kept", "reduced"]
    # and with other settings all
    table = reduce_files(files[3:4], out, reducer=Reducer(background=BackgroundSettings(box=16)))
    assert list(table["status"]) == ["reduced", "reduced"]
    # the pixel of mosaics is that of the reducer, or of the call
    fine = Reducer(background=BackgroundSettings(box=16), pixel_scale=0.09 * u.arcsec)
    for options, scale in (({}, 0.09), ({"pixel_scale": 0.1 * u.arcsec}, 0.1)):
        reduce_files(files[3:4], out, reducer=fine, **options)
        (mosaic,) = read_images(next(out.glob("mosaic_*.fits")))
        assert mosaic.image.pixel_scale.to_value(u.arcsec) == pytest.approx(scale, rel=1e-6)


@pytest.mark.slow
def test_backgrounds_of_dithers_are_those_of_the_classes(files, tmp_path):
    reducer = Reducer(background=BackgroundSettings("dithers"))
    table = reduce_files(files[:3], tmp_path, reducer=reducer)
    assert table["reason"][-1] in ("", None, np.ma.masked)
    (file,) = read_images(tmp_path / "mosaic_f770w.fits")
    result = reducer.run(files[:3])
    # but for the rounding of files and the mosaic's own level
    noise = np.nanmedian(result.mosaic.uncertainty.array)
    off = np.abs(file.image.data - result.mosaic.data)[~result.mosaic.mask]
    assert np.percentile(off, 99) < 0.02 * noise


def test_wrong_arguments_are_named(files, tmp_path, capsys):
    refuses("'paths' must be at least one file, got none", reduce_files, [], tmp_path)
    with pytest.raises(ValueError, match="files of different names, got two of f770w_0"):
        reduce_files([files[0], tmp_path / "f770w_0_cal.fits"], tmp_path)
    arguments = ["reduce", str(files[0]), "-o", str(tmp_path)]
    for more in (["--gain", "4", "--references", "none"], ["--context", "jwst_1364.pmap"]):
        assert main([*arguments, *more]) != 0
        assert "only one of these" in capsys.readouterr().err


def test_products_never_replace_what_they_are_made_of(files, tmp_path):
    path = tmp_path / "a_rate.fits"
    path.write_bytes(files[1].read_bytes())
    for overwrite in (False, True):
        with pytest.raises(ValueError, match="'folder' must be another one than that of the files"):
            reduce_files([path], tmp_path, overwrite=overwrite)
    assert path.read_bytes() == files[1].read_bytes()


def test_without_references_there_are_slopes_alone(files, tmp_path):
    with pytest.warns(MiricigaleWarning, match="slopes without references for"):
        table = reduce_files(files[:1], tmp_path, reducer=Reducer(references="none"))
    assert list(table["status"]) == ["rate"]
    assert table["reason"][0] == "no photometry without references"
    (file,) = read_images(tmp_path / "f770w_0_rate.fits")
    assert file.image.unit == u.adu / u.s
    table = reduce_files(files[:1], tmp_path, reducer=Reducer(references="none"))
    assert list(table["status"]) == ["kept"]
    # slopes are there too where a reference of the brightness is missing
    some = ReferenceFiles(gain=4.0, read_noise=6.0, incomplete=True)
    with pytest.warns(MiricigaleWarning, match="without references for"):
        table = reduce_files(files[:1], tmp_path / "some", reducer=Reducer(references=some))
    assert table["status"][0] == "failed"
    assert "'photom'" in table["reason"][0]
    assert read_images(tmp_path / "some" / "f770w_0_rate.fits")[0].image.unit == u.adu / u.s


def test_slopes_of_each_integration_on_demand(tmp_path):
    exposure = exposure_of("miri.f770w", n_groups=10, n_integrations=2, subarray="SUB64")
    ramp = Detector.miri_imager().expose(sky_of(exposure, 5.0), exposure, seed=1)
    path = ramp.write(tmp_path / "a_uncal.fits")
    arguments = ["reduce", str(path), "-o", str(tmp_path / "out"), "--no-progress"]
    assert main([*arguments, "--rateints"]) == 0
    out = tmp_path / "out"
    rate, *parts = read_images(out / "a_rate.fits") + read_images(out / "a_rateints.fits")
    assert len(parts) == 2
    for file in (rate, *parts):
        assert {"VAR_POISSON", "VAR_RNOISE"} <= set(file.planes)
    # half the exposure, twice the variance
    good = ~rate.image.mask & ~parts[0].image.mask
    ratio = parts[0].image.uncertainty.array[good] / rate.image.uncertainty.array[good]
    assert np.median(ratio) == pytest.approx(np.sqrt(2), rel=0.02)
    assert main(arguments) == 0
    assert Table.read(out / "files.ecsv")["status"][0] == "reduced"


def test_two_versions_of_an_observed_exposure_count_once(tmp_path):
    """Two deliveries of the archive have other data; simulations with other seeds have the same keywords."""
    exposure = exposure_of(n_groups=6, subarray="SUB64")
    detector = Detector.miri_imager()
    names = {}
    for seed in (1, 2):
        ramp = detector.expose(sky_of(exposure, 5.0), exposure, seed=seed)
        path = ramp.write(tmp_path / f"sim{seed}_uncal.fits")
        names[path.name] = path
        with fits.open(path) as hdus:
            hdus[0].header["ORIGIN"] = "STSCI"
            del hdus["SIM_META"]
            hdus.writeto(tmp_path / f"jw{seed}_uncal.fits")
    record = ExposureRecord()
    assert record.add_file(tmp_path / "jw1_uncal.fits") is None
    assert record.add_file(tmp_path / "jw2_uncal.fits") == str(tmp_path / "jw1_uncal.fits")
    record = ExposureRecord()
    assert [record.add_file(path) for path in names.values()] == [None, None]
    ramps = [Ramp.read(tmp_path / f"jw{seed}_uncal.fits") for seed in (1, 2)]
    record = ExposureRecord()
    record.check("exposure 1", ramps[0])
    text = "exposures that differ, got exposure 2, the same as exposure 1"
    refuses(text, record.check, "exposure 2", ramps[1])


def test_copies_and_ramps_with_their_slopes_are_left_out(tmp_path):
    exposure = exposure_of(n_groups=6, subarray="SUB64")
    ramp = Detector.miri_imager().expose(sky_of(exposure, 5.0), exposure, seed=1)
    ramp.write(tmp_path / "a_uncal.fits")
    write_image(Reducer().fit_ramp(ramp, planes=True), tmp_path / "b_rate.fits")
    shutil.copy(tmp_path / "a_uncal.fits", tmp_path / "c_uncal.fits")
    paths = [tmp_path / name for name in ("a_uncal.fits", "b_rate.fits", "c_uncal.fits")]
    table = reduce_files(paths, tmp_path / "out")
    assert list(table["status"]) == ["reduced", "failed", "failed", "reduced"]
    for row in table[1:3]:
        assert row["reason"] == f"the same exposure as {paths[0]}"
    mosaic = read_images(tmp_path / "out" / "mosaic_f1000w.fits")[0]
    assert mosaic.image.meta["n_exposures"] == 1
