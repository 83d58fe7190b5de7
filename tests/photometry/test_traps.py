"""Mistakes that are easily made with files: each is mended and said, or refused before the work."""

import subprocess
import sys
import types

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from helpers.errors import refuses, warned
from helpers.mosaics import disks
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import MosaicFile, read_mosaic
from miricigale.photometry.commands.from_files import measure_files
from miricigale.psf import (
    MatchingKernel,
    encircled_energy,
    filter_psf,
    hst_psf,
    miri_psf,
    psf_image,
    psf_mosaic,
)
from miricigale.utils.exceptions import DataError, MiricigaleWarning

CENTER, ARCSEC = SkyCoord(34.3, -5.1, unit="deg"), u.arcsec
COARSE, FINE, PA = 0.11, 0.06, 75.0
SIZE = {"image": (COARSE, 241), "prior": (FINE, 441)}
NOISE = {"image": 0.004, "prior": 0.002}


def brightness(data, wcs):
    return data / pixel_area_map(wcs, data.shape) / 1e12


def drawn(rng, name, model, sky, flux):
    """Points with noise on the pixels of the image or the prior, uJy in each pixel."""
    scale, n = SIZE[name]
    data = rng.normal(0, NOISE[name], (n, n))
    at = north_up_wcs(CENTER, scale * ARCSEC, (n, n)).world_to_pixel(sky)
    for light, x, y in zip(flux, *at, strict=True):
        i, j = round(float(x)), round(float(y))
        form = {"pixel_scale": scale * ARCSEC, "shape": 2 * n + 1, "offset": (x - i, y - j)}
        data += light * psf_image(model, **form)[n - j : 2 * n - j, n - i : 2 * n - i]
    return data


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Sixteen points with the PSFs of F770W at a roll of 75 deg and of F160W."""
    folder, rng = tmp_path_factory.mktemp("field"), np.random.default_rng(3)
    steps = (np.arange(4) - 1.5) * 5.0
    places = np.array(np.meshgrid(steps, steps)).reshape(2, -1) + rng.uniform(-0.7, 0.7, (2, 16))
    sky, flux = CENTER.spherical_offsets_by(*(places * ARCSEC)), np.geomspace(2, 50, 16)
    models = {"image": psf_mosaic(miri_psf("miri.f770w"), COARSE * ARCSEC, PA * u.deg)}
    models["prior"] = hst_psf()
    headers = {"image": {"INSTRUME": "MIRI", "FILTER": "F770W", "PA_APER": PA}}
    headers["prior"] = {"INSTRUME": "WFC3", "FILTER": "F160W"}
    made = types.SimpleNamespace(folder=folder, flux=flux, models=models)
    for name, model in models.items():
        scale, n = SIZE[name]
        wcs = north_up_wcs(CENTER, scale * ARCSEC, (n, n))
        data = drawn(rng, name, model, sky, flux)
        header = wcs.to_header()
        header.update({"BUNIT": "MJy/sr", **headers[name]})
        error = brightness(np.full((n, n), NOISE[name]), wcs)
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(brightness(data, wcs), header, name="SCI")]
        fits.HDUList([*hdus, fits.ImageHDU(error, name="ERR")]).writeto(folder / f"{name}.fits")
    labels = disks(sky, wcs, (n, n), 10)
    fits.writeto(folder / "seg.fits", labels, wcs.to_header())
    made.catalog = Table({"id": np.arange(1, 17), "ra": sky.ra.deg, "dec": sky.dec.deg})
    made.catalog.write(folder / "cat.fits")
    names = {"image": "image", "highres": "prior", "segmentation": "seg", "catalog": "cat"}
    made.paths = {key: folder / f"{name}.fits" for key, name in names.items()}
    return made


def measured(field, **options):
    options = {**field.paths, **options}
    images = []
    for name, prefix in (("image", ""), ("highres", "highres_")):
        keys = ("psf", "psf_scale", "psf_angle", "pa_aper")
        known = {key: options.pop(prefix + key, None) for key in keys}
        images.append(MosaicFile(options.pop(name), **known))
    return measure_files(*images, n_threads=1, **options)


def fluxes(field, **options):
    return measured(field, **options)["miri.f770w"].to_value(u.uJy)


#: For faults that have nothing to do with the PSF, which the stars would confirm each time.
WITHOUT_STARS = {"psf_stars": False}


def edited(field, tmp_path, name, change=None, *, add=0.0, **header):
    path = tmp_path / f"{name}.fits"
    with fits.open(field.folder / f"{name}.fits") as hdus:
        hdus["SCI"].data += add
        hdus["SCI"].header.update(header)
        if change:
            change(hdus)
        hdus.writeto(path)
    return path


def saved(tmp_path, data, name="psf.fits", **header):
    hdu = fits.PrimaryHDU(data)
    hdu.header.update(header)
    hdu.writeto(tmp_path / name, overwrite=True)
    return tmp_path / name


@pytest.mark.slow
def test_psfs_that_the_package_wrote_are_taken_as_they_are(field, tmp_path):
    """And stars leave an exact PSF alone, also where sixteen stand in each other's wings."""
    field.models["image"].write(tmp_path / "own.fits")
    known = fluxes(field)
    for options in ({"psf": tmp_path / "own.fits"}, {"psf_stars": True}):
        assert_allclose(fluxes(field, **options), known, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "total"), [(17, 1.0), (17, 0.5), (91, 1.0), (91, 40.0)])
