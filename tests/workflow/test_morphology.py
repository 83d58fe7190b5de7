"""Shapes that no Sersic profile describes: light, place, size and turn of clumps and of stamps."""

import functools

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers import scenes
from helpers.errors import refuses, warned
from helpers.runs import STAGES, do_stage, one_band
from helpers.scenes import catalog_at
from miricigale.psf import gaussian_psf
from miricigale.scene import Scene
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import ConfigError, DataError, MiricigaleWarning
from miricigale.workflow.morphology import (
    MIN_RADIUS,
    RealGalaxies,
    add_clumps,
    read_stamps,
    stamps_of_sources,
    write_stamps,
)
from miricigale.workflow.study import check_study

BAND, PRIOR, SEED = "miri.f770w", "wfc3.f160w", 5
PIXEL = 0.06
NONE = "none of the {} Sersic profiles of the catalog has a galaxy on the image"


def disks(n=400):
    rng = np.random.default_rng(3)
    table = catalog_at(
        SkyCoord(53.1 + 0.002 * np.arange(n), np.full(n, -27.8), unit="deg"),
        id=7 * np.arange(1, n + 1),
        profile="sersic",
        half_light_radius=rng.uniform(0.2, 1.0, n) * u.arcsec,
        axis_ratio=rng.uniform(0.2, 1.0, n),
        position_angle=rng.uniform(0, 180, n) * u.deg,
        **{BAND: rng.uniform(1, 100, n) * u.uJy},
    )
    table["miri.f1500w"] = 3 * table[BAND]
    return table


def in_own_axes(table, clumps, owner):
    """Offsets of clumps along the axes of their galaxies, over the half-light radius along each."""
    own = table[owner]
    east, north = own["sky"].spherical_offsets_to(clumps["sky"])
    angle = own["position_angle"]
    major = east * np.sin(angle) + north * np.cos(angle)
    minor = east * np.cos(angle) - north * np.sin(angle)
    radius = own["half_light_radius"]
    return (major / radius).to_value(""), (minor / radius / own["axis_ratio"]).to_value("")


def test_clumps_follow_the_light_of_their_galaxies():
    table = disks()
    painted = add_clumps(table, BAND, share=0.2, seed=SEED)
    smooth, clumps = painted[: len(table)], painted[len(table) :]
    assert_allclose(smooth[BAND], 0.8 * table[BAND])
    assert len(np.unique(painted["id"])) == len(painted)
    assert set(clumps["profile"]) == {"point"}
    # galaxies are 0.002 deg from each other
    owner = np.rint((clumps["sky"].ra.deg - 53.1) / 0.002).astype(int)
    numbers = np.bincount(owner)
    assert (numbers.min(), numbers.max()) == (3, 12)
    light = np.bincount(owner, weights=clumps[BAND].value)
    assert_allclose(light, 0.2 * table[BAND].value)
    major, minor = in_own_axes(table, clumps, owner)
    radius = np.hypot(major, minor)
    # an exponential disk has half of its light within 1, 90 % within 2.318 (x = 3.890 of 1.678)
    assert np.mean(radius < 1) == pytest.approx(0.5 / 0.9, abs=0.03)
    assert radius.max() < 2.318
    assert radius.max() > 2.2
    for values in (major, minor):
        assert abs(values.mean()) < 4 * values.std() / np.sqrt(len(values))


def test_clumps_are_those_of_a_source_in_every_band():
    table = disks(30)
    first = add_clumps(table, BAND, share=0.2, seed=SEED)
    other = add_clumps(table, "miri.f1500w", share=0.2, seed=SEED)
    assert_array_equal(first["sky"].ra, other["sky"].ra)
    assert_allclose(other["miri.f1500w"], 3 * first[BAND])
    # of the id, not of the row
    part = add_clumps(table[20:], BAND, share=0.2, seed=SEED)
    assert_array_equal(part["sky"].ra[10:], first["sky"].ra[len(first) - len(part) + 10 :])


