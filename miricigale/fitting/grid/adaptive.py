"""
Posteriors of single objects between the nodes of a grid, by adaptive importance sampling.

Places are drawn from a mixture of t distributions, weighed by the posterior over the mean of all mixtures so
far, and the next mixture is fitted to them (adaptive multiple importance sampling: Cornuet et al. 2012, Scand.
J. Stat. 39, 798). The first one is fitted to draws from the posterior on the nodes. Results rest on places
drawn afterwards, from parts that do not depend on them: recycled weights are biased (Marin, Pudlo & Sedki 2019,
Bernoulli 25, 2714), which takes from what has little weight. Where errors are small, the mixture is fitted to
places that follow a likelihood whose power rises (`~miricigale.fitting.grid.tempering`). Points are quasi-random,
and the same for all objects: nothing depends on the id or place of an object in its catalog.
"""

from dataclasses import replace

import numpy as np

from miricigale.fitting import _core
from miricigale.fitting.grid.labels import active_axes, labels_of_ranges
from miricigale.fitting.grid.place_sets import Collection, WeightedPlaces, fitted_peaks
from miricigale.fitting.grid.placed_models import PlacedModels, places_to_values, thinned
from miricigale.fitting.grid.points import quasi_random
from miricigale.fitting.grid.proposals import MIN_WEIGHT, Places, fit_mixture
from miricigale.fitting.grid.tempering import TemperedPlaces, n_tempered, prior_mixture, temper

#: Number of places in a round.
ROUND_SIZE = 512
#: Largest number of places in a round of those that results rest on.
_MAX_ROUND_SIZE = 2048
#: Largest number of places for each of the effective number that is wanted.
_MAX_PLACES_EACH = 80
#: Smallest value of the largest number of places of an object.
_MIN_MAX_PLACES = 1 << 14
#: Number of places that there is memory for to begin with; most objects need no more.
_SIZE_TO_BEGIN = 1 << 13
#: Largest number of rounds whose places mixtures are fitted to before results are collected.
_ADAPTING_ROUNDS = 6
#: Effective number, over that wanted in all, at which these rounds end.
_FIRST_GOAL = 0.3
#: Number of places after which a mixture is judged.
_N_TRIAL = 2048
#: Effective number wanted over that reached, up to which a judged mixture is kept.
_MAX_SHORTAGE = 1.5
#: A mixture is given up only if this many times the places of all so far may follow.
_TRIAL_GROWTH = 0.5
#: Effective number of a peak of redshift or a label that counts, as a part of that wanted in all.
_EFFECTIVE_PART = 0.05
#: Smallest such number.
_MIN_EFFECTIVE = 30
#: Smallest number of places with weights that results rest on.
_MIN_RESULT_PLACES = 2048
#: The same where errors are small, for each of the effective number that is wanted: mixtures are good at once, and
#: few places would be in the tails.
_MIN_NARROW_EACH = 10
#: Share of a mixture that is divided evenly among the labels, whatever their weight.
_GUARD = 0.05
#: Smallest share of each peak of the nodes.
_MIN_PEAK_SHARE = 0.05
#: Weight of a peak that counts.
_PEAK = 0.005
#: Effective number of points that the weights of a peak are flattened to for a fit, for each round so far.
_FLAT_EACH = 75
#: Largest such number at first; it doubles each time.
_MAX_FLAT = 150
#: Such a weight over the mean, below which it is 0.
_LEAST_FLAT = 0.003
#: Number of narrow parts that are added to each label and peak where weights are large.
_N_LOCAL = 16
#: Part of the effective number that is wanted, below which the power of the likelihood is raised instead.
_MIN_WEIGHED = 0.5
#: Number of places from each of the mixtures that this begins with, over that of the places it is done to.
_BROAD_EACH = 2
#: Distance of labels by which places are sorted, beyond all scores.
_APART = 1e6
#: Weight of the models that are left out of results.
_LEFT_OUT = 1e-4
#: Largest number of models that results are of.
_MAX_MODELS = 1536
#: The same where errors are small, and weights nearly equal: fewer would not show the tails.
_MAX_NARROW_MODELS = 6144
#: Part of the effective number that is wanted, of what all places that may follow would give at most, below which
#: no more are tried.
_HOPELESS = 0.5
#: Number of places after which that is judged.
_HOPELESS_TRIAL = 4096