def test_psfs_of_any_sum_hold_what_the_model_does(field, tmp_path, width, total):
    """The light of a PSF within 1.9 arcsec is 0.85 of all."""
    data = psf_image(field.models["image"], pixel_scale=COARSE * ARCSEC, shape=width)
    part = data.sum()
    path = saved(tmp_path, data * total / data.sum())
    found = warned(f"'psf' sums to 1 and is taken to hold {part:.3f}", fluxes, field, psf=path)
    assert_allclose(np.median(found / field.flux), 1, atol=0.007)


@pytest.mark.slow
def test_psfs_on_cells_of_a_pixel_are_told_by_their_width(field, tmp_path):
    data = miri_psf("miri.f770w", fov=8 * ARCSEC).data
    path = saved(tmp_path, data / data.sum())
    refuses(r"'psf' must be a PSF of miri.f770w, about 0\.28.*its pix", fluxes, field, psf=path)
    # the header tells the cell; then the roll is missing
    path = saved(tmp_path, data / data.sum(), PIXELSCL=0.11092 / 4)
    refuses("one whose spikes stand as in the detector's axes", fluxes, field, psf=path)
    with pytest.raises(ValueError, match=r"'psf_scale' must be 0\.02773 arcsec, as the header"):
        fluxes(field, psf=path, psf_scale=0.11 * ARCSEC)
    # of a single exposure: not as wide as that of a mosaic
    with pytest.warns(MiricigaleWarning) as said:
        fluxes(field, psf=path, psf_angle=PA * u.deg)
    assert "'psf' is 6% narrower" in str(said[0].message)


@pytest.mark.slow
def test_model_psfs_are_turned_to_the_angle_of_the_aperture(field, tmp_path):
    path = edited(field, tmp_path, "image", PA_APER=PA - 30)
    images = field.paths["image"], path
    right, wrong = (measured(field, image=one, **WITHOUT_STARS) for one in images)
    assert_allclose(np.median(right["miri.f770w"].value / field.flux), 1, atol=0.007)
    # the six spikes stand elsewhere at another angle
    bright = field.flux > 30
    assert np.all(wrong["miri.f770w_chi2"][bright] > 2 * right["miri.f770w_chi2"][bright])


@pytest.mark.slow
def test_a_turned_psf_with_its_angle_is_right(field, tmp_path):
    form = {"grid_angle": 0 * u.deg, "oversampling": 4}
    drizzled = psf_mosaic(miri_psf("miri.f770w"), COARSE * ARCSEC, 0 * u.deg, **form)
    data = psf_image(drizzled, pixel_scale=COARSE / 3 * ARCSEC, shape=301)
    path = saved(tmp_path, data, PIXSCALE=COARSE / 3)
    found = fluxes(field, psf=path, psf_angle=PA * u.deg)
    assert_allclose(np.median(found / field.flux), 1, atol=0.01)


@pytest.mark.slow
def test_kernels_of_other_pixels_filters_or_sums(field, tmp_path):
    given = {"pixel_scale": FINE * ARCSEC}
    made = MatchingKernel.from_psfs(field.models["prior"], field.models["image"], **given)
    path = saved(tmp_path, 0.93 * made.array / made.array.sum(), "kernel.fits")
    found = warned(r"kernel summed to 0\.9300 and was brought to 1", fluxes, field, kernel=path)
    # a bare kernel of unit sum leaves out what lies beyond its grid
    assert_allclose(np.median(found / field.flux), made.array.sum(), atol=0.01)
    message = r"kernel for pixels of 0\.04 arcsec, and those of the image"
    with pytest.raises(DataError, match=message):
        fluxes(field, kernel=saved(tmp_path, made.array / made.array.sum(), PIXSCALE=0.04))
    red = filter_psf("miri.f2100w", pixel_scale=COARSE * ARCSEC, pa=PA * u.deg)
    other = MatchingKernel.from_psfs(field.models["prior"], red, **given)
    with pytest.raises(ValueError, match=r"'kernel' must be a PSF of miri\.f770w, about"):
        fluxes(field, kernel=saved(tmp_path, other.array / other.array.sum()))
    # without the prior's PSF: segments as they are
    nameless = edited(field, tmp_path, "prior", lambda hdus: hdus["SCI"].header.remove("FILTER"))
    catalog = field.catalog.copy()
    catalog.add_row((99, CENTER.ra.deg, CENTER.dec.deg))
    catalog.write(tmp_path / "more.fits")
    path = saved(tmp_path, made.array / made.array.sum())
    with pytest.warns(MiricigaleWarning, match="kernel has no PSFs: sources are their segments"):
        found = fluxes(field, kernel=path, highres=nameless, catalog=tmp_path / "more.fits",
                       page=tmp_path / "page.html")  # fmt: skip
    # the prior's light within 0.6 arcsec, as the model has it
    held = field.models["prior"]
    inside = encircled_energy(held, 0.6 * u.arcsec)
    assert np.all((found[:-1] / field.flux > inside - 0.05) & (found[:-1] / field.flux < 0.97))
    assert np.isnan(found[-1])
    page = (tmp_path / "page.html").read_text()
    assert "The kernel has no PSFs: sources are their segments as they are" in page
    assert "the catalog position has no segment" in page


