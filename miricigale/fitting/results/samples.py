"""Models drawn from posteriors: joint distributions, fluxes in any band, spectra."""

from dataclasses import field
from functools import cached_property

import astropy.units as u
import numpy as np

from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.posterior.posterior import FitRows, bin_edges, cell_edges, check_levels
from miricigale.fitting.posterior.priors import grid_priors
from miricigale.fitting.posterior.quantities import FRACTIONS, Quantities
from miricigale.fitting.results import histories, inference_data
from miricigale.fitting.results.corner_panels import draw_panel, marked_values
from miricigale.fitting.results.drawing import CORNER, labeled
from miricigale.fitting.results.listed_models import fluxes_between_nodes, models_of_draws
from miricigale.fitting.results.percentile_columns import LEVELS, quantile_columns
from miricigale.sed import grid_spectra
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.file_formats import read_write
from miricigale.utils.flag_arrays import FlagField
from miricigale.utils.object_rows import PerObject, PerObjectDict
from miricigale.utils.options import check_names, check_shape, check_that
from miricigale.utils.tables import described_table, error_column
from miricigale.utils.units import FNU, WAVE
from miricigale.utils.values import value_class


@value_class
class Samples(FitRows):
    """
    Models drawn from the posteriors of the objects of a catalog.

    All draws of an object have the same weight. Draws on the nodes of a grid are models of it, of which only four
    indices and a scale are kept. Draws between the nodes are some of the models that the results of a fit rest on,
    with values and fluxes of their own. ``samples[id]`` and ``samples[rows]`` are of this class too; of a single
    object the arrays have no axis of objects.

    Parameters
    ----------
    grid : `~miricigale.sed.ModelGrid`
        The grid that was fitted.
    ids : array_like, shape (n,)
        Ids of the objects.
    flags : array_like of int, shape (n,)
        `FitFlags`.
    index : array_like of int, shape (n, n_draws, 4)
        Redshift, galaxy, AGN model and AGN fraction of every draw, as indices of the grid; -1 for
        objects that could not be fitted. Where the fraction is 0 the AGN model may be -1: none. Of draws
        between the nodes, those in whose cells they lie.
    scale : array_like, shape (n, n_draws)
        Solar masses formed.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from, for other bands and for spectra.
    meta : dict, optional
        Provenance, for people.
    axes : dict of str to `~miricigale.fitting.posterior.priors.GridAxis`, optional
        Parameters that have several values, with the prior of the fit (``fitter.priors.axes``);
        flat in the nodes by default. It matters only for parameters without effect: their
        posterior is their prior.
    seed : int, optional
        Chooses values of parameters without effect.
    drawn : dict of str to array_like, shape (n, n_draws), optional
        Of draws between the nodes: parameters of the grid, redshift and AGN fraction among them, and derived
        quantities, in their units. Empty on nodes.
    flux : array_like, shape (n, n_draws, n_filters), optional
        Of draws between the nodes: fluxes in the bands of the grid in uJy.

    Raises
    ------
    ValueError
        If shapes do not agree, an index is not one of the grid, or values of draws between nodes are missing.

    Examples
    --------
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes, model_error=0.02)
    >>> samples = fitter.sample(photometry, 100, seed=1)
    >>> samples
    <Samples of 2 objects, 100 draws each>
    >>> samples["b"].mean("redshift").round(1)
    <Quantity 1.>
    """

    grid: object
    ids: PerObject
    flags: PerObject
    index: PerObject
    scale: PerObject
    model: object = None
    meta: dict = field(default_factory=dict)
    axes: dict | None = None
    seed: int = 0
    drawn: PerObjectDict = field(default_factory=dict)
    flux: PerObject = None

    read, write = read_write(
        "draws (FITS: all but grid and model; ECSV: their table, not read back)",
        """grid : `~miricigale.sed.ModelGrid`
    The grid that was fitted (``fitter.grid``), for draws are indices of it; others are refused.
model : `~miricigale.sed.SEDModel`, optional
    The model that it was made from, for other bands and for spectra.
""",
    )

    def __post_init__(self):
        ids = np.asarray(self.ids)
        self._check(ids.size)
        dtypes = {"ids": ids.dtype, "flags": np.int64, "index": np.int32, "scale": float}
        for name, dtype in dtypes.items():
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype))
        if self.axes is None:
            object.__setattr__(self, "axes", grid_priors(self.grid).axes)
        self._check_drawn()
        super().__post_init__()

    def _check(self, n):
        """Refuse draws whose shapes do not agree, or that are no models of the grid."""
        grid = self.grid
        index = np.asarray(self.index)
        shape = np.shape(self.scale)
        if len(shape) != 2 or shape[0] != n or shape[1] < 1:
            raise argument_error("scale", f"of shape ({n}, n_draws)", f"{shape}")
        for name, wanted in (("index", shape + (4,)), ("flags", (n,))):
            check_shape(getattr(self, name), wanted, name)
        sizes = (grid.redshift.size, grid.n_galaxies, max(grid.n_agn, 1), grid.frac_agn.size)
        drawn = index[(index[:, :, 0] >= 0).all(axis=1)].reshape(-1, 4)
        if np.any(drawn < [0, 0, -1, 0]) or np.any(drawn >= sizes):
            raise argument_error("index", f"within the grid's {sizes}", "others")
        if np.any((drawn[:, 2] < 0) & (grid.frac_agn[drawn[:, 3]] > 0)):
            wanted = "with an AGN model where the AGN fraction is above 0"
            raise argument_error("index", wanted, "none")

    def _check_drawn(self):
        """Refuse draws between nodes without all values, or of other shapes."""
        if self.on_nodes:
            check_that(self.flux is None, "flux", "None without 'drawn'", "an array")
            return
        shape = self.scale.shape
        for name in self._drawn_names:
            check_that(name in self.drawn, "drawn", f"with {name!r}", sorted(self.drawn))
        drawn = {name: np.asarray(array, float) for name, array in self.drawn.items()}
        for name, array in drawn.items():
            check_that(
                array.shape == shape, "drawn", f"of shape {shape}", f"{array.shape} ({name})"
            )
        object.__setattr__(self, "drawn", drawn)
        shape = shape + (len(self.grid.filters),)
        got = np.shape(self.flux)
        check_that(got == shape, "flux", f"of shape {shape} with 'drawn'", got)
        object.__setattr__(self, "flux", np.asarray(self.flux, float))

    @property
    def on_nodes(self):
        """Whether draws are models of the grid, and not models between its nodes."""
        return not self.drawn

    @property
    def _drawn_names(self):
        """Names of all values of draws between nodes."""
        return dict.fromkeys(("redshift", "frac_agn", *self.axes, *self._quantities.names))

    def __repr__(self):
        if self.isscalar:
            flags = ""
            if self.flags:
                flags = f", {self.flags}"
            return f"<Samples of {np.asarray(self.ids).item()!r}, {self.n_draws} draws{flags}>"
        n = len(self)
        return f"<Samples of {n} object{'s' * (n != 1)}, {self.n_draws} draws each>"

    @property
    def n_draws(self):
        """Number of draws of each object."""
        return self.scale.shape[-1]

    @property
    def fitted(self):
        """Which objects have draws."""
        return (self.index[..., 0] >= 0).all(axis=-1)

    # ------------------------------------------------------------------- values

    @cached_property
    def _quantities(self):
        return Quantities.of_grid(self.grid)

    @property
    def _fractions(self):
        have = set(self._quantities.names)
        return [name for name, parts in FRACTIONS.items() if have.issuperset(parts[1:])]

    @property
    def parameters(self):
        """
        Names of all that can be asked for.

        Parameters with several values in the grid, derived quantities and, where the grid has
        AGN, the AGN fraction in both definitions.
        """
        fractions = self._fractions
        derived = (name for name in self._quantities.names if name not in fractions)
        return tuple(self.axes) + tuple(derived) + tuple(fractions)

    def unit(self, name):
        """Return the unit of a parameter or derived quantity."""
        name = self._named(name)
        if name in self.axes:
            return u.Unit(self.axes[name].unit)
        check_names([name], "parameter", self.parameters)
        quantities = self._quantities
        if name in FRACTIONS:
            return u.dimensionless_unscaled
        return quantities.units[quantities.names.index(name)]

    def description(self, name):
        """Return one line on a parameter or derived quantity."""
        quantities = self._quantities
        texts = dict(zip(quantities.names, quantities.descriptions, strict=True))
        texts |= {name: parts[0] for name, parts in FRACTIONS.items()}
        for table in (self.grid.galaxy_parameters, self.grid.agn_parameters):
            texts |= {column: table[column].info.description for column in table.colnames}
        return texts.get(name) or name

    def values(self, name):
        """
        Return the values of a parameter or derived quantity in every draw.

        Returns
        -------
        values : `~astropy.units.Quantity`, shape (n, n_draws)
            NaN for objects that could not be fitted, and for parameters of the AGN where a
            draw has none. Parameters without effect have values of their prior.
        """
        name = self._named(name)
        rows = self._several()
        unit = self.unit(name)
        out = np.where(rows.fitted[:, None], rows._values(name), np.nan)
        return out.reshape(self.scale.shape) * unit

    def _values(self, name):
        """Look up values without their unit, shape (n, n_draws); of any model for objects without draws."""
        if name in self.drawn:
            return self.drawn[name]
        z, g, k, f = np.moveaxis(self.index, -1, 0)
        grid = self.grid
        axis = self.axes.get(name)
        if name in self._fractions:
            _, agn_name, galaxy_name = FRACTIONS[name]
            agn = self._values(agn_name)
            galaxy = self._values(galaxy_name)
            total = agn + galaxy
            return np.divide(agn, total, out=np.zeros_like(total), where=total != 0)
        if axis is None:
            frac = grid.frac_agn[f]
            return self._quantities.evaluate(name, grid, g, np.maximum(k, 0), frac, self.scale)
        values = {"redshift": grid.redshift[z], "frac_agn": grid.frac_agn[f]}
        if axis.kind in values:
            return values[axis.kind]
        model = {"galaxy": g, "agn": k}[axis.kind]
        return axis.values_of_models(model, self.ids, int(self.seed))

    def to_table(self, names=None):
        """
        Return all draws as a long table.

        Parameters
        ----------
        names : list of str, optional
            Parameters and derived quantities; all by default.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id``, ``draw`` (from 0), ``flags``, and a column for each parameter and derived
            quantity; the draws of an object follow one another. Objects that could not be
            fitted stay in place with NaN.
        """
        rows = self._several()
        n, draws = rows.scale.shape
        columns = {
            "id": (np.repeat(rows.ids, draws), "identifier"),
            "draw": (np.tile(np.arange(draws), n), "number of the draw"),
            "flags": (np.repeat(rows.flags, draws), FitFlags.describe()),
        }
        if names is None:
            names = self.parameters
        for name in names:
            columns[name] = (rows.values(name).ravel(), self.description(name))
        return described_table(columns, dict(self.meta))

    def mean(self, name):
        """Return the means of the draws: Quantity, shape (n,)."""
        return self.values(name).mean(axis=-1)

    def std(self, name):
        """Return the standard deviations of the draws: Quantity, shape (n,)."""
        return self.values(name).std(axis=-1)

    def percentile(self, name, levels=(16, 50, 84)):
        """
        Compute percentiles of the draws.

        Parameters
        ----------
        name : str
            A parameter or derived quantity.
        levels : array_like, shape (n_levels,), optional
            Levels in (0, 1), or all in percent, of percentiles of shape (n, n_levels); (n,) for a single level.
        """
        values = self.values(name)
        single = np.ndim(levels) == 0
        levels = check_levels(levels)
        out = np.moveaxis(np.quantile(values.value, levels, axis=-1), 0, -1) * values.unit
        if single:
            return out[..., 0]
        return out

    # -------------------------------------------------------------- distributions

    def pdf(self, name, key):
        """
        Return the distribution of a parameter or derived quantity of one object.

        Parameters
        ----------
        name, key : str and object
            A parameter or derived quantity, and the id of the object.

        Returns
        -------
        edges : `~astropy.units.Quantity`, shape (n_bins + 1,)
            Of parameters of the grid the cells around its nodes; of derived quantities 30 bins of equal
            width, in the logarithm where they scale with mass.
        weights : `~numpy.ndarray`, shape (n_bins,)
            Part of the draws in each.
        """
        values, edges = self._binned(name, key)
        return edges * self.unit(name), np.histogram(values, edges)[0] / self.n_draws

    def pdf_2d(self, a, b, key):
        """
        Return the joint distribution of two parameters or derived quantities of one object.

        Parameters
        ----------
        a, b : str
            Parameters or derived quantities.
        key : object
            Id of the object.

        Returns
        -------
        a_edges, b_edges : `~astropy.units.Quantity`, shapes (n_a + 1,) and (n_b + 1,)
            Edges of the cells; see `pdf`.
        weights : `~numpy.ndarray`, shape (n_a, n_b)
            Part of the draws in each; the draws without a value (parameters of an AGN that is
            not there) are in none.
        """
        x, x_edges = self._binned(a, key)
        y, y_edges = self._binned(b, key)
        # all draws have the same weight
        part = np.full(self.n_draws, 1.0 / self.n_draws)
        weights = np.histogram2d(x, y, (x_edges, y_edges), weights=part)[0]
        return x_edges * self.unit(a), y_edges * self.unit(b), weights

    def _binned(self, name, key):
        """Return the values in the draws of an object, and edges of the cells."""
        name = self._named(name)
        values = self.loc[key]._fitted_one().values(name).value
        if name in self.axes:
            axis = self.axes[name]
            if not self.on_nodes:
                # counted as a fit does, where what is absent has a cell of its own
                values = axis.values[axis.cell_of(values)]
            return values, cell_edges(axis.values, axis.bounds)
        check_that(np.isfinite(values).any(), "name", "one with values in the draws", repr(name))
        return values, bin_edges(values, log=self.extensive(name))

    def extensive(self, name):
        """Whether it is a derived quantity that scales with mass."""
        quantities = self._quantities
        return name in quantities.names and name not in quantities.intensive

    # ---------------------------------------------------------- fluxes and spectra

    def fluxes(self, filters=None):
        """
        Compute the model fluxes of every draw in uJy.

        Parameters
        ----------
        filters : list of str or `~miricigale.filters.FilterSet`, optional
            Any bands. Those of the grid (all of them by default) are known; for others
            the model is evaluated, every different model of the draws once.

        Returns
        -------
        fluxes : `~astropy.units.Quantity`, shape (n, n_draws, n_filters)
            In uJy; NaN for objects that could not be fitted.

        Raises
        ------
        ValueError
            If a band is not one of the grid and no model is known, or the model is another.
        """
        names, extra = grid_spectra.band_names(self.grid, filters)
        model = None
        if extra:
            model = self._model()
        rows = self._several()
        out = nans(rows.scale.shape + (len(names),))
        fitted = rows.fitted
        if self.on_nodes:
            out[fitted] = grid_spectra.draw_fluxes(
                self.grid, rows.index[fitted], rows.scale[fitted], names, extra, model
            )
        else:
            for i in np.flatnonzero(fitted):
                out[i] = fluxes_between_nodes(rows[int(i)], names, extra, model)
        return out.reshape(self.scale.shape + (len(names),)) * FNU

    def _model(self):
        check_that(self.model is not None, "model", "an SEDModel (these samples know none)", "None")
        grid_spectra.check_model(self.model, self.grid)
        return self.model

    def predict(self, filters=None, *, levels=LEVELS):
        """
        Tabulate the posterior of the fluxes in any bands.

        Parameters
        ----------
        filters : list of str or `~miricigale.filters.FilterSet`, optional
            See `fluxes`.
        levels : tuple of float, optional
            Levels of percentiles.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id``, ``flags`` and, for each filter, mean (by its name), standard deviation
            (``<name>_err``) and percentiles (``<name>_p16``, ...) in uJy.
        """
        levels = check_levels(levels)
        names, _ = grid_spectra.band_names(self.grid, filters)
        rows = self._several()
        columns = {
            "id": (np.array(rows.ids), "identifier"),
            "flags": (np.array(rows.flags), FitFlags.describe()),
        }
        for name, flux in zip(names, np.moveaxis(rows.fluxes(filters), -1, 0), strict=True):
            columns[name] = (flux.mean(axis=1), "posterior mean of the model flux")
            columns[error_column(name)] = (flux.std(axis=1), "its standard deviation")
            columns |= quantile_columns(flux.T, levels, "the model flux", f"{name}_")
        return described_table(columns, dict(self.meta))

    def spectra(self, key, *, rest=True):
        """
        Compute the spectra of the draws of one object; different galaxies and AGN models are evaluated once.

        Parameters
        ----------
        key : object
            Id of the object.
        rest : bool, optional
            Whether in the rest frame (L_nu as it leaves the galaxy, without absorption between
            the galaxies and in the Milky Way) or as observed (F_nu, with both).

        Returns
        -------
        wave : `~astropy.units.Quantity`, shape (n_wave,)
            Wavelengths in um; of the observed spectra those that all draws cover, in the steps
            of the median redshift. Spectra of other redshifts are means around these
            wavelengths: narrow lines may be wider there, and their light is conserved.
        spectra : `~astropy.units.Quantity`, shape (n_draws, n_wave)
            In W / Hz or uJy.
        """
        draws = self.loc[key]._fitted_one()
        function = grid_spectra.observed_spectra
        unit = FNU
        if rest:
            function = grid_spectra.rest_spectra
            unit = u.W / u.Hz
        models, index = models_of_draws(draws)
        wave, values = function(self._model(), models, index, draws.scale)
        return wave * WAVE, values * unit

    def sed_band(self, key, levels=LEVELS, *, rest=True):
        """
        Compute percentiles of the spectrum of one object.

        Parameters
        ----------
        key, rest : optional
            See `spectra`.
        levels : tuple of float, optional
            Levels of the percentiles, in (0, 1).

        Returns
        -------
        table : `~astropy.table.QTable`
            ``wave`` and a column for each level (``p16``, ``p50``, ``p84``), taken at every
            wavelength by itself: L_nu in W / Hz, or F_nu in uJy as observed.
        """
        levels = check_levels(levels)
        wave, values = self.spectra(key, rest=rest)
        frame = "observed"
        quantity = "F_nu"
        if rest:
            frame = "rest"
            quantity = "L_nu"
        columns = {"wave": (wave, f"{frame} wavelength")}
        columns |= quantile_columns(values, levels, quantity)
        return described_table(columns, dict(self.meta) | {"id": str(key), "rest": bool(rest)})

    def plot_sed_band(self, key, ax=None, *, levels=LEVELS, rest=True, **kwargs):
        """Draw `sed_band`; returns the axes."""
        from miricigale.plotting.posteriors import plot_sed_band

        table = self.sed_band(key, levels, rest=rest)
        bands = [table[name] for name in table.colnames[1:]]
        return plot_sed_band(table["wave"], bands, ax=ax, rest=rest, **kwargs)

    to_arviz = inference_data.of_samples
    sfh_band = histories.sfh_band
    plot_sfh = histories.plot_sfh_band

    def plot_pdf2d(self, key, a="redshift", b="frac_agn", ax=None, **kwargs):
        """Draw the joint distribution of two parameters of an object; returns the axes."""
        from miricigale.plotting.posteriors import plot_pdf_2d

        a_edges, b_edges, weights = self.pdf_2d(a, b, key)
        labels = (labeled(a, self.unit(a)), labeled(b, self.unit(b)))
        kwargs.setdefault("labels", labels)
        return plot_pdf_2d(a_edges.value, b_edges.value, weights, ax=ax, **kwargs)

    def plot_corner(self, key, names=None, *, truths=None, figure=None):
        """
        Draw the posteriors of several parameters of an object, each and in pairs.

        Parameters
        ----------
        key : object
            Id of the object.
        names : list of str, optional
            Parameters and derived quantities; by default those of redshift, stellar mass, star-formation rate,
            attenuation and AGN fraction that there are. Quantities that scale with mass are drawn as log10.
        truths : dict of str to float, optional
            Values to mark, by name.
        figure : `~matplotlib.figure.Figure`, optional
            Where to draw; a new one by default.

        Returns
        -------
        axes : `~miricigale.plotting.axes.AxesArray` of `~matplotlib.axes.Axes`, shape (n, n)
            Parameters on nodes and labels of libraries have the cells of the grid. Of others and of derived
            quantities the outermost 1 % of the draws are beyond the panels.
        """
        from miricigale.plotting.corner import plot_corner

        if names is None:
            names = [name for name in CORNER if name in self.parameters]
        names = [self._named(name) for name in names]
        check_names(names, "parameter", self.parameters)
        draws = self.loc[key]._fitted_one()
        panels = [draw_panel(draws, name) for name in names]
        marginals = [(panel.edges, panel.shares()) for panel in panels]
        joints = {}
        for row, later in enumerate(panels):
            for column, earlier in enumerate(panels[:row]):
                shares = earlier.joint_shares(later)
                joints[row, column] = earlier.joint_edges, later.joint_edges, shares
        values = marked_values(self, names, truths)
        labels = []
        for i, name in enumerate(names):
            label = labeled(name, self.unit(name))
            if panels[i].is_log:
                label = f"log {label}"
                if values[i] is not None:
                    values[i] = np.log10(values[i])
            labels.append(label)
        return plot_corner(labels, marginals, joints, truths=values, figure=figure)


FlagField.add_to(Samples, "flags", FitFlags)
