"""A run of CIGALE: read from ``pcigale.ini``, as a model, a grid and a fit here."""

import dataclasses
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from miricigale.cigale.best_models import write_best_models
from miricigale.cigale.catalog import GIVE_FILTER, read_cigale_catalog
from miricigale.cigale.distances import at_their_distances
from miricigale.cigale.ini import LIMIT_FLAGS, parse_ini
from miricigale.cigale.models import save_models, with_agn_parts
from miricigale.cigale.modules import read_modules
from miricigale.cigale.names import AGN_PARTS, cigale_names
from miricigale.cigale.results import described, write_cigale_results
from miricigale.filters.band_names import band_filters, given_filters
from miricigale.filters.filter_set import FilterSet
from miricigale.fitting import BayesFitter, FitResults
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import ConfigError, MiricigaleWarning, argument_error
from miricigale.utils.tables import error_column, require_columns

__all__ = ["CigaleSetup", "fit_cigale", "read_pcigale_ini"]


@dataclass(frozen=True, eq=False, repr=False)
class CigaleSetup:
    """
    A run of CIGALE in our terms; made by `read_pcigale_ini`.

    Parameters
    ----------
    path : `~pathlib.Path`
        The configuration.
    data_file : `~pathlib.Path` or None
        The catalog.
    components : tuple of `~miricigale.sed.Component`
        The chain.
    parameters : dict of str to `~numpy.ndarray`
        Axes of the grid but redshift.
    redshift : `~numpy.ndarray` or None
        Redshifts that the configuration lists.
    modules : dict of str to str
        Role of a component to the module that it came from.
    frac_agn_definition : str
        See `~miricigale.sed.SEDModel`.
    bands : dict of str to str
        Bands to fit: our names to CIGALE's.
    predicted : dict of str to str
        Bands to predict besides.
    columns : tuple of str
        Bands to fit, with ``_err`` where their errors are used, by CIGALE's names.
    variables : tuple of str
        Quantities to estimate, by CIGALE's names; empty: all.
    additional_error : float
        Part of the flux added to errors in quadrature.
    limits : bool
        Whether upper limits take part in the fit.
    redshift_decimals : int
        To how many decimals known redshifts are rounded; negative: not at all.
    mock : bool
        Whether an analysis of mock objects was asked for.
    cores : int
        Number of cores asked for.
    method : str
        ``pdf_analysis``, or ``savefluxes``, which `save_models` does.
    left_out, replaced, differs : tuple of str
        What there is no counterpart of, what something else stands in for, and conventions
        that differ.
    names : dict of str to `~miricigale.filters.Filter`
        Filters that the user gave for bands, by CIGALE's names.
    """

    path: Path
    data_file: Path | None
    components: tuple
    parameters: dict
    redshift: np.ndarray | None
    modules: dict
    frac_agn_definition: str
    bands: dict
    predicted: dict
    columns: tuple
    variables: tuple
    additional_error: float = 0.1
    limits: bool = False
    redshift_decimals: int = 2
    mock: bool = False
    cores: int = 1
    method: str = "pdf_analysis"
    left_out: tuple = ()
    replaced: tuple = ()
    differs: tuple = ()
    names: dict = field(default_factory=dict)

    def __repr__(self):
        parts = " -> ".join(component.name for component in self.components)
        return f"<CigaleSetup {self.path.name}: {parts}, {len(self.bands)} bands>"

    def describe(self):
        """Say what is left out, replaced and different, a line each; "" if nothing is."""
        return "\n".join(described(vars(self)))

    def model(self):
        """Make the `~miricigale.sed.SEDModel`."""
        return SEDModel(self.components, frac_agn_definition=self.frac_agn_definition)

    def axes(self, redshifts=None):
        """
        Axes of the grid.

        Parameters
        ----------
        redshifts : array_like, optional
            Redshifts of objects; not needed where the configuration lists redshifts.

        Returns
        -------
        axes : dict of str to `~numpy.ndarray`
            For `~miricigale.sed.SEDModel.grid`. The redshifts are those of the configuration,
            or each different one of the objects' after `rounded`.

        Raises
        ------
        ValueError
            If there is no redshift.
        """
        nodes = self.redshift
        if nodes is None:
            if redshifts is None:
                wanted = "given where the configuration lists no redshifts"
                raise argument_error("redshifts", wanted, "None")
            nodes = self.rounded(redshifts)
            nodes = np.unique(nodes[np.isfinite(nodes)])
            if not nodes.size:
                raise argument_error("redshifts", "with a redshift >= 0", "none")
        return self.parameters | {"redshift": nodes}

    def rounded(self, redshifts):
        """
        Redshifts to ``redshift_decimals``.

        Those that would become 0, which stands for 10 pc, stay as they are; negative ones are
        missing (NaN).
        """
        z = np.ma.filled(np.ma.masked_invalid(np.ma.asarray(redshifts, dtype=float)), np.nan)
        z = np.where(z >= 0, z, np.nan)
        if self.redshift_decimals < 0:
            return z
        near = np.round(z, self.redshift_decimals)
        return np.where((near == 0) & (z > 0), z, near)

    def catalog(self, path=None, *, strict=False):
        """
        Read the photometry, as `read_cigale_catalog` does.

        Parameters
        ----------
        path : path-like, optional
            Another catalog than that of the configuration.
        strict : bool, optional
            Whether a band without a filter is an error.

        Raises
        ------
        `~miricigale.utils.exceptions.ConfigError`
            If the configuration names no catalog.
        """
        path = self.data_file if path is None else path
        if path is None:
            msg = f"{self.path} names no data_file"
            raise ConfigError(msg)
        return read_cigale_catalog(
            path, bands=self.columns, limits=self.limits, names=self.names, strict=strict
        )

    def filters(self, names=None):
        """
        Filters of bands: a `~miricigale.filters.FilterSet`.

        Parameters
        ----------
        names : iterable of str, optional
            Our names; those of ``bands`` and ``predicted`` by default.
        """
        given = {one.name: one for one in self.names.values()}
        names = [*self.bands, *self.predicted] if names is None else names
        return FilterSet([given.get(name, name) for name in names])

    def fitter(self, photometry, *, compat="cigale", **options):
        """
        Make the fitter, and the grid with the redshifts of the objects.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`
            Photometry, such as `catalog` gives.
        compat : {"cigale", None}, optional
            Whether the fit keeps CIGALE's conventions, see `~miricigale.fitting.BayesFitter`.
        **options
            Passed to `~miricigale.fitting.BayesFitter`.

        Returns
        -------
        fitter : `~miricigale.fitting.BayesFitter`
        """
        require_columns(photometry, ["id"], "photometry")
        have = [name for name in self.bands if name in photometry.colnames]
        if not have:
            wanted = f"a table with at least one of the columns {list(self.bands)}"
            raise argument_error("photometry", wanted, f"columns {photometry.colnames}")
        redshifts = photometry["redshift"] if "redshift" in photometry.colnames else None
        grid = self.model().grid(self.axes(redshifts), self.filters([*have, *self.predicted]))
        wanted = set(self.variables) & {theirs for _, theirs in AGN_PARTS.values()}
        if wanted or not self.variables:
            grid = with_agn_parts(grid, self.model())
        options = {"model_error": self.additional_error} | options
        if compat is not None:
            options["compat"] = compat
        return BayesFitter(grid, have, **options)

    def fit(self, photometry, *, compat="cigale", executor=None, progress_bar=False, **options):
        """
        Fit photometry.

        Objects with a redshift are fitted at the node next to it, after rounding where the nodes
        are the objects' own, and get masses and luminosities of their own distance: that of a column
        ``distance`` if it is there, else of the redshift. Others are fitted over all redshifts that the
        configuration lists.

        Parameters
        ----------
        photometry, compat, **options
            See `fitter`.
        executor, progress_bar : optional
            See `~miricigale.fitting.BayesFitter.fit`.

        Returns
        -------
        results : `~miricigale.fitting.FitResults`
            In the order of the table; ``meta["cigale"]`` says what was left out.
        """
        if self.redshift is not None:
            # the nearest node is taken at any distance
            options = {"redshift_tolerance": np.inf} | options
        fitter = self.fitter(photometry, compat=compat, **options)
        known = {"executor": executor, "progress_bar": progress_bar}
        if "redshift" in photometry.colnames:
            z = self.rounded(photometry["redshift"])
        else:
            z = np.full(len(photometry), np.nan)
        if self.redshift is None:
            results = fitter.fit(photometry, redshift=z, **known)
        else:
            results = _by_redshift(fitter, photometry, z, known)
        note = {
            "configuration": self.path.name,
            "bands": self.bands | self.predicted,
            "modules": self.modules,
            "left_out": list(self.left_out),
            "replaced": list(self.replaced),
            "differs": list(self.differs),
        }
        meta = dict(results.meta) | {"cigale": note}
        model = self.model()
        results = dataclasses.replace(results, meta=meta, model=model)
        known = photometry["redshift"] if "redshift" in photometry.colnames else z
        far = photometry["distance"] if "distance" in photometry.colnames else None
        # objects over all redshifts of the file are where the model is
        known = np.where(
            np.isfinite(z), np.ma.filled(np.ma.asarray(known, dtype=float), np.nan), np.nan
        )
        return at_their_distances(results, known, far, model.cosmology)

    def save_models(self, path, redshifts=None, *, overwrite=False):
        """
        Write all models of the grid, as the analysis ``savefluxes`` does in ``models-block-0.fits``.

        Parameters
        ----------
        path : path-like
            The FITS file.
        redshifts : array_like, optional
            As for `axes`.
        overwrite : bool, optional
            Whether a file that is there is replaced.

        Returns
        -------
        table : `~astropy.table.QTable`
            What was written, a row for each model of one solar mass formed: ``id``, fluxes in mJy by
            CIGALE's bands, parameters and quantities by its names and in its units. Models older than the
            universe have NaN.

        Raises
        ------
        `~miricigale.utils.exceptions.ConfigError`
            If there are more models than 2 million.
        """
        return save_models(self, path, redshifts, overwrite=overwrite)

    def write_results(self, results, path, *, overwrite=False):
        """Write results as `write_cigale_results` does, with the names of this configuration."""
        write_cigale_results(
            results,
            path,
            variables=self.variables or None,
            bands=self.bands | self.predicted,
            modules=self.modules,
            overwrite=overwrite,
        )