@pytest.mark.slow
def test_a_background_is_fitted_or_said(field, tmp_path):
    path = edited(field, tmp_path, "image", add=0.05)
    assert_allclose(
        np.median(fluxes(field, image=path, **WITHOUT_STARS) / field.flux), 1, atol=0.007
    )
    with pytest.warns(MiricigaleWarning, match=r"a background of 0\.05\d* MJy / sr between"):
        fluxes(field, image=path, background_order=None, **WITHOUT_STARS)
    prior = edited(field, tmp_path, "prior", add=0.06)
    warned(
        "'highres' has a sky of 2.* times its noise", fluxes, field, highres=prior, **WITHOUT_STARS
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["image", "prior"])
def test_areas_filled_with_zero_have_no_data(field, tmp_path, name):
    def corner(hdus):
        n = hdus["SCI"].shape[0]
        y, x = np.indices(hdus["SCI"].shape)
        hdus["SCI"].data[x + y < 0.5 * n] = 0
        # of a single pixel nothing is said
        hdus["SCI"].data[-1, -1] = 0

    path = edited(field, tmp_path, name, corner)
    n = SIZE[name][1]
    zero = np.count_nonzero(np.add(*np.indices((n, n))) < 0.5 * n)
    image = warned(f"has {zero} pixels in areas that are exactly 0", read_mosaic, path)
    assert np.count_nonzero(image.mask) == zero
    key = "image" if name == "image" else "highres"
    with pytest.warns(MiricigaleWarning, match="exactly 0"):
        table = measured(field, **{key: path}, **WITHOUT_STARS)
    found, error, snr = (np.asarray(table[f"miri.f770w{c}"]) for c in ("", "_err", "_template_snr"))
    good = np.isfinite(found)
    assert np.count_nonzero(good) >= 13
    # a source that the prior does not show may be a galaxy as well as a point
    assert np.count_nonzero(snr < 5) <= 1
    assert_allclose((found / field.flux)[good & (snr >= 5)], 1, atol=0.05)
    assert np.all(np.abs(found - field.flux)[snr < 5] < 3 * error[snr < 5])


def test_maps_of_the_noise_below_zero_are_refused(field, tmp_path):
    for name in ("error", "variance", "inverse_variance"):
        data = np.ones((241, 241))
        data[3, 4:6] = -1.0
        path = saved(tmp_path, data, f"{name}.fits")
        wanted = rf"'{name}' must be a map of 0 \(no data\) or more, got 2 pixels below 0 in .*{name}.fits"
        with pytest.raises(ValueError, match=wanted):
            read_mosaic(field.paths["image"], **{name: path})


@pytest.mark.slow
def test_labels_of_another_detection_are_not_taken(field, tmp_path):
    labels, header = fits.getdata(field.folder / "seg.fits", header=True)
    # ids of the map say nothing of the catalog's: positions do
    order = np.append(0, np.random.default_rng(1).permutation(16) + 1)
    fits.writeto(tmp_path / "stale.fits", order[labels].astype(np.int32), header)
    found = fluxes(field, segmentation=tmp_path / "stale.fits", **WITHOUT_STARS)
    assert_allclose(np.median(found / field.flux), 1, atol=0.007)
    # three of sixteen
    some = np.arange(17)
    some[[1, 2, 3]] = [2, 3, 1]
    fits.writeto(tmp_path / "some.fits", some[labels].astype(np.int32), header)
    with pytest.warns(MiricigaleWarning, match="those of 3 of 16 sources that stand on another"):
        fluxes(field, segmentation=tmp_path / "some.fits", **WITHOUT_STARS)
    # segments where no source is
    fits.writeto(tmp_path / "moved.fits", np.roll(labels, 30, axis=1), header)
    with pytest.warns(MiricigaleWarning) as said:
        fluxes(field, segmentation=tmp_path / "moved.fits", **WITHOUT_STARS)
    assert any("on the map have no segment" in str(one.message) for one in said)


