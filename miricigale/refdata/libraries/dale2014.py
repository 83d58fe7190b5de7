"""Reading of the templates of Dale et al. 2014 as CIGALE distributes them."""

import hashlib
from pathlib import Path

import numpy as np

from miricigale.refdata.libraries.members import is_archive, members
from miricigale.refdata.libraries.table import LibraryTable
from miricigale.refdata.lookup import locate
from miricigale.refdata.tables import load_ssp
from miricigale.utils.exceptions import data_error, file_errors
from miricigale.utils.options import check_data
from miricigale.utils.package_tables import declared
from miricigale.utils.units import is_ascending

SPECTRA = "spectra.0.00AGN.dat"
CALIBRATION = "dhcal.dat"
STARS = "stellar_SED_age13Gyr_tau10Gyr.spec"
ALPHA = np.arange(1, 65) / 16.0
N_WAVE = 1018
SHORTEST = 2.0  # um, where CIGALE lets the templates begin
SCALED_AT = 7  # row of the spectra (1.028 um) at which CIGALE scales the starlight
LONGEST = 1e4  # um; beyond, rows are 7 to 25 % apart and the last says -99.9999

#: Files that this reader was tested on.
KNOWN = declared("miricigale.refdata.libraries", "formats.toml")["dale2014"]


def read_dale2014(path):
    """
    Read the templates of Dale et al. 2014 without AGN.

    Wanted are ``spectra.0.00AGN.dat`` (wavelength in um and 64 columns of log10 nuF_nu) and
    ``dhcal.dat`` (alpha in the second column), and, where it is there, CIGALE's
    ``stellar_SED_age13Gyr_tau10Gyr.spec`` (A, W/A). Made of them, by the rules of CIGALE's
    database builder: the columns are divided by wavelength; starlight of 13 Gyr (exponential,
    tau 10 Gyr) that equals the template at 1.028 um is subtracted, negative rests being 0; what
    is below 2 um goes; the integral becomes 1 W. Rows beyond 1 cm, coarse and without radio
    emission, go too. Without the stellar file the starlight is that of the bundled
    ``ssp.bc03`` (solar). The templates before the subtraction are kept beside.

    Parameters
    ----------
    path : path-like
        Folder with the files, a CIGALE source tree, or a zip or tar archive of either.

    Returns
    -------
    library : `~miricigale.refdata.libraries.LibraryTable`
        64 rows; axis ``alpha``; spectra ``removed`` and ``kept`` (with and without the
        subtraction of starlight) in W/um for 1 W; value ``log_f60_f100`` of ``dhcal.dat``.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file is missing, foreign or truncated.
    """
    path = Path(path)
    contents, places = _find(path)
    alpha, color = _read_calibration(contents[CALIBRATION], places[CALIBRATION])
    wave, log_power = _read_spectra(contents[SPECTRA], places[SPECTRA])
    _check_order(wave, log_power, color, places)
    if STARS in contents:
        stars = np.interp(wave, *_read_stars(contents[STARS], places[STARS]), right=0)
        source = STARS
    else:
        stars = _bundled_starlight(wave)
        source = "ssp.bc03 (Z = 0.02, exponential history, tau 10 Gyr, age 13 Gyr)"

    emission = 10.0**log_power / wave[:, None]
    starlight = stars[:, None] * (emission[SCALED_AT] / stars[SCALED_AT])
    in_range = (wave >= SHORTEST) & (wave <= LONGEST)
    nodes = wave[in_range]
    emission = emission[in_range].T
    starlight = starlight[in_range].T
    removed = emission - starlight
    negative = int(np.sum(removed < 0))
    share = np.max(starlight[:, 0] / emission[:, 0])
    spectra = {}
    for name, part in (("removed", np.maximum(removed, 0.0)), ("kept", emission)):
        spectra[name] = part / np.trapezoid(part, nodes, axis=1)[:, None]
    files = {name: hashlib.sha256(data).hexdigest() for name, data in sorted(contents.items())}
    changed = [name for name, sha in KNOWN.items() if files[name] != sha]
    return LibraryTable(
        name="dust.dale2014",
        wave=nodes,
        axes={"alpha": alpha},
        spectra=spectra,
        units={"removed": "W / um", "kept": "W / um"},
        values={"log_f60_f100": color},
        meta={"files": files, "starlight": source, "negative": negative},
        summary=(
            f"{alpha.size} templates in alpha, {nodes[0]:g} to {nodes[-1]:g} um",
            f"starlight subtracted: {source}; {100 * share:.0f} % of the emission at 2 um",
            f"{negative} values beyond 2 um were negative after that and became 0",
            f"not the copy that this reader was tested on: {', '.join(changed)}"
            if changed
            else "spectra and alphas are those of CIGALE 0.9",
        ),
    )


