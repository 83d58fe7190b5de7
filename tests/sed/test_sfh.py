import astropy.units as u
import numpy as np
import pytest
from astropy.table import MaskedColumn, QTable, Table
from numpy.testing import assert_allclose

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.sed import SEDModel
from miricigale.sed.components import ConstantSFH, DelayedSFH, DoubleExponentialSFH, TableSFH
from miricigale.utils.exceptions import DataError

RATE = u.Msun / u.yr


def table_of(time, *rates):
    out = QTable({"time": np.asarray(time, dtype=float) * u.Myr})
    for i, rate in enumerate(rates):
        out[f"sfr_{i}"] = np.asarray(rate, dtype=float) * RATE
    return out


@pytest.fixture(scope="module")
def uneven():
    return TableSFH(table_of([0, 0.3, 7.5, 20, 21, 400], [2, 0, 5, 1, 0.5, 3]))


# ------------------------------------------------------------------- mass and edges


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("cls", [DelayedSFH, DoubleExponentialSFH, ConstantSFH])
def test_one_solar_mass_is_formed_whatever_the_parameters(cls, seed):
    rng, part = np.random.default_rng([seed, 7]), cls()
    ends = {n: np.log([max(p.bounds[0], 1e-3), p.bounds[1]]) for n, p in part.parameters.items()}
    values = {name: np.exp(rng.uniform(*logs)) for name, logs in ends.items()}
    if seed % 4 == 0 and "f_burst" in values:
        values["f_burst"] = 0.0
    rate = part.history(values)
    assert rate.size == round(values["age"] * 1e3)
    assert rate.sum() == pytest.approx(1e-6, rel=1e-12, abs=0)
    assert rate.min() >= 0


@pytest.mark.parametrize("cls", [DelayedSFH, DoubleExponentialSFH, ConstantSFH])
def test_a_single_step_forms_everything(cls):
    part = cls()
    for changes in ({}, {"f_burst": 0.3, "age_burst": 0.001}):
        known = {k: v for k, v in changes.items() if k in part.parameters}
        assert_allclose(part.history(values_of(part, age=0.001, **known)), [1e-6])


@pytest.mark.parametrize("cls", [DelayedSFH, DoubleExponentialSFH])
def test_a_burst_as_old_as_the_galaxy_makes_its_fraction(cls):
    part = cls()
    values = values_of(part, age=0.3, tau=0.2, f_burst=0.4, age_burst=0.3, tau_burst=0.05)
    assert part.invalid(values) is None
    with_burst, without = part.history(values), part.history(values | {"f_burst": 0.0})
    burst = with_burst - 0.6 * without
    assert_allclose(burst / burst[0], np.exp(-np.arange(300) / 50), rtol=1e-8)
    assert burst.sum() == pytest.approx(0.4e-6, rel=1e-10, abs=0)
    # an older one is refused, if there is one
    values["age_burst"] = 0.4
    assert "'age_burst' must not exceed 'age'" in part.invalid(values)
    assert part.invalid(values | {"f_burst": 0.0}) is None


# -------------------------------------------------------------------- closed forms


def test_delayed_history_is_its_formula():
    part = DelayedSFH()
    rate = part.history(values_of(part, age=13.0, tau=1.7))
    t = np.arange(13000)
    # sum of k q^k over k < n, in closed form
    q, n = np.exp(-1 / 1700), 13000
    total = (q - n * q**n + (n - 1) * q ** (n + 1)) / (1 - q) ** 2
    assert_allclose(rate, 1e-6 * t * np.exp(-t / 1700) / total, rtol=1e-9)


@pytest.mark.parametrize("tau", [0.001, 0.3, 6.0, 100.0, -0.001, -0.5, -40.0])
def test_exponential_history_is_a_geometric_series(tau):
    part = DoubleExponentialSFH()
    rate = part.history(values_of(part, age=2.0, tau=tau, f_burst=0.0))
    formed = np.cumsum(rate) * 1e6
    n = np.arange(1, 2001)
    # 1 + q + ... + q^(n-1), with q = exp(-1 / tau), relative to all 2000 steps
    scale = abs(tau) * 1e3
    want = np.expm1(-n / scale) if tau > 0 else np.exp(-2000 / scale) - np.exp((n - 2000) / scale)
    assert_allclose(formed, want / np.expm1(-2000 / scale), rtol=1e-9, atol=1e-12)


def test_double_exponential_has_a_burst_on_top_of_the_main_history():
    part = DoubleExponentialSFH(age=5.0, tau=3.0, f_burst=0.1, age_burst=0.1, tau_burst=0.02)
    rate, main = part.history(values_of(part)), np.exp(-np.arange(5000) / 3000)
    main *= 0.9e-6 / main.sum()
    assert_allclose(rate[:-100], main[:-100], rtol=1e-10)
    burst = rate[-100:] - main[-100:]
    assert_allclose(burst[1:] / burst[:-1], np.exp(-1 / 20), rtol=1e-8)
    assert burst.sum() == pytest.approx(1e-7, rel=1e-9, abs=0)


def test_an_exponential_without_time_is_refused():
    part = DoubleExponentialSFH()
    for tau in (0.0, 0.0005, -0.0009):
        assert "'tau' must be" in part.invalid(values_of(part, tau=tau))
    assert part.invalid(values_of(part, tau=-0.001)) is None


# -------------------------------------------------------------------------- tables


