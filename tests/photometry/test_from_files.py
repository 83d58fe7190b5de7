"""The command `miricigale photometry` on files of a small field whose fluxes are known."""

import contextlib
import html
import types
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal

from helpers.light import gaussian_image
from helpers.mosaics import disks, render
from miricigale.cli import main
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.instrument.image_files import write_image
from miricigale.photometry import ForcedFlags, ForcedPhotometer, read_mosaic
from miricigale.utils.exceptions import MiricigaleWarning

CENTER = SkyCoord(34.3, -5.1, unit="deg")
#: Pixels and rms of the PSFs of image and prior, arcsec.
COARSE, FINE, WIDE, SHARP = 0.11, 0.06, 0.25, 0.09
#: A filter without a model PSF, which could not be a Gaussian.
BAND = "irac.ch4"


def points(sky, flux, width, wcs, shape):
    """Points of ``flux`` (uJy) as Gaussians, uJy in each pixel."""
    return render(sky, flux, width, wcs, shape) * pixel_area_map(wcs, shape) * 1e12


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """An image in 10 nJy with weights of another scale, a prior in nJy, segments, PSFs."""
    folder = tmp_path_factory.mktemp("files")
    rng = np.random.default_rng(12)
    steps = np.arange(-2, 3) * 4.2
    grid = np.array(np.meshgrid(steps, steps)).reshape(2, -1) + rng.uniform(-0.7, 0.7, (2, 25))
    sky = CENTER.spherical_offsets_by(*(grid * u.arcsec))
    flux = np.geomspace(0.3, 30, 25)
    rng.shuffle(flux)
    ids = 150_000 + 37 * np.arange(25)

    def save(name, data, wcs=None, **header):
        hdu = fits.PrimaryHDU(np.asarray(data, np.float32), wcs and wcs.to_header())
        hdu.header.update(header)
        hdu.writeto(folder / name)
        return str(folder / name)

    low, high = (260, 262), (470, 474)
    image_wcs = north_up_wcs(CENTER, COARSE * u.arcsec, low)
    prior_wcs = north_up_wcs(CENTER, FINE * u.arcsec, high)
    labels = disks(sky, prior_wcs, high, 8, ids)
    noise = 0.005
    data = points(sky, flux, WIDE, image_wcs, low) + rng.normal(0, noise, low)
    prior = points(sky, 3 * flux, SHARP, prior_wcs, high) + rng.normal(0, 0.002, high)
    paths = {
        "image": save("image.fits", data * 100, image_wcs, BUNIT="10*nanoJansky"),
        # 1 / variance up to a factor of 4
        "weight": save("wht.fits", np.full(low, 0.25 / (100 * noise) ** 2), image_wcs),
        "highres": save("prior.fits.gz", prior * 1e3, prior_wcs, BUNIT="nJy", FILTER="F430M",
                        INSTRUME="NIRCAM"),
        "highres-error": save("rms.fits", np.full(high, 2.0)),
        "segmentation": save("seg.fits", labels, prior_wcs),
        "psf": save("psf.fits", gaussian_image(41, WIDE / COARSE), PIXSCALE=COARSE),
        # a cube of PSFs that are off their middle
        "highres-psf": save("hipsf.fits", [gaussian_image(61, SHARP / FINE, *s) for s in [(1.3, -0.6), (0, 0.4)]],
                            PIXSCALE=FINE) + "[0,mean]",
    }  # fmt: skip
    return types.SimpleNamespace(
        folder=folder, paths=paths, sky=sky, flux=flux, ids=ids, save=save, wcs=prior_wcs
    )


def arguments(files, output, **changes):
    options = {**files.paths, "filter": BAND, "output": output, **changes}
    given = [[f"--{key}", str(value)] for key, value in options.items() if value is not None]
    return ["photometry", "--no-progress", *(part for pair in given for part in pair)]


