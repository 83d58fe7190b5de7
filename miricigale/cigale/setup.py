"""A run of CIGALE as a model, a grid and a fit here."""

import dataclasses
from dataclasses import field
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.cigale.catalog import read_cigale_catalog
from miricigale.cigale.distances import at_their_distances
from miricigale.cigale.names import AGN_PARTS, cigale_names
from miricigale.cigale.relation import near_relation
from miricigale.cigale.results import described, write_cigale_results
from miricigale.filters.band_names import xray_energies
from miricigale.filters.filter_set import FilterSet
from miricigale.fitting import BayesFitter, FitResults, GridSettings, Samples
from miricigale.sed import SEDModel
from miricigale.sed.grid_spectra import row_values
from miricigale.sed.xray_bands import with_xray_bands, xray_filter
from miricigale.utils.arrays import finite_values, nans
from miricigale.utils.exceptions import config_error
from miricigale.utils.files import replacing
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.tables import columns_among, require_columns
from miricigale.utils.values import value_class

#: Most models that are written.
_MOST = 2_000_000


def with_agn_parts(grid, model):
    """Return a grid whose AGN have the luminosities of their parts too (`AGN_PARTS`), for each W of AGN power."""
    if not grid.n_agn:
        return grid
    chain = model.chain
    table = grid.agn_properties.copy()
    parts = [chain.agn(row_values(model, grid.agn_parameters, k)) for k in range(grid.n_agn)]
    for name, (ours, theirs) in AGN_PARTS.items():
        light = np.array([chain.weights @ getattr(part, name) for part in parts])
        table[ours] = light * table["agn_power"]
        table[ours].info.description = f"{theirs} of CIGALE"
    return dataclasses.replace(grid, agn_properties=table)


