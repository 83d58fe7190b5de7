"""Runs of CIGALE from their files: configuration to setup, catalog to results."""

from pathlib import Path

from miricigale.cigale.best_models import write_best_models
from miricigale.cigale.catalog import GIVE_FILTER
from miricigale.cigale.ini import LIMIT_FLAGS, parse_ini
from miricigale.cigale.modules import read_modules
from miricigale.cigale.names import cigale_names
from miricigale.cigale.setup import CigaleSetup
from miricigale.filters.band_names import band_filters, xray_energies
from miricigale.filters.filter_arguments import given_filters
from miricigale.utils.exceptions import CatalogWarning, ConfigError, config_error, warn
from miricigale.utils.named_values import convert_values, without
from miricigale.utils.options import check_choice
from miricigale.utils.outputs import check_output
from miricigale.utils.tables import error_column
from miricigale.utils.values import value_class


def read_pcigale_ini(path, *, libraries="best", names=None, strict=False):
    """
    Read the configuration of a run of CIGALE.

    Parameters
    ----------
    path : path-like
        ``pcigale.ini`` of CIGALE 2018 to 2022, with a grid of parameters for the analysis
        ``pdf_analysis``.
    libraries : {"best", "bundled"}, optional
        Whether libraries that are registered (`miricigale.sed`) are used, or the bundled tables
        alone.
    names : dict, optional
        Filters of bands that are not known, or otherwise known: by CIGALE's name a
        `~miricigale.filters.Filter`, the name of one, or the path of its file, as for `read_cigale_catalog`.
    strict : bool, optional
        Whether anything that is left out or replaced is an error, not a warning.

    Returns
    -------
    setup : `CigaleSetup`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file, or that of a filter, cannot be read.
    KeyError
        If there is no filter of a name in ``names``.
    `~miricigale.utils.exceptions.ConfigError`
        If a value cannot be read, a parameter is not known while one that is would get its default, nothing
        can be fitted, or with ``strict``, something would be left out or replaced.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of all that is left out, replaced or different, in one message.

    Examples
    --------
    >>> from miricigale.cigale import read_pcigale_ini
    >>> setup = read_pcigale_ini("pcigale.ini")  # doctest: +SKIP
    >>> results = setup.fit(setup.catalog())  # doctest: +SKIP
    """
    path = Path(path)
    check_choice(libraries, "libraries", ("best", "bundled"))
    config = parse_ini(path)
    analysis = config["analysis_params"]
    names = given_filters(names)
    if config["parameters_file"]:
        raise config_error(path, "has lists of models (parameters_file), which are not read")
    try:
        chain = read_modules(
            config["sed_modules"],
            config["sed_modules_params"],
            folder=path.parent,
            libraries=libraries,
        )
        bands = _RunBands.of_config(config, names, has_xray=bool(chain.xray))
    except (ConfigError, ValueError) as err:
        raise config_error(path, f"cannot be used: {err}") from err
    bands.check(path)
    computed = _computed_variables(chain, bands)
    if chain.xray and not bands.hard:
        chain.left_out.append(f"{chain.modules['xray']} (no band of it)")
    chain.left_out[:] = _all_left_out(chain, bands, config, computed)
    extended = bands.extended(names)
    if extended:
        chain.differs.append(f"bands {', '.join(extended)}: curves of point sources")
    flag = analysis["lim_flag"]
    if flag == "noscaling":
        chain.differs.append("lim_flag noscaling: upper limits act on the scale too, as with full")
    data_file = None
    if config["data_file"]:
        data_file = path.parent / config["data_file"]
    setup = CigaleSetup(
        path=path,
        data_file=data_file,
        bands=bands.fitted,
        predicted=without(bands.predicted, bands.fitted),
        columns=bands.fitted_columns(),
        variables=tuple(name for name in analysis["variables"] if name in computed),
        additional_error=config["additionalerror"],
        limits=LIMIT_FLAGS[flag] != "none",
        redshift_decimals=analysis["redshift_decimals"],
        mock=analysis["mock_flag"],
        method=config["analysis_method"],
        names=names,
        **convert_values(_frozen, vars(chain)),
    )
    text = setup.describe()
    if strict and (setup.left_out or setup.replaced):
        raise config_error(path, f"cannot be used as a whole:\n{text}")
    if text:
        warn(f"{path}:\n{text}", CatalogWarning)
    return setup