@pytest.mark.pictures
@pytest.mark.slow
def test_files_become_a_catalog_that_can_be_fitted_and_a_page(files, tmp_path, capsys):
    output = tmp_path / "new" / "fluxes.ecsv"
    assert main([*arguments(files, output), "--psf-stars"]) == 0
    assert f"25 sources in {output}" in capsys.readouterr().out
    table = QTable.read(output)
    assert list(table["id"]) == list(files.ids)
    flux, error = (table[name].to_value(u.uJy) for name in (BAND, f"{BAND}_err"))
    assert np.all(table["sky"].separation(files.sky) < 0.05 * u.arcsec)
    # the error of a point source on white noise, in closed form: sigma sqrt(4 pi) width / pixel
    expected = 0.005 * np.sqrt(4 * np.pi) * WIDE / COARSE
    assert_allclose(np.median(error), expected, rtol=0.05)
    # errors are of the image's noise; PSFs and templates are good to a percent
    pulls = (flux - files.flux) / np.hypot(error, 0.01 * files.flux)
    assert np.abs(pulls).max() < 4
    assert 0.6 < pulls.std() < 1.4
    page = output.with_suffix(".html").read_text()
    for text in (f"Forced photometry: {BAND}", "Image, model and residual", "Magnitudes",
                 "pulls at empty positions", "Brightest sources", "10*nanoJansky", "150037"):  # fmt: skip
        assert text in page
    # every flag with what it means
    told = html.unescape(page)
    for value, (name, meaning) in ForcedFlags.meanings().items():
        assert f"<td>{value} {name}</td><td>{meaning}</td>" in told
    # the whole, the brightest source without a flag, magnitudes, pulls, stars on both images
    assert page.count("<img") == 6
    assert "PSFs from the images themselves" in page


@pytest.mark.slow
def test_catalog_kernel_and_the_plain_form(files, tmp_path):
    """A kernel of others alone, a catalog, and the two files without options, packed."""
    from miricigale.psf import MatchingKernel

    psfs = (gaussian_image(61, width / FINE) for width in (SHARP, WIDE))
    made = MatchingKernel.from_psfs(*psfs, pixel_scale=FINE * u.arcsec)
    kernel = files.save("kernel.fits", made.array)
    made.write(files.folder / "own.fits")
    catalog = files.folder / "catalog.csv"
    order = np.arange(25)[::-1]
    Table({"ID": files.ids[order], "ra": files.sky.ra.deg[order], "dec": files.sky.dec.deg[order]}
          ).write(catalog)  # fmt: skip
    found = []
    for path, sharp in ((kernel, files.paths["highres-psf"]), (files.folder / "own.fits", None)):
        output = tmp_path / f"{len(found)}.ecsv"
        changes = {"kernel": path, "psf": None, "highres-psf": sharp, "catalog": catalog}
        plain = {**changes, "image": None, "highres": None}
        command = arguments(files, output, **plain)
        assert main([*command, files.paths["image"], files.paths["highres"]]) == 0
        table = QTable.read(output)
        assert list(table["id"]) == list(files.ids[order])
        found.append(table[BAND].to_value(u.uJy))
        assert_allclose(found[-1], files.flux[order], rtol=0.03, atol=0.2)
    assert_allclose(*found, rtol=0.01, atol=0.02)


def test_positions_of_a_catalog_are_measured_as_points_without_a_prior(files, tmp_path, capsys):
    catalog = files.folder / "positions.csv"
    positions = {"id": files.ids, "ra": files.sky.ra.deg, "dec": files.sky.dec.deg}
    Table(positions).write(catalog)
    output = tmp_path / "points.ecsv"
    options = ["--catalog", str(catalog), "--filter", BAND, "--psf", files.paths["psf"]]
    options += ["--weight", files.paths["weight"], "--output", str(output), "--no-progress"]
    assert main(["photometry", files.paths["image"], *options]) == 0
    table = QTable.read(output)
    assert "highres" not in table.meta
    pulls = (table[BAND].value - files.flux) / np.hypot(
        table[f"{BAND}_err"].value, 0.01 * files.flux
    )
    assert np.abs(pulls).max() < 4
    page = output.with_suffix(".html").read_text()
    assert "points at the positions of a catalog" in page
    assert "for points with the PSF of the image" in page
    # the same as in Python, but for the background that files are fitted with
    image = read_mosaic(files.paths["image"], weight=files.paths["weight"], filter=BAND)
    psf = (fits.getdata(files.paths["psf"]), COARSE * u.arcsec)
    points = ForcedPhotometer(psf=psf, background_order=0).measure(image, files.sky)
    assert_allclose(table[BAND], points.flux, rtol=0.01, atol=0.01 * u.uJy)
    for wrong, message in (
        (["--segmentation", "seg.fits"], "--segmentation must be left out without a high-res"),
        (["--highres-filter", "F444W"], "--highres-filter must be left out without a high-res"),
        (["--patches", "parts"], "--patches must be left out without a high-resolution image"),
    ):
        again = ["photometry", files.paths["image"], *options, "--overwrite", *wrong]
        assert main(again) == 2
        assert message in capsys.readouterr().err
    assert main(["photometry", files.paths["image"], "--filter", BAND]) == 2
    assert "or an image and --catalog" in capsys.readouterr().err