@value_class
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
    method : str
        ``pdf_analysis``, or ``savefluxes``, which `save_models` does.
    left_out, replaced, differs : tuple of str
        What there is no counterpart of, what something else stands in for, and conventions
        that differ.
    names : dict of str to `~miricigale.filters.Filter`
        Filters that the user gave for bands, by CIGALE's names.
    xray : dict
        Options of `~miricigale.sed.with_xray_bands`; empty without X-rays.
    max_dev_alpha_ox : float
        Largest distance from the relation of Just et al. 2007; 0 for any.

    Examples
    --------
    >>> from miricigale.cigale import read_pcigale_ini
    >>> setup = read_pcigale_ini("pcigale.ini")  # doctest: +SKIP
    >>> grid = setup.model().grid(setup.axes([0.5, 1.0]), list(setup.bands))  # doctest: +SKIP
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
    method: str = "pdf_analysis"
    left_out: tuple = ()
    replaced: tuple = ()
    differs: tuple = ()
    names: dict = field(default_factory=dict)
    xray: dict = field(default_factory=dict)
    max_dev_alpha_ox: float = 0.0

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
        Return the axes of the grid.

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
            wanted = "given where the configuration lists no redshifts"
            check_that(redshifts is not None, "redshifts", wanted, "None")
            nodes = self.rounded(redshifts)
            nodes = np.unique(finite_values(nodes))
            check_that(nodes.size, "redshifts", "with a redshift >= 0", "none")
        return self.parameters | {"redshift": nodes}

    def rounded(self, redshifts):
        """
        Return the redshifts to ``redshift_decimals``.

        Those that would become 0, which stands for 10 pc, stay as they are; negative ones are
        missing (NaN).
        """
        z = floats(redshifts)
        z = np.where((z >= 0) & np.isfinite(z), z, np.nan)
        if self.redshift_decimals < 0:
            return z
        rounded = np.round(z, self.redshift_decimals)
        return np.where((rounded == 0) & (z > 0), z, rounded)

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
        path = path or self.data_file
        if path is None:
            raise config_error(self.path, "names no data_file")
        return read_cigale_catalog(
            path, bands=self.columns, limits=self.limits, names=self.names, strict=strict
        )

    def filters(self, names=None):
        """
        Return the filters of bands: a `~miricigale.filters.FilterSet`.

        Parameters
        ----------
        names : iterable of str, optional
            Our names; those of ``bands`` and ``predicted`` by default.
        """
        by_name = {filter_.name: filter_ for filter_ in self.names.values()}
        by_name |= {name: xray_filter(name, band) for name, band in self.xray_bands().items()}
        if names is None:
            names = list(self.bands | self.predicted)
        return FilterSet([by_name.get(name, name) for name in names])

    def xray_bands(self):
        """Return the X-ray bands among ``bands`` and ``predicted``: name to lowest and highest energy."""
        names = [name for name in self.bands | self.predicted if xray_energies(name)]
        return {name: xray_energies(name) * u.keV for name in names if name not in self.names}

    def grid(self, names, redshifts=None):
        """
        Make the `~miricigale.sed.ModelGrid` of bands by our names; ``redshifts`` are those for `axes`.

        Its AGN have the luminosities of their parts too if these are among the ``variables``.
        """
        model = self.model()
        xray = self.xray_bands()
        bands = self.filters([name for name in names if name not in xray])
        grid = model.grid(self.axes(redshifts), bands)
        parts = {theirs for _, theirs in AGN_PARTS.values()}
        if parts.intersection(self.variables) or not self.variables:
            grid = with_agn_parts(grid, model)
        xray = {name: band for name, band in xray.items() if name in names}
        if xray:
            return with_xray_bands(grid, model, xray, **self.xray)
        return grid

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
        have = columns_among(photometry, self.bands)
        grid = self.grid(have + list(self.predicted), _column(photometry, "redshift"))
        options = {"model_error": self.additional_error} | options
        return BayesFitter(grid, have, compat=compat, **options)

    def fit(
        self, photometry, *, compat="cigale", executor=None, progress_bar=False, seed=0, **options
    ):
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
        seed : int, optional
            Of the draws that keep ``max_dev_alpha_ox``.

        Returns
        -------
        results : `~miricigale.fitting.FitResults`
            In the order of the table; ``meta["cigale"]`` says what was left out.
        """
        if self.redshift is not None:
            # the nearest node is taken at any distance
            settings = options.get("settings", GridSettings())
            if settings.redshift_tolerance is None:
                settings = dataclasses.replace(settings, redshift_tolerance=np.inf)
            options |= {"settings": settings}
        fitter = self.fitter(photometry, compat=compat, **options)
        parallel = {"executor": executor, "progress_bar": progress_bar}
        distances = _column(photometry, "redshift")
        if distances is None:
            distances = nans(len(photometry))
        z = self.rounded(distances)

        def fit(redshift=None):
            fits = fitter.fit(photometry, redshift=redshift, **parallel)
            max_deviation = 0.0
            if "l_2500" in fits.quantities:
                max_deviation = self.max_dev_alpha_ox
            if not max_deviation:
                return fits
            return near_relation(
                fitter, photometry, fits, max_deviation, redshift=redshift, seed=seed
            )

        if self.redshift is None:
            results = fit(z)
        else:
            results = _by_redshift(fit, z, fitter.grid.redshift[0])
        note = {
            "configuration": self.path.name,
            "bands": self.bands | self.predicted,
            "modules": self.modules,
            **{name: list(getattr(self, name)) for name in ("left_out", "replaced", "differs")},
        }
        meta = dict(results.meta) | {"cigale": note}
        model = self.model()
        results = dataclasses.replace(results, meta=meta, model=model)
        # objects over all redshifts of the file are where the model is
        distances = floats(distances)
        distances = np.where(np.isfinite(z), distances, np.nan)
        far = _column(photometry, "distance")
        return at_their_distances(results, distances, far, model.cosmology)

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
        axes = self.axes(redshifts)
        if self.xray_bands() and self.model().has_agn:
            axes["alpha_ox"] = self.xray["alpha_ox"]
        count = int(np.prod([len(values) for values in axes.values()], dtype=float))
        if count > _MOST:
            raise config_error(self.path, f"has {count:,} models; at most {_MOST:,} are written")
        bands = self.bands | self.predicted
        grid = self.grid(list(bands), redshifts)
        shape = grid.redshift.size, grid.n_galaxies, max(grid.n_agn, 1), grid.frac_agn.size
        index = np.indices(shape).reshape(4, -1).T
        n = len(index)
        mass = np.where(grid.allowed[index[:, 0], index[:, 1]], 1.0, np.nan)
        # each model as the only draw of an object, in the order of the file's parameters
        models = Samples(grid, np.arange(n), np.zeros(n, int), index[:, None], mass[:, None])
        models = models[np.lexsort([models.values(name)[:, 0].value for name in reversed(axes)])]
        fluxes = models.fluxes(list(bands))[:, 0]
        out = QTable({"id": np.arange(n)})
        for i, band in enumerate(bands.values()):
            out[band] = fluxes[:, i].to(u.mJy)
        for ours, (theirs, unit, factor) in cigale_names(self.modules).items():
            if ours in models.parameters:
                out[theirs] = models.values(ours)[:, 0].value * factor * unit
        with replacing(path, overwrite=overwrite) as partial:
            out.write(partial, format="fits")
        return out

    def write_results(self, results, path, *, overwrite=False):
        """Write results as `write_cigale_results` does, with the variables of this configuration."""
        variables = self.variables or None
        write_cigale_results(results, path, variables=variables, overwrite=overwrite)


def _column(table, name):
    """Return a column of a table; None if it has none of this name."""
    if name in table.colnames:
        return table[name]
    return None


def _by_redshift(fit, z, any_redshift):
    """Fit objects of known redshift there and the others everywhere; join in order."""
    fixed = np.isfinite(z)
    if np.all(fixed):
        return fit(z)
    at_each_node = fit()
    if not np.any(fixed):
        return at_each_node
    # both fits get all objects, so that duplicate ids are flagged
    at = fit(np.where(fixed, z, any_redshift))
    rows = np.concatenate([np.flatnonzero(~fixed), np.flatnonzero(fixed)])
    return FitResults.concatenate([at_each_node[~fixed], at[fixed]])[np.argsort(rows)]
