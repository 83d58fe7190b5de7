"""Reader of the SKIRTOR library as its authors, CIGALE and lightningpy distribute it."""

import hashlib
import itertools
import re
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.refdata.libraries.members import is_archive, members
from miricigale.refdata.libraries.table import LibraryTable
from miricigale.utils.content_hash import file_sha256
from miricigale.utils.exceptions import data_error, file_errors
from miricigale.utils.named_values import convert_values, rows_of
from miricigale.utils.options import check_data
from miricigale.utils.package_tables import declared
from miricigale.utils.table_files import read_table
from miricigale.utils.units import is_ascending, to_array

#: Values of the whole library: 19,200 spectra.
SKIRTOR_AXES = declared("miricigale.refdata.libraries", "formats.toml")["skirtor"]
_WHOLE = 19200
_WANTED = (
    "the SKIRTOR library (t*_p*_q*_oa*_R*_Mcl0.97_i*_sed.dat, or lightningpy's SKIRTOR.fits.gz)"
)
_NUMBER = r"(\d+(?:\.\d+)?)"
_NAME = re.compile(
    rf"t{_NUMBER}_p{_NUMBER}_q{_NUMBER}_oa{_NUMBER}_R{_NUMBER}_Mcl0\.97_i{_NUMBER}_sed\.dat"
)
_ROWS = 132
_COLUMNS = 7

# the files are for 1e11 Lsun of 3.839e26 W at 10 Mpc
_SUN = 1e11
_FLUX = _SUN * 3.839e26 / (4.0 * np.pi * (1e7 * 3.0856775814913673e16) ** 2)  # W/m2

# lightningpy's FITS file has one torus only
_FITS_FIXED = {"p": 1.0, "q": 0.0, "opening_angle": 40.0, "radius_ratio": 20.0}
_FITS_LIGHT = ("TOTAL", "DISK_DIRECT", "DISK_SCATTERED", "DUST_TOTAL", "TRANSPARENT")
_FITS_UNITS = {"TAU": u.one, "INCLINATION": u.deg, "WAVE_REST": u.um, "NU_REST": u.Hz}
_FITS_UNITS |= {f"LNU_{name}": u.Lsun / u.Hz for name in _FITS_LIGHT}


def read_skirtor(path):
    """
    Read SKIRTOR (Stalevski et al. 2012, MNRAS 420, 2756; 2016, MNRAS 458, 2288).

    Parameters
    ----------
    path : `~pathlib.Path`
        A folder with the authors' ``*_sed.dat`` anywhere below (CIGALE's source tree is one), a
        zip or tar archive of them, a folder of such archives, or the FITS file of lightningpy.

    Returns
    -------
    library : `~miricigale.refdata.libraries.LibraryTable`
        ``torus.skirtor2016``: ``disk`` (direct and scattered) and ``dust``, L_lambda in 1/um for
        one watt of accretion power, 32 bit. The whole library has 19,200 rows; a part is
        taken where it is a full product of values and has inclination 0, which is
        the disk seen from above.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file is truncated, foreign or in other units, models differ under one name,
        or the product of values has holes.
    """
    path = Path(path)
    check_data(path.exists(), path, f"does not exist; wanted {_WANTED}")
    if path.is_file() and not is_archive(path):
        wave, axes, spectra, files = _read_fits(path)
    else:
        wave, axes, spectra, files = _read_texts(path)
    order = np.lexsort([axes[name] for name in reversed(SKIRTOR_AXES)])
    axes = {name: np.asarray(axes[name])[order] for name in SKIRTOR_AXES}
    _check_product(path, axes)
    n = len(order)
    part = "the whole library"
    if n != _WHOLE:
        part = f"a part of the library, {n:,} of {_WHOLE:,}"
    span = f"{wave.size} wavelengths, {wave[0]:g}-{wave[-1]:g} um"
    summary = (f"SKIRTOR 2016: {n:,} spectra ({part}) at {span}",)
    return LibraryTable(
        name="torus.skirtor2016",
        wave=wave,
        axes=axes,
        spectra=rows_of(spectra, order),
        units={"opening_angle": "deg", "inclination": "deg", "disk": "um-1", "dust": "um-1"},
        meta={
            "files": files,
            "scale": "L_lambda for one watt of accretion power",
            "complete": n == _WHOLE,
        },
        summary=summary,
    )