def test_ids_may_be_text(field, tmp_path):
    galaxies, table, _ = field
    table = table[:3]
    table["id"] = ["a", "b", "cc"]
    painted = add_clumps(table, BAND, share=0.2, seed=SEED)
    assert len(set(painted["id"])) == len(painted) > 10
    assert painted["id"][:3].tolist() == ["a", "b", "cc"]
    stamps = stamps_of_sources(table, galaxies, of="own", seed=SEED)
    write_stamps(stamps, tmp_path / "stamps.fits")
    assert list(read_stamps(tmp_path / "stamps.fits")) == list(stamps) == ["a", "b", "cc"]
    assert paint(table, stamps, scenes.tan_wcs(shape=(210, 210)), BAND).sum() > 0


def test_only_the_disks_are_clumpy_and_points_keep_their_light():
    table = disks(4)
    table["sersic_index"][0] = 4.0
    table["profile"][1] = "point"
    table["half_light_radius"][2] = np.nan * u.arcsec
    table["share"] = [0.5, 0.5, 0.5, 0.5]
    options = {"share": 0.2, "seed": SEED}
    text = "1 of 3 Sersic profiles are drawn as points"
    painted = warned(text, add_clumps, table, BAND, **options, point="share")
    assert_allclose(painted[BAND][:3], table[BAND][:3])
    assert painted[BAND].sum().value == pytest.approx(table[BAND].sum().value)
    # clumps take of the galaxy's half only
    assert painted[BAND][3].value == pytest.approx(0.9 * table[BAND][3].value)
    in_points = (painted[BAND] * painted["share"])[3].value
    assert in_points == pytest.approx(0.5 * table[BAND][3].value)
    assert_array_equal(painted["share"][4:], 0)
    painted = warned("1 of 2 Sersic", add_clumps, table[:3], BAND, **options)
    assert painted[BAND].sum() == table[BAND][:3].sum()


@pytest.fixture(scope="module")
def drawn():
    """Spirals that no Sersic profile describes, on 0.06 arcsec pixels, with a point and a faint galaxy."""
    wcs = scenes.tan_wcs(shape=(400, 400), scale=PIXEL)
    x, y = [100.0, 280.0, 120.0, 290.0, 200.0], [110.0, 100.0, 290.0, 280.0, 200.0]
    table = scenes.make_catalog(
        wcs, x, y, profile="sersic", radius=[0.5, 0.6, 0.4, 0.3, 0.1], ratio=[0.5, 0.7, 1.0, 1.0, 1.0],
        angle=[30.0, 100.0, 0.0, 0.0, 0.0], flux=[50.0, 60.0, 40.0, 0.2, 30.0],
    )  # fmt: skip
    table["profile"][4] = "point"
    table[PRIOR] = table[BAND]
    width = 2.3548 * 1.2 * PIXEL * u.arcsec
    psf = gaussian_psf(width, pixel_scale=PIXEL * u.arcsec, fov=4 * u.arcsec)
    clumpy = add_clumps(table, PRIOR, share=0.4, seed=2)
    image = Scene(clumpy, filter=PRIOR, wcs=wcs, psf=psf).render()
    data = image.data + 0.002 * np.random.default_rng(1).normal(size=image.shape)
    mask = np.zeros(data.shape, bool)
    return CCDData(data, unit="MJy/sr", wcs=wcs, mask=mask), psf, table, clumpy


@pytest.fixture(scope="module")
def field(drawn):
    image, psf, table, clumpy = drawn
    return RealGalaxies(image, psf), table, clumpy


def paint(catalog, stamps, wcs, band):
    catalog = catalog.copy()
    catalog["profile"][np.isin(catalog["id"], list(stamps))] = "cutout"
    psf = scenes.gaussian_psf(sigma=1.3)
    return Scene(catalog, filter=band, wcs=wcs, psf=psf, cutouts=stamps).render().data


def test_galaxies_have_their_own_light(field):
    galaxies, table, clumpy = field
    stamps = stamps_of_sources(table, galaxies, of="own", seed=SEED)
    # the fourth is too faint, the fifth a point
    assert list(stamps) == [1, 2, 3]
    wcs = scenes.tan_wcs(shape=(210, 210))
    clumpy = clumpy[[True, True, True, False, False, *[True] * (len(clumpy) - 5)]]
    clumpy[BAND] = clumpy[PRIOR]
    owner = np.argmin([row.separation(table["sky"]) for row in clumpy["sky"]], axis=1)
    clumpy = clumpy[owner < 3]
    table = table[:3]
    pairs = (clumpy, {}), (table, stamps), (table, {})
    known, found, smooth = (paint(rows, chosen, wcs, BAND) for rows, chosen in pairs)
    # as they are, and not as their profiles
    error, change = (np.abs(image - known).sum() / known.sum() for image in (found, smooth))
    assert change > 0.2
    assert error < 0.35 * change
    assert found.sum() == pytest.approx(smooth.sum(), rel=0.01)