@pytest.mark.slow
def test_without_a_segmentation_sources_are_detected(files, tmp_path):
    catalog = tmp_path / "catalog.fits"
    Table({"id": files.ids, "ra": files.sky.ra.deg, "dec": files.sky.dec.deg}).write(catalog)
    output = tmp_path / "out.ecsv"
    command = arguments(files, output, segmentation=None, catalog=catalog)
    # noise peaks at the low threshold of the detection are in no catalog
    with pytest.warns(MiricigaleWarning, match="segments of the segmentation belong to no source"):
        assert main(command) == 0
    table = QTable.read(output)
    assert list(table["id"]) == list(files.ids)
    ours = table[BAND].to_value(u.uJy)
    assert_allclose(ours, files.flux, rtol=0.05, atol=0.2)


@pytest.mark.slow
def test_sources_that_the_prior_lacks_are_the_last_rows(files, tmp_path):
    labels, header = fits.getdata(files.paths["segmentation"], header=True)
    lost = np.argsort(-files.flux)[[2, 5]]
    labels[np.isin(labels, files.ids[lost])] = 0
    fits.writeto(tmp_path / "seg.fits", labels, header)
    output = tmp_path / "out.fits"
    command = arguments(files, output, segmentation=tmp_path / "seg.fits")
    assert main([*command, "--second-pass", "--background-order", "1"]) == 0
    table = QTable.read(output)
    assert list(table["id"][:23]) == sorted(np.delete(files.ids, lost))
    assert len(table) == 25
    assert not np.isin(table["id"][23:], files.ids).any()
    flagged = np.asarray(table["irac.ch4_flags"]) & int(ForcedFlags.NOT_IN_CATALOG) > 0
    assert flagged.tolist() == [False] * 23 + [True] * 2
    index, separation, _ = files.sky[lost].match_to_catalog_sky(table["sky"][23:])
    assert separation.max() < 0.05 * u.arcsec
    found = table["irac.ch4"][23:][index].to_value(u.uJy)
    assert_allclose(found, files.flux[lost], rtol=0.02)


