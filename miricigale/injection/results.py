"""What injection returns: sources that were injected, and what was found of them."""

import dataclasses
import functools
import itertools

import numpy as np
from astropy.stats import binom_conf_interval, mad_std, poisson_conf_interval
from astropy.table import QTable

from miricigale.injection.completeness import CompletenessCurve
from miricigale.injection.trials import PLACES
from miricigale.utils.interactive import Interactive
from miricigale.utils.options import check_choice
from miricigale.utils.package_tables import column_texts
from miricigale.utils.units import FNU
from miricigale.utils.values import value_class

#: What tables may be binned by.
BINNED_BY = ("magnitude", "size", "place", "neighbors")

#: The two questions: the column of the sources that answers each.
QUESTIONS = {"detection": "detected", "forced": "recovered"}

#: Width of bins in magnitude, and classes of the size of galaxies.
_STEP = 0.5
_SIZES = 3

#: Light of other sources over the noise of a pixel above which a source is on another one.
_ON_SOURCE = 1.0

#: Signal-to-noise of the true flux above which sources tell a bias, as a fraction of the flux.
_BRIGHT = 5.0

#: Part of Gaussian values within one standard deviation.
_ONE_SIGMA = 68.27


@value_class
class InjectionResult(Interactive):
    """
    Completeness, purity, bias and error calibration of the photometry of a field.

    Attributes
    ----------
    sources : `~astropy.table.QTable`
        A row for each injected source: ``trial``, ``row`` (of an own catalog, from 0; -1), ``sky``, ``kind``
        (star or galaxy), ``x``, ``y`` (pixels), ``flux_true``, ``magnitude`` (true, AB), ``prior_flux_true``,
        shape, ``detected`` (by a detection on the image), ``flux_detected`` (of its segment), ``in_prior``
        (whether the prior shows it), ``flux``, ``flux_err``, ``flags`` and ``template`` of the forced
        photometry, ``recovered`` (signal-to-noise above the threshold), ``neighbor_light`` (light of other
        sources over the noise of a pixel) and ``place``.
    detections : `~astropy.table.QTable`
        Detections on the field itself and, where ``negative``, on its negative image: ``magnitude`` (of the
        segment), ``size`` (arcsec, rms along the major axis), ``place`` and ``neighbor_light``.
    photometry : `~astropy.table.QTable`
        The user's own photometry, without injected sources.
    empty_pulls : `~numpy.ndarray`
        Flux over error at empty positions of the field.
    meta : dict
        Settings and provenance; ``limit`` is five times the median error of the field's sources (AB).
    folder : `~pathlib.Path` or None
        The products, with the page ``index.html``.

    Notes
    -----
    *Detection* asks which sources the image itself shows; *forced* which are measured above the threshold at the
    positions of the prior. Numbers are by true magnitude and size but purity, which is by measured ones.
    """

    sources: QTable
    detections: QTable
    photometry: QTable
    empty_pulls: np.ndarray
    meta: dict = dataclasses.field(default_factory=dict)
    folder: object = None

    def __repr__(self):
        return f"<InjectionResult {len(self.sources)} sources>"

    def _facts(self):
        facts = {"injected sources": len(self.sources)}
        for question in QUESTIONS:
            curve = self.curve(question)
            if curve is not None and np.isfinite(curve.limit):
                facts[f"50 % limit, {question}"] = f"{curve.limit:.2f} AB"
        return facts

    def curve(self, question, *, kind=None):
        """
        Return the completeness as a function of magnitude.

        Parameters
        ----------
        question : {"detection", "forced"}
            Whether a source is detected on the image, or measured above the threshold at its position.
        kind : {"star", "galaxy"}, optional
            Which sources; all by default.

        Returns
        -------
        curve : `CompletenessCurve` or None
            Its ``limit`` is the magnitude of half completeness, NaN where the sources do not bracket it; None
            with too few sources.

        Raises
        ------
        ValueError
            If there is no such question or kind.
        """
        check_choice(question, "question", tuple(QUESTIONS))
        return self._curve(question, self._of_kind(kind))

    def _of_kind(self, kind):
        """Tell which sources are of a kind; all of None."""
        check_choice(kind, "kind", (None, "star", "galaxy"))
        if kind is None:
            return np.ones(len(self.sources), bool)
        return np.asarray(self.sources["kind"]) == kind

    def _curve(self, question, rows):
        if not rows.any():
            return None
        magnitude = np.asarray(self.sources["magnitude"])[rows]
        return CompletenessCurve.fit(magnitude, np.asarray(self.sources[QUESTIONS[question]])[rows])

    def recovery(self, by="magnitude", *, kind=None):
        """
        Return the completeness, bias and error calibration.

        Parameters
        ----------
        by : {"magnitude", "size", "place", "neighbors"}, optional
            By true magnitude, half-light radius, part of the image, or whether another source is at the
            position.
        kind : {"star", "galaxy"}, optional
            Which sources; all by default.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each bin, with ``n`` sources. ``detected`` and ``recovered``, each with ``_low`` and
            ``_high`` (68 % Wilson intervals), are shares of those in the bin; by anything but magnitude of
            those brighter than the limit of all (of all in the bin, where there is no limit), and
            ``limit_detection`` and ``limit_forced``, with ``_err``, are the magnitudes of half completeness in
            the bin. ``bias`` is the median of measured over true flux less 1 of sources above 5 sigma.
            ``pull_median``, ``pull_mad`` (1.4826 times the median absolute deviation) and ``pull_rms`` are those
            of (measured - true flux) / error, of ``n_measured`` sources, and ``factor`` that within which 68.27 %
            of them are.

        Raises
        ------
        ValueError
            If there is no such bin or kind.
        """
        check_choice(by, "by", BINNED_BY)
        chosen = self._of_kind(kind)
        limits = {}
        if by != "magnitude":
            for question in QUESTIONS:
                curve = self._curve(question, chosen)
                if curve is None:
                    limits[question] = np.nan
                else:
                    limits[question] = curve.limit
        rows = []
        for name, low, high, member in self._bins(by, chosen):
            rows.append(self._recovery_row(name, low, high, member, limits))
        return _described(rows, "recovery")

    def _bins(self, by, chosen):
        """Name, edges and members of each bin that has sources."""
        sources = self.sources
        if by == "magnitude":
            yield from _steps(np.asarray(sources["magnitude"]), chosen)
        elif by == "size":
            star = chosen & (np.asarray(sources["kind"]) == "star")
            if star.any():
                yield "stars", 0.0, 0.0, star
            radius = np.asarray(sources["half_light_radius"].value)
            yield from _classes(radius, chosen & ~star)
        elif by == "place":
            for name in PLACES:
                member = chosen & (np.asarray(sources["place"]) == name)
                if member.any():
                    yield name, np.nan, np.nan, member
        else:
            yield from _neighbors(np.asarray(sources["neighbor_light"]), chosen)

    def _recovery_row(self, name, low, high, member, limits):
        sources = self.sources
        row = {"name": name, "low": low, "high": high, "n": int(member.sum())}
        magnitude = np.asarray(sources["magnitude"])
        for question, column in QUESTIONS.items():
            counted = member
            if limits and np.isfinite(limits[question]):
                counted = member & (magnitude < limits[question])
            share, share_low, share_high = _share(np.asarray(sources[column])[counted])
            row[column] = share
            row[f"{column}_low"] = share_low
            row[f"{column}_high"] = share_high
        for question in QUESTIONS:
            curve = None
            if limits:
                curve = self._curve(question, member)
            row |= limit_columns(question, curve)
        return row | _errors(sources[member])

    def purity(self, by="magnitude"):
        """
        Estimate which share of the detections on the field is real, from its negative image.

        Parameters
        ----------
        by : {"magnitude", "size", "place", "neighbors"}, optional
            By measured magnitude, measured size (rms along the major axis), part of the image, or whether the
            model of the field has light at the position.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``name``, ``low``, ``high``, ``n_positive``, ``n_negative``, ``purity`` (1 - n_negative /
            n_positive, NaN without positive ones) with ``purity_low`` and ``purity_high``, by the Poisson error
            of ``n_negative``.

        Raises
        ------
        ValueError
            If there is no such bin.
        """
        check_choice(by, "by", BINNED_BY)
        table = self.detections
        everything = np.ones(len(table), bool)
        if by == "magnitude":
            bins = _steps(np.asarray(table["magnitude"]), np.isfinite(table["magnitude"]))
        elif by == "size":
            bins = _classes(np.asarray(table["size"].value), everything)
        elif by == "place":
            place = np.asarray(table["place"])
            bins = []
            for name in PLACES:
                if np.any(place == name):
                    bins.append((name, np.nan, np.nan, place == name))
        else:
            bins = _neighbors(np.asarray(table["neighbor_light"]), everything)
        rows = [self._purity_row(*group) for group in bins]
        return _described(rows, "purity")

    def _purity_row(self, name, low, high, member):
        negative = np.asarray(self.detections["negative"])[member]
        n_negative = int(np.count_nonzero(negative))
        n_positive = len(negative) - n_negative
        smallest, largest = poisson_conf_interval(n_negative, interval="frequentist-confidence")
        row = {"name": name, "low": low, "high": high}
        row |= {"n_positive": n_positive, "n_negative": n_negative}
        counts = {"purity": n_negative, "purity_low": largest, "purity_high": smallest}
        for column, n in counts.items():
            if n_positive:
                row[column] = 1.0 - n / n_positive
            else:
                row[column] = np.nan
        return row

    def errors(self):
        """
        Return the bias and error calibration of all injected sources.

        Returns
        -------
        numbers : dict of str to float
            ``bias``, ``bias_err``, ``n_measured``, ``pull_median``, ``pull_mad``, ``pull_rms`` and ``factor``,
            as of `recovery`.
        """
        return _errors(self.sources)

    def false_rate(self):
        """
        Share of empty positions whose flux is above the threshold: false sources of forced photometry.

        Returns
        -------
        rate : float
            NaN without empty positions.
        """
        pulls = self.empty_pulls[np.isfinite(self.empty_pulls)]
        if len(pulls):
            return float(np.mean(pulls > self.meta["threshold"]))
        return np.nan

    @functools.cached_property
    def summary(self):
        """The tables of `recovery` by each of its bins, as one: ``by`` says which."""
        from astropy.table import vstack

        tables = []
        for by in BINNED_BY:
            table = self.recovery(by)
            table.add_column(np.full(len(table), by, "U9"), name="by", index=0)
            tables.append(table)
        return vstack(tables, metadata_conflicts="silent")

    def to_table(self):
        """Return completeness, bias and error calibration by magnitude, size, place and neighbors: `summary`."""
        return self.summary.copy()