def _find(path):
    """Return the contents of the files by name, and where each was found."""
    wanted = (SPECTRA, CALIBRATION, STARS)
    if not path.is_dir() and not (path.is_file() and is_archive(path)):
        problem = "cannot be read as templates of Dale et al. 2014: wanted a folder or an archive"
        got = "no such file or folder"
        if path.is_file():
            got = "got another file"
        raise data_error(path, f"{problem} that holds {SPECTRA} and {CALIBRATION}, {got}")
    tables = list(members(path, lambda name: name in wanted))
    folders = [place.parent for place, _, _ in tables if place.name == SPECTRA]
    if len(folders) > 1:
        folders = [f for f in folders if f.parts[-2:] == ("database_builder", "dale2014")]
    check_data(len(folders) == 1, path, f"must hold one {SPECTRA}, got {len(folders) or 'none'}")
    chosen = [(place.name, *content) for place, *content in tables if place.parent == folders[0]]
    contents = {name: data for name, data, _ in chosen}
    problem = f"has {SPECTRA} without {CALIBRATION}, which lists the alphas of its columns"
    check_data(CALIBRATION in contents, path, problem)
    sources = {}
    for name, _, source in chosen:
        sources[name] = source
    return contents, sources


def _numbers(data, place, n_columns, wanted):
    """Return the columns of numbers of a text file, comments left out: array (n_rows, n_columns)."""
    with file_errors(place, f"is not {wanted} in {n_columns} columns"):
        table = np.loadtxt(data.decode("ascii").splitlines(), ndmin=2)
    got = f"row 1 of {len(table)} has {table.shape[1]} columns"
    check_data(table.shape[1] == n_columns, place, f"is not {wanted} in {n_columns} columns: {got}")
    if n_bad := np.count_nonzero(~np.isfinite(table)):
        raise data_error(place, f"must hold finite numbers, got {n_bad} others")
    return table


def _read_calibration(data, place):
    _, alpha, color, _, _ = _numbers(data, place, 5, "the list of alphas").T
    if alpha.shape != ALPHA.shape or not np.allclose(alpha, ALPHA, rtol=0, atol=1e-6):
        steps = f"{ALPHA[0]:g} to {ALPHA[-1]:g} in {ALPHA.size} steps in its second column"
        raise data_error(place, f"must list alpha = {steps}, got {alpha.size} rows")
    return alpha, color


def _read_spectra(data, place):
    table = _numbers(data, place, 1 + ALPHA.size, "wavelength and log10 nuF_nu")
    wave = table[:, 0]
    problem = f"must have {N_WAVE} rows, got {wave.size}: truncated or another version"
    check_data(wave.size == N_WAVE, place, problem)
    problem = "must have ascending wavelengths in um, from 1 or less to 1000 or more"
    check_data(is_ascending(wave) and wave[0] <= 1.0 and wave[-1] >= 1e3, place, problem)
    return wave, table[:, 1:]


def _read_stars(data, place):
    wave, light, _, _ = _numbers(data, place, 4, "wavelength in A and starlight in W/A").T
    wave = wave / 1e4
    if not is_ascending(wave) or wave[0] > 1.0 or wave[-1] < 5.0 or np.any(light < 0):
        raise data_error(
            place, "must hold starlight, not negative, at ascending wavelengths from 1 to 5 um"
        )
    return wave, light


def _check_order(wave, log_power, color, places):
    """Columns belong to the alphas if their colors do (dhcal.dat has those of IRAS bands)."""
    log_fnu = (log_power + np.log10(wave)[:, None]).T
    at = np.log([60.0, 100.0])
    colors = np.array([np.subtract(*np.interp(at, np.log(wave), row)) for row in log_fnu])
    worst = np.abs(colors - color).max()
    problem = f"does not fit {places[CALIBRATION]}: log f60/f100 differs by {worst:.2f}"
    check_data(worst <= 0.06, places[SPECTRA], f"{problem}, wanted less than 0.06")


def _bundled_starlight(wave):
    """Return the L_lambda at 13 Gyr of a history exp(-t / 10 Gyr), from the bundled SSPs; arbitrary scale."""
    nodes, age, spectra, _ = load_ssp(locate("ssp.bc03"))
    born = np.arange(13000) + 0.5  # Myr ago
    # what each age counts for where spectra are linear between ages
    weights = [np.interp(born, age, basis) @ np.exp(born / 1e4) for basis in np.eye(age.size)]
    return np.interp(wave, nodes, weights @ spectra[0.02], right=0)
