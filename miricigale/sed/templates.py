"""Grids of given spectra, such as those of stars: each has a scale and nothing else."""

import re
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import Table

from miricigale.filters import FilterSet
from miricigale.sed.components.igm import Meiksin2006
from miricigale.sed.grid import ModelGrid
from miricigale.sed.spectrum import SED
from miricigale.sed.stated_units import stated_units
from miricigale.utils.curve_columns import unit_of_fluxes, unit_of_wavelengths
from miricigale.utils.exceptions import ModelWarning, data_error, file_errors, warn
from miricigale.utils.meta import provenance
from miricigale.utils.missing_values import floats, plain_floats
from miricigale.utils.options import check_choice, check_data, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import described_table
from miricigale.utils.units import FLAM, FNU, WAVE, is_ascending

_SUFFIXES = (".fits", ".fit", ".dat", ".txt", ".csv", ".ecsv", ".ascii", ".spec")
#: Parameters that a grid has itself.
_OF_GRIDS = frozenset({"redshift", "mass", "frac_agn"})
#: Where spectra that end before are continued to.
_FAR = 100.0  # um
#: Part of the wavelengths at the end of a spectrum whose mean its continuation starts from.
_END = 0.95


@takes_other_keywords
def read_spectra(path):
    r"""
    Read spectra, such as those of a library of stars.

    Parameters
    ----------
    path : path-like
        A file, or a folder of files with one of the usual suffixes: FITS tables or text. The first column is the
        wavelength in vacuum (Angstrom where it has no unit), the second the flux density (F_lambda where it has
        no unit, of the column or in the comments of a text, as in ``# wave(um) flux(uJy)``), or
        several of them in a column of vectors; all others are left alone. That is how STScI distributes the atlas
        of Pickles (1998). In its model atmospheres (Castelli & Kurucz, PHOENIX) each column
        ``g00`` to ``g55`` is one of another surface gravity: all that have light are read. Files ``.spec`` are
        those of optically thick atmospheres of Liu et al. 2026 (arXiv:2603.02317).

    Returns
    -------
    spectra : dict of str to `SED`
        By the name of the file without its suffix, with the number in the vector or the name of the gravity.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no file, one is no spectrum or lacks values, or two have the same name but for their suffix.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from miricigale.sed import read_spectra
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "star.txt"  # Angstrom, F_lambda
    >>> _ = path.write_text("4000 2e-15\n20000 5e-16\n300000 1e-20\n")
    >>> read_spectra(path)
    {'star': <SED 3 points, 0.4 um to 30 um, redshift 0>}
    """
    path = Path(path).expanduser()
    files = [path]
    if path.is_dir():
        names = sorted(p for p in path.iterdir() if p.is_file())
        files = [p for p in names if p.name.lower().removesuffix(".gz").endswith(_SUFFIXES)]
        check_data(files, path, f"has no files of spectra ({', '.join(_SUFFIXES)})")
    out = {}
    for file in files:
        spectra = _read_file(file)
        if spectra.keys() & out.keys():
            raise data_error(file, "has the name of another file of spectra but for its suffix")
        out |= spectra
    return out