class AdaptiveSampler:
    """
    Sampling of the posterior of one object.

    Parameters
    ----------
    space, labels : `~miricigale.fitting._core.Space`, `~miricigale.fitting._core.Labels`
        What places are in.
    work : `~miricigale.fitting._core.interpolation.Work`
        Scratch of the models.
    target : `~miricigale.fitting._core.Object`
        The object.
    borders, peaks : `~numpy.ndarray`
        Redshifts between peaks, and weights of the peaks on the nodes; see `redshift_peaks`.
    wanted : int
        Effective number that is wanted.
    scramble : int
        Seed of the quasi-random points.
    is_narrow : bool
        Whether errors are so small that the draws to begin with are of larger ones: places then come from a
        likelihood whose power rises (`~miricigale.fitting.grid.tempering`).
    """

    def __init__(
        self, space, labels, work, target, borders, peaks, *, wanted, scramble=1, is_narrow=False
    ):
        self.space = space
        self.labels = labels
        self.work = work
        self.target = target
        self.borders = borders
        self.peaks = peaks
        self.wanted = wanted
        table = np.arange(self.n_groups).reshape(-1, len(peaks))
        parts = [table[members].ravel() for members in labels_of_ranges(labels)]
        # each label, each peak, and each range of a component
        self.sets = _core.make_group_sets([*table, *table.T, *parts])
        self.is_narrow = is_narrow
        self.scramble = scramble
        n_axes = len(space.size)
        max_places = max(_MAX_PLACES_EACH * wanted, _MIN_MAX_PLACES)
        # at least those that parts are fitted to, and a first try
        max_places = max(max_places, _ADAPTING_ROUNDS * ROUND_SIZE + _N_TRIAL)
        self.max_places = max_places
        self.n_tempered = n_tempered(wanted)
        self.n_broad = _BROAD_EACH * -(-self.n_tempered // ROUND_SIZE) * ROUND_SIZE
        n_points = max_places + 2 * self.n_broad
        self.points = quasi_random(n_axes, int(np.ceil(np.log2(n_points))), scramble)
        size = _SIZE_TO_BEGIN
        self.label = np.empty(size, np.int64)
        self.score = np.empty((size, n_axes))
        self.place = np.empty((size, n_axes))
        self.evaluated = np.empty((size, 5))
        n_bands = work.flux.shape[1] - 2
        self.flux = np.empty((size, n_bands))
        self.peak = np.zeros(size, np.int64)
        self.group = np.empty(size, np.int64)
        self.density = np.zeros(size)
        self.scratch = np.empty((n_axes + 2, _MAX_ROUND_SIZE))
        self.n_fitted = _MAX_FLAT
        self.n = 0
        #: What results rest on.
        self.collection = None
        self._first_wanted = wanted
        self._min_places = _MIN_RESULT_PLACES
        self._max_models = _MAX_MODELS
        if is_narrow:
            self._min_places = max(_MIN_RESULT_PLACES, _MIN_NARROW_EACH * wanted)
            self._max_models = _MAX_NARROW_MODELS
        #: Mixture fitted to the draws to begin with.
        self._broad = None
        #: `PlacedModels` of places of a rising likelihood.
        self._tempered = None

    def run(self, label, score, peak):
        """
        Sample until the effective number is reached.

        Parameters
        ----------
        label, peak : `~numpy.ndarray` of int, shape (n,)
            Labels and peaks of draws to begin with.
        score : `~numpy.ndarray`, shape (n, n_axes)
            Their scores.

        Returns
        -------
        models : `PlacedModels` or None
            None if no place has a probability above 0.
        """
        share = np.bincount(self._groups(label, peak), minlength=self.n_groups)
        parts = self._fit(Places(label, score, peak, np.ones(len(label))))
        self._broad = parts.shared(self._guarded(share))
        if self.is_narrow:
            adapted = self._temper()
        else:
            adapted = self._adapt(parts, share)
        if adapted is None:
            return None
        self.collection = Collection(*adapted, self)
        return self._models_of(self._reach())

    def extend(self, factor):
        """
        Add places until a larger effective number is reached.

        Parameters
        ----------
        factor : float
            That number over the one wanted before.

        Returns
        -------
        models : `PlacedModels` or None
            Converged if they reach the number wanted at first, which places of large weight that are met now may
            undo; None if the number wanted before was not reached.
        """
        if not self.collection.is_enough:
            return None
        self.collection.is_enough = False
        self.wanted = int(factor * self.wanted)
        sample = self._reach()
        if sample is not None:
            sample = replace(sample, enough=sample.effective >= self._first_wanted)
        return self._models_of(sample)

    def _reach(self):
        """
        Add places until there are enough: `WeightedPlaces`; None if none is possible.

        What is known of the shape of the posterior is fitted by more parts if places show that it would take many
        more. A few large weights, which places from the new parts bring down, are reason enough.
        """
        collection = self.collection
        while self.max_places - self.n >= ROUND_SIZE:
            sample = self._collect(collection)
            if sample is None:
                return None
            if sample.enough:
                collection.is_enough = True
                break
            self.n_fitted *= 2
            parts = self._fit(self._places(self.n_fitted), n_local=_N_LOCAL)
            collection.begin(parts, self.n)
        return collection.sample

    def _models_of(self, sample):
        """Make `PlacedModels` of `WeightedPlaces` if they are enough, or of places of a rising likelihood."""
        if sample is not None and sample.effective >= _MIN_WEIGHED * self._first_wanted:
            return self._models(sample)
        if self._tempered is None:
            self._temper()
        return self._tempered

    def _adapt(self, parts, share):
        """
        Add places that say where the posterior is, until they have an effective number.

        Returned are parts that are fitted to them, and shares of labels and peaks; None if no place is possible.
        """
        mixtures = []
        ends = []
        total = np.zeros((1, _ADAPTING_ROUNDS * ROUND_SIZE))
        for turn in range(_ADAPTING_ROUNDS):
            mixture = parts.shared(self._guarded(share))
            mixtures.append(mixture)
            new = self._add_round(mixture, ROUND_SIZE)
            for earlier in mixtures:
                self._add_density(earlier, new, total)
            if ends:
                self._add_density(mixture, np.concatenate(ends), total)
            ends.append(new)
            rows = slice(0, self.n)
            self.density[rows] = total[0, rows] / len(mixtures)
            sample = self._weigh(rows)
            if sample is None:
                return None
            n_flat = min(_MAX_FLAT, _FLAT_EACH * len(mixtures))
            places = self._places(n_flat)
            share = sample.wanted
            if sample.effective >= _FIRST_GOAL * self.wanted:
                break
            if turn + 1 == _ADAPTING_ROUNDS:
                break
            parts = self._fit(places)
        return self._fit(places, n_local=_N_LOCAL), share

    def _collect(self, collection):
        """
        Add places that the parts do not depend on: `WeightedPlaces`, or None if none is possible.

        They are added until there are enough. If the first ones show that it would take many more, this ends as
        long as half the number of all so far may follow.
        """
        first = collection.first
        begin = self.n
        missing = collection.missing
        while self.max_places - self.n >= ROUND_SIZE:
            size = int(np.clip(missing.sum(), ROUND_SIZE, _MAX_ROUND_SIZE)) & ~127
            size = min(size, self.max_places - self.n)
            sample = self._add_to(collection, missing, size)
            if sample is None:
                return None
            rows = sample.rows
            n = self.n - first
            n_own = self.n - begin
            sample = replace(sample, enough=sample.enough and n >= self._min_places)
            n_each = np.bincount(self.group[rows], minlength=self.n_groups)
            missing = np.maximum(sample.wanted - n_each, 0.02 * sample.wanted)
            collection.missing = missing
            collection.sample = sample
            many_more = self.wanted > _MAX_SHORTAGE * sample.effective
            may_follow = self.max_places - self.n > _TRIAL_GROWTH * n
            if sample.enough or (many_more and n_own >= _N_TRIAL and may_follow):
                break
            effective_in_all = sample.effective * (self.max_places - first) / n
            is_hopeless = effective_in_all < _HOPELESS * self.wanted
            if n >= _HOPELESS_TRIAL and is_hopeless and not may_follow:
                break
        return collection.sample

    def _add_to(self, collection, missing, size):
        """Add places to a collection, most where most are missing: `WeightedPlaces`, None if none is possible."""
        parts = collection.parts
        guarded = parts.possible(self._guarded(missing))
        ends = self._add_round(parts.shared(guarded), size)
        collection.add(size * guarded, len(self.label))
        self._add_density(parts.kernel, ends, collection.density, collection.column)
        own = slice(collection.first_own, self.n)
        of_peaks = (self.label[own], collection.density, own.start)
        _core.mix_peaks(collection.shares, *of_peaks, self.density[own])
        weight = np.empty(own.stop - own.start)
        top, _ = _core.weigh_places(self.evaluated[own], self.density[own], weight)
        if not top > 0.5 * _core.NEVER:
            weight[:] = 0.0
        weight, log_unit = collection.weigh(weight, top, self.group[own])
        total = weight.sum()
        if not total > 0.0:
            return None
        rows = slice(collection.first, self.n)
        return WeightedPlaces(rows, weight, log_unit + np.log(total), *self._wanted(weight, rows))

    @property
    def n_groups(self):
        """Number of labels in all peaks."""
        return len(self.labels.n_active) * len(self.peaks)

    def _groups(self, label, peak):
        """Number the labels in peaks."""
        return label * len(self.peaks) + peak

    def _places(self, n_flat):
        """
        Select `Places` for a fit of parts.

        Weights of each peak are made flat enough to say what its shape is, to an effective number of ``n_flat``.
        """
        rows = slice(0, self.n)
        log = self.evaluated[rows, 0] - np.log(self.density[rows])
        weight = np.exp(np.maximum(log - log.max(), -700.0))
        peak = self.peak[rows]
        chosen = fitted_peaks(np.bincount(peak, minlength=len(self.peaks)))
        return Places(
            label=self.label[rows],
            score=self.score[rows],
            peak=peak,
            flat=self._flatten(log, peak, chosen, n_flat),
            weight=weight,
            log_target=self.evaluated[rows, 0],
        )

    def _fit(self, places, n_local=0):
        """Fit parts to places: `FittedParts`."""
        return fit_mixture(self.labels, len(self.peaks), places, n_local)

    def _weigh(self, rows):
        """Weigh places by the posterior over the density of the proposal; None if none is possible."""
        weight = np.empty(rows.stop - rows.start)
        top, mean = _core.weigh_places(self.evaluated[rows], self.density[rows], weight)
        if not top > 0.5 * _core.NEVER:
            return None
        effective, enough, wanted = self._wanted(weight, rows)
        return WeightedPlaces(rows, weight, top + np.log(mean), effective, enough, wanted)

    def _add_round(self, mixture, size):
        """Draw places of a mixture and evaluate them; returned are their ends for `_core.add_density`."""
        self._reserve(self.n + size)
        new = slice(self.n, self.n + size)
        choice, _, normal, spread = self.points
        label = np.empty(size, np.int64)
        score = np.empty((size, self.score.shape[1]))
        points = (choice[new], normal[new], spread[new])
        upto = np.cumsum(mixture.share)
        _core.propose(self.labels, mixture, upto, *points, label, score)
        # by redshift, so that models that lie near each other in memory are met together
        order = np.argsort(_APART * label + score[:, 0])
        label = label[order]
        score = score[order]
        self.label[new] = label
        self.score[new] = score
        self._evaluate(label, score, self.place[new], self.evaluated[new], self.flux[new])
        self.peak[new] = self._peaks_of(self.place[new])
        self.group[new] = self._groups(label, self.peak[new])
        ends = self.n + np.searchsorted(label, np.arange(len(self.labels.n_active) + 1))[None]
        self.n += size
        return ends

    def _evaluate(self, label, score, place, evaluated, flux):
        """Evaluate places; see `_core.evaluate_places`."""
        _core.evaluate_places(
            self.space, self.labels, self.target, label, score, place, evaluated, flux, self.work
        )

    def _reserve(self, n):
        """Make memory for n places."""
        size = len(self.label)
        if n <= size:
            return
        size = max(2 * size, n)
        for name in ("label", "score", "place", "evaluated", "flux", "peak", "group", "density"):
            values = getattr(self, name)
            larger = np.empty((size, *values.shape[1:]), values.dtype)
            larger[: self.n] = values[: self.n]
            setattr(self, name, larger)
        # without borders all are in one peak
        self.peak[self.n :] = 0

    def _add_density(self, parts, ends, density, column=None):
        """Add densities of parts of a mixture at blocks of places to columns of others, or to one."""
        if column is None:
            column = np.zeros(len(parts.share), np.int64)
        _core.add_density(self.labels, parts, column, ends, self.score, self.scratch, density)

    def _redshift(self, place):
        """Compute the redshifts of places in the unit interval."""
        _, redshift = places_to_values(self.space, 0, place)
        return redshift

    def _wanted(self, weight, rows):
        """
        Compute the effective number of weights, whether it is enough, and places wanted in each label and peak.

        Labels, peaks, and components that count have enough of their own.
        """
        group = self.group[rows]
        least_each = max(_EFFECTIVE_PART * self.wanted, _MIN_EFFECTIVE)
        limits = (float(self.wanted), float(least_each), MIN_WEIGHT)
        sums = np.empty((3, self.n_groups))
        wanted = np.empty(self.n_groups)
        effective, enough = _core.allocate_places(weight, group, self.sets, *limits, sums, wanted)
        return effective, bool(enough), wanted

    def _guarded(self, share):
        """Raise shares of labels and peaks, so that each label, and each peak of the nodes, has some."""
        n_peaks = len(self.peaks)
        share = share.reshape(-1, n_peaks) / share.sum()
        of_peak = share.sum(axis=0)
        min_share = np.where(self.peaks > _PEAK, _MIN_PEAK_SHARE, 0.0)
        is_short = (of_peak > 0) & (of_peak < min_share)
        share = share * np.where(is_short, min_share / np.maximum(of_peak, 1e-300), 1.0)
        share = share / share.sum()
        even_share = share.sum(axis=0) / len(share)
        return ((1.0 - _GUARD) * share + _GUARD * even_share).ravel()

    def _flatten(self, log, peak, chosen, n_flat):
        """Flatten weights for a fit, in each of some peaks enough to show its shape."""
        flat = np.zeros(self.n)
        for j in chosen:
            rows = np.flatnonzero(peak == j)
            flat_weight = np.empty(rows.size)
            _core.flatten(log[rows], min(float(n_flat), 0.5 * rows.size), flat_weight)
            # most places have next to no weight, and parts take as long to fit to them as to others
            flat_weight[flat_weight < _LEAST_FLAT * flat_weight.mean()] = 0.0
            flat[rows] = flat_weight / flat_weight.sum()
        return flat

    def _models(self, sample):
        """Make `PlacedModels` of weighted places, without those of least weight."""
        weight = sample.weight
        ascending = np.sort(weight)
        upto = np.cumsum(ascending)
        least = ascending[np.searchsorted(upto, _LEFT_OUT * upto[-1], "right")]
        indices = np.flatnonzero(weight >= least)
        rows = sample.rows.start + indices
        # neighbors in redshift, label by label
        indices = indices[np.lexsort((self.place[rows, 0], self.label[rows]))]
        rows = sample.rows.start + indices
        is_best = rows == rows[np.argmax(self.evaluated[rows, 4])]
        max_models = self._max_models * self.wanted // self._first_wanted
        indices, weight = thinned(indices, weight[indices], is_best, max_models)
        rows = sample.rows.start + indices
        return self._placed(
            self.place[rows],
            self.evaluated[rows],
            self.flux[rows],
            weight / weight.sum(),
            self.points[1][rows],
            sample.log_mean,
            converged=sample.enough,
        )

    def _placed(
        self, place, evaluated, flux, weight, uniform, log_evidence, *, converged, lineage=None
    ):
        """Make `PlacedModels` of evaluated places and their weights."""
        _, scale, variance, power, log_likelihood = evaluated.T
        return PlacedModels(
            place=place,
            weight=weight,
            scale=scale,
            variance=variance,
            power=power,
            flux=flux,
            log_likelihood=log_likelihood,
            uniform=uniform,
            log_evidence=log_evidence,
            converged=converged,
            lineage=lineage,
        )

    def _temper(self):
        """
        Raise the power of the likelihood from where places are spread.

        They begin from places of the prior and of the draws to begin with, half of each. Returned are parts that
        are fitted to where they end, and shares of labels and peaks; None if no place is possible.
        """
        broad, log_density = self._broad_places()
        if not np.any(broad.evaluated[:, 0] > 0.5 * _core.NEVER):
            return None
        n_bands = self.flux.shape[1]

        def evaluate(label, score):
            place = np.empty(score.shape)
            evaluated = np.empty((len(score), 5))
            self._evaluate(label, score, place, evaluated, np.empty((len(score), n_bands)))
            return evaluated, place

        rng = np.random.default_rng(self.scramble)
        active = active_axes(self.labels)
        number = self.n_tempered
        tempered, broader = temper(evaluate, broad, log_density, active, rng, number)
        # neighbors in redshift, label by label
        order = np.lexsort((tempered.place[:, 0], tempered.label))
        tempered = tempered.chosen(order, tempered.log_evidence)
        n = len(order)
        place = np.empty(tempered.place.shape)
        evaluated = np.empty((n, 5))
        flux = np.empty((n, n_bands))
        self._evaluate(tempered.label, tempered.score, place, evaluated, flux)
        self._tempered = self._placed(
            place,
            evaluated,
            flux,
            np.full(n, 1.0 / n),
            self.points[1][:n],
            tempered.log_evidence,
            converged=True,
            lineage=tempered.lineage,
        )
        peak = self._peaks_of(place)
        share = np.bincount(self._groups(tempered.label, peak), minlength=self.n_groups)
        # with broader ones, so that parts reach into the tails, where few places are
        places = Places(
            label=np.concatenate([tempered.label, broader.label]),
            score=np.concatenate([tempered.score, broader.score]),
            peak=np.concatenate([peak, self._peaks_of(broader.place)]),
            flat=np.ones(n + len(broader.label)),
            weight=np.concatenate([np.ones(n), np.zeros(len(broader.label))]),
            log_target=np.concatenate([evaluated[:, 0], broader.evaluated[:, 0]]),
        )
        return self._fit(places, n_local=_N_LOCAL), share

    def _peaks_of(self, place):
        """Find the peaks of redshift of places in the unit interval, (n,)."""
        if not self.borders.size:
            return np.zeros(len(place), np.int64)
        return np.searchsorted(self.borders, self._redshift(place[:, 0]))

    def _broad_places(self):
        """Draw places of the prior and of the draws to begin with: `TemperedPlaces`, and ln of their density."""
        first = self.n
        mixtures = (prior_mixture(self.labels), self._broad)
        ends = []
        for mixture in mixtures:
            for _ in range(self.n_broad // ROUND_SIZE):
                ends.append(self._add_round(mixture, ROUND_SIZE))
        ends = np.concatenate(ends) - first
        rows = slice(first, self.n)
        total = np.zeros((1, self.n - first))
        column = np.zeros(max(len(mixture.share) for mixture in mixtures), np.int64)
        for mixture in mixtures:
            _core.add_density(
                self.labels, mixture, column, ends, self.score[rows], self.scratch, total
            )
        self.density[rows] = total[0] / len(mixtures)
        with np.errstate(divide="ignore"):
            log_density = np.log(self.density[rows])
        places = TemperedPlaces(
            self.label[rows],
            self.score[rows],
            self.evaluated[rows],
            self.place[rows],
            np.arange(self.n - first),
            0.0,
        )
        return places, log_density
