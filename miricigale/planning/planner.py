"""From exposures to accuracy: mock photometry of a sample, fitted and compared with its truth."""

import contextlib
import functools

import astropy.units as u
import numpy as np
from astropy.table import QTable, vstack

from miricigale.fitting import GridSettings
from miricigale.fitting.results.pulls import without_scatter_warnings
from miricigale.instrument import frame_time, frames_per_group
from miricigale.planning.accuracy import accuracy
from miricigale.planning.config import PlanConfig, check_plan
from miricigale.planning.exposures import band_plans, wall_clock
from miricigale.planning.sample import make_sample
from miricigale.utils.exceptions import config_error
from miricigale.utils.named_values import places, subset
from miricigale.utils.options import check_names, check_that
from miricigale.utils.progress import progress
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.values import value_class
from miricigale.workflow.stages.fits import existing_errors, study_fitter
from miricigale.workflow.stages.inputs import fit_plan
from miricigale.workflow.stages.sample import detected_bands

#: Name of the fit without MIRI.
EXISTING = "existing bands"
#: Sizes (arcsec) of sources for which errors are computed; each source takes the nearest.
_SIZES = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.2, 1.6])
#: Field of the imager.
_FIELD = 74 * 113 * u.arcsec**2
#: Part of the weight of its models that each fit may leave out: means change by 1e-6, and what is planned is
#: uncertain by far more.
_RTOL = 1e-4
#: Groups of the shortest exposure of a budget.
_LEAST = 3


@value_class
class Plan:
    """
    What one set of exposures yields; made by `Planner`.

    Parameters
    ----------
    name : str
        Name of the set of bands.
    bands : dict of str to `~miricigale.planning.BandPlan`
        The MIRI bands; empty for the existing ones alone.
    sources : `~astropy.table.QTable`
        A row for each source: ``id``, true ``redshift`` and ``frac_agn``, ``n_detected`` bands above 5
        sigma, posterior means and standard deviations (``redshift_mean``, ``redshift_std``,
        ``frac_agn_mean``, ``frac_agn_std``), ``agn_probability`` of a fracAGN above the limit,
        ``selected``, and for each MIRI band ``<band>_saturated`` and ``<band>_missing``, whether it has no
        flux there.
    time : `~astropy.units.Quantity`
        Time that the observatory charges for all pointings, h.
    area : `~astropy.units.Quantity`
        Of all pointings, square arcmin.

    Examples
    --------
    >>> from miricigale.planning import Planner, load_plan  # doctest: +SKIP
    >>> planner = Planner(load_plan(overrides={"sample": {"n_sources": 100}}))  # doctest: +SKIP
    >>> plan = planner.evaluate(["miri.f770w", "miri.f1500w"])  # doctest: +SKIP
    >>> plan.band_table()["filter", "time", "limit_used"]  # doctest: +SKIP
    """

    name: str
    bands: dict
    sources: QTable
    time: u.Quantity
    area: u.Quantity

    def __repr__(self):
        return f"<Plan {self.name}: {len(self.sources)} sources, {self.time:.1f}>"

    def band_table(self):
        """
        Return the exposures, band by band.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``filter``, ``time`` of all dithers, ``groups``, ``integrations``, ``dithers``,
            ``background``, ``sky_in_well`` (share), the 5-sigma limits ``limit_etc`` (calculator), ``limit``
            (`~miricigale.depth.sensitivity`) and ``limit_used`` (the errors that are drawn, points),
            ``saturates``, the magnitude at which a point does, ``n_saturated`` sources of the sample and
            ``n_missing`` of them without a flux.
        """
        rows = []
        for name, plan in self.bands.items():
            row = plan.numbers() | {
                "limit_used": plan.limit_used,
                "saturates": np.round(plan.saturation, 1),
            }
            for problem in ("saturated", "missing"):
                row[f"n_{problem}"] = int(np.count_nonzero(self.sources[f"{name}_{problem}"]))
            rows.append(row)
        return QTable(rows)


def _short_name(name):
    """Return the name of a set of bands without that of the instrument."""
    return name.replace("miri.", "").replace(" ", "")