@pytest.mark.slow
def test_catalogs_of_other_fields_and_missing_positions(field, tmp_path, monkeypatch):
    def unread(self):
        raise AssertionError

    catalog = field.catalog.copy()
    catalog["ra"][3] = np.nan
    catalog.write(tmp_path / "gap.fits")
    found = fluxes(field, catalog=tmp_path / "gap.fits", **WITHOUT_STARS)
    assert np.flatnonzero(np.isnan(found)).tolist() == [3]
    monkeypatch.setattr("miricigale.photometry.images.mosaics.MosaicFile.read", unread)
    ra = field.catalog["ra"]
    nowhere = r"none of the 16 sources of .*far.fits is on .*image.fits \('image'\): the"
    for wrong, message in ((ra + 1, nowhere), (ra / 15, "is ra in hours")):
        catalog = field.catalog.copy()
        catalog["ra"] = wrong
        catalog.write(tmp_path / "far.fits", overwrite=True)
        refuses(message, fluxes, field, catalog=tmp_path / "far.fits")


@pytest.mark.slow
def test_model_psfs_of_a_nircam_prior(field, tmp_path):
    """An image of points with NIRCam's model PSF, at the roll of its header."""
    model = filter_psf("nircam.f444w", pixel_scale=FINE * ARCSEC, pa=40 * u.deg)
    sky = SkyCoord(field.catalog["ra"], field.catalog["dec"], unit="deg")
    data = drawn(np.random.default_rng(4), "prior", model, sky, 2 * field.flux)

    def drawn_anew(hdus):
        hdus["SCI"].data[:] = brightness(data, WCS(hdus["SCI"].header))

    named = {"INSTRUME": "NIRCAM", "FILTER": "F444W", "PUPIL": "CLEAR"}
    path = edited(field, tmp_path, "prior", drawn_anew, **named)
    message = r"'highres_pa_aper' must be given \(or 'highres_psf'\), for the header"
    refuses(message, fluxes, field, highres=path)
    found = fluxes(field, highres=path, highres_pa_aper=40 * u.deg, page=tmp_path / "page.html")
    assert "FWHM of the PSF (arcsec)" in (tmp_path / "page.html").read_text()
    assert_allclose(np.median(found / field.flux), 1, atol=0.007)


@pytest.mark.slow
def test_model_and_residual_are_written_with_their_coordinates(field, tmp_path):
    paths = {name: tmp_path / "new" / f"{name}.fits" for name in ("model", "residual")}
    fluxes(field, **paths, **WITHOUT_STARS)
    image = read_mosaic(field.paths["image"])
    model = warned("no map of the noise", read_mosaic, paths["model"])
    residual = read_mosaic(paths["residual"])
    assert_allclose(model.data + residual.data, image.data, rtol=1e-5, atol=1e-4)
    assert_allclose(residual.uncertainty.array, image.uncertainty.array, rtol=1e-5)
    assert 0.9 < np.std(residual.data / residual.uncertainty.array) < 1.1
    for one in (model, residual):
        assert one.wcs.wcs.compare(image.wcs.wcs, tolerance=1e-9)
    with pytest.raises(ValueError, match="'model, residual' must be different files"):
        fluxes(field, model=tmp_path / "a.fits", residual=tmp_path / "a.fits")
    with pytest.raises(ValueError, match=r"'model' must be a FITS file \(.fits, .fits.gz\)"):
        fluxes(field, model=tmp_path / "a.png")


@pytest.mark.pictures
@pytest.mark.slow
def test_poor_fits_of_the_bright_stand_on_the_page_and_warnings_are_shown_once(field, tmp_path):
    """The PSF of another band, said to be that of a smoothed image."""
    form = {"pixel_scale": COARSE * ARCSEC}
    wide = psf_image(filter_psf("miri.f1500w", **form, pa=PA * u.deg), **form, shape=91)
    command = [sys.executable, "-m", "miricigale", "photometry", "--no-progress", "--threads", "1"]
    for name, path in field.paths.items():
        command += [f"--{name}", path]
    command += ["--psf", saved(tmp_path, wide / wide.sum()), "--psf-scale", str(COARSE)]
    command += ["-o", tmp_path / "out.ecsv", "--residual", tmp_path / "residual.fits"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True)
    assert done.stderr.count("was the image brought to this resolution?") == 1
    assert "leave residuals above the noise" in (tmp_path / "out.html").read_text()
    assert (tmp_path / "residual.fits").is_file()