def _steps(values, chosen):
    """Yield the bins of equal steps in magnitude."""
    if not chosen.any():
        return
    number = np.floor(np.where(chosen, values, 0.0) / _STEP).astype(int)
    for k in np.unique(number[chosen]):
        low = k * _STEP
        high = (k + 1) * _STEP
        yield f"{low:.1f} - {high:.1f}", low, high, chosen & (number == k)


def _classes(values, chosen):
    """Yield the classes of a size (arcsec) that have about as many members each."""
    if not chosen.any():
        return
    edges = np.unique(np.quantile(values[chosen], np.linspace(0, 1, _SIZES + 1)))
    if len(edges) == 1:
        edges = np.append(edges, edges)
    for k, (low, high) in enumerate(itertools.pairwise(edges)):
        if k == len(edges) - 2:
            inside = values <= high
        else:
            inside = values < high
        member = chosen & (values >= low) & inside
        if member.any():
            yield f"{low:.2f} - {high:.2f} arcsec", low, high, member


def limit_columns(question, curve):
    """Return the 50 % limit of a curve and its error; NaN without a curve."""
    limit = np.nan
    limit_err = np.nan
    if curve is not None:
        limit = curve.limit
        limit_err = curve.limit_err
    return {f"limit_{question}": limit, f"limit_{question}_err": limit_err}