@pytest.mark.pictures
@pytest.mark.slow
def test_several_bands_are_measured_in_one_call(files, tmp_path, capsys):
    """The second with a kernel by place, the prior with a sky; what one shows beyond it is measured in both."""
    from miricigale.psf import KernelField, MatchingKernel

    shape, red = (260, 262), "irac.ch3"
    wcs, rng = north_up_wcs(CENTER, COARSE * u.arcsec, shape), np.random.default_rng(5)
    labels, header = fits.getdata(files.paths["segmentation"], header=True)
    lost = np.argsort(-files.flux)[[2, 5]]
    labels[np.isin(labels, files.ids[lost])] = 0
    fits.writeto(tmp_path / "seg.fits", labels, header)
    psfs = [gaussian_image(61, width / FINE) for width in (SHARP, WIDE)]
    kernel = MatchingKernel.from_psfs(*psfs, pixel_scale=FINE * u.arcsec)
    places = SkyCoord([34.298, 34.302], [-5.1, -5.1], unit="deg")
    KernelField([kernel, kernel], places).write(tmp_path / "kernels.fits")
    data = points(files.sky, 2 * files.flux, WIDE, wcs, shape) + rng.normal(0, 0.005, shape)
    # one of the two is as blue as the sky
    data -= points(files.sky[lost[1:]], 2 * files.flux[lost[1:]], WIDE, wcs, shape)
    extra = {"image": files.save("red.fits", data * 100, wcs, BUNIT="10*nanoJansky"), "filter": red,
             "weight": "-", "psf": "-", "kernel": tmp_path / "kernels.fits"}  # fmt: skip
    more = [text for key, value in extra.items() for text in (f"--{key}", str(value))]
    prior, own = fits.getdata(files.paths["highres"], header=True)
    fits.writeto(tmp_path / "prior.fits", prior + 8.0, own)
    folder, rest = tmp_path / "both", {"segmentation": tmp_path / "seg.fits", "kernel": "-"}
    rest |= {"highres": tmp_path / "prior.fits", "highres-background-box": 50}
    command = arguments(files, folder / "out.ecsv", **rest)
    with pytest.warns(MiricigaleWarning, match="has no map of the noise"):
        assert main([*command, *more, "--model", str(folder / "model.fits")]) == 0
    both = QTable.read(folder / "out.ecsv")
    assert len(both) == 25
    assert (folder / "model_ch3.fits").is_file()
    assert (folder / "model_ch4.fits").is_file()
    flagged = np.asarray(both[f"{BAND}_flags"]) & int(ForcedFlags.NOT_IN_CATALOG) > 0
    assert flagged.tolist() == [False] * 23 + [True] * 2
    index, separation, _ = files.sky.match_to_catalog_sky(both["sky"])
    assert separation.max() < 0.05 * u.arcsec
    wanted = {BAND: files.flux, red: 2 * files.flux}
    wanted[red][lost[1]] = 0.0
    for name, flux in wanted.items():
        found = both[name][index].to_value(u.uJy)
        error = both[f"{name}_err"][index].to_value(u.uJy)
        assert_allclose(found, flux, atol=4 * error.max(), rtol=0.03)
        assert both.meta["bands"][name]["second_pass"]["fitted"]
    assert_allclose(
        both[f"{BAND}_upper"][index] - both[BAND][index],
        1.645 * both[f"{BAND}_err"][index],
        rtol=0.02,
    )
    page = (folder / "out.html").read_text()
    for text in (
        f"Forced photometry: {BAND}, {red}",
        "out-sources.html",
        f"The whole image, {red}.",
    ):
        assert text in page
    facts = (folder / "out-sources.html").read_text()
    assert f"<h1>Forced photometry: {BAND}, {red}</h1>" in facts
    assert f'"mag_{red}"' in facts
    assert len(list((folder / "out-sources").iterdir())) == 2
    # an option given once for two images, and one filter twice
    assert main([*command, *more[:2]]) == 2
    assert "--filter must be given for each of 2 images" in capsys.readouterr().err
    assert main([*command, *more[:2], "--filter", BAND, *more[4:], "--overwrite"]) == 2
    assert "--image must be of different filters" in capsys.readouterr().err


@pytest.mark.slow
def test_sources_are_detected_on_several_images(files, tmp_path):
    """A source that the prior does not show is found on another image of its pixels."""
    data, header = fits.getdata(files.paths["highres"], header=True)
    shape, faint = data.shape, int(np.argmax(files.flux))
    data = data - 1e3 * points(files.sky[[faint]], [3 * files.flux[faint]], SHARP, files.wcs, shape)
    fits.writeto(tmp_path / "prior.fits", data, header)
    found = []
    for more in ([], ["--detection", files.paths["highres"]]):
        output = tmp_path / f"{len(more)}.ecsv"
        command = arguments(files, output, highres=tmp_path / "prior.fits", segmentation=None)
        with pytest.warns(MiricigaleWarning) if more else contextlib.nullcontext():
            assert main([*command, "--no-second-pass", *more]) == 0
        table = QTable.read(output)
        found.append(table["sky"].separation(files.sky[faint]).min().arcsec)
    assert found[0] > 0.3
    assert found[1] < 0.1