def _by_redshift(fitter, photometry, z, known):
    """Fit objects of known redshift there and the others everywhere; join in order."""
    fixed = np.isfinite(z)
    if np.all(fixed):
        return fitter.fit(photometry, redshift=z, **known)
    free = fitter.fit(photometry, **known)
    if not np.any(fixed):
        return free
    # both fits get all objects, so that duplicate ids are flagged
    at = fitter.fit(photometry, redshift=np.where(fixed, z, fitter.grid.redshift[0]), **known)
    rows = np.concatenate([np.flatnonzero(~fixed), np.flatnonzero(fixed)])
    return FitResults.concatenate([free[~fixed], at[fixed]])[np.argsort(rows)]


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
    `~miricigale.utils.exceptions.MiricigaleWarning`
        Of all that is left out, replaced or different, in one message.
    """
    path = Path(path)
    if libraries not in ("best", "bundled"):
        raise argument_error("libraries", "'best' or 'bundled'", repr(libraries))
    config = parse_ini(path)
    analysis = config["analysis_params"]
    names = given_filters(names)
    if config["parameters_file"]:
        msg = f"{path}: lists of models (parameters_file) are not read, grids are"
        raise ConfigError(msg)
    try:
        chain = read_modules(
            config["sed_modules"],
            config["sed_modules_params"],
            folder=path.parent,
            libraries=libraries,
        )
        columns = config["bands"]
        bands, lost = band_filters(dict.fromkeys(c.removesuffix("_err") for c in columns), names)
        wanted = [band for band in analysis["bands"] if band not in bands.values()]
        predicted, more = band_filters(dict.fromkeys(wanted), names)
    except (ConfigError, ValueError) as err:
        msg = f"{path}: {err}"
        raise ConfigError(msg) from err
    if not bands:
        msg = f"{path}: no band is known here, of {', '.join(lost) or 'none'}"
        raise ConfigError(msg)
    for band in bands.values():
        if band not in columns:
            msg = f"{path}: {error_column(band)} is among the bands, and {band} is not"
            raise ConfigError(msg)
    known = {theirs for theirs, *_ in cigale_names(chain.modules).values()}
    variables = analysis["variables"]
    chain.left_out[:] = [
        *(f"module {x}" if "." not in x and " " not in x else x for x in chain.left_out),
        *_bands_without_filter(dict.fromkeys([*lost, *more])),
        *(f"variable {x}" for x in variables if x not in known),
        *(f"property {x}" for x in config["properties"] if not x.endswith("_err")),
    ]
    extended = [x for x in {**bands, **predicted}.values() if x.endswith("_ext") and x not in names]
    if extended:
        chain.differs.append(f"bands {', '.join(extended)}: curves of point sources")
    flag = analysis["lim_flag"]
    if flag == "noscaling":
        chain.differs.append("lim_flag noscaling: upper limits act on the scale too, as with full")
    setup = CigaleSetup(
        path=path,
        data_file=path.parent / config["data_file"] if config["data_file"] else None,
        bands=bands,
        predicted={name: band for name, band in predicted.items() if name not in bands},
        columns=tuple(c for c in columns if c.removesuffix("_err") in bands.values()),
        variables=tuple(name for name in variables if name in known),
        additional_error=config["additionalerror"],
        limits=LIMIT_FLAGS[flag] != "none",
        redshift_decimals=analysis["redshift_decimals"],
        mock=analysis["mock_flag"],
        cores=config["cores"],
        method=config["analysis_method"],
        names=names,
        **{k: tuple(v) if isinstance(v, list) else v for k, v in vars(chain).items()},
    )
    text = setup.describe()
    if strict and (setup.left_out or setup.replaced):
        msg = f"{path}:\n{text}"
        raise ConfigError(msg)
    if text:
        warnings.warn(f"{path}:\n{text}", MiricigaleWarning, stacklevel=2)
    return setup


def _bands_without_filter(bands):
    """Items of what is left out; the last one says what to do."""
    items = [f"band {band}" for band in bands]
    return [*items[:-1], f"{items[-1]} (no filter here: {GIVE_FILTER})"] if items else []


def fit_cigale(
    ini, *, output=None, best_models=None, libraries="best", names=None, strict=False, **options
):
    """
    Do what a run of CIGALE does: read configuration and catalog, fit, write.

    Parameters
    ----------
    ini : path-like or `CigaleSetup`
        ``pcigale.ini``, or what `read_pcigale_ini` made of it.
    output : path-like, optional
        File of results in CIGALE's columns (``results.fits`` or ``.txt``), replaced if it is
        there.
    best_models : path-like, optional
        Folder of files of the best models (`write_best_models`), replaced if they are there.
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

    Examples
    --------
    >>> from miricigale.cigale import fit_cigale
    >>> results = fit_cigale("pcigale.ini", output="results.fits")  # doctest: +SKIP
    """
    setup = ini
    if not isinstance(ini, CigaleSetup):
        setup = read_pcigale_ini(ini, libraries=libraries, names=names, strict=strict)
    if setup.method == "savefluxes":
        msg = f"{setup.path} asks for the models (savefluxes): CigaleSetup.save_models writes them"
        raise ConfigError(msg)
    photometry = setup.catalog(strict=strict)
    results = setup.fit(photometry, **options)
    if output is not None:
        setup.write_results(results, output, overwrite=True)
    if best_models is not None:
        write_best_models(results, best_models, overwrite=True)
    return results