class Planner:
    """
    What exposures would yield, from noise and fits, without images.

    Parameters
    ----------
    config : `~miricigale.planning.PlanConfig`, optional
        The plan; the exposures of CEERS by default.
    sources : `~astropy.table.QTable`, optional
        In place of the section ``sample``: a row for each source with ``id``, ``redshift``, ``frac_agn``
        and its fluxes in all bands (existing and MIRI), and if wanted ``size``. ``meta["density"]`` is
        their number per square arcmin.
    executor : `concurrent.futures.Executor`, optional
        Threads to fit with; the answer is the same.

    Raises
    ------
    ValueError
        If ``config`` is none, or ``sources`` lacks a column.

    Examples
    --------
    >>> from miricigale.planning import Planner, load_plan
    >>> config = load_plan(overrides={"sample": {"n_sources": 100}})
    >>> planner = Planner(config)  # doctest: +SKIP
    >>> for plan in planner.compare():  # doctest: +SKIP
    ...     print(plan.name, planner.accuracy(plan))
    """

    def __init__(self, config=None, *, sources=None, executor=None):
        if config is None:
            config = PlanConfig()
        check_plan(config)
        self.config = config
        self.executor = executor
        #: Sources of the caller, if there are any.
        self._caller_sources = sources
        if sources is not None:
            wanted = ("id", "redshift", "frac_agn") + self.bands
            require_columns(sources, wanted, "sources", units=dict.fromkeys(self.bands, u.uJy))

    def __repr__(self):
        bands = ", ".join(name.removeprefix("miri.") for name in self.config.exposures.bands)
        return f"<Planner {bands}: {len(self.config.exposures.sets)} sets of bands>"

    @property
    def bands(self):
        """Existing bands and those of MIRI."""
        return self.config.fit.bands + self.config.exposures.bands

    @functools.cached_property
    def sources(self):
        """The sample with its true fluxes, `~astropy.table.QTable`."""
        if self._caller_sources is not None:
            return self._caller_sources
        return make_sample(self.config, self.bands, executor=self.executor)

    @property
    def density(self):
        """Sources per square arcmin of which the sample is a part; NaN if not known."""
        return float(self.sources.meta.get("density", np.nan))

    @property
    def min_detected(self):
        """MIRI bands in which a source is detected to count, the same for every set: at most the smallest's."""
        config = self.config
        smallest = min(len(config.set_bands(name)) for name in config.exposures.sets)
        return max(1, min(config.fit.min_detected, smallest))

    def band_plans(self, share=1.0, bands=None):
        """The exposures of bands (all by default), each time multiplied by ``share``: dict of `BandPlan`."""
        return band_plans(self.config, share=share, bands=bands)

    def share(self, bands, pointings=None):
        """
        Return the factor on all exposure times with which a set of bands takes the hours of the configuration.

        Parameters
        ----------
        bands : iterable of str
            MIRI bands of the configuration.
        pointings : int, optional
            Pointings, each a visit; those of the configuration by default.

        Returns
        -------
        share : float
            The largest that the budget allows, to 0.1 %; 1 without a budget, or bands.

        Raises
        ------
        KeyError
            If the plan has no such band.
        `~miricigale.utils.exceptions.ConfigError`
            If the shortest exposures take longer.
        """
        exposures = self.config.exposures
        bands = tuple(bands)
        check_names(bands, "band of the plan", exposures.bands)
        if not exposures.hours or not bands:
            return 1.0
        if pointings is None:
            pointings = exposures.pointings

        def charged(share):
            plans = self.band_plans(share, bands)
            chosen = [plans[name] for name in bands]
            return wall_clock(chosen, self.config.overheads, pointings=pointings).to_value(u.h)

        # other bands may be too short to be split into dithers
        rows = places(bands, exposures.bands)
        times = np.array(exposures.by_band("time"))[rows]
        dithers = np.array(exposures.by_band("dithers"))[rows]
        group = frames_per_group(exposures.readout) * frame_time(exposures.readout).value
        low = float(np.max(_LEAST * group * dithers / times))
        shortest = charged(low)
        if shortest > exposures.hours:
            names = ", ".join(name.removeprefix("miri.") for name in bands)
            raise config_error(
                "[exposures] hours",
                f"must be at least {shortest:.2f} for {names}, got {exposures.hours:g}",
            )
        high = low * 2
        while charged(high) <= exposures.hours:
            low = high
            high = high * 2
        while high > 1.001 * low:
            middle = np.sqrt(low * high)
            if charged(middle) <= exposures.hours:
                low = middle
            else:
                high = middle
        return low

    @functools.cached_property
    def _existing(self):
        """Mock photometry in the existing bands, the same for every plan."""
        columns = self.sources[["id"] + list(self.config.fit.bands)]
        depths = dict(zip(self.config.fit.bands, self.config.fit.depths, strict=True))
        return existing_errors(depths).perturb(columns, seed=self.config.plan.seed)

    def photometry(self, plans, measured=None):
        """
        Return the mock photometry of the sample.

        Parameters
        ----------
        plans : iterable of `BandPlan`
            MIRI bands.
        measured : `~astropy.table.QTable`, optional
            Fluxes and errors in these bands, in the order of the sample, in place of mock ones.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id``, and flux and error in the existing bands and those of ``plans``. Draws depend on
            seed, source and band alone.
        """
        table = QTable(self._existing, copy=True)
        for plan in plans:
            photometry = measured
            if photometry is None:
                photometry = self._mock(plan)
            for column in (plan.filter, error_column(plan.filter)):
                table[column] = photometry[column]
        return table

    def _mock(self, plan):
        """
        Return the fluxes of one band with the errors of each source's size, in the order of the sample.

        Sources that saturate have the errors of the groups before, NaN where there is no slope.
        """
        columns = self.sources[["id", plan.filter]]
        seed = self.config.plan.seed
        good = self._good_groups(plan)
        node = np.zeros(len(columns), int)
        if self.config.noise.sizes:
            node = np.argmin(np.abs(self._size[:, None] - _SIZES), axis=1)
        # a power of two, so that few errors are computed
        rounded = 2 ** np.log2(np.maximum(good, 2)).astype(int)
        rounded[good == plan.exposure.n_groups] = plan.exposure.n_groups
        parts = []
        rows = []
        for k, n_groups in np.unique([node, rounded], axis=1).T:
            members = np.flatnonzero((node == k) & (rounded == n_groups))
            errors = plan.cut(n_groups).errors(_SIZES[k] * u.arcsec)
            parts.append(errors.perturb(columns[members], seed=seed))
            rows.append(members)
        joined = vstack(parts, metadata_conflicts="silent")
        joined = joined[np.argsort(np.concatenate(rows), kind="stable")]
        for column in (plan.filter, error_column(plan.filter)):
            joined[column][good < 2] = np.nan
        return joined

    @property
    def _size(self):
        """Widths of the sources in arcsec, 0 where they are not known."""
        if "size" in self.sources.colnames:
            return self.sources["size"].to_value(u.arcsec)
        return np.zeros(len(self.sources))

    def _good_groups(self, plan):
        """Return the groups before the sources of the sample saturate in a band."""
        return plan.good_groups(self.sources[plan.filter], self._size * u.arcsec)

    def evaluate(self, bands=None, *, name=None, share=1.0, pointings=None, measured=None):
        """
        Fit the sample as one set of bands would measure it.

        Parameters
        ----------
        bands : iterable of str, optional
            MIRI bands of the configuration; all by default, none for the existing bands alone.
        name : str, optional
            Name of the plan.
        share : float, optional
            Factor on all exposure times.
        pointings : int, optional
            Pointings side by side; those of the configuration by default.
        measured : `~astropy.table.QTable`, optional
            As for `photometry`.

        Returns
        -------
        plan : `Plan`
        """
        config = self.config
        if bands is None:
            bands = config.exposures.bands
        bands = tuple(bands)
        wanted = f"some of {list(config.exposures.bands)}"
        check_that(set(bands) <= set(config.exposures.bands), "bands", wanted, list(bands))
        planned = self.band_plans(share, bands)
        plans = subset(planned, bands)
        photometry = self.photometry(plans.values(), measured)
        all_bands = list(config.fit.bands) + list(bands)
        settings = GridSettings(interpolate=0, rtol=_RTOL)
        fitter = study_fitter(config.fit, all_bands, axes=fit_plan(config, name), settings=settings)
        # mock fluxes scatter by the errors that they were drawn with
        quiet = contextlib.nullcontext()
        if measured is None:
            quiet = without_scatter_warnings()
        with quiet:
            results = fitter.fit(photometry, executor=self.executor)
        table = self._results(results, photometry, plans)
        if pointings is None:
            pointings = config.exposures.pointings
        time = 0 * u.h
        area = (pointings * _FIELD).to(u.arcmin**2)
        if plans:
            time = wall_clock(plans.values(), config.overheads, pointings=pointings)
        name = name or ", ".join(b.removeprefix("miri.") for b in bands) or EXISTING
        return Plan(name, plans, table, time, area)

    def _results(self, results, photometry, plans):
        """Return the table of sources of a `Plan`."""
        agn = self.config.agn
        columns = ["id", "redshift", "frac_agn"]
        if "sky" in self.sources.colnames:
            columns.append("sky")
        table = self.sources[columns]
        table["n_detected"] = 0
        if plans:
            table["n_detected"] = detected_bands(photometry, list(plans))
        for name in ("redshift", "frac_agn"):
            table[f"{name}_mean"] = u.Quantity(results.mean(name)).value
            table[f"{name}_std"] = u.Quantity(results.std(name)).value
        nodes = np.asarray(u.Quantity(results.axes["frac_agn"].values).value)
        # the posterior's weight on the fractions of the grid from the limit on
        table["agn_probability"] = results.pdf["frac_agn"][:, nodes >= agn.limit - 1e-9].sum(axis=1)
        table["selected"] = table["agn_probability"] >= agn.threshold
        for name, plan in plans.items():
            table[f"{name}_saturated"] = self._good_groups(plan) < plan.exposure.n_groups
            table[f"{name}_missing"] = ~np.isfinite(photometry[name])
        return table

    def exposure_table(self):
        """
        Tabulate the exposures of each set of bands and their depths, before anything is fitted.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each band of each set: ``plan`` (the set), ``filter``, ``time`` of all dithers, ``dithers``,
            ``groups``, ``integrations`` and ``limit_used`` (5-sigma AB limit of points, of the errors that
            are drawn).
        """
        rows = []
        for name in self.config.exposures.sets:
            bands = self.config.set_bands(name)
            for plan in self.band_plans(self.share(bands), bands).values():
                numbers = plan.numbers()
                row = {"plan": _short_name(name)}
                for column in ("filter", "time", "dithers", "groups", "integrations"):
                    row[column] = numbers[column]
                row["limit_used"] = plan.limit_used
                rows.append(row)
        return QTable(rows)

    def compare(self, *, progress_bar=False):
        """
        Evaluate the existing bands alone and each set of bands of the configuration.

        Parameters
        ----------
        progress_bar : bool, optional
            Whether a progress bar is shown.

        Returns
        -------
        plans : list of `Plan`
            The existing bands first.
        """
        sets = self.config.exposures.sets
        # refused before the fits, which take minutes
        shares = [self.share(self.config.set_bands(name)) for name in sets]
        with progress(show=progress_bar, total=len(sets) + 1, desc="fits", unit="sets") as bar:
            plans = [self.evaluate((), name=EXISTING)]
            bar.update()
            for name, share in zip(sets, shares, strict=True):
                plan = self.evaluate(
                    self.config.set_bands(name), name=_short_name(name), share=share
                )
                plans.append(plan)
                bar.update()
        return plans

    def divide(self, bands=None):
        """
        Divide the exposure times among more pointings: depth against area.

        Parameters
        ----------
        bands : iterable of str, optional
            As in `evaluate`.

        Returns
        -------
        plans : list of `Plan`
            One for each number of ``[survey] areas``.
        """
        if bands is None:
            bands = self.config.exposures.bands
        plans = []
        for n in self.config.survey.areas:
            share = 1.0 / n
            if self.config.exposures.hours:
                share = self.share(bands, n)
            plans.append(self.evaluate(bands, name=str(n), share=share, pointings=n))
        return plans

    def common(self, plans):
        """Which sources one of the plans detects in `min_detected` bands: more bands never make them fewer."""
        detected = [np.asarray(plan.sources["n_detected"]) for plan in plans]
        return np.max(detected, axis=0) >= self.min_detected

    def accuracy(self, plan, chosen=None):
        """
        Return the numbers of one plan; see `~miricigale.planning.accuracy.accuracy`.

        Parameters
        ----------
        plan : `Plan`
            The plan.
        chosen : bool array-like, optional
            Sources that count; those of `common` by default.
        """
        if chosen is None:
            chosen = self.common([plan])
        sources = plan.sources[np.asarray(chosen, bool)]
        return accuracy(sources, agn_limit=self.config.agn.limit, seed=self.config.plan.seed)