def test_uneven_bins_keep_their_mass_in_every_step(uneven):
    edges = np.array([0, 0.3, 7.5, 20, 21, 400, 779])
    rates = np.array([2, 0, 5, 1, 0.5, 3.0])
    formed = np.append(0, np.cumsum(np.diff(edges) * rates))
    values = values_of(uneven)
    assert values["age"] == pytest.approx(0.779)
    got = uneven.history(values)
    want = np.interp(np.arange(1, 780), edges, formed) / formed[-1]
    assert_allclose(np.cumsum(got) * 1e6, want, rtol=1e-12)
    # the first step holds 0.3 Myr of rate 2, the eighth 0.5 Myr of rate 5
    assert got[7] / got[0] == pytest.approx(2.5 / 0.6, rel=1e-12)


def test_a_table_that_ends_within_a_step_keeps_its_mass():
    part = TableSFH(table_of([0, 1.25, 2.5], [4, 8, 8]))  # ends at 3.75 Myr
    got = part.history(values_of(part))
    assert_allclose(got * 1e6, np.array([4, 7, 8, 6]) / 25, rtol=1e-12)


def test_time_is_counted_from_the_first_row_in_any_unit():
    rate = [1.0, 3.0, 2.0]
    first = TableSFH(table_of([0, 10, 20], rate))
    table = Table({"time": [4.0, 4.01, 4.02], "sfr_0": rate}, units={"time": "Gyr"})
    table["sfr_0"].unit = "kg / s"
    second = TableSFH(table)
    assert_allclose(first.history(values_of(first)), second.history(values_of(second)))


def test_an_earlier_observation_sees_the_first_part_alone(uneven):
    values = values_of(uneven)
    whole, part = uneven.history(values), uneven.history(values | {"age": 0.1})
    assert_allclose(part / part.sum(), whole[:100] / whole[:100].sum(), rtol=1e-12)


def test_index_selects_the_column():
    part = TableSFH(table_of(np.arange(4), [1, 1, 1, 1], [0, 0, 0, 7]), sfh_index=1)
    values = values_of(part)
    assert_allclose(part.history(values), [0, 0, 0, 1e-6])
    assert_allclose(part.history(values | {"sfh_index": 0.0}), 2.5e-7)
    assert "'sfh_index' must be a whole number below 2" in part.invalid(values | {"sfh_index": 2.0})
    assert "'sfh_index'" in part.invalid(values | {"sfh_index": 0.5})
    assert "must be after the first stars" in part.invalid(values | {"age": 0.002})


def test_beyond_the_table_is_refused(uneven):
    assert "end of the table, 0.779 Gyr" in uneven.invalid(values_of(uneven, age=0.9))
    refuses("end of the table", TableSFH, table_of([0, 1], [1, 1]), age=0.003)


def test_numbers_of_the_table_are_in_the_settings():
    one, same, other = (TableSFH(table_of([0, 1, 2], [1, 2, x])) for x in (3, 3, 4))
    assert one.settings == same.settings
    assert one.settings["sha256"] != other.settings["sha256"]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"time": [0, 2, 1] * u.Myr}, "'time' must be ascending"),
        ({"time": [0, 1, 1] * u.Myr}, "'time' must be ascending"),
        ({"time": [0, 1, np.nan] * u.Myr}, "'time' must be finite"),
        ({"sfr_0": [1, -1, 2] * RATE}, "'sfr_0' must be rates of 0 or more"),
        ({"sfr_0": [1, np.inf, 2] * RATE}, "'sfr_0' must be finite"),
        ({"sfr_0": [0, 0, 0] * RATE}, "'sfr_0' must be a history that forms stars"),
        ({"sfr_0": [1, 1, 2] * u.Msun}, "'sfr_0' must be convertible to solMass / yr"),
        ({"sfr_0": [1.0, 1.0, 2.0]}, "'sfr_0' must be convertible to solMass / yr, got None"),
    ],
)
def test_bad_tables_are_refused(change, match):
    table = table_of([0, 1, 2], [1, 2, 3])
    for name, column in change.items():
        table[name] = column
    refuses(match, TableSFH, table, error=(ValueError, u.UnitsError))


def test_masked_short_and_nameless_tables_are_refused():
    table = Table(table_of([0, 1, 2], [1, 2, 3]))
    table["sfr_0"] = MaskedColumn([1.0, 2.0, 3.0], mask=[0, 1, 0], unit=RATE)
    refuses("'sfr_0' must be without masked values, got 1", TableSFH, table)
    refuses("two rows or more", TableSFH, table_of([0], [1]))
    refuses("column 'time'", TableSFH, QTable({"t": [0, 1] * u.Myr, "sfr": [1, 1] * RATE}))
    refuses(r"'age' must be from 0\.001 to 13\.7 Gyr, got ", TableSFH, table_of([0, 9000], [1, 1]))
    assert TableSFH(table_of([0, 9000], [1, 1]), age=13.0).age == 13.0
    refuses("one of them", TableSFH)


@pytest.mark.parametrize("suffix", ["ecsv", "fits"])
def test_model_from_a_configuration_reads_the_file(tmp_path, suffix):
    path = tmp_path / f"history.{suffix}"
    table_of(np.arange(500), np.full(500, 3.0)).write(path)
    parts = [{"name": "sfh_table", "path": str(path)}, {"name": "bc03"}]
    constant = [{"name": "constant", "age": 0.5}, {"name": "bc03"}]
    mine, theirs = (SEDModel.from_dict({"components": c}).evaluate() for c in (parts, constant))
    assert_allclose(mine.fnu, theirs.fnu, rtol=1e-10)


def test_files_that_are_no_tables_are_refused(tmp_path):
    (tmp_path / "noise.fits").write_bytes(b"SIMPLE but no more")
    for name in ("absent.ecsv", "noise.fits"):
        match = f"{name} cannot be read as a table"
        refuses(match, TableSFH, error=DataError, path=tmp_path / name)