def _read_file(file):
    # not aliases of astropy's, which hold for all threads: what is not known here either is refused below
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", u.UnitsWarning)
        table = read_table(file, wanted="a spectrum", cls=Table)
    if len(table.colnames) < 2:
        got = f"it has the columns {table.colnames}"
        raise data_error(file, f"cannot be read as a spectrum: {got}")
    first, *fluxes = table.colnames
    gravities = [name for name in fluxes if re.fullmatch(r"g\d\d", name)]
    with file_errors(file, "cannot be read as a spectrum"):
        # NaN where a value is lacking, which is none of a spectrum
        units = _stated_units(file, table)
        wave_unit = units[0] or u.AA
        wave = plain_floats(table[first], first, "spectrum")
        wave = wave * unit_of_wavelengths(table[first].unit or wave_unit)
        endings = "|".join(map(re.escape, _SUFFIXES))
        stem = re.sub(rf"({endings})?(\.gz)?$", "", file.name, flags=re.I)
        out = {}
        for column in gravities or fluxes[:1]:
            values = plain_floats(table[column], column, "spectrum").reshape(wave.size, -1).T
            if gravities:
                parts = [column]
            elif len(values) > 1:
                parts = range(len(values))
            else:
                parts = [None]
            for part, flux in zip(parts, values, strict=True):
                # atmospheres that were not computed are 0 in such files
                if not gravities or flux.any():
                    if part is None:
                        name = stem
                    else:
                        name = f"{stem}[{part}]"
                    unit = unit_of_fluxes(table[column].unit or units[1] or FLAM)
                    out[name] = SED(wave, flux * unit)
        return out


def _stated_units(file, table):
    """Units of wavelengths and fluxes in the comments of a text; None for those of columns that have their own."""
    if any(column.unit is not None for column in table.itercols()):
        return None, None
    return stated_units(file, table.colnames)


@takes_other_keywords
def template_grid(spectra, filters, *, beyond="error", redshift=None):
    """
    Return a grid of given spectra, for `~miricigale.fitting.BayesFitter`: at redshift 0, or at redshifts.

    Parameters
    ----------
    spectra : dict of str to `SED` or `synphot.SourceSpectrum`
        The templates by name, such as stars that `read_spectra` read.
    filters : `~miricigale.filters.FilterSet` or list of str
        The bands.
    beyond : {"error", "rayleigh-jeans"}, optional
        What is done with spectra that end before the bands do: they are refused, or continued with
        F_nu ~ wave^-2 to 100 um, with a warning. That holds within some percent for stars of 3500 K and
        above; for brown dwarfs and stars in dust it does not.
    redshift : array_like, shape (n_z,), optional
        Ascending redshifts at which the spectra, by wavelength at rest, are seen, behind the intergalactic medium
        (`~miricigale.sed.components.Meiksin2006`); by default they are taken as they are.

    Returns
    -------
    grid : `ModelGrid`
        One redshift, 0, or those given; as galaxies the templates, each with a mean flux of 1 uJy in the bands; no
        AGN. They have the parameters that the spectra have (``SED.parameters``), where these are a full grid, such
        as those of `red_dots`; others are numbered by the parameter ``template``. The scale of a fit (``mass`` of
        its results) is the mean flux in uJy. ``meta["templates"]`` has the names.

    Raises
    ------
    ValueError
        If there is no template, one does not cover a band, or has no light in them.

    Warns
    -----
    `~miricigale.utils.exceptions.ModelWarning`
        Of spectra that are continued.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale.sed import SED, template_grid
    >>> wave = np.geomspace(0.3, 40.0, 500) * u.um
    >>> spectra = {f"slope {s}": SED(wave, wave.value**s * u.uJy) for s in (-2, 0, 2)}
    >>> grid = template_grid(spectra, ["wfc3.f160w", "miri.f770w"])
    >>> grid.meta["templates"], grid.galaxy[0].round(3)
    (['slope -2', 'slope 0', 'slope 2'], array([[1.921, 0.079],
           [1.   , 1.   ],
           [0.078, 1.922]]))
    """
    check_choice(beyond, "beyond", ("error", "rayleigh-jeans"))
    check_that(spectra, "spectra", "a dict of at least one spectrum", spectra)
    if not isinstance(filters, FilterSet):
        filters = FilterSet(filters)
    seds = {}
    for name, spectrum in spectra.items():
        if isinstance(spectrum, SED):
            seds[name] = spectrum
        else:
            seds[name] = SED.from_synphot(spectrum)
    if beyond != "error":
        last = max(band.wave[-1] for band in filters)
        short = [name for name, sed in seds.items() if sed.wave[-1] < last]
        seds |= {name: _continued(seds[name]) for name in short}
        if short:
            msg = f"{len(short)} of {len(seds)} spectra continued to {last:.3g} with F_nu ~ wave^-2"
            warn(msg, ModelWarning)
    if redshift is None:
        z = np.zeros(1)
    else:
        z = np.atleast_1d(floats(redshift))
    good = is_ascending(z) and z[0] >= 0 and np.isfinite(z[-1])
    check_that(good, "redshift", "finite, ascending and >= 0", redshift)
    if redshift is None:
        flux = np.array([[_fluxes(name, sed, filters) for name, sed in seds.items()]])
    else:
        flux = _observed_fluxes(list(seds.values()), z, filters)
    mean = flux.mean(axis=-1, keepdims=True)
    n = len(seds)
    columns = _columns(list(seds.values()))
    return ModelGrid(
        filters=filters.names,
        redshift=z,
        galaxy=np.divide(flux, mean, out=np.ones_like(flux), where=mean > 0),
        dust_luminosity=np.zeros(n),
        allowed=mean[..., 0] > 0,
        galaxy_parameters=described_table(columns),
        meta=provenance(templates=list(seds)),
        axes={"redshift": z}
        | {name: np.unique(column.value) for name, (column, _) in columns.items()},
    )


