"""Fits from file to file: the numbers of one call, in pieces that a later call resumes from."""

from concurrent.futures import Executor, Future
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import draw_photometry, node_fitter
from helpers.results import assert_joined, assert_same, assert_same_tables
from miricigale.fitting import FitFlags, FitResults, GridSettings, fit_file, open_results
from miricigale.fitting.results.io import FitFolder
from miricigale.utils.exceptions import CatalogWarning, DataError, FitWarning
from miricigale.utils.row_files import write_rows
from miricigale.utils.table_files import read_table

# some ids of the catalog occur twice, of which fits warn
pytestmark = pytest.mark.filterwarnings("ignore:.*an id that occurred before")

MANIFESTS = [".fit.lock", ".manifest.copy.json", "manifest.json"]


class Stopped(Exception):
    pass


class Counting(Executor):
    """An executor that counts its tasks, one for each part of up to 64 rows, and stops at one."""

    def __init__(self, stop=None):
        self.n_tasks, self.stop = 0, stop

    def submit(self, function, *args):
        self.n_tasks += 1
        if self.n_tasks == self.stop:
            raise Stopped
        future = Future()
        future.set_result(function(*args))
        return future


@pytest.fixture
def grid(grid):
    n = grid.n_galaxies
    shape = QTable({"a_v": np.repeat(np.linspace(0, 2, n // 4), 4) * u.mag, "beta": np.arange(n)})
    return replace(grid, galaxy_shape=shape)


@pytest.fixture
def fitter(grid):
    return node_fitter(grid, error_floor=0.01)


@pytest.fixture
def catalog(grid):
    """Photometry with gaps, useless rows and ids that occur again, near and far."""
    table = draw_photometry(grid, 150, missing=0.15)[0]
    ids = [f"{'n' * (1 + i % 5)}{i}" for i in range(150)]
    ids[5] = ids[140] = ids[3]
    ids[120] = ids[70]
    table["id"] = ids
    table["band2"][9] = np.inf * u.uJy
    for name in grid.filters:
        table[name][11] = np.nan
        table[name][12] = -table[name][12]
    return table


@pytest.fixture
def on_disk(catalog, tmp_path):
    """The catalog as a file, and a folder for its results."""
    catalog.write(tmp_path / "catalog.fits")
    return tmp_path / "catalog.fits", tmp_path / "out"


@pytest.fixture
def in_pieces(fitter, tmp_path):
    """Fit a catalog from a file of some kind, in a folder that begins anew."""

    def fit(catalog, *, kind="fits", chunk_rows=40, delimiter=None, fitter=fitter, **options):
        path = tmp_path / f"catalog.{kind}"
        catalog.write(path, overwrite=True, **({"delimiter": delimiter} if delimiter else {}))
        options = {"chunk_rows": chunk_rows, "resume": False, **options}
        return fit_file(fitter, path, tmp_path / "out", **options)

    return fit


def test_fits_that_are_not_converged_are_counted_once(fitter, catalog, in_pieces, monkeypatch):
    """Of all pieces together, as of the whole catalog."""
    monkeypatch.setattr("miricigale.fitting.grid.adaptive._MAX_PLACES_EACH", 1)
    monkeypatch.setattr("miricigale.fitting.grid.adaptive._MIN_MAX_PLACES", 512)
    fitter = fitter.replace(settings=GridSettings(interpolate=1000))
    catalog = catalog[:20]
    texts = []
    for call in (fitter.fit, lambda table: in_pieces(table, fitter=fitter, chunk_rows=7)):
        with pytest.warns(FitWarning, match="fits are not converged") as caught:
            call(catalog)
        texts += [str(w.message) for w in caught if "not converged" in str(w.message)]
    assert len(texts) == 2
    assert texts[0] == texts[1]


def test_negative_errors_of_all_pieces_are_counted(fitter, catalog, in_pieces):
    """Those that stand for no value are not: they are taken as missing, and counted as such."""
    measured = np.isfinite(catalog["band0"]) & np.isfinite(catalog["band1"])
    near, code, middle, far = np.flatnonzero(measured)[[20, 25, 50, 90]]
    catalog["band0_err"][[near, far]] *= -1
    catalog["band1_err"][middle] *= -1
    catalog["band1_err"][code] = -99 * u.uJy
    text = r"fluxes with a negative error are not fitted: band0 2, band1 1; .*limits=True"
    codes = "taken as missing, by the number that stands there: band1 1 of 150"
    for call in (in_pieces, fitter.fit):
        with (
            pytest.warns(FitWarning, match=text),
            pytest.warns(CatalogWarning, match=codes),
        ):
            results = call(catalog)
        parts = [results]
        if call is in_pieces:
            parts = results.parts()
        flags = np.concatenate([part.flags for part in parts])
        bad = np.flatnonzero(flags & FitFlags.BAD_ERROR)
        assert {near, middle, far} <= set(bad)
        assert code not in bad


@pytest.mark.slow
@pytest.mark.parametrize("chunk_rows", [1, 7, 64, 100, 1000])
def test_the_pieces_are_one_fit_bit_for_bit(fitter, catalog, in_pieces, chunk_rows):
    catalog = catalog[: 8 * chunk_rows]
    whole, results = fitter.fit(catalog), in_pieces(catalog, chunk_rows=chunk_rows)
    assert len(results.paths) == -(-len(catalog) // chunk_rows)
    assert_joined(results.parts(), whole)
    twice = (whole.flags & FitFlags.DUPLICATE_ID) > 0
    assert np.flatnonzero(twice).tolist() == [i for i in (5, 120, 140) if i < len(catalog)]


def test_a_part_is_a_file_of_results_without_their_table(fitter, on_disk, tmp_path):
    path, out = on_disk
    results = fit_file(fitter, path, out, chunk_rows=150)
    (part,) = results.paths
    whole = FitResults.read(part)
    whole.write(tmp_path / "whole.fits")
    names = {}
    for item in (part, tmp_path / "whole.fits"):
        with fits.open(item) as hdus:
            names[item] = {hdu.name for hdu in hdus}
    assert names[tmp_path / "whole.fits"] - names[part] == {"TABLE"}
    shown = QTable.read(tmp_path / "whole.fits", hdu="TABLE")
    table = results.to_table()
    assert shown.colnames == table.colnames
    assert_array_equal(shown["mass_p50"].value, table["mass_p50"].value)


@pytest.mark.parametrize("how", ["column", "values", "prior", "priors", "prior column"])
def test_redshifts_go_with_their_rows(fitter, catalog, in_pieces, how):
    nodes = np.linspace(0.0, 3.0, 7)
    catalog["p_z"] = density = np.random.default_rng(3).uniform(0.1, 1.0, (len(catalog), 7))
    each = {"redshift_prior": (nodes, density)}
    options = {
        "column": {"redshift": "redshift"},
        "values": {"redshift": catalog["redshift"].tolist()},
        "prior": {"redshift_prior": (nodes, density[0])},
        "prior column": {"redshift_prior": (nodes, "p_z")},
    }.get(how, each)
    whole = fitter.fit(catalog, **(each if how == "prior column" else options))
    assert_joined(in_pieces(catalog, **options).parts(), whole)


@pytest.mark.slow
def test_parquet_gives_the_columns_and_values_of_fits(catalog, in_pieces, tmp_path):
    pytest.importorskip("pyarrow.parquet")
    found = []
    for kind in ("fits", "parquet"):
        results = in_pieces(catalog, kind=kind)
        path = tmp_path / f"table.{kind}"
        results.write_table(path)
        found.append(read_table(path, wanted="a table"))
        assert_same_tables(found[-1], results.to_table())
    assert_same_tables(*found)
    with pytest.raises(DataError, match="different columns"):
        write_rows(path, [catalog, catalog["id", "band0"]], 300, overwrite=True)


def test_csv_has_the_unit_that_is_given(fitter, catalog, in_pieces, tmp_path):
    whole = fitter.fit(catalog)
    for name in catalog.colnames[1:-1]:
        catalog[name] = catalog[name].to(u.nJy)
    results = in_pieces(catalog, kind="csv", flux_unit=u.nJy)
    assert len(list(results.parts())) == 4
    table, wanted = results.to_table(), whole.to_table()
    assert_array_equal(table["flags"], wanted["flags"])
    for name in ("redshift_mean", "mass_mean"):
        assert_allclose(table[name].value, wanted[name].value, rtol=1e-9)
    arguments = (fit_file, fitter, tmp_path / "catalog.csv", tmp_path / "no unit")
    refuses("must be convertible to uJy", *arguments, error=u.UnitsError, chunk_rows=40)
    text = "'flux_unit' must be a unit of flux density, such as uJy, or 'ABmag', got 'mag'"
    refuses(text, *arguments, error=u.UnitsError, flux_unit="mag")


@pytest.mark.slow
def test_a_stopped_fit_is_resumed(fitter, on_disk, catalog, tmp_path):
    arguments = (fitter, *on_disk)
    whole = fitter.fit(catalog)
    with pytest.raises(Stopped):
        fit_file(*arguments, chunk_rows=40, executor=Counting(stop=3))
    text = r"holds 2 of 4 parts: fit_file .* resumes"
    refuses(text, open_results, tmp_path / "out", error=DataError)
    there = open_results(tmp_path / "out", partial=True)
    assert (len(there), there.complete) == (80, False)
    assert len(there.to_table()) == 80
    executor = Counting()
    results = fit_file(*arguments, chunk_rows=40, executor=executor)
    assert executor.n_tasks == 2
    assert_joined(results.parts(), whole)
    # nothing is left to do
    fit_file(*arguments, chunk_rows=40, executor=executor)
    assert executor.n_tasks == 2


@pytest.mark.slow
def test_a_damaged_part_is_made_again(fitter, on_disk, catalog, tmp_path):
    arguments = (fitter, *on_disk)
    fit_file(*arguments, chunk_rows=40)
    whole = fitter.fit(catalog)
    one, two = (tmp_path / "out" / f"part-0000{i}.fits" for i in (1, 2))
    one.write_bytes(one.read_bytes()[:-2880])
    data = bytearray(two.read_bytes())
    data[-4000] ^= 1
    two.write_bytes(data)
    (tmp_path / "out" / ".partial-1-part-00003.fits").write_bytes(b"half a part")
    executor = Counting()
    joined = fit_file(*arguments, chunk_rows=40, executor=executor)
    assert_joined(joined.parts(), whole)
    assert executor.n_tasks == 2


def test_a_full_disk_is_reported_with_the_file_and_left_behind(
    fitter, on_disk, catalog, tmp_path, full_disk
):
    path, out = on_disk
    whole = fitter.fit(catalog)
    arguments = (fit_file, fitter, path, out)
    with full_disk(20000):
        refuses(r"part-00000\.fits", *arguments, error=OSError, chunk_rows=80)
    assert sorted(item.name for item in out.iterdir()) == MANIFESTS
    with full_disk(10):
        refuses(r"fit\.lock", *arguments, error=OSError, chunk_rows=80)
    results = fit_file(fitter, path, out, chunk_rows=80)
    assert_joined(results.parts(), whole)
    with full_disk(20000):
        refuses(r"table\.fits'?$", results.write_table, tmp_path / "table.fits", error=OSError)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["catalog.fits", "out"]


@pytest.mark.slow
def test_parts_of_another_fit_are_refused(fitter, grid, on_disk, catalog):
    path, out = on_disk
    fit_file(fitter, path, out, chunk_rows=80, redshift="redshift")
    same = {"chunk_rows": 80, "redshift": "redshift"}

    def refused(match, fitter=fitter, **changes):
        text = rf"holds results of another fit: .*{match}"
        refuses(text, fit_file, fitter, path, out, **(same | changes))

    # the same grid, made again, is the same, and so are the bytes
    again = node_fitter(replace(grid, meta={**grid.meta, "created": "later"}), error_floor=0.01)
    fit_file(again, path, out, **same)
    for part in fit_file(again, path, out.with_name("again"), **same).paths:
        assert part.read_bytes() == (out / part.name).read_bytes()
    refused("chunk_rows", chunk_rows=79)
    refused("redshift", redshift=None)
    refused("pairs", pairs=[("age", "tau")])
    refused("redshift", redshift=np.array(catalog["redshift"]))
    refused("model_error", node_fitter(grid, error_floor=0.01, model_error=0.2))
    refused("error_floor", node_fitter(grid))
    refused("priors", node_fitter(grid, error_floor=0.01, priors={"tau": "log"}))
    other = replace(grid, galaxy=grid.galaxy * (1 + 1e-15 * np.arange(6)))
    refused("grid", node_fitter(other, error_floor=0.01))
    catalog["band0"][0] *= 1.01
    catalog.write(path, overwrite=True)
    refused(r"catalogue\.sha256")
    results = fit_file(fitter, path, out, chunk_rows=150, resume=False)
    assert [item.name for item in sorted(out.iterdir())] == [*MANIFESTS, "part-00000.fits"]
    assert_joined(results.parts(), fitter.fit(catalog))


def test_parts_of_another_version_are_refused_with_what_to_do(fitter, on_disk):
    path, out = on_disk
    fit_file(fitter, path, out)
    with FitFolder(out) as folder:
        folder.facts["versions"]["miricigale"] = "0.1"
        folder.facts["job"]["settings"]["former"] = 1
        folder.write_manifest()
    match = r"settings.former differ; give another folder, or resume=False .* of miricigale 0.1, "
    refuses(match + r".*open_results\(path, partial=True\) reads them", fit_file, fitter, path, out)
    assert len(open_results(out, partial=True)) == 150


def test_a_call_that_failed_at_once_binds_no_other(fitter, catalog, tmp_path):
    path, out = tmp_path / "catalog.csv", tmp_path / "out"
    catalog.write(path)
    refuses("convertible to uJy", fit_file, fitter, path, out, error=u.UnitsError)
    # the remedy is another setting, in the folder that the first call made
    results = fit_file(fitter, path, out, flux_unit="uJy")
    assert len(results) == len(catalog)


@pytest.mark.slow
def test_results_are_read_as_if_they_were_one(fitter, catalog, in_pieces, tmp_path):
    whole = fitter.fit(catalog)
    in_pieces(catalog)
    results = open_results(tmp_path / "out")
    assert (len(results), results.complete) == (150, True)
    assert repr(results).startswith("<FitResultsFiles of 150 objects, ")
    assert [item.ids for item in results] == catalog["id"].tolist()
    key = catalog["id"][90]
    assert results.loc[key].best["mass"] == whole.loc[key].best["mass"]
    # across parts, in any order
    rows = np.array([100, 3, 41, 40, 149, 3])
    for chosen in (rows, rows.tolist(), slice(10, 95, 7), np.arange(150) % 9 == 0, []):
        want = whole[chosen]
        assert_same(results[chosen], want)
    with pytest.raises(KeyError, match="no object with the id 'nobody' among 150"):
        results["nobody"]
    wanted, path = whole.to_table(), tmp_path / "table.fits"
    results.write_table(path)
    refuses("overwrite=True replaces it", results.write_table, path, error=OSError)
    assert_same_tables(results.to_table(), wanted)
    assert "nobody" in QTable.read(path).meta["CITE"]
    few = results.to_table(["id", "mass_p50"])
    assert few.colnames == ["id", "mass_p50"]
    assert_array_equal(few["mass_p50"], wanted["mass_p50"])
    refuses("no column 'weight'; the nearest", results.to_table, ["weight"], error=KeyError)


def test_a_catalog_without_rows_has_results_without_rows(fitter, catalog, tmp_path):
    for suffix in ("fits", "ecsv"):
        catalog[:0].write(tmp_path / f"empty.{suffix}")
        results = fit_file(fitter, tmp_path / f"empty.{suffix}", tmp_path / suffix)
        assert len(results) == len(results.to_table()) == 0
        results.write_table(tmp_path / "table.fits", overwrite=True)
        assert len(QTable.read(tmp_path / "table.fits")) == 0


def refused_at_once(match, fitter, path):
    """The rows of a file are named, and nothing is fitted or written."""
    executor, out = Counting(), path.parent / "out"
    with pytest.raises(ValueError, match=match) as info:
        fit_file(fitter, path, out, chunk_rows=40, flux_unit="uJy", executor=executor)
    assert info.value.__notes__ == [f"in rows 120 to 149 of {path}"]
    assert executor.n_tasks == 0
    assert not out.exists()


@pytest.mark.parametrize("suffix", ["ecsv", "csv"])
def test_ids_that_parts_cannot_hold_are_refused_at_once(fitter, catalog, tmp_path, suffix):
    name = "Kümmel 3"
    ids = np.array(catalog["id"].astype("U20"))
    ids[5], ids[120] = 'with "quotes", and a\nline', name
    catalog["id"] = ids
    path = tmp_path / f"catalog.{suffix}"
    catalog.write(path)
    refused_at_once(rf"'photometry' must be ASCII.* got '{name}'", fitter, path)
    # in memory they are as good as others
    assert fitter.fit(catalog)[name].ids == name


@pytest.mark.parametrize(
    ("start", "match"),
    [("é".encode(), "'photometry' must be ASCII.* got 'é"), (b"\xe9n", "bytes of text in UTF-8")],
)
def test_ids_in_fits_that_are_no_ascii_are_refused_at_once(fitter, on_disk, catalog, start, match):
    path, key = on_disk[0], catalog["id"][149].encode()
    data = path.read_bytes()
    assert data.count(key) == 1
    path.write_bytes(data.replace(key, start + key[2:]))
    refused_at_once(match, fitter, path)


def test_a_fit_that_was_killed_at_its_first_moment_is_resumed(fitter, on_disk):
    path, out = on_disk
    out.mkdir()
    # a number above the largest that Linux gives to a process
    (out / "fit.lock").write_text("4194305")
    (out / ".partial-1-manifest.json").write_text("{")
    assert len(fit_file(fitter, path, out)) == 150
    assert sorted(item.name for item in out.iterdir()) == [*MANIFESTS, "part-00000.fits"]


def test_links_are_not_followed(fitter, on_disk, tmp_path):
    path, out = on_disk
    (tmp_path / "victim").write_text("mine")
    results = fit_file(fitter, path, out)
    for name in ("manifest.json", "part-00000.fits"):
        (out / f".partial-1-{name}").symlink_to(tmp_path / "victim")
    # a name is replaced, not what it points to
    (tmp_path / "table.fits").symlink_to(tmp_path / "victim")
    results.write_table(tmp_path / "table.fits", overwrite=True)
    fit_file(fitter, path, out, resume=False)
    assert not any(entry.is_symlink() for entry in out.iterdir())
    assert not (tmp_path / "table.fits").is_symlink()
    (out / "part-00000.fits").unlink()
    (out / "part-00000.fits").symlink_to(tmp_path / "victim")
    refuses("symbolic link", fit_file, fitter, path, out, error=DataError, resume=False)
    assert (tmp_path / "victim").read_text() == "mine"


@pytest.mark.slow
def test_numbers_as_ids(fitter, catalog, in_pieces):
    for kind in (np.uint64, np.int32, float):
        ids = np.arange(150).astype(kind)
        ids[100] = ids[2]
        catalog["id"] = ids
        assert_joined(in_pieces(catalog).parts(), fitter.fit(catalog))


def test_what_cannot_be_read_by_rows_is_refused(fitter, catalog, tmp_path):
    def refused(name, match, error=DataError, **options):
        refuses(match, fit_file, fitter, tmp_path / name, tmp_path / "out", error=error, **options)

    good = tmp_path / "good.fits"
    catalog.write(good)
    refused("absent.fits", "absent.fits cannot be read as a catalog: no such file")
    (tmp_path / "short.fits").write_bytes(good.read_bytes()[:-2880])
    refused("short.fits", "truncated|cannot be read")
    (tmp_path / "nothing.csv").write_text("")
    refused("nothing.csv", "nothing.csv cannot be read as a catalog")
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    refused("image.fits", "has 0 binary tables")
    with fits.open(good) as hdus:
        fits.HDUList([hdus[0], hdus[1], hdus[1].copy()]).writeto(tmp_path / "two.fits")
    refused("two.fits", "has 2 binary tables; 'hdu' says which")
    refused("two.fits", "no binary table in extension 'PHOTOMETRY'", hdu="photometry")
    refused("two.fits", "no binary table in extension 0", hdu=0)
    assert len(fit_file(fitter, tmp_path / "two.fits", tmp_path / "second", hdu=2)) == 150
    ragged = fits.Column("p", "PD()", array=np.array([[1.0], [1.0, 2.0]], dtype=object))
    fits.BinTableHDU.from_columns([ragged]).writeto(tmp_path / "ragged.fits")
    with pytest.warns(CatalogWarning, match="columns of variable length are left out: 'p'"):
        refused("ragged.fits", "it has no columns")
    refused("good.fits", "'chunk_rows' must be an integer >= 1, got 0", ValueError, chunk_rows=0)
    refused("good.fits", "'redshift' must be 150 values", ValueError, redshift=[1.0, 2.0])
    assert not (tmp_path / "out").exists()
    refuses("'fitter' must be a BayesFitter, got str", fit_file, "fitter", good, tmp_path / "out")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    for resume in (True, False):
        arguments = (fit_file, fitter, good, tmp_path / "full")
        refuses("is not empty and is no fit", *arguments, error=DataError, resume=resume)
    assert (tmp_path / "full" / "thesis.tex").read_text() == "mine"
    refuses("need a folder of their own", fit_file, fitter, good, good, error=DataError)


def test_a_folder_of_something_else_is_no_results(tmp_path):
    refuses("holds no results of fit_file", open_results, tmp_path, error=DataError)
    (tmp_path / "manifest.json").write_text('{"format": "photos"}')
    refuses(r"neither manifest.json nor .* can be read", open_results, tmp_path, error=DataError)