def test_two_sources_on_one_segment_keep_their_profiles(field):
    galaxies, table, _ = field
    twice = table[[0, 1, 1]]
    twice["id"] = [1, 2, 3]
    assert list(stamps_of_sources(twice, galaxies, of="own", seed=SEED)) == [1]
    away = table[:2]
    away["sky"] = SkyCoord(away["sky"].ra + 1 * u.deg, away["sky"].dec)
    refuses(NONE.format(2), stamps_of_sources, away, galaxies, error=DataError, of="own", seed=SEED)


def moments(image, x0, y0, reach):
    y, x = np.indices(image.shape)
    light = np.where(np.hypot(x - x0, y - y0) < reach, image, 0.0)
    total = light.sum()
    x0, y0 = (float(np.sum(light * at) / total) for at in (x, y))
    parts = ((x - x0, x - x0), (y - y0, y - y0), (x - x0, y - y0))
    return x0, y0, [float(np.sum(light * a * b) / total) for a, b in parts]


def test_drawn_galaxies_have_size_place_and_turn_of_the_source(field):
    galaxies, _, _ = field
    # no points
    assert len(galaxies.resolved) == 3
    assert np.all(np.asarray(galaxies.resolved["radius"], float) > MIN_RADIUS)
    wcs = scenes.tan_wcs(shape=(120, 120))
    shape = {"profile": "sersic", "radius": 0.7, "ratio": 0.5, "angle": 70.0}
    table = scenes.make_catalog(wcs, 60.0, 60.0, **shape)
    stamps = stamps_of_sources(table, galaxies, of="any", seed=SEED)
    again = stamps_of_sources(table, galaxies, of="any", seed=SEED)
    assert_array_equal(stamps[1].data, again[1].data)
    radius = 0.7 * np.sqrt(0.5)
    assert stamps[1].half_light_radius.to_value(u.arcsec) == pytest.approx(radius, rel=1e-9)
    x, y, (xx, yy, xy) = moments(paint(table, stamps, wcs, BAND), 60, 60, 20)
    assert (x, y) == (pytest.approx(60, abs=0.3), pytest.approx(60, abs=0.3))
    # +x is west: the position angle from the north over the east
    angle = 0.5 * np.degrees(np.arctan2(-2 * xy, yy - xx)) % 180
    assert angle == pytest.approx(70, abs=12)
    # nothing is like it
    table["half_light_radius"] = 8.0 * u.arcsec
    options = {"error": DataError, "of": "any", "seed": SEED}
    refuses(NONE.format(1), stamps_of_sources, table, galaxies, **options)


def test_masked_galaxies_and_those_at_the_edge_are_not_used(drawn):
    image, psf, table = drawn[0].copy(), *drawn[1:3]
    image.mask[110, 100] = True
    # that of row 2 ends 1 arcsec from the edge
    image = CCDData(image.data[:300], mask=image.mask[:300], unit=image.unit, wcs=image.wcs[:300])
    stamps = stamps_of_sources(table[:3], RealGalaxies(image, psf), of="own", seed=SEED)
    assert list(stamps) == [2]


def test_stamps_come_back_from_their_file(field, tmp_path):
    galaxies, table, _ = field
    stamps = stamps_of_sources(table, galaxies, of="any", seed=SEED)
    write_stamps(stamps, tmp_path / "stamps.fits")
    back = read_stamps(tmp_path / "stamps.fits")
    assert list(back) == list(stamps)
    for key, stamp in stamps.items():
        assert_allclose(back[key].data, stamp.data, rtol=1e-6)
        assert back[key].pixel_scale == stamp.pixel_scale
        assert back[key].angle == stamp.angle
        assert back[key].center == stamp.center