@value_class
class _RunBands:
    """
    Bands of a run of CIGALE.

    ``columns`` are those of the configuration. ``fitted`` and ``predicted`` are dicts of our names to CIGALE's;
    ``lost`` and ``lost_predictions`` have CIGALE's names of which there is no filter. ``hard`` are all bands of
    X-rays, and ``dark`` those without the module that fills them.
    """

    columns: list
    fitted: dict
    predicted: dict
    lost: list
    lost_predictions: list
    hard: set
    dark: set

    @classmethod
    def of_config(cls, config, names, *, has_xray):
        """Of a configuration, with filters ``names`` that were given."""
        columns = config["bands"]
        fitted, lost = band_filters(dict.fromkeys(map(_without_error, columns)), names)
        in_catalog = set(fitted.values())
        other_bands = [
            band for band in config["analysis_params"]["bands"] if band not in in_catalog
        ]
        predicted, lost_predictions = band_filters(dict.fromkeys(other_bands), names)
        hard = set()
        for name in fitted | predicted:
            if xray_energies(name) and name not in names:
                hard.add(name)
        dark = set()
        if not has_xray:
            dark = hard
        return cls(
            columns=columns,
            fitted=without(fitted, dark),
            predicted=without(predicted, dark),
            lost=lost,
            lost_predictions=lost_predictions,
            hard=hard,
            dark=dark,
        )

    def check(self, path):
        """Refuse a run without a band that can be fitted, or with the errors of a band alone."""
        if not self.fitted:
            names = ", ".join(self.lost) or "none"
            raise config_error(path, f"has no band that is known here, of {names}")
        for band in self.fitted.values():
            if band not in self.columns:
                raise config_error(
                    path, f"has {error_column(band)} among the bands, and not {band}"
                )

    def fitted_columns(self):
        """List the columns of the catalog that belong to bands that are fitted: tuple of str."""
        fitted = set(self.fitted.values())
        return tuple(name for name in self.columns if _without_error(name) in fitted)

    def extended(self, names):
        """List CIGALE's bands for extended sources, for which there are curves of points alone."""
        all_bands = (self.fitted | self.predicted).values()
        return [name for name in all_bands if name.endswith("_ext") and name not in names]


def _computed_variables(chain, bands):
    """Return CIGALE's names of the quantities that are computed for these modules and bands: set of str."""
    computed = {entry[0] for entry in cigale_names(chain.modules).values()}
    if bands.dark or not bands.hard:
        computed -= {"xray.alpha_ox", "xray.agn_Lx_2to10keV", "agn.intrin_Lnu_2500A_30deg"}
    return computed


def _all_left_out(chain, bands, config, computed):
    """Name each module, band, variable and property that is left out, with the reason: list of str."""
    left_out = []
    for entry in chain.left_out:
        is_module = "." not in entry and " " not in entry
        left_out.append(f"module {entry}" if is_module else entry)
    for name in sorted(bands.dark):
        left_out.append(f"band {name} (no module xray)")
    unknown = [f"band {name}" for name in dict.fromkeys(bands.lost + bands.lost_predictions)]
    if unknown:
        # the last one says what to do
        unknown[-1] += f" (no filter here: {GIVE_FILTER})"
    left_out += unknown
    for name in config["analysis_params"]["variables"]:
        if name not in computed:
            left_out.append(f"variable {name}")
    for name in config["properties"]:
        if not name.endswith("_err"):
            left_out.append(f"property {name}")
    return left_out


def _without_error(column):
    """Name of the band of a column of fluxes or errors."""
    return column.removesuffix("_err")


def _frozen(value):
    """Return a list as a tuple, and anything else as it is."""
    if isinstance(value, list):
        return tuple(value)
    return value


def fit_cigale(
    ini,
    *,
    output=None,
    best_models=None,
    overwrite=False,
    libraries="best",
    names=None,
    strict=False,
    **options,
):
    """
    Do what a run of CIGALE does: read configuration and catalog, fit, write.

    Parameters
    ----------
    ini : path-like or `CigaleSetup`
        ``pcigale.ini``, or what `read_pcigale_ini` made of it.
    output : path-like, optional
        File of results in CIGALE's columns (``results.fits`` or ``.txt``).
    best_models : path-like, optional
        Folder of files of the best models (`write_best_models`).
    overwrite : bool, optional
        Whether files that are there are replaced.
    libraries, names, strict : optional
        As for `read_pcigale_ini`; no use for a `CigaleSetup`.
    **options
        Passed to `CigaleSetup.fit`.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If the configuration is one of ``savefluxes``, which `CigaleSetup.save_models` does; as
        `read_pcigale_ini`.
    ValueError
        If ``output`` is there and ``overwrite`` is False.
    OSError
        If a file of ``best_models`` is there and ``overwrite`` is False.

    Examples
    --------
    >>> from miricigale.cigale import fit_cigale
    >>> results = fit_cigale("pcigale.ini", output="results.fits")  # doctest: +SKIP
    """
    check_output(output, "output", overwrite=overwrite)
    setup = ini
    if not isinstance(ini, CigaleSetup):
        setup = read_pcigale_ini(ini, libraries=libraries, names=names, strict=strict)
    if setup.method == "savefluxes":
        raise config_error(setup.path, "asks for savefluxes: CigaleSetup.save_models writes them")
    photometry = setup.catalog(strict=strict)
    results = setup.fit(photometry, **options)
    if output is not None:
        setup.write_results(results, output, overwrite=overwrite)
    if best_models is not None:
        xray = None
        if setup.xray_bands():
            xray = setup.xray
        write_best_models(results, best_models, xray=xray, overwrite=overwrite)
    return results