def _check_product(path, axes):
    """Refuse holes and values that are not the library's."""
    values = convert_values(np.unique, axes)
    for name, nodes in values.items():
        strange = sorted(set(nodes.tolist()) - set(SKIRTOR_AXES[name]))
        if strange:
            expected = " ".join(f"{v:g}" for v in SKIRTOR_AXES[name])
            raise data_error(
                path, f"has {name} {strange[0]:g}, which is not of SKIRTOR 2016: it has {expected}"
            )
    present = set(zip(*(column.tolist() for column in axes.values()), strict=True))
    wanted = int(np.prod([v.size for v in values.values()]))
    if len(present) < wanted:
        product = itertools.product(*(v.tolist() for v in values.values()))
        holes = itertools.islice((key for key in product if key not in present), 3)
        problem = f"has {len(present):,} spectra, but the values found make {wanted:,}; missing, among others:"
        raise data_error(path, f"{problem} {', '.join(map(_file_name, holes))}")
    problem = "has no spectrum at inclination 0: the disk seen from above"
    check_data(values["inclination"][0] == 0.0, path, problem)


def _file_name(key):
    t, p, q, oa, ratio, i = (f"{v:g}" for v in key)
    return f"t{t}_p{p}_q{q}_oa{oa}_R{ratio}_Mcl0.97_i{i}_sed.dat"


def _texts(path):
    """Name, bytes and source of each spectrum below a folder, or in an archive or a folder of them."""
    n = 0
    for place, data, source in members(path, _NAME.fullmatch):
        n += 1
        yield place.name, data, source
    if path.is_dir() and n == 0:
        for archive in sorted(path.rglob("*")):
            if archive.name.endswith((".zip", ".tar", ".tar.gz", ".tgz")):
                yield from _texts(archive)


def _read_texts(path):
    """Return the wavelengths, axes, spectra and checksums from the authors' text files."""
    wave = None
    keys = []
    disk = []
    dust = []
    files = {}
    sources = {}
    for name, data, source in _texts(path):
        key = tuple(map(float, _NAME.fullmatch(name).groups()))
        digest = hashlib.sha256(data).hexdigest()
        if key in sources:
            problem = f"and {sources[key][1]} are the same model with different numbers"
            check_data(sources[key][0] == digest, source, problem)
            continue
        sources[key] = (digest, source)
        table = _parse(data, source)
        if wave is None:
            wave = table[0]
            _check_wave(wave, source)
        elif not np.allclose(table[0], wave, rtol=1e-4, atol=0.0):
            raise data_error(source, "has other wavelengths than the files before it")
        observed = table[2] + table[3]
        _check_columns(wave, table[1:], observed, key[-1], _FLUX, source)
        keys.append(key)
        disk.append((observed / (wave * _FLUX)).astype(np.float32))
        dust.append((table[4] / (wave * _FLUX)).astype(np.float32))
        files[source.removeprefix(f"{path}{'/' if path.is_dir() else ':'}")] = digest
    check_data(keys, path, f"holds no spectrum; wanted {_WANTED}")
    axes = dict(zip(SKIRTOR_AXES, np.array(keys).T, strict=True))
    return wave, axes, {"disk": np.array(disk), "dust": np.array(dust)}, files


def _parse(data, source):
    """Return the seven columns of one file, shape (7, 132): wavelength in um, then lambda F_lambda."""
    rows = [line for line in data.splitlines() if not line.startswith(b"#")]
    tokens = b"\n".join(rows).split()
    if len(tokens) != _ROWS * _COLUMNS:
        problem = (
            f"must have {_ROWS} rows of {_COLUMNS} numbers below '#' lines, got {len(tokens)} words"
        )
        raise data_error(source, f"{problem}: truncated, or not a spectrum of SKIRTOR")
    with file_errors(source, "has text in a spectrum of SKIRTOR"):
        table = np.array([float(x) for x in tokens]).reshape(_ROWS, _COLUMNS)
    _check_numbers(table, source)
    return table.T


