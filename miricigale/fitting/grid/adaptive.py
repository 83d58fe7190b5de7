"""
Posteriors of single objects between the nodes of a grid, by adaptive importance sampling.

Places are drawn from a mixture of t distributions, weighed by the posterior over the mean of all mixtures so
far, and the next mixture is fitted to them (adaptive multiple importance sampling: Cornuet et al. 2012, Scand.
J. Stat. 39, 798). The first one is fitted to draws from the posterior on the nodes. Results rest on places
drawn afterwards, from parts that do not depend on them: recycled weights are biased (Marin, Pudlo & Sedki 2019,
Bernoulli 25, 2714), which takes from what has little weight. Points are quasi-random, and the same for all
objects: nothing depends on the id or place of an object in its catalog.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, ndtri
from scipy.stats import qmc

from miricigale.fitting import _core
from miricigale.fitting.grid.labels import labels_of_ranges
from miricigale.fitting.grid.moves import move_places, systematic
from miricigale.fitting.grid.proposals import LEAST_WEIGHT, Places, fit_mixture
from miricigale.utils.caching import cached

#: Places in a round, and most places for each of the effective number that is wanted, and at least.
ROUND_SIZE = 512
_LARGEST_ROUND = 1024
_MOST_EACH = 80
_LEAST_MOST = 1 << 14
#: Places fitted to at first: rounds, or effective number of them over that wanted in all; places after which it is
#: seen whether a mixture will do, which double each time; and how near it must be by then.
_ADAPTING_ROUNDS = 6
_PURSUING_ROUNDS = 16
_FIRST_GOAL = 0.3
_TRIED = 2048
_ALMOST = 1.5
_TRY_AGAIN = 2
#: Weight of peaks of redshift and of labels that are to have this part of the effective number themselves.
_COUNTS = 0.02
_PART_EACH = 0.05
_PART_LEAST = 30
#: Least number of places with weights that results rest on, and part of them in each label that has weight.
_LEAST_KEPT = 2048
_LEAST_PLACES = 0.03
#: Part of the draws to begin with from which a label in a peak is pursued, its share of the places until its shape
#: is found.
_PURSUED = 0.01
_PURSUED_SHARE = 0.06
#: Least number of places that parts are fitted to.
_FEWEST_PLACES = 20
#: Share of a mixture that all labels have, whatever their weight, and each peak and what has weight in it.
_GUARD = 0.05
#: Least efficiency, effective over number of places, of what has few of them.
_LEAST_RATE = 0.05
_LEAST_SHARE = 0.05
#: Weight of a node's redshift, over the largest, below which there is none between peaks; and of a peak that
#: counts.
_GAP = 2e-3
_PEAK = 0.005
#: Effective number of points that the weights of a peak are flattened to for a fit: in each round, and at most at
#: first, which doubles each time.
_FLAT_EACH = 50
_FLAT_MOST = 150
#: Narrow parts that are added to each label and peak where weights are large.
_N_LOCAL = 16
#: Number of places that are moved where weights stay too unequal, least number in each label and peak, and the
#: least weight of these.
_N_MOVED = 768
_FEWEST_MOVED = 48
_LEAST_MOVED = 1e-3
#: Weight of the models that are left out of results.
_LEFT_OUT = 1e-4
#: Uniform numbers keep this from 0 and 1.
_END = 1e-9


@dataclass(frozen=True, eq=False)
class PlacedModels:
    """
    Models between nodes with the weights of a posterior.

    Parameters
    ----------
    place : `~numpy.ndarray`, shape (n, n_axes)
        Places in the unit intervals of `~miricigale.fitting._core.Space`.
    weight : `~numpy.ndarray`, shape (n,)
        Weights; they sum to 1.
    scale, variance, power : `~numpy.ndarray`, shape (n,)
        Best scales and their variances, and AGN power for each solar mass formed.
    log_likelihood : `~numpy.ndarray`, shape (n,)
        Ln of the likelihoods, but for a constant.
    uniform : `~numpy.ndarray`, shape (n,)
        Quasi-random numbers for the scales' own errors.
    log_evidence : float
        Ln of the mean likelihood over the priors, but for the constant of the likelihoods.
    converged : bool
        Whether the effective number is what was asked for.
    """

    place: np.ndarray
    weight: np.ndarray
    scale: np.ndarray
    variance: np.ndarray
    power: np.ndarray
    log_likelihood: np.ndarray
    uniform: np.ndarray
    log_evidence: float
    converged: bool


@cached(maxsize=8)
def quasi_random(n_axes, log2_n, scramble):
    """
    Sobol points for all objects.

    Parameters
    ----------
    n_axes, log2_n : int
        Axes of the space, and base-2 logarithm of the number n of points.
    scramble : int
        Seed of the scrambling.

    Returns
    -------
    choice, uniform : `~numpy.ndarray`, shape (n,)
        Uniform numbers, which choose a part of a mixture and the error of a scale.
    normal : `~numpy.ndarray`, shape (n, n_axes)
        Standard normal numbers.
    spread : `~numpy.ndarray`, shape (n,)
        What makes normal numbers those of a t distribution.
    """
    points = qmc.Sobol(n_axes + 3, seed=scramble).random_base2(log2_n)
    points = np.clip(points, _END, 1.0 - _END)
    normal = np.ascontiguousarray(ndtri(points[:, 3:]))
    spread = np.sqrt(_core.FREEDOM / chdtri(_core.FREEDOM, points[:, 1]))
    return points[:, 0].copy(), points[:, 2].copy(), normal, spread


def redshift_peaks(redshift, posterior):
    """
    Peaks of a posterior on nodes of redshift that others separate which have next to no weight.

    Parameters
    ----------
    redshift, posterior : `~numpy.ndarray`, shape (nz,)
        Nodes and their weights, which sum to 1.

    Returns
    -------
    borders : `~numpy.ndarray`, shape (n_peaks - 1,)
        Redshifts between them.
    weights : `~numpy.ndarray`, shape (n_peaks,)
        Their weights.
    """
    high = posterior > _GAP * posterior.max()
    # a peak reaches to the next nodes
    high = np.convolve(high, [1, 1, 1], "same") > 0
    change = np.diff(high.astype(int), prepend=0, append=0)
    first = np.flatnonzero(change == 1)
    last = np.flatnonzero(change == -1) - 1
    borders = 0.5 * (redshift[last[:-1]] + redshift[first[1:]])
    weights = np.bincount(np.searchsorted(borders, redshift), posterior, minlength=first.size)
    return borders, weights


@dataclass(frozen=True, eq=False)
class WeightedPlaces:
    """
    Some of the places of a sampler with their weights, and what is wanted of them.

    Parameters
    ----------
    rows : slice
        Which places.
    weight : `~numpy.ndarray`, shape (n,)
        Weights, the largest of which is 1.
    log_mean : float
        Ln of the mean of the posterior over the density of the proposal.
    effective : float
        Effective number of the weights.
    enough : bool
        Whether it is, in all and in each label, peak and component that counts.
    wanted : `~numpy.ndarray`, shape (n_labels * n_peaks,)
        Numbers of places wanted in labels and peaks.
    """

    rows: slice
    weight: np.ndarray
    log_mean: float
    effective: float
    enough: bool
    wanted: np.ndarray


class AdaptiveSampler:
    """
    Sampling of the posterior of one object.

    Parameters
    ----------
    space, labels : `~miricigale.fitting._core.Space`, `~miricigale.fitting._core.Labels`
        What places are in.
    work : `~miricigale.fitting._core.interpolation.Work`
        Scratch of the models.
    one : `~miricigale.fitting._core.Object`
        The object.
    borders, peaks : `~numpy.ndarray`
        Redshifts between peaks, and weights of the peaks on the nodes; see `redshift_peaks`.
    wanted : int
        Effective number that is wanted.
    scramble : int
        Seed of the quasi-random points.
    pursue : bool
        Whether each label of the draws to begin with is followed until its shape is found, whatever weight it
        seems to have before that: where errors are small, the label in which a good model is found first would
        take all places from the others.
    """

    def __init__(
        self, space, labels, work, one, borders, peaks, *, wanted, scramble=1, pursue=False
    ):
        self.space = space
        self.labels = labels
        self.work = work
        self.one = one
        self.borders = borders
        self.peaks = peaks
        self.wanted = wanted
        self.members = labels_of_ranges(labels)
        self.pursue = pursue
        self.scramble = scramble
        n_axes = len(space.size)
        most = max(_MOST_EACH * wanted, _LEAST_MOST)
        self.n_rounds = _ADAPTING_ROUNDS
        if pursue:
            self.n_rounds = _PURSUING_ROUNDS
        # at least those that parts are fitted to, and a first try
        most = max(most, self.n_rounds * ROUND_SIZE + _TRIED)
        self.most = most
        self.points = quasi_random(n_axes, int(np.ceil(np.log2(most))), scramble)
        self.label = np.empty(most, np.int64)
        self.score = np.empty((most, n_axes))
        self.place = np.empty((most, n_axes))
        self.known = np.empty((most, 5))
        self.peak = np.zeros(most, np.int64)
        self.density = np.zeros(most)
        self.scratch = np.empty((n_axes + 2, _LARGEST_ROUND))
        self.n_fitted = _FLAT_MOST
        self.n = 0

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
        self.pursued = (share > _PURSUED * share.sum()) & self.pursue
        parts = self._fit(Places(label, score, peak, np.ones(len(label))))
        adapted = self._adapt(parts, share)
        if adapted is None:
            return None
        parts, share = adapted
        best = None
        size = _TRIED
        while self.most - self.n >= ROUND_SIZE:
            sample = self._collect(parts, share, size)
            if sample is None:
                return None
            if best is None or sample.enough or sample.effective > best.effective:
                best = sample
            if sample.enough:
                break
            # what is seen of the posterior by now is fitted by more parts
            size = 2 * size
            self.n_fitted = 2 * self.n_fitted
            parts = self._fit(self._places(self.n_fitted), n_local=_N_LOCAL)
            share = sample.wanted
        return self._models(best) if best.enough else self._moved(best)

    def _adapt(self, parts, share):
        """
        Add places that say where the posterior is, until they have an effective number.

        Returned are parts that are fitted to them, and shares of labels and peaks; None if no place is possible.
        """
        mixtures = []
        ends = []
        total = np.zeros((1, self.n_rounds * ROUND_SIZE))
        for turn in range(self.n_rounds):
            mixture = parts.shared(self._guarded(share))
            mixtures.append(mixture)
            new = self._add_round(mixture, ROUND_SIZE)
            for each in mixtures:
                self._add_density(each, new, total)
            if ends:
                self._add_density(mixture, np.concatenate(ends), total)
            ends.append(new)
            rows = slice(0, self.n)
            self.density[rows] = total[0, rows] / len(mixtures)
            sample = self._weigh(rows)
            if sample is None:
                return None
            few = min(_FLAT_MOST, _FLAT_EACH * len(mixtures))
            places = self._places(few)
            share = self._pursuing(sample.wanted)
            good = sample.effective >= _FIRST_GOAL * self.wanted or turn + 1 >= _ADAPTING_ROUNDS
            if good and not self.pursued.any():
                break
            parts = self._fit(places)
        return self._fit(places, n_local=_N_LOCAL), share

    def _collect(self, parts, share, tried):
        """
        Add places that the parts do not depend on: `WeightedPlaces`, or None if none is possible.

        They are added until there are enough. If ``tried`` of them show that it would take many more, this ends as
        long as twice their number may follow.
        """
        first = self.n
        total = np.zeros(self.n_groups)
        density = np.zeros((len(self.peaks), self.most))
        missing = share
        while self.most - self.n >= ROUND_SIZE:
            size = int(np.clip(missing.sum(), ROUND_SIZE, _LARGEST_ROUND)) & ~127
            size = min(size, self.most - self.n)
            guarded = parts.possible(self._guarded(missing))
            ends = self._add_round(parts.shared(guarded), size)
            self._add_density(parts.kernel, ends, density, parts.group % len(self.peaks))
            total += size * guarded
            rows = slice(first, self.n)
            each = total.reshape(-1, len(self.peaks))[self.label[rows]]
            self.density[rows] = np.sum(each.T * density[:, rows], axis=0) / total.sum()
            sample = self._weigh(rows)
            if sample is None:
                return None
            n = self.n - first
            sample = replace(sample, enough=sample.enough and n >= _LEAST_KEPT)
            many_more = self.wanted > _ALMOST * sample.effective
            may_follow = self.most - self.n > _TRY_AGAIN * n
            if sample.enough or (many_more and n >= tried and may_follow):
                break
            group = self._groups(self.label[rows], self.peak[rows])
            n_each = np.bincount(group, minlength=self.n_groups)
            missing = np.maximum(sample.wanted - n_each, 0.02 * sample.wanted)
        return sample

    @property
    def n_groups(self):
        """Number of labels in all peaks."""
        return len(self.labels.n_active) * len(self.peaks)

    def _groups(self, label, peak):
        """Index of labels and peaks."""
        return label * len(self.peaks) + peak

    def _places(self, few):
        """
        `Places` for a fit of parts.

        Weights of each peak are made flat enough to say what its shape is, or those of each label that has weight:
        to an effective number of ``few``.
        """
        rows = slice(0, self.n)
        log = self.known[rows, 0] - np.log(self.density[rows])
        weight = np.exp(np.maximum(log - log.max(), -700.0))
        group = self.peak[rows]
        chosen = range(len(self.peaks))
        if self.pursue:
            group = self._groups(self.label[rows], self.peak[rows])
            share = np.bincount(group, weight, minlength=self.n_groups)
            chosen = np.flatnonzero(self.pursued | (share > LEAST_WEIGHT * share.sum()))
        return Places(
            label=self.label[rows],
            score=self.score[rows],
            peak=self.peak[rows],
            flat=self._flatten(log, group, chosen, few),
            weight=weight,
            log_target=self.known[rows, 0],
        )

    def _fit(self, places, n_local=0):
        """`FittedParts` of places."""
        return fit_mixture(self.labels, len(self.peaks), places, n_local)

    def _pursuing(self, share):
        """Shares of places, of which labels whose shape is still to be found have a part whatever their weight."""
        least = _PURSUED_SHARE * share.sum()
        return np.where(self.pursued, np.maximum(share, least), share)

    def _weigh(self, rows):
        """`WeightedPlaces` of some places; None if none is possible."""
        log = self.known[rows, 0] - np.log(self.density[rows])
        top = log.max()
        if not top > 0.5 * _core.NEVER:
            return None
        weight = np.exp(np.maximum(log - top, -700.0))
        log_mean = top + np.log(weight.mean())
        return WeightedPlaces(rows, weight, log_mean, *self._wanted(weight, rows))

    def _add_round(self, mixture, size):
        """Draw places of a mixture and evaluate them; returned are their ends for `_core.add_density`."""
        new = slice(self.n, self.n + size)
        choice, _, normal, spread = self.points
        label = np.empty(size, np.int64)
        score = np.empty((size, self.score.shape[1]))
        _core.propose(self.labels, mixture, choice[new], normal[new], spread[new], label, score)
        # by redshift, so that models that lie near each other in memory are met together
        order = np.lexsort((score[:, 0], label))
        label = label[order]
        score = score[order]
        self.label[new] = label
        self.score[new] = score
        of_new = (label, score, self.place[new], self.known[new], self.work)
        _core.evaluate_places(self.space, self.labels, self.one, *of_new)
        if self.borders.size:
            self.peak[new] = np.searchsorted(self.borders, self._redshift(self.place[new, 0]))
        ends = self.n + np.searchsorted(label, np.arange(len(self.labels.n_active) + 1))[None]
        self.n += size
        return ends

    def _add_density(self, parts, ends, density, column=None):
        """Add densities of parts of a mixture at blocks of places to columns of others, or to one."""
        if column is None:
            column = np.zeros(len(parts.share), np.int64)
        places = (ends, self.score, self.scratch, density)
        _core.add_density(self.labels, parts, column, *places)

    def _redshift(self, place):
        """Redshifts of places in the unit interval."""
        return places_to_values(self.space, 0, place)[1]

    def _wanted(self, weight, rows):
        """
        Effective number of weights, whether it is enough, and places wanted in each label and peak.

        Most is had of a number of places if that of each label and peak is as its weight over the root of its
        efficiency (Neyman allocation). Labels, peaks, and components that count have enough of their own.
        """
        group = self._groups(self.label[rows], self.peak[rows])
        whole = weight.sum()

        def of_groups(values=None):
            return np.bincount(group, values, minlength=self.n_groups)

        own = of_groups(weight)
        square = of_groups(weight * weight)
        n = of_groups()
        effective = whole**2 / square.sum()
        enough = bool(effective >= self.wanted)
        each = np.square(own) / np.maximum(square, 1e-300)
        rate = np.clip(each / np.maximum(n, 1), _LEAST_RATE, 1.0)
        part = own / whole
        wanted = self.wanted * part / np.sqrt(rate) * np.sum(part / np.sqrt(rate))
        table = np.arange(n.size).reshape(-1, len(self.peaks))
        parts = [table[members].ravel() for members in self.members]
        least_each = max(_PART_EACH * self.wanted, _PART_LEAST)
        for members in (*table, *table.T, *parts):
            total = part[members].sum()
            if total <= _COUNTS:
                continue
            has = (total * whole) ** 2 / square[members].sum()
            enough = enough and bool(has >= least_each)
            least = least_each * part[members] / total / rate[members]
            wanted[members] = np.maximum(wanted[members], least)
        # what has little weight so far may have more
        some = part > LEAST_WEIGHT
        wanted[some] = np.maximum(wanted[some], _LEAST_PLACES * wanted.sum())
        return effective, enough, wanted

    def _guarded(self, share):
        """Shares of labels and peaks: each label has some, and each peak of the nodes, whatever its weight."""
        n_peaks = len(self.peaks)
        share = share.reshape(-1, n_peaks) / share.sum()
        of_peak = share.sum(axis=0)
        least = np.where(self.peaks > _PEAK, _LEAST_SHARE, 0.0)
        few = (of_peak > 0) & (of_peak < least)
        share = share * np.where(few, least / np.maximum(of_peak, 1e-300), 1.0)
        share = share / share.sum()
        even = share.sum(axis=0) / len(share)
        return ((1.0 - _GUARD) * share + _GUARD * even).ravel()

    def _flatten(self, log, group, chosen, few):
        """
        Weights for a fit, flat enough in each of some groups to say what its shape is.

        A label whose own weights need not be made flat is no longer pursued: its weight can be believed.
        """
        flat = np.zeros(self.n)
        for j in chosen:
            rows = np.flatnonzero(group == j)
            if rows.size < _FEWEST_PLACES:
                continue
            own = np.empty(rows.size)
            power, _ = _core.flatten(log[rows], min(float(few), 0.5 * rows.size), own)
            flat[rows] = own / own.sum()
            if self.pursue and power == 1.0 and min(few, 0.5 * rows.size) >= _FLAT_MOST:
                self.pursued[j] = False
        return flat

    def _models(self, sample):
        """`PlacedModels` of weighted places but those of least weight."""
        weight = sample.weight
        order = np.argsort(weight, kind="stable")
        upto = np.cumsum(weight[order])
        kept = np.sort(order[upto > _LEFT_OUT * upto[-1]])
        rows = sample.rows.start + kept
        return self._placed(
            self.place[rows],
            self.known[rows],
            weight[kept] / weight[kept].sum(),
            self.points[1][rows],
            sample,
            converged=sample.enough,
        )

    def _placed(self, place, known, weight, uniform, sample, *, converged):
        """`PlacedModels` of places, what is known of them and their weights; ``sample`` has the evidence."""
        _, scale, variance, power, log_likelihood = known.T
        return PlacedModels(
            place=place,
            weight=weight,
            scale=scale,
            variance=variance,
            power=power,
            log_likelihood=log_likelihood,
            uniform=uniform,
            log_evidence=sample.log_mean,
            converged=converged,
        )

    def _moved(self, sample):
        """
        `PlacedModels` of places that are moved to the posterior, where weights are too unequal for results.

        Labels and peaks keep the weights that the sample gives them; places begin from all that there are.
        """
        rows = sample.rows
        index = self._groups(self.label[rows], self.peak[rows])
        share = np.bincount(index, sample.weight, minlength=self.n_groups)
        share = share / share.sum()
        share[share < _LEAST_MOVED] = 0.0
        share = share / share.sum()
        every = self._groups(self.label[: self.n], self.peak[: self.n])
        log = self.known[: self.n, 0] - np.log(self.density[: self.n])
        picked = []
        weight = []
        for j in np.flatnonzero(share):
            own = np.flatnonzero(every == j)
            n = max(int(np.rint(share[j] * _N_MOVED)), _FEWEST_MOVED)
            flat = np.empty(own.size)
            _core.flatten(log[own], float(min(_FLAT_MOST, 0.5 * own.size)), flat)
            picked.append(own[systematic(flat, n)])
            weight.append(np.full(n, share[j] / n))
        picked = np.concatenate(picked)
        label = self.label[picked]
        score = self.score[picked]
        known = self.known[picked]
        place = self.place[picked]
        active = np.zeros(self.labels.first.shape, bool)
        for i, n in enumerate(self.labels.n_active):
            active[i, self.labels.axes[i, :n]] = True
        peaks = self.peak[picked]

        def evaluate(rows, new):
            place_new = np.empty(new.shape)
            known_new = np.empty((len(new), 5))
            of_new = (label[rows], new, place_new, known_new, self.work)
            _core.evaluate_places(self.space, self.labels, self.one, *of_new)
            if self.borders.size:
                # the weights are those of the peaks
                left = np.searchsorted(self.borders, self._redshift(place_new[:, 0]))
                known_new[left != peaks[rows], 0] = _core.NEVER
            return known_new, place_new

        move_places(evaluate, every[picked], active[label], score, known, place, self.scramble)
        uniform = self.points[1][: len(picked)]
        return self._placed(place, known, np.concatenate(weight), uniform, sample, converged=False)


def places_to_values(space, axis, place):
    """Cells, and values of an axis, of places in its unit interval: two arrays, shape (n,)."""
    n = space.size[axis]
    y = place * n
    cell = np.minimum(y.astype(np.int64), n - 1)
    low, high = space.low[axis, cell], space.high[axis, cell]
    return cell, low + (y - cell) * (high - low)
