"""AGN put into images: what is measured of them is what was put in."""

import shutil

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.commands import command
from helpers.errors import refuses
from helpers.mosaics import CENTER, FINE, HI, LO, lattice, places, render
from miricigale.agn import AGNImages
from miricigale.agn.images import N_IMAGES, separate_trials
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import MosaicFile, measure_files
from miricigale.psf import gaussian_psf

#: Peaks of the noise are detected on the prior, which the catalog lacks.
pytestmark = pytest.mark.filterwarnings("ignore:.*segments of the segmentation")

BAND, PRIOR = "irac.ch4", "nircam.f430m"
FWHM = np.sqrt(8 * np.log(2))
PIXEL = 0.11
#: Width of galaxies in arcsec.
SIZE = 0.25
#: Total fluxes in uJy.
FLUX = 10.0


def write(path, sky, *, scale, width, side, noise, rng):
    """An image of Gaussian galaxies in white noise, in uJy."""
    wcs = north_up_wcs(CENTER, scale * u.arcsec, (side, side))
    area = pixel_area_map(wcs, (side, side)) * 1e12
    data = render(sky, np.full(len(sky), FLUX), np.hypot(width, SIZE), wcs, (side, side)) * area
    header = wcs.to_header()
    header.update(BUNIT="uJy")
    hdus = [fits.PrimaryHDU()]
    hdus.append(fits.ImageHDU(data + rng.normal(0, noise, data.shape), header, name="SCI"))
    hdus.append(fits.ImageHDU(np.full(data.shape, noise), header, name="ERR"))
    fits.HDUList(hdus).writeto(path)
    psf = gaussian_psf(
        width * FWHM * u.arcsec, pixel_scale=0.03 * u.arcsec, fov=16 * width * u.arcsec
    )
    psf.write(path.with_name(f"psf_{path.name}"))


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Folder with an image and a prior of nine galaxies, and the options of their photometry."""
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(2)
    sky = places(*lattice(rng, 3, 6.0, 0.5))
    write(folder / "image.fits", sky, scale=PIXEL, width=LO, side=200, noise=0.004, rng=rng)
    write(folder / "prior.fits", sky, scale=FINE, width=HI, side=380, noise=0.0005, rng=rng)
    catalog = QTable({"id": np.arange(len(sky)) + 11, "ra": sky.ra, "dec": sky.dec})
    catalog["components"] = 2
    catalog.write(folder / "catalog.fits")
    image = MosaicFile(folder / "image.fits", filter=BAND, psf=folder / "psf_image.fits")
    prior = MosaicFile(folder / "prior.fits", filter=PRIOR, psf=folder / "psf_prior.fits")
    return {"image": image, "highres": prior, "catalog": folder / "catalog.fits"}


@pytest.fixture(scope="module")
def hosts(field):
    """Photometry of some galaxies, one of them twice, with nuclei."""
    measured = measure_files(**field)
    rows = [0, 4, 4, 8]
    table = QTable({"id": np.asarray(measured["id"])[rows]})
    table[BAND] = measured[BAND][rows]
    table[f"{BAND}_err"] = measured[f"{BAND}_err"][rows]
    for end in ("", "_err", "_corr"):
        table[f"{BAND}_nucleus{end}"] = measured[f"{BAND}_flux_point{end}"][rows]
    table[f"{BAND}_nucleus_limit"] = np.zeros(4, bool)
    return table


def test_catalogs_in_files_choose_components(field):
    """All galaxies have a point that was fitted, not only those that noise made brighter."""
    point = measure_files(**field)[f"{BAND}_flux_point"].value
    assert np.all(np.isfinite(point))
    without = measure_files(field["image"], field["highres"], catalog=None)
    assert f"{BAND}_flux_point" not in without.colnames


def test_agn_are_measured_as_bright_as_they_are(field, hosts):
    """The noise is the same without them, so that the light comes back without any."""
    light = {BAND: [1.0, 2.0, 4.0, 0.5] * u.uJy, PRIOR: np.zeros(4) * u.uJy}
    images = AGNImages(**field)
    measured = images.add_agn(hosts, hosts, hosts["id"], light)
    assert measured[N_IMAGES].tolist() == [1, 1, 1, 1]
    for name in (BAND, f"{BAND}_nucleus"):
        assert_allclose((measured[name] - hosts[name]).value, light[BAND].value, rtol=0.02)
        errors = measured[f"{name}_err"] / hosts[f"{name}_err"]
        assert_allclose(errors.value, 1.0, rtol=0.02)
    assert_allclose(measured[f"{BAND}_nucleus_corr"], hosts[f"{BAND}_nucleus_corr"], atol=0.02)


def test_bright_agn_have_the_noise_of_their_electrons(field, hosts, tmp_path):
    """An electron each second is 1 uJy; fits of points cannot be better than counting all of the electrons."""
    time = 100.0
    path = tmp_path / "image.fits"
    with fits.open(field["image"].path) as hdus:
        for hdu in hdus[1:]:
            hdu.header["BUNIT"] = "electron/s"
        hdus["SCI"].header["EXPTIME"] = time
        hdus.writeto(path)
    counted = field["image"].replace(path=path, zero_point=23.9 * u.ABmag)
    images = AGNImages(**field | {"image": counted})
    assert images.photon_noise[BAND].text == "pixels in electron / s, EXPTIME 100 s"
    bright = 50.0
    light = {BAND: np.full(9, bright) * u.uJy, PRIOR: np.zeros(9) * u.uJy}
    galaxies = measure_files(**field)
    table = QTable({"id": galaxies["id"].astype(str)})
    for end in ("", "_err"):
        table[f"{BAND}{end}"] = galaxies[f"{BAND}{end}"]
    deviations = []
    for seed in range(6):
        measured = images.add_agn(table, table, galaxies["id"], light, seed=seed)
        deviations.append((measured[BAND] - table[BAND]).value - bright)
    deviations = np.array(deviations) / np.sqrt(bright / time)
    # that of a lone Gaussian with equal weights is the root of 4 / 3; 54 values tell it to a tenth
    assert 0.9 < np.std(deviations) < 1.6
    assert abs(np.mean(deviations)) < 0.5
    # threads change nothing
    others = AGNImages(**field | {"image": counted}, n_threads=2)
    again = others.add_agn(table, table, galaxies["id"], light, seed=5)
    for name in measured.colnames:
        assert np.array_equal(again[name], measured[name])


def test_the_prior_shows_agn_too(field, hosts):
    """A point in the template: the total comes back, but less of it is told from the galaxy."""
    light = {BAND: np.full(4, 4.0) * u.uJy, PRIOR: np.full(4, 4.0) * u.uJy}
    measured = AGNImages(**field).add_agn(hosts, hosts, hosts["id"], light)
    assert_allclose((measured[BAND] - hosts[BAND]).value, 4.0, rtol=0.05)
    assert np.all(measured[f"{BAND}_nucleus"] - hosts[f"{BAND}_nucleus"] < 2.0 * u.uJy)


def test_what_the_catalog_lacks_is_taken_from_the_images(field, hosts):
    light = {BAND: np.full(4, 1.0) * u.uJy, PRIOR: np.zeros(4) * u.uJy}
    images = AGNImages(**field)
    whole = images.add_agn(hosts, hosts, hosts["id"], light)
    table = hosts.copy()
    table[BAND][0] = np.nan * u.uJy
    table[f"{BAND}_nucleus"][1] = 5.0 * u.uJy
    table[f"{BAND}_nucleus_limit"][1] = True
    # fluxes that were corrected since stay corrected
    table[BAND][3] += 1.0 * u.uJy
    # a galaxy that no image has
    ids = np.array([*hosts["id"][:2], 999, hosts["id"][3]])
    measured = images.add_agn(table, table, ids, light)
    assert_allclose(measured[BAND][:2].value, whole[BAND][:2].value, rtol=1e-6)
    assert_allclose(measured[f"{BAND}_nucleus"][1].value, whole[f"{BAND}_nucleus"][1].value)
    assert not measured[f"{BAND}_nucleus_limit"][1]
    assert_allclose((measured[BAND][3] - whole[BAND][3]).value, 1.0)
    assert measured[BAND][2] == table[BAND][2]
    assert measured[N_IMAGES].tolist() == [1, 1, 0, 1]


def test_content_is_that_of_files_and_options(field, tmp_path):
    content = AGNImages(**field).content
    assert AGNImages(**field, n_threads=2).content == content
    assert AGNImages(**field, components=1).content != content
    other = tmp_path / "image.fits"
    shutil.copy(field["image"].path, other)
    copied = field | {"image": field["image"].replace(path=other)}
    assert AGNImages(**copied).content == content
    with fits.open(other, mode="update") as hdus:
        hdus["SCI"].data[3, 4] += 1.0
    assert AGNImages(**copied).content != content


def test_sets_of_positions_are_apart():
    rng = np.random.default_rng(1)
    sky = SkyCoord(rng.uniform(0, 0.01, 60), rng.uniform(0, 0.01, 60), unit="deg")
    sky = sky[np.arange(90) % 60]
    chosen = np.arange(90) != 7
    trial = separate_trials(sky, chosen, 3 * u.arcsec)
    assert trial[7] == -1
    for number in range(trial.max() + 1):
        members = sky[trial == number]
        separation = members[:, None].separation(members[None]).arcsec
        assert np.all(separation[~np.eye(len(members), dtype=bool)] >= 3)
    assert np.all(trial[chosen] >= 0)


def test_the_command_takes_images_with_their_options(field, hosts, tmp_path, capsys):
    catalog = tmp_path / "catalog.fits"
    hosts[[0, 1, 3]][["id", BAND, f"{BAND}_err"]].write(catalog)
    arguments = ["agn", catalog, "--area", 20, "--plan", "--images"]
    arguments += [field["image"].path, field["highres"].path, "--catalog", field["catalog"]]
    named = ["--filter", "irac.ch4", "--psf", field["image"].psf]
    named += ["--highres-filter", PRIOR, "--highres-psf", field["highres"].psf]
    assert "3 objects and at most 200 injected AGN" in command(capsys, *arguments, *named).out
    missing = [*arguments[:7], tmp_path / "none.fits"]
    assert "none.fits" in command(capsys, *missing, *named, status=2).err


def test_refusals(field, hosts):
    light = {BAND: np.ones(4) * u.uJy, PRIOR: np.zeros(4) * u.uJy}
    images = AGNImages(**field)
    refuses("with the ids of the photometry", images.add_agn, hosts, hosts, np.full(4, "x"), light)
    refuses("'detection' must be left out", AGNImages, **field, detection=["x.fits"])
    plain = AGNImages(field["image"], field["highres"], components=1)
    refuses("'components' must be 2", plain.add_agn, hosts, hosts, hosts["id"], light)