def test_a_study_paints_the_light_of_an_image(drawn, tmp_path, monkeypatch):
    """From a file to the sky of an exposure: the truth keeps its profiles, the scene has the stamps."""
    image, table = drawn[0].copy(), drawn[2].copy()
    image.write(tmp_path / "galaxies.fits")
    bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", PRIOR]
    parameters = QTable({"redshift": np.full(len(table), 1.0), "age": np.full(len(table), 1.0)})
    parameters["mass"], parameters["tau"], parameters["ebv"] = 10.0**10.5, 1.0, 0.3
    parameters["alpha"] = 2.0
    light = SEDModel.yang2021(agn=False).fluxes(parameters, bands)
    for name in bands:
        table[name] = light[name]
    table["mag_f160w"] = 20.0
    table.remove_column(BAND)
    table.write(tmp_path / "mine.ecsv")
    perturb = {"effects": "cutouts", "cutouts": str(tmp_path / "galaxies.fits")}
    catalog, sed = {"source": str(tmp_path / "mine.ecsv")}, {"axes": "quick"}
    config = one_band(BAND, kind="rates", catalog=catalog, sed=sed, perturb=perturb)
    run = functools.partial(do_stage, config, tmp_path)
    for name, unit in (("catalog", ""), ("seds", ""), ("truth", "agn00")):
        run(name, unit)
    with pytest.warns(MiricigaleWarning, match="has no map of the noise"):
        run("truth", "agn00+cutouts")
    paths = (tmp_path / name / "truth.ecsv" for name in ("agn00", "agn00+cutouts"))
    known, own = map(QTable.read, paths)
    for name in (BAND, PRIOR, "profile", "mass"):
        assert_array_equal(own[name], known[name])
    # the fourth, faint on the image, is not
    assert list(read_stamps(tmp_path / "agn00+cutouts" / "stamps.fits")) == [1, 2, 3]
    assert not (tmp_path / "agn00" / "stamps.fits").exists()
    painted = {}

    def scene(catalog, **options):
        painted["profile"] = np.asarray(catalog["profile"]).tolist()
        painted["cutouts"] = sorted(options["cutouts"])
        raise RuntimeError

    monkeypatch.setattr("miricigale.scene.Scene", scene)
    for name, profiles, ids in (
        ("agn00", ["sersic"] * 4, []),
        ("agn00+cutouts", ["cutout"] * 3 + ["sersic"], [1, 2, 3]),
    ):
        with pytest.raises(RuntimeError):
            run("exposures", f"{name}/{BAND}-0")
        assert painted == {"profile": [*profiles, "point"], "cutouts": ids}
    # another image under the same name is seen
    plan = STAGES["truth"].plan
    first = plan(config, "agn00+cutouts")
    image.data[0, 0] = 1.0
    image.write(tmp_path / "galaxies.fits", overwrite=True)
    assert plan(config, "agn00+cutouts") != first
    (tmp_path / "galaxies.fits").unlink()
    text = r"\[perturb\] cutouts must be a file, got '.*galaxies.fits'"
    refuses(text, check_study, config, error=ConfigError)


@pytest.mark.slow
def test_real_galaxies_of_an_image_with_its_psf(data_file):
    """F444W of PRIMER-UDS: sharper than on the image, but for noise, and of light that is the image's."""
    uds = data_file("uds")
    path, psf = f"{uds}/uds-test-f444w_sci.fits.gz", f"{uds}/psf/uds-test-f444w_psf.fits.gz[0,mean]"
    with pytest.warns(MiricigaleWarning, match="has no map of the noise"):
        galaxies, plain = RealGalaxies.read(path, psf=psf), RealGalaxies.read(path)
    assert galaxies.psf.fwhm.to_value(u.arcsec) == pytest.approx(0.16, abs=0.02)
    assert plain.psf is None
    both = (plain, galaxies)
    labels = [label for label in plain.labels if all(one.cutout(label) is not None for one in both)]
    assert len(labels) > 15
    sums, radii = (
        np.transpose([[f(one.cutout(label)) for one in (plain, galaxies)] for label in labels])
        for f in (lambda stamp: stamp.data.sum(), lambda stamp: stamp.half_light_radius.value)
    )
    # light comes in from the wings
    assert_allclose(sums[1] / sums[0], 1.03, atol=0.08)
    assert np.all(radii[1] < radii[0])
    # in quadrature the PSF's own: Gaussian of its width at least
    less = np.sqrt(radii[0] ** 2 - radii[1] ** 2)
    assert 0.05 < np.median(less) < 0.2
