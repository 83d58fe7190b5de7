"""Reading of the simple stellar populations of Bruzual & Charlot as they distribute them."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from miricigale.refdata.libraries.ised import Ised, read_ised
from miricigale.refdata.libraries.table import LibraryTable
from miricigale.refdata.lookup import file_sha256
from miricigale.utils.exceptions import data_error
from miricigale.utils.options import check_data

#: Of GALAXEV, in W: its files are in this unit (3.826e33 erg/s).
SOLAR_LUMINOSITY = 3.826e26
#: Metallicities by their code in file names: tracks of Padova 1994, and of Padova 2000.
PADOVA_1994 = {22: 0.0001, 32: 0.0004, 42: 0.004, 52: 0.008, 62: 0.02, 72: 0.05, 82: 0.1}
PADOVA_2000 = {122: 0.0004, 132: 0.001, 142: 0.004, 152: 0.008, 162: 0.019, 172: 0.03}
IMFS = {"chab": "Chabrier", "salp": "Salpeter", "kroup": "Kroupa"}
#: Second age in yr, which differs between the versions of 2003 and 2016.
SECOND_AGE = {2003: 125893.0, 2016: 1.0e5}

LONGEST = 160.0  # um
DENSE_FROM = 10.0  # um
DENSITY = 30.0  # wavelengths for each e-fold

#: How names of the files end.
_ENDING = re.compile(r"\.ised(_ascii)?(\.gz)?$", re.IGNORECASE)


class _Burst(NamedTuple):
    """A file of a set: a single burst of one metallicity."""

    file: Path
    content: Ised
    metallicity: float
    imf: str


def read_bc03(path):
    """
    Read SSPs of Bruzual & Charlot (2003, 2016), any IMF, any number of metallicities.

    Metallicities come from the text in the files, or their names (``m62``) where there is
    none; the IMF from the names (``chab``, ``salp``, ``kroup``) or the head. Beyond 10 um, where
    the files sample coarsely, wavelengths are inserted by interpolation in the logarithms, and
    files that end before 160 um go on to there with their last slope.

    The surviving mass leaves out remnants. Files of 2003 give the mass in stars with remnants,
    of which their mass of remnants is taken away; those of 2016 give that in stars. Which it
    is, the mass of gas says where the file has it, else the second age. At age 0 it is all.

    Parameters
    ----------
    path : path-like
        A file ``.ised`` or ``.ised_ASCII`` (also ``.gz``), a folder of one set of them, or a
        pattern of names such as ``folder/bc2003_lr_*_ssp.ised``.

    Returns
    -------
    library : `~miricigale.refdata.libraries.LibraryTable`
        Axes ``metallicity`` and ``age`` (Myr); spectra ``luminosity`` in W/um for one solar
        mass formed; values ``surviving`` and ``remnants`` (Msun for one solar mass formed).

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file is foreign, truncated or no single burst, states another metallicity or IMF
        than its name, or the files are not one set (IMF, wavelengths, ages, limits of mass).
    """
    paths = _files(path)
    bursts = []
    files = {file.name: file_sha256(file) for file in paths}
    for file in paths:
        part = read_ised(file)
        problem = f"holds a composite population ({part.history}), wanted a single burst"
        check_data(not part.law, file, problem)
        bursts.append(_Burst(file, part, _metallicity(part, file), _imf(part, file)))
    _check_set(bursts)
    bursts.sort(key=lambda burst: burst.metallicity)
    first = bursts[0].content
    imf = bursts[0].imf
    wave, _ = _refine(first.wave / 1e4, first.spectra[:1])
    n_age = first.age.size
    spectra = np.empty((len(bursts) * n_age, wave.size), dtype=np.float32)
    surviving = np.empty(len(spectra))
    remnants = np.empty(len(spectra))
    basis = set()
    for i, burst in enumerate(bursts):
        part = burst.content
        rows = slice(i * n_age, (i + 1) * n_age)
        spectra[rows] = _refine(part.wave / 1e4, part.spectra)[1] * (SOLAR_LUMINOSITY * 1e4)
        surviving[rows], how = _surviving(part, burst.file)
        remnants[rows] = part.quantities["remnants"]
        basis.add(how)
    metallicities = [burst.metallicity for burst in bursts]
    name = _set_name(paths[0].name)
    return LibraryTable(
        name="ssp.bc03_user",
        wave=wave,
        axes={
            "metallicity": np.repeat(metallicities, n_age),
            "age": np.tile(first.age / 1e6, len(bursts)),
        },
        spectra={"luminosity": spectra},
        units={"age": "Myr", "luminosity": "W / um"},
        values={"surviving": surviving, "remnants": remnants},
        meta={
            "files": files,
            "imf": imf,
            "mass_limits": list(first.mass_limits),
            "version": _version(first),
            "models": name,
            "surviving": sorted(basis),
        },
        summary=_summary(name, imf, first, metallicities, wave.size, sorted(basis)),
    )


def _summary(name, imf, first, metallicities, n_wave, basis):
    """Return the lines that say what a set holds; ``first`` is the content of one of its files."""
    low, high = first.mass_limits
    last = first.wave[-1] / 1e4
    reach = f"the files reach {last:g} um"
    if _ends_early(last):
        reach = f"continued from {last:g} to {LONGEST:g} um"
    metals = ", ".join(f"{metallicity:g}" for metallicity in metallicities)
    return (
        f"{name}: {imf} IMF, {low:g} to {high:g} Msun, Z = {metals}",
        f"{first.age.size} ages to {first.age[-1] / 1e9:g} Gyr, {first.wave.size} wavelengths",
        f"{n_wave - first.wave.size} wavelengths inserted beyond {DENSE_FROM:g} um",
        f"surviving mass: {', '.join(basis)}",
        reach,
    )


def _files(path):
    path = Path(path).expanduser()
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if _is_ised(p.name))
    elif path.exists():
        files = [path]
    else:
        files = sorted(p for p in path.parent.glob(path.name) if _is_ised(p.name))
    wanted = "wanted files *.ised or *.ised_ASCII (also .gz), got none"
    check_data(files, path, f"cannot be read as populations of BC03: {wanted}")
    return files


def _is_ised(name):
    return _ENDING.search(name) is not None


def _set_name(name):
    """Name of a file without endings and code of metallicity, which its set shares."""
    return re.sub(r"_m\d{2,3}(?=_|$)", "", _ENDING.sub("", name))


def _metallicity(part, file):
    match = re.search(r"_m(\d{2,3})(?=[_.])", file.name)
    named = None
    if match:
        named = (PADOVA_1994 | PADOVA_2000).get(int(match[1]))
    metallicity = part.metallicity
    if metallicity is None:
        wanted = "wanted 'Z=...' in its head or a name like _m62_"
        check_data(named is not None, file, f"states no metallicity: {wanted}")
        return named
    if named is not None and not np.isclose(named, metallicity, rtol=0.01):
        raise data_error(
            file, f"states Z = {metallicity:g}, but its name (m{match[1]}) means Z = {named:g}"
        )
    return metallicity


def _imf(part, file):
    named = {imf for token, imf in IMFS.items() if f"_{token}" in file.name.lower()}
    stated_imf = None
    if not part.slopes:
        # the only one that is no power law
        stated_imf = "Chabrier"
    if len(part.slopes) == 1 and np.isclose(part.slopes[0], 1.35, atol=0.01):
        stated_imf = "Salpeter"
    if len(named) != 1 and stated_imf is None:
        raise data_error(file, f"names no IMF: wanted one of {', '.join(IMFS)} in its name")
    if len(named) == 1 and stated_imf is not None and stated_imf not in named:
        raise data_error(file, f"holds a {stated_imf} IMF, but its name means {named.pop()}")
    if stated_imf is not None:
        return stated_imf
    return named.pop()


def _check_set(bursts):
    """Refuse files that are not one set, and say which two do not fit."""
    first_file, first, _, imf = bursts[0]
    files = {}
    for file, part, metallicity, imf_of_file in bursts:
        ages = part.age.shape == first.age.shape and np.allclose(part.age, first.age, rtol=1e-4)
        pairs = {
            "wavelengths": np.array_equal(part.wave, first.wave),
            "IMF": imf_of_file == imf,
            "limits of mass": part.mass_limits == first.mass_limits,
            "ages": ages,
        }
        differ = ", ".join(name for name, is_same in pairs.items() if not is_same)
        check_data(not differ, file, f"and {first_file.name} are not one set: other {differ}")
        if metallicity in files:
            twice = f"the same metallicity as {files[metallicity].name}, {metallicity:g}"
            raise data_error(file, f"is not of one set: it has {twice}")
        files[metallicity] = file


def _version(part):
    """Return the year of the version that made a file, by its second age, or None."""
    for year, age in SECOND_AGE.items():
        if np.isclose(part.age[1], age, rtol=1e-3):
            return year
    return None


def _surviving(part, file):
    """Return the mass in surviving stars without remnants, and how it was found."""
    mass = part.quantities["mass"]
    remnants = part.quantities["remnants"]
    gas = part.quantities.get("gas")
    old = part.age > 1e8
    if gas is not None and np.any(gas[old] > 0):
        with_remnants = np.abs(mass + gas - 1.0)[old].max()
        without = np.abs(mass + remnants + gas - 1.0)[old].max()
        problem = "has masses of stars, remnants and gas that do not sum to 1 Msun"
        check_data(min(with_remnants, without) <= 0.01, file, problem)
        has_remnants = with_remnants < without
    elif _version(part) is not None:
        has_remnants = _version(part) == 2003
    else:
        ages = " or ".join(f"{age:g} yr ({year})" for year, age in SECOND_AGE.items())
        problem = "does not tell whether its mass of stars includes remnants: wanted a mass of gas"
        raise data_error(file, f"{problem}, or a second age of {ages}, got {part.age[1]:g} yr")
    if has_remnants:
        surviving = mass - remnants
        basis = "mass in stars less remnants"
    else:
        surviving = mass.copy()
        basis = "mass in stars, as in the file"
    surviving[part.age == 0] = 1.0
    if surviving.min() < 0 or surviving.max() > 1.05:
        got = f"got up to {surviving.max():g}"
        raise data_error(file, f"must have surviving masses of 0 to 1 Msun, {got}")
    return surviving, basis


def _ends_early(last):
    """Tell whether spectra that end at this wavelength (um) are continued."""
    return last < LONGEST * (1 - 1e-6)


def _refine(wave, spectra):
    """Insert wavelengths beyond 10 um, log-log between neighbors, and go on to 160 um."""
    target = max(LONGEST, wave[-1])
    points = wave
    if _ends_early(wave[-1]):
        points = np.append(wave, LONGEST)
    pieces = [points[points <= DENSE_FROM]]
    far = points[points > DENSE_FROM]
    if pieces[0].size:
        start = pieces[0][-1:]
    else:
        start = far[:1]
    for low, high in zip(np.append(start, far[:-1]), far, strict=True):
        n = max(1, int(np.ceil(np.log(high / low) * DENSITY)))
        pieces.append(np.append(np.geomspace(low, high, n + 1)[1:-1], high))
    fine = np.concatenate(pieces)
    out = np.empty((len(spectra), fine.size))
    is_node = np.isin(fine, wave)
    new = ~is_node
    logs = np.log(wave)
    at = np.log(np.minimum(fine[new], target))
    for row, spectrum in zip(out, spectra, strict=True):
        row[is_node] = spectrum
        # a spectrum that is 0 stays 0, whatever the slope
        level = np.log(np.maximum(spectrum.astype(float), 1e-300))
        slope = (level[-1] - level[-2]) / (logs[-1] - logs[-2])
        inside = np.interp(at, logs, level)
        extrapolated = level[-1] + slope * (at - logs[-1])
        row[new] = np.exp(np.where(at > logs[-1], extrapolated, inside))
    return fine, np.where(out < 1e-200, 0.0, out)
