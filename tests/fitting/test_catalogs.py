"""What catalogs may hold that a fit cannot use: it is reported, flagged or refused, never guessed."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Column, MaskedColumn, QTable, Table
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import brute_force, draw_photometry, make_grid, node_fitter
from miricigale.fitting import BayesFitter, FitFlags, FitResults, GridSettings, Samples, fit_file
from miricigale.utils.exceptions import MiricigaleWarning


@pytest.fixture
def catalog(grid):
    return draw_photometry(grid, 6, noise=0.1)[0]


@pytest.fixture
def wider(catalog):
    """Bands that the grid lacks, by unit and by name, and columns that are none."""
    table = catalog.copy()
    table["acs.f606w"], table["acs.f606w_err"] = table["band0"], table["band0_err"]
    table["miri.f560w"] = np.ones(6)
    table["mass"], table["mass_err"] = 1e10 * u.Msun, 1e9 * u.Msun
    table["sky"] = 1.0 * u.uJy
    return table


# ------------------------------------------------------------------------------- bands


def test_bands_that_the_grid_lacks_are_named(grid, catalog, wider):
    fitter = node_fitter(grid)
    text = r"are not fitted: acs\.f606w, miri\.f560w$"
    with pytest.warns(MiricigaleWarning, match=text) as record:
        results = fitter.fit(wider)
    # the line that called
    assert [one.filename for one in record] == [__file__]
    assert results.meta["fit"]["unused_bands"] == ["acs.f606w", "miri.f560w"]
    with pytest.warns(MiricigaleWarning, match="acs.f606w") as record:
        samples = fitter.sample(wider, 2, seed=1)
    assert record[0].filename == __file__
    assert samples.meta["fit"]["unused_bands"] == ["acs.f606w", "miri.f560w"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = fitter.fit(catalog)
        # who names the bands knows
        chosen = node_fitter(grid, ["band0", "band1", "band2"]).fit(wider)
    assert alone.meta["fit"]["unused_bands"] == []
    assert_array_equal(alone.chi2, results.chi2)
    unused = ["band3", "band4", "band5", "acs.f606w", "miri.f560w"]
    assert chosen.meta["fit"]["unused_bands"] == unused


def test_a_catalog_on_disk_is_warned_of_once(grid, wider, tmp_path):
    wider.write(tmp_path / "cat.fits")
    with pytest.warns(MiricigaleWarning, match="acs.f606w") as record:
        results = fit_file(node_fitter(grid), tmp_path / "cat.fits", tmp_path / "o", chunk_rows=2)
    assert [w.filename for w in record if issubclass(w.category, MiricigaleWarning)] == [__file__]
    for part in results.parts():
        assert part.meta["fit"]["unused_bands"] == ["acs.f606w", "miri.f560w"]


# -------------------------------------------------------------------------------- rows


@pytest.mark.parametrize("kind", [int, str])
def test_masked_ids_are_refused(grid, catalog, tmp_path, kind):
    table = Table(catalog)
    table["id"] = MaskedColumn(np.arange(6).astype(kind), mask=[0, 0, 0, 0, 1, 0])
    match = "'photometry' must be a table with an id in every row, got 1 masked or empty"
    refuses(rf"{match}, the first in row 4 \(from 0\)", node_fitter(grid).fit, table)
    if kind is str:
        # as some files have them
        table["id"] = [*"abcd", "", "f"]
        refuses(match, node_fitter(grid).fit, table)
        table.write(tmp_path / "cat.ecsv")
        with pytest.raises(ValueError, match=match) as error:
            fit_file(node_fitter(grid), tmp_path / "cat.ecsv", tmp_path / "o", chunk_rows=3)
        assert "in rows 3 to 5 of" in error.value.__notes__[0]


def test_text_ids_are_text_wherever_they_come_from(grid, catalog, tmp_path):
    catalog["id"] = [f"g{i}" for i in range(6)]
    fitter = node_fitter(grid)
    want, drawn = fitter.fit(catalog), fitter.sample(catalog, 5, seed=1)
    catalog.write(tmp_path / "cat.fits")
    read = Table.read(tmp_path / "cat.fits", character_as_bytes=True)
    assert read["id"].dtype.kind == "S"
    of_objects = Table(catalog)
    of_objects["id"] = np.array(catalog["id"].tolist(), dtype=object)
    for table in (read, of_objects):
        got = fitter.fit(table)
        assert got["g3"].chi2 == want["g3"].chi2
        assert repr(got["g3"]).startswith("<FitResults of 'g3', chi2 ")
        assert got[0:2].ids.tolist() == ["g0", "g1"]
        assert_array_equal(got[[3, 1]].chi2, want.chi2[[3, 1]])
        assert_array_equal(got[want.chi2 > 1.0].ids, want.ids[want.chi2 > 1.0])
        with pytest.raises(KeyError, match=r"no column or id 'g7'; .* g5"):
            got["g7"]
        with pytest.raises(KeyError, match="no object with the id 'g7' among 6"):
            got.loc["g7"]
        # and so are the random streams
        assert_array_equal(fitter.sample(table, 5, seed=1).scale, drawn.scale)
        got.write(tmp_path / "r.fits", overwrite=True)
        assert FitResults.read(tmp_path / "r.fits")["g5"].chi2 == want["g5"].chi2
    for bad, message in (
        (["a", 1, "b", 2, "c", 3], r"ids of one kind, got \['int', 'str'\]"),
        (["a", None, "b", "c", "d", "e"], "1 masked or empty, the first in row 1"),
    ):
        of_objects["id"] = np.array(bad, dtype=object)
        refuses(message, fitter.fit, of_objects)


@pytest.mark.parametrize("name", ["Kümmel 3", "b "])
def test_ids_that_fits_files_cannot_hold_are_named(grid, catalog, tmp_path, name):
    catalog["id"] = ["a", "b", name, "c", "d", "e"]
    fitter = node_fitter(grid)
    results, samples = fitter.fit(catalog), fitter.sample(catalog, 2, seed=1)
    for item in (results, samples):
        assert item[name] is not None
        refuses(rf"'ids' must be ASCII, .* got '{name}'", item.write, tmp_path / "r.fits")


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", ">i4", ">u4", "i8", "u8", ">f4", "f8"])
def test_ids_of_any_number_survive_files(grid, catalog, tmp_path, dtype):
    known = np.dtype(dtype)
    # floats that have no integer between them
    top = np.iinfo(known).max if known.kind in "iu" else 2**24 - 1
    ids = np.array([1, 2, 3, 4, top - 1, top], dtype=known)
    table = Table(catalog)
    table["id"] = ids
    fitter = node_fitter(grid)
    results, samples = fitter.fit(table), fitter.sample(table, 2, seed=1)
    assert not np.any(results.flags & int(FitFlags.DUPLICATE_ID))
    results.write(tmp_path / "r.fits")
    samples.write(tmp_path / "s.fits")
    for item in (FitResults.read(tmp_path / "r.fits"), Samples.read(tmp_path / "s.fits", grid)):
        assert item.ids.tolist() == ids.tolist()
        assert item.row(ids[5]) == 5


def test_masked_redshifts_are_missing(grid, catalog):
    fitter = node_fitter(grid)
    z = np.array(catalog["redshift"], dtype=float)
    mask = np.arange(6) == 2
    want = fitter.fit(catalog, redshift=np.where(mask, np.nan, z))
    assert FitFlags.NO_REDSHIFT & want.flags[2]
    table = Table(catalog)
    table["z"] = MaskedColumn(z, mask=mask)
    for given in ("z", table["z"], np.ma.array(z, mask=mask), table["z"].tolist()):
        got = fitter.fit(table, redshift=given)
        assert_array_equal(got.flags, want.flags)
        assert_array_equal(got.chi2, want.chi2)


def test_masked_densities_are_missing(grid, catalog):
    fitter = node_fitter(grid)
    nodes = np.linspace(0.0, 3.0, 31)
    density = np.ma.array(np.ones((6, 31)), mask=np.zeros((6, 31), dtype=bool))
    density[3, 7:9] = np.ma.masked
    got = fitter.fit(catalog, redshift_prior=(nodes, density))
    assert_array_equal(got.flags & int(FitFlags.NO_REDSHIFT) > 0, np.arange(6) == 3)
    assert_array_equal(got.fitted, np.arange(6) != 3)
    prior = (np.ma.masked_less(nodes, 1.0), np.ones(31))
    text = r"'redshift_prior\[0\]' must be >= 0 and ascending"
    refuses(text, fitter.fit, catalog, redshift_prior=prior)


def test_errors_may_be_per_cent(grid, catalog):
    want = node_fitter(grid, model_error=0.2, error_floor={"band1": 0.3}).fit(catalog)
    floor = {"band1": 30 * u.percent}
    got = node_fitter(grid, model_error=20 * u.percent, error_floor=floor).fit(catalog)
    assert_allclose(got.sigma, want.sigma, rtol=1e-12)
    for bad, error, text in (
        (0.1 * u.uJy, u.UnitsError, "be convertible to"),
        (np.ones(5), ValueError, "be an array of 0 dimension"),
    ):
        refuses(f"'model_error' must {text}", BayesFitter, grid, error=error, model_error=bad)


@pytest.mark.slow
@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("flux", [0.0, -0.3, 1e-158, 1e-250])
def test_without_signal_the_posterior_is_the_prior(flux, limited):
    """No model has light, all have the same chi2: sum (F / sigma)^2."""
    grid = make_grid(3)
    table, _ = draw_photometry(grid, 3)
    weights = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    for name in grid.filters:
        table[name][1] = flux * table[f"{name}_err"][1]
    if limited:
        table["band5"][1] = 1.0 * table["band5_err"][1]
        table["band5_limit"] = [False, True, False]
    fitter = node_fitter(grid, priors={"tau": weights}, model_error=0.0)
    results = fitter.fit(table)
    assert list(results.ids) == [0, 1, 2]
    assert results.fitted.all()
    assert FitFlags.NO_SIGNAL & results.flags[1]
    assert not FitFlags.NO_SIGNAL & (results.flags[0] | results.flags[2])
    assert results.best_scale[1] == 0.0
    assert results.mean("mass")[1] == 0.0
    assert_allclose(results.pdf["tau"][1], weights / 15.0, rtol=1e-6)
    assert_allclose(results.pdf["frac_agn"][1], 0.25, rtol=1e-6)
    # impossible ages leave the rest of the prior
    allowed = (grid.allowed * np.repeat(weights / 15.0, 4)).reshape(4, 5, 4).sum((1, 2)) / 16.0
    assert_allclose(results.pdf["redshift"][1], allowed / allowed.sum(), rtol=1e-6)
    n = 5 if limited else 6
    sigma = results.sigma[1, :n]
    evidence = -0.5 * n * flux**2 - np.log(np.sqrt(2.0 * np.pi) * sigma).sum()
    # a measurement of nothing lies below a limit of one sigma in 84 % of cases
    evidence += np.log(0.8413447460685429) if limited else 0.0
    assert_allclose(results.log_evidence[1], evidence + np.log(allowed.sum()), rtol=1e-6)
    drawn = fitter.sample(table, 50, seed=2)
    assert drawn.fitted.all()


def test_the_best_model_has_the_lowest_chi2_of_those_that_matter():
    """Whatever its prior with ``rtol=0``; else none is left out that has weight."""
    grid = make_grid(5, n_tau=8)
    table, truth = draw_photometry(grid, 8, noise=0.3)
    n_better = 0
    for i, (_, g, *_) in enumerate(truth):
        weights = np.ones(8)
        weights[g // 4] = 1e-30
        for rtol in (0.0, 1e-6):
            priors = {"tau": weights}
            fitter = node_fitter(grid, priors=priors, settings=GridSettings(rtol=rtol))
            results = fitter.fit(table[i : i + 1])
            want = brute_force(grid, results.flux[0], results.sigma[0], priors=priors)
            if rtol == 0.0:
                assert_allclose(results.chi2[0], want["chi2"], rtol=1e-9)
                assert results.best["tau"][0] == grid.galaxy_parameters["tau"][want["index"][1]]
                continue
            assert results.chi2[0] >= want["chi2"] * (1.0 - 1e-9)
            if results.chi2[0] > want["chi2"] * (1.0 + 1e-9):
                n_better += 1
                assert want["weights"][want["index"]] < 1e-7
    # the case that the documentation speaks of does occur
    assert n_better > 0


def test_tables_of_any_kind_are_the_same_fit(grid, catalog, tmp_path):
    """Plain columns with units, other units, files, NaN that files mask."""
    catalog["band1"][2] = np.nan
    want = node_fitter(grid).fit(catalog)
    plain = Table(catalog)
    catalog.write(tmp_path / "cat.fits")
    catalog.write(tmp_path / "cat.ecsv")
    tables = [plain, Table(plain, masked=True)]
    tables += [cls.read(tmp_path / f"cat.{x}") for cls in (Table, QTable) for x in ("fits", "ecsv")]
    tables += [tmp_path / "cat.ecsv", {name: catalog[name] for name in catalog.colnames}]
    for table in tables:
        got = node_fitter(grid).fit(table)
        assert_allclose(got.chi2, want.chi2, rtol=1e-12)
        assert_array_equal(got.flags, want.flags)
        assert_array_equal(got.n_bands, want.n_bands)


def test_fluxes_are_numbers(grid, catalog):
    table, flux = Table(catalog), np.asarray(catalog["band1"])
    columns = {"text": flux.astype(str), "true and false": flux > 0, "complex numbers": flux * 1j}
    for kind, values in columns.items():
        table["band1"] = Column(values, unit="uJy")
        match = f"'photometry' must be a table with numbers in column 'band1', got {kind}"
        refuses(match, node_fitter(grid).fit, table)
    words = flux.astype("U8")
    words[2] = "<1.5"
    table["band1"] = Column(words, unit="uJy")
    refuses("got text, <1.5 in row 2 ", node_fitter(grid).fit, table)


@pytest.mark.parametrize(
    ("column", "code"),
    [("band2_err", code) for code in (1e99, 1e-99, np.inf)]
    + [("band2", code) for code in (-1e99, np.inf, -np.inf)],
)
def test_codes_beyond_all_measurements_are_left_out(grid, catalog, column, code):
    """Their squares are no numbers, or leave none of those of others."""
    flag = FitFlags.BAD_FLUX if column == "band2" else FitFlags.BAD_ERROR
    missing = catalog.copy()
    missing[column][1] = np.nan
    catalog[column][1] = code * u.uJy
    fitter = node_fitter(grid)
    got, want = fitter.fit(catalog), fitter.fit(missing)
    assert_array_equal(got.flags, want.flags | np.where(np.arange(6) == 1, int(flag), 0))
    for name in ("chi2", "log_evidence", "moments", "n_bands"):
        assert_array_equal(getattr(got, name), getattr(want, name))


@pytest.mark.parametrize("noise", [1e-8, 1e-12, 1e-30])
def test_fluxes_without_noise_give_their_model_back(noise):
    grid = make_grid(2)
    table, truth = draw_photometry(grid, 20, noise=1e-300)
    for name in grid.filters:
        table[f"{name}_err"] = noise * table[name]
    fitter = node_fitter(grid, model_error=0.0)
    results = fitter.fit(table)
    mass = np.array([model[-1] for model in truth])
    assert_allclose(results.mean("mass").value, mass, rtol=1e-6)
    assert_allclose(fitter.sample(table, 20, seed=1).mean("mass").value, mass, rtol=1e-5)
    assert_allclose(results.mean("redshift").value, table["redshift"].value, rtol=1e-6)
    # no error below 1e-6: that of the mass is this over the root of the number of bands
    assert_allclose(results.std("mass").value / mass, 1e-6 / np.sqrt(6), rtol=0.01)
    assert_allclose(results.chi2, 0.0, atol=1e-9)
    assert np.isfinite(results.log_evidence).all()
    assert np.isfinite(results.model_flux_std).all()


# ----------------------------------------------------------- codes for a missing value


def coded(catalog):
    """-99 with errors alike in a row, an error of -999, 99 with 99; real fluxes of -98.9 are none."""
    table = catalog.copy()
    table["band1"][0] = table["band1_err"][0] = -99 * u.uJy
    table["band1_err"][2] = -999 * u.uJy
    table["band2"][3] = table["band2_err"][3] = 99 * u.uJy
    table["band0"][1] = -98.9 * u.uJy
    table["band0"][2] = np.nan
    return table


def without_their_unit(table, bands):
    """The same numbers, without units."""
    plain = Table(table)
    for band in bands:
        for name in (band, f"{band}_err"):
            plain[name] = table[name].value
    return plain


def test_codes_are_missing_bands_wherever_the_unit_is_given(grid, catalog, tmp_path):
    """By the column, by ``unit``, in a file read by pieces: the fit is as with NaN, and a warning counts them."""
    table = coded(catalog)
    blank = table.copy()
    for band, row in (("band1", 0), ("band1", 2), ("band2", 3)):
        blank[f"{band}_err"][row] = np.nan
        if row != 2:
            blank[band][row] = np.nan
    want = node_fitter(grid).fit(blank)
    wanted = r": taken as missing, .*: band1 2 of 6 \(-999, -99\); band2 1 of 6 \(99\)"
    with pytest.warns(MiricigaleWarning, match=f"photometry{wanted}") as record:
        by_column = node_fitter(grid).fit(table)
    assert [one.filename for one in record] == [__file__]
    with pytest.warns(MiricigaleWarning, match=f"photometry{wanted}"):
        by_unit = node_fitter(grid).fit(without_their_unit(table, grid.filters), unit="uJy")
    path = tmp_path / "catalog.fits"
    table.write(path)
    with pytest.warns(MiricigaleWarning, match=rf"catalog\.fits{wanted}") as record:
        of_file = fit_file(node_fitter(grid), path, tmp_path / "out", chunk_rows=2)
    assert len(record) == 1
    assert table["band1"][0] == -99 * u.uJy
    for results in (by_column, by_unit, of_file[:]):
        assert_array_equal(results.flags, want.flags)
        assert_array_equal(results.n_bands, want.n_bands)
        assert_allclose(results.chi2, want.chi2, rtol=1e-12)
        assert np.isnan(results.flux[[0, 3], [1, 2]]).all()
        # the flux beside an error of -999 is one
        assert np.isfinite(results.flux[2, 1])


@pytest.mark.parametrize(
    ("values", "words"),
    [([1j] * 6 * u.uJy, "complex numbers"), ([True, False] * 3 << u.uJy, "true and false")],
)
def test_what_is_no_real_number_is_refused_with_a_unit_too(grid, catalog, values, words):
    catalog["band0"] = values
    refuses(f"numbers in column 'band0', got {words}", node_fitter(grid).fit, catalog)