def test_coordinates_of_an_image_are_read_once(files, monkeypatch):
    from miricigale.photometry import MosaicFile
    from miricigale.photometry.commands.file_inputs import Inputs
    from miricigale.photometry.images import mosaics

    names = []
    image_wcs = mosaics.image_wcs

    def read(header, hdus):
        names.append(Path(hdus.filename()).name)
        return image_wcs(header, hdus)

    monkeypatch.setattr(mosaics, "image_wcs", read)
    paths = files.paths
    psf = {"psf": paths["psf"], "psf_scale": COARSE * u.arcsec}
    image = MosaicFile(paths["image"], weight=paths["weight"], filter=BAND, **psf)
    highres = MosaicFile(paths["highres"], error=paths["highres-error"], psf=paths["highres-psf"])
    inputs = Inputs.of(image, highres)
    inputs.check()
    inputs.read()
    assert sorted(names) == ["image.fits", "prior.fits.gz"]


def test_our_own_files_are_read(files, tmp_path):
    image = read_mosaic(files.paths["image"], weight=files.paths["weight"], filter="miri.f770w")
    write_image(image, tmp_path / "own.fits")
    again = read_mosaic(tmp_path / "own.fits")
    assert_array_equal(again.data, image.data)
    assert_array_equal(again.uncertainty.array, image.uncertainty.array)
    assert_array_equal(again.mask, image.mask)
    assert again.meta["filter"] == "miri.f770w"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"filter": None}, "--filter must be given, for the header of"),
        ({"filter": "miri.f771w"}, "--filter must be a filter that 'miricigale filters' lists"),
        ({"image": "highres", "highres": "image", "filter": "nircam.f356w", "weight": None},
         "--filter must be 'nircam.f430m', the filter in"),
        ({"image": "highres", "highres": "f770w", "weight": None, "filter": "miri.f770w"},
         "seem to be swapped"),
        ({"highres": "f770w", "image": "image", "psf": "highres-psf", "highres-psf": "psf",
          "psf-scale": 0.06, "highres-psf-scale": 0.11, "segmentation": None}, "must be wider than that of"),
        ({"highres": "far", "highres-error": None}, "show different fields: the middle of"),
        ({"highres": "plain", "highres-error": None}, "no celestial coordinates"),
        ({"highres": "mirrored", "highres-error": None}, "mirrored.fits: 'wcs' must be of an image of"),
        ({"segmentation": "moved"}, "is not on the pixels of"),
        ({"segmentation": "absent.fits"}, "no file absent.fits ('segmentation')"),
        ({"psf": None, "filter": "miri.f770w"}, "--pa-aper must be given (or --psf), for the header of"),
        ({"psf": None, "filter": None},
         "does not name it, or not its instrument; --pa-aper must be given (or --psf), for the header of"),
        ({"highres-psf": None}, "there is no model PSF for nircam.f430m"),
        ({"highres-psf": None, "highres": "f444w"}, "--highres-pa-aper must be given (or --highres-psf), for the"),
        ({"psf": None, "filter": "nircam.f480m"}, "there is no model PSF for nircam.f480m"),
        ({"kernel": "psf"}, "--psf must be left out where a kernel is given"),
        ({"kernel": "segmentation", "psf": None, "highres-psf": None}, "cannot be read as a kernel"),
        ({"kernel": "segmentation", "psf": None, "highres-psf": None}, "square with an odd number of pixels"),
        ({"psf": "segmentation"}, "seg.fits cannot be read as a PSF"),
        ({"psf": "cube"}, "must be an image with a PSF, got the shape"),
        ({"output": "out.txt"}, "--output must be a table (.ecsv, .fits, .fits.gz)"),
        ({"output": "/proc/none/out.ecsv"}, "--output must be in a folder that can be written to"),
        ({"output": "image"}, "another file than those that are read"),
        ({"output": "there.ecsv"}, "--output must be a new file (or --overwrite given)"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_before_the_work(
    files, tmp_path, monkeypatch, capsys, changes, message
):
    monkeypatch.chdir(tmp_path)
    Path("there.ecsv").write_text("")
    data, header = fits.getdata(files.paths["highres"], header=True)
    made = {**files.paths, "cube": files.paths["highres-psf"].partition("[")[0]}
    for name, own in {
        "f770w": {"FILTER": "F770W", "INSTRUME": "MIRI"},
        "f444w": {"FILTER": "F444W"},
        "far": {"CRVAL1": header["CRVAL1"] + 1},
        "moved": {"CRPIX1": header["CRPIX1"] + 2},
        "mirrored": {"CDELT1": -header["CDELT1"]},
        "plain": {"CTYPE1": "", "CTYPE2": ""},
    }.items():
        kept = np.ones(data.shape, np.int32) if name == "moved" else data
        fits.writeto(f"{name}.fits", kept, fits.Header({**header, **own}))
        made[name] = f"{name}.fits"
    if "f770w" in changes.values() and "psf" in changes:
        fits.setval("f770w.fits", "FILTER", value="F430M")
        fits.setval("f770w.fits", "INSTRUME", value="NIRCAM")
    changes = {key: made.get(value, value) for key, value in changes.items()}
    status = main(arguments(files, **{"output": "out.ecsv", **changes}))
    said = capsys.readouterr().err
    assert status == 2, said
    assert message in said
    assert not Path("out.ecsv").exists()
    assert not Path("out.html").exists()


def test_an_angle_other_than_the_headers_is_refused(files, tmp_path, capsys):
    path = tmp_path / "image.fits"
    path.write_bytes(Path(files.paths["image"]).read_bytes())
    fits.setval(path, "PA_APER", value=359.5)
    output = tmp_path / "out.ecsv"
    command = arguments(files, output, image=path, psf=None)
    assert main([*command, "--pa-aper", "40"]) == 2
    assert "--pa-aper must be PA_APER of" in capsys.readouterr().err


@pytest.mark.slow
def test_a_real_field_agrees_with_another_program(data_file, tmp_path, capsys):
    """PRIMER-UDS, F444W to F770W; the other program's fluxes are no truth."""
    uds = data_file("uds")
    start = f"{uds}/uds-test-"
    psfs = f"{uds}/psf/uds-test-f444w"
    output = tmp_path / "uds.ecsv"
    command = [
        "photometry",
        "--no-progress",
        "--no-second-pass",
        "--filter",
        "miri.f770w",
        "-o",
        str(output),
    ]
    for key, path in {
        "image": f"{start}f770w_sci.fits.gz",
        "weight": f"{start}f770w_wht.fits.gz",
        "highres": f"{start}f444w_sci.fits.gz",
        "highres-weight": f"{start}f444w_wht.fits.gz",
        "segmentation": f"{start}LW_seg.fits.gz",
        "kernel": f"{psfs}_kernel_f770w.fits.gz[0,mean]",
        "highres-psf": f"{psfs}_psf.fits.gz[0,mean]",
    }.items():
        command += [f"--{key}", path]
    # the weights were made for an image of another scale
    with pytest.warns(UserWarning, match="noise on the sky is 2.. times|each of its pixels 2 x 2"):
        assert main(command) == 0
    table = QTable.read(output)
    other = Table.read(uds / "photometry_ca3cf34.cat", format="ascii")
    assert list(table["id"]) == list(other["id"])
    ours = table["miri.f770w"].to_value(u.uJy)
    error = table["miri.f770w_err"].to_value(u.uJy)
    theirs = np.asarray(other["flux_1"]) / 4 * 0.01
    bright = (ours > 10 * error) & np.isfinite(theirs)
    assert np.count_nonzero(bright) >= 15
    # light beyond their segments, and sizes that differ between the bands: see the guide
    assert 0.97 < np.median(ours[bright] / theirs[bright]) < 1.10
    faint = (ours < 10 * error) & np.isfinite(theirs)
    assert np.abs(np.median(((ours - theirs) / error)[faint])) < 0.5
    # residuals of bright sources are noise and resampling; no flux is negative
    assert np.nanmin(ours / error) > -5
    bright = ours > 20 * error
    assert np.count_nonzero(bright) >= 9
    assert np.mean(table["miri.f770w_chi2"][bright] < 2) > 0.84