def measured_values(sources):
    """Return the true fluxes, fluxes and errors (uJy) of a table, as arrays."""
    return [np.asarray(sources[name].to_value(FNU)) for name in ("flux_true", "flux", "flux_err")]


def _neighbors(light, chosen):
    """On the free sky, and where another source has light."""
    on_source = light > _ON_SOURCE
    for name, member in (("free sky", ~on_source), ("on a source", on_source)):
        if (chosen & member).any():
            yield name, np.nan, np.nan, chosen & member


def _share(values):
    """Share of values that are True, and its 68 % interval."""
    if not len(values):
        return [np.nan] * 3
    k = int(np.count_nonzero(values))
    n = len(values)
    low, high = binom_conf_interval(k, n, interval="wilson")
    return [k / n, float(low), float(high)]


def _errors(sources):
    """Return the bias and calibration of errors of some sources."""
    true, flux, error = measured_values(sources)
    measured = np.isfinite(flux) & (error > 0)
    pull = (flux[measured] - true[measured]) / error[measured]
    bright = measured & (true > _BRIGHT * error)
    row = dict.fromkeys(("bias", "bias_err"), np.nan)
    if bright.sum() > 1:
        ratio = flux[bright] / true[bright] - 1.0
        row["bias"] = float(np.median(ratio))
        # of a median of Gaussian values
        row["bias_err"] = float(1.2533 * mad_std(ratio) / np.sqrt(len(ratio)))
    row["n_measured"] = len(pull)
    row |= dict.fromkeys(("pull_median", "pull_mad", "pull_rms", "factor"), np.nan)
    if len(pull) > 1:
        row["pull_median"] = float(np.median(pull))
        row["pull_mad"] = float(mad_std(pull))
        row["pull_rms"] = float(np.sqrt(np.mean(pull**2)))
        row["factor"] = float(np.percentile(np.abs(pull), _ONE_SIGMA))
    return row


def _described(rows, kind):
    """Return a table of rows (dicts), whose columns say what they are."""
    texts = column_texts("miricigale.injection", kind)
    counts = ("n", "n_measured", "n_positive", "n_negative")
    table = QTable()
    for name, text in texts.items():
        if name == "name":
            kind = str
        elif name in counts:
            kind = int
        else:
            kind = float
        table[name] = np.array([row[name] for row in rows], kind)
        table[name].info.description = text
    return table