def _columns(seds):
    """
    Return the parameters of templates, with meanings: their own, where these are a full grid, or their numbers.

    Templates have their own parameters if all have the same, none is what a grid has itself, and each combination
    of the values is there once.
    """
    numbers = {"template": (np.arange(len(seds), dtype=float) * u.one, "number of the template")}
    names = list(seds[0].parameters)
    alike = all(list(sed.parameters) == names for sed in seds)
    if len(seds) < 2 or not names or not alike or _OF_GRIDS.intersection(names):
        return numbers
    columns = {name: u.Quantity([sed.parameters[name] for sed in seds]) for name in names}
    values = [column.value.tolist() for column in columns.values()]
    n_points = len(set(zip(*values, strict=True)))
    n_grid = np.prod([len(set(labels)) for labels in values])
    if not n_points == n_grid == len(seds):
        return numbers
    return {name: (column, name) for name, column in columns.items()}


def _observed_fluxes(seds, redshifts, filters):
    """Return the fluxes of spectra at redshifts, of any scale: shape (n_z, n, n_filters)."""
    igm = Meiksin2006()
    alike = {}
    # spectra often have the same wavelengths
    for i, sed in enumerate(seds):
        wave = sed.rest_wavelength.to_value(WAVE)
        alike.setdefault(wave.tobytes(), (wave, []))[1].append(i)
    out = np.empty((len(redshifts), len(seds), len(filters)))
    for shared, rows in alike.values():
        fnu = np.array([seds[i].fnu.to_value(FNU) for i in rows])
        for k, redshift in enumerate(redshifts):
            wave = shared * (1.0 + redshift)
            weights = filters.weights(wave) * igm.transmission(wave, redshift)
            out[k, rows] = fnu @ weights.T
    return out


def _continued(sed):
    """Return a spectrum with F_nu ~ wave^-2 from its end on."""
    wave = sed.wave.to_value(WAVE)
    fnu = sed.fnu.to_value(FNU)
    end = wave > _END * wave[-1]
    level = np.mean((fnu * wave**2)[end])
    extension = np.geomspace(wave[-1], max(_FAR, 2.0 * wave[-1]), 400)[1:]
    return SED(np.append(wave, extension) * WAVE, np.append(fnu, level / extension**2) * FNU)


def _fluxes(name, sed, filters):
    try:
        flux = filters.synthetic_fluxes(sed).to_value(FNU)
    except ValueError as err:
        msg = f"template {name!r}: {err}"
        raise ValueError(msg) from err
    check_that(flux.mean() > 0, "spectra", f"with light in the bands, also {name!r}", flux)
    return flux