def _check_numbers(table, source):
    good = np.isfinite(table).all() and table.min() >= 0.0
    check_data(good, source, "has negative, infinite or missing numbers")


def _check_wave(wave, source):
    """SKIRTOR has 132 wavelengths from 0.001 to 1000 um."""
    if not (
        is_ascending(wave) and np.isclose(wave[0], 1e-3, 1e-3) and np.isclose(wave[-1], 1e3, 1e-3)
    ):
        got = f"{wave[0]:g} to {wave[-1]:g}"
        raise data_error(source, f"must have wavelengths from 0.001 to 1000 um, got {got}")


def _check_columns(wave, table, observed, inclination, unit, source):
    """
    The columns are what they should be, by two laws that all spectra obey.

    The parts add up to the total, and the disk without dust shines as cos i (1 + 2 cos i)
    with 1e11 Lsun over all directions: a foreign unit or column breaks one of them.
    """
    total = table[0]
    dust = table[3]
    transparent = table[-1]
    problem = "has a total that is not direct + scattered + dust: columns in another order?"
    check_data(np.abs(total - observed - dust).max() <= 1e-3 * total.max(), source, problem)
    mu = np.cos(np.radians(inclination))
    power = np.trapezoid(transparent / wave, wave) / unit
    law = mu * (1.0 + 2.0 * mu) / 3.0 * 18.0 / 7.0
    if abs(power - law) > 0.02:
        got = f"{power:.4g} of 1e11 Lsun at 10 Mpc, wanted {law:.4g} at inclination {inclination:g}"
        raise data_error(source, f"has a transparent disk of {got}: another unit than W/m2?")


# ------------------------------------------------------------------ lightningpy's file


def _read_fits(path):
    """Return the wavelengths, axes, spectra and checksum from the FITS grid of lightningpy."""
    table = read_table(path, wanted=_WANTED, hdu=1)
    lacking = [name for name in _FITS_UNITS if name not in table.colnames]
    if lacking:
        raise data_error(path, f"is not {_WANTED}: its table has no column {lacking[0]}")
    with file_errors(path, "has another unit"):
        columns = {}
        for name, unit in _FITS_UNITS.items():
            columns[name] = to_array(table[name], unit, name)
        table = columns
    order = np.argsort(table["WAVE_REST"][0])
    wave = table["WAVE_REST"][0][order]
    if wave.shape != (_ROWS,) or not np.all(table["WAVE_REST"] == table["WAVE_REST"][0]):
        raise data_error(path, f"must have the same {_ROWS} wavelengths in all rows")
    _check_wave(wave, path)
    nu = table["NU_REST"][:, order]
    good = np.allclose(nu * wave, 2.99792458e14, rtol=1e-4)
    check_data(good, path, "has frequencies and wavelengths that do not belong together")
    power = {name: table[f"LNU_{name}"][:, order] * nu for name in _FITS_LIGHT}
    for name, array in power.items():
        _check_numbers(array, f"{path}, column LNU_{name},")
    observed = power["DISK_DIRECT"] + power["DISK_SCATTERED"]
    for k, angle in enumerate(table["INCLINATION"]):
        part = [power["TOTAL"][k], None, None, power["DUST_TOTAL"][k], power["TRANSPARENT"][k]]
        _check_columns(wave, part, observed[k], angle, _SUN, f"{path} row {k + 1}")
    n = len(observed)
    axes = {"tau97": table["TAU"], "inclination": table["INCLINATION"]}
    axes |= {name: np.full(n, value) for name, value in _FITS_FIXED.items()}
    spectra = {
        "disk": (observed / (wave * _SUN)).astype(np.float32),
        "dust": (power["DUST_TOTAL"] / (wave * _SUN)).astype(np.float32),
    }
    return wave, axes, spectra, {path.name: file_sha256(path)}
