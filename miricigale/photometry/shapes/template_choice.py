"""Templates of sources on the high-resolution image: points, profiles, or the image itself."""

import copy
import dataclasses
import itertools

import numpy as np
import scipy.ndimage
import scipy.optimize

from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.photometry.shapes.divided_galaxies import (
    claimed_groups,
    continued_groups,
    divided,
    joined_groups,
    padded,
    reaching_over,
)
from miricigale.photometry.shapes.shapes import POINT_SIZE, Beside, Shape, ShapeFitter, not_fitted
from miricigale.utils.parallel import chunks, parallel_map

#: Ratio of the radii of neighboring nodes, and how much the scale may change between two nodes
#: (standard deviation) where the image does not constrain it.
_RATIO, _CHANGE = 1.35, 0.3


def adjust_wings(stamp, radius, core, *, convolve, data, weight):
    """
    Scale a profile with radius until it is the light outside of the core.

    One Sersic profile does not describe a bulge and a disk; what it owes to the bright inner part
    must not decide how much light is far outside.

    Parameters
    ----------
    stamp, radius : `~numpy.ndarray`, shape (h, w)
        The profile before convolution, and the semi-major axis (pixels) of the ellipse through each pixel.
    core : float
        Semi-major axis up to which the profile stays as it is.
    convolve : callable
        Takes images of the stamp's shape, shape (n, h, w), to the pixels of ``data``.
    data, weight : `~numpy.ndarray`, shape (ny, nx)
        Light and the inverse of its error, zero for pixels that do not count.

    Returns
    -------
    scale, outer : `~numpy.ndarray`, shape (h, w), and float
        What the profile is to be multiplied with, never negative; the same beyond the stamp.

    Notes
    -----
    The scale is linear in ln(radius) between nodes and found by least squares, with a random walk as
    prior: it starts from 1 in the core and stays constant where the noise hides the light.
    """
    last = radius.max()
    n_nodes = max(int(np.ceil(np.log(max(last / core, 1.0)) / np.log(_RATIO))), 1)
    place = np.log(np.maximum(radius, 1e-3) / core) / np.log(_RATIO)
    # node 0 is the core's edge, where the scale is 1
    hats = [np.clip(1.0 - np.abs(place - k), 0.0, 1.0) for k in range(1, n_nodes + 1)]
    hats[-1] = np.clip(place - (n_nodes - 1), 0.0, 1.0)
    inner = np.clip(1.0 - place, 0.0, 1.0)
    use = weight > 0
    fixed, *free = (one[use] * weight[use] for one in convolve(stamp * np.array([inner, *hats])))
    walk = (np.eye(n_nodes) - np.eye(n_nodes, k=-1)) / _CHANGE
    begin = np.zeros(n_nodes)
    begin[0] = 1.0 / _CHANGE
    scale, _ = scipy.optimize.nnls(
        np.vstack([np.stack(free, axis=1), walk]),
        np.concatenate([data[use] * weight[use] - fixed, begin]),
    )
    return inner + np.tensordot(scale, hats, axes=1), float(scale[-1])


#: Width (pixels) of the Gaussian that defines the core, its least signal-to-noise, how many standard
#: deviations of chi^2 a profile may miss it by, and the signal-to-noise that makes a neighbor.
_WIDTH, _CORE_SNR, _EXCESS, _OTHER_SNR = 1.5, 4.0, 3.0, 4.0

#: Noise of the image smoothed with it over that of the pixels.
_GAIN = 1.0 / (2.0 * np.sqrt(np.pi) * _WIDTH)

#: Error of a profile, as a fraction of the brightness: no galaxy is one to better than that.
_MISFIT = 0.1

#: Half-width (pixels) of the stamps that profiles are fitted on: beyond the segment, least and most.
_AROUND, _LEAST, _MOST = 6, 16, 160

#: Semi-major axis to which profiles are drawn: in half-light radii, and at most (pixels).
_DRAWN, _FARTHEST = 6.0, 200.0

#: Passes in which neighbors' light is taken off, and chi^2 of that light from which a source is fitted
#: again.
_PASSES, _CONTAMINATED = 4, 4.0

#: Largest number of sources whose profiles are fitted together, and chi^2 of the light of one on
#: another's segment from which they are. Not those of a signal-to-noise of a hundred: what a
#: profile misses of a bright galaxy would be taken for light of its neighbors.
_TOGETHER, _LINKED, _BRIGHT = 5, 0.3, 100.0

#: Least number of sources by which the population is known well enough.
_LOOKED_AT = 500


def cutouts(
    data, variance, psf, scale, segmentation, label, xy, *, min_snr, wings=True, select=True,
    executor=None,
):  # fmt: skip
    """
    Make the template of each source from the high-resolution image.

    Parameters
    ----------
    data, variance : `~numpy.ndarray`, shape (ny, nx)
        Light per pixel (any unit), background subtracted, and its variance, infinite where not usable.
    psf : `~numpy.ndarray`, shape (k, k)
        Its PSF, odd and centered.
    scale : float
        Arcsec per pixel.
    segmentation : int `~numpy.ndarray`, shape (ny, nx)
        Labels.
    label : int `~numpy.ndarray`, shape (n,)
        Label of each source, 0 for none.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of the sources on the image.
    min_snr : float
        Least signal-to-noise of a segment.
    wings : bool, optional
        Whether light outside of the segment is added; otherwise a cutout is the
        segment as it is.
    select : bool, optional
        Whether points and Sersic profiles are used where they explain the image;
        otherwise the image itself always is.
    executor : `concurrent.futures.Executor`, optional
        Threads to work with.

    Returns
    -------
    cutout : list of `Cutout` or None
        None where a point source is to be used.
    flags : int `~numpy.ndarray`, shape (n,)
        ``NOISY_SEGMENT``, and ``NO_SEGMENT`` where the label is not on the image.
    snr : float `~numpy.ndarray`, shape (n,)
        Signal-to-noise of each segment; NaN without one.
    fitted : `~numpy.ndarray` of `~miricigale.photometry.shapes.shapes.FITTED`, shape (n,)
        The profiles, and how well they are known. Sources whose segment is too noisy have the shape that
        is expected beforehand.

    Notes
    -----
    With ``wings`` a point and a Sersic profile through the PSF are fitted to the pixels about
    each source, other sources' segments left out. A source is a point if that is the more probable
    (see `~miricigale.photometry.shapes.shapes.ShapeFitter`). It is the profile where that leaves
    nothing but noise on the core, which are the pixels whose smoothed signal-to-noise is
    above 4; otherwise the core is taken from the image, and everything beyond from the profile,
    scaled with radius to what is seen (see `~miricigale.photometry.shapes.template_choice.adjust_wings`). Sources
    whose pixels hold light of others' models are fitted again without that light; the profiles of up to five that
    overlap are fitted together, on the pixels of all of them.
    """
    segments = _Segments.of(data, variance, segmentation)
    flags, snr = np.zeros(len(label), int), np.full(len(label), np.nan)
    found, fitted, chosen = [None] * len(label), not_fitted(len(label)), []
    for k, one in enumerate(label):
        if not 0 < one < len(segments.ratio) or segments.places[one - 1] is None:
            flags[k] = int(ForcedFlags.NO_SEGMENT) if one > 0 else 0
            continue
        snr[k] = segments.ratio[one]
        if segments.totals[one] > 0 and snr[k] >= min_snr:
            chosen.append(k)
        else:
            flags[k] = int(ForcedFlags.NOISY_SEGMENT)
    if not wings:
        for k in chosen:
            found[k] = _bare(data, variance, segments, label[k])
        return found, flags, snr, fitted
    lights = _Lights(data, variance, ShapeFitter(psf, scale), segments, select, executor)
    sources = [(label[k], xy[k]) for k in chosen]
    models, population = lights.fit(sources)
    models, galaxies = lights.rejoined(models, sources, population)
    for galaxy in galaxies:
        for row, piece, record in zip(galaxy.rows, galaxy.pieces, galaxy.records(), strict=True):
            found[chosen[row]], fitted[chosen[row]] = piece, record
            flags[chosen[row]] |= int(ForcedFlags.SHREDDED)
    in_pieces = set(itertools.chain(*(galaxy.rows for galaxy in galaxies)))
    for row, (k, model) in enumerate(zip(chosen, models, strict=True)):
        if model is not None:
            found[k], fitted[k] = model.cutout, (*model.record, 0.0, 1.0)
        elif found[k] is None or row not in in_pieces:
            flags[k] |= int(ForcedFlags.NOISY_SEGMENT)
    lacking = int(ForcedFlags.NOISY_SEGMENT | ForcedFlags.SHREDDED)
    for k in np.flatnonzero(flags & lacking == int(ForcedFlags.NOISY_SEGMENT)):
        shape = lights.fitter.unfitted(xy[k], population.at(segments.brightness(label[k])))
        fitted[k] = shape.parameters, shape.covariance, shape.point, 1.0, 0.0, 1.0
    return found, flags, snr, fitted


@dataclasses.dataclass(frozen=True, eq=False)
class _Segments:
    """Where each label is (label 1 first), and its light and signal-to-noise (from label 0)."""

    labels: np.ndarray
    usable: np.ndarray
    places: list
    totals: np.ndarray
    ratio: np.ndarray

    @classmethod
    def of(cls, data, variance, labels):
        places = scipy.ndimage.find_objects(labels)
        usable = np.isfinite(variance)
        totals, noise = np.zeros((2, len(places) + 1))
        for rows in chunks(len(labels), 256):
            for sums, image in ((totals, data), (noise, variance)):
                sums += np.bincount(
                    labels[rows][usable[rows]], image[rows][usable[rows]], len(sums)
                )
        # infinite for noiseless images, zero for segments without data
        ratio = np.where(totals > 0, np.inf, 0.0)
        np.divide(totals, np.sqrt(noise), out=ratio, where=noise > 0)
        totals[0] = ratio[0] = 0.0
        return cls(labels, usable, places, totals, ratio)

    def brightness(self, label):
        """Ln of the light of a label."""
        return np.log(max(self.totals[label], 1e-300))

    def merged(self, groups):
        """The same with each group of labels as one segment, which has the first of them."""
        names = np.arange(len(self.totals))
        places, totals, ratio = list(self.places), self.totals.copy(), self.ratio.copy()
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = np.where(self.ratio > 0, (self.totals / self.ratio) ** 2, 0.0)
        for group in groups:
            leader = group[0]
            names[group] = leader
            places[leader - 1] = _hull([self.places[label - 1] for label in group])
            totals[leader] = self.totals[group].sum()
            noise = np.sqrt(variance[group].sum())
            ratio[leader] = totals[leader] / noise if noise > 0 else np.inf
        labels = names.astype(self.labels.dtype)[self.labels]
        return _Segments(labels, self.usable, places, totals, ratio)


def _bare(data, variance, segments, label):
    """The segment as it is."""
    place, total = segments.places[label - 1], segments.totals[label]
    member = (segments.labels[place] == label) & segments.usable[place]
    light = np.where(member, data[place], 0.0) / total
    noise = float(variance[place][member].sum()) / total**2
    return Cutout(light, (place[0].start, place[1].start), noise=noise)


@dataclasses.dataclass(frozen=True, eq=False)
class _Model:
    """
    A fitted source: its stamp, profile and template (None for a point) of some total light.

    ``image`` is its light on the stamp, ``light`` the profile's part of the template, ``others`` the light
    that was taken off the stamp before, ``labels`` those of the sources that it was fitted together with, and
    ``beside`` what is known of these.
    """

    around: tuple
    shape: Shape
    image: np.ndarray
    cutout: Cutout | None = None
    light: float = 1.0
    others: np.ndarray | float = 0.0
    labels: tuple = ()
    beside: Beside | None = None

    @property
    def record(self):
        """What is kept of the fit."""
        shape = self.shape.moved(_corner(self.around))
        return shape.parameters, shape.covariance, shape.point, self.light


@dataclasses.dataclass(frozen=True, eq=False)
class _Galaxy:
    """A galaxy whose light is divided among sources."""

    rows: list  # Numbers of its sources.
    pieces: list  # The `Cutout` of each, None without light; that of the largest has the template of the whole.
    shares: np.ndarray  # Their parts of the light.
    record: tuple | None  # What is known of the whole, None if templates are taken without error.
    number: int = 0

    def records(self):
        """What is known of each piece, as `~miricigale.photometry.shapes.shapes.FITTED`."""
        found = not_fitted(len(self.rows))
        for k, (piece, share) in enumerate(zip(self.pieces, self.shares, strict=True)):
            if piece is not None and self.record is not None:
                found[k] = (*self.record, self.number, share)
        return found


class _Lights:
    """All sources of one image, whose pixels may hold light of each other."""

    def __init__(self, data, variance, fitter, segments, select, executor):
        self.data, self.variance, self.fitter, self.segments = data, variance, fitter, segments
        self.select, self.executor = select, executor
        self.light, self.core = _smooth(data, variance, executor)
        # what is no more than a peak of the noise hides nothing
        self.others = segments.ratio >= _OTHER_SNR

    def fit(self, sources):
        """The model of each (label, position); None where no light fits."""
        # the population is that of some of the sources, of all parts of the list
        every = max(1, len(sources) // _LOOKED_AT)
        drafts = [(*one, k % every == 0) for k, one in enumerate(sources)]
        models = parallel_map(lambda one: self._draft(*one), drafts, executor=self.executor)
        population = self._population(models, sources)
        models = self._joined(models, sources, population)
        return self._refined(models, sources, population), population

    def _refined(self, models, sources, population, first=0):
        """Fit models again without the light of others; those that hold none of it in the first pass only."""
        for turn in range(first, _PASSES):
            sum_of_all = self._paint(models)

            def again(one, sum_of_all=sum_of_all, turn=turn):
                model, (label, xy) = one
                if model is None:
                    return None
                others = sum_of_all[model.around] - model.image
                if turn:
                    weight, _, _ = self._weight(model.around, label, model.labels)
                    if np.sum(((others - model.others) * weight) ** 2) < _CONTAMINATED:
                        return model
                return self._model(label, xy, others, population, model)

            models = parallel_map(again, zip(models, sources, strict=True), executor=self.executor)
        return models

    def rejoined(self, models, sources, population):
        """
        Fit galaxies that are divided into several segments as what they are, and divide their light.

        Parameters
        ----------
        models, sources, population
            As `fit` returns and takes them.

        Returns
        -------
        models : list
            Those of all sources that are whole; None for pieces.
        galaxies : list of `_Galaxy`
            Galaxies of several pieces, and sources whose profile reaches over those of others although it touches
            none of them.
        """
        labels = [label for label, _ in sources]
        before, groups, lights = list(models), [], self
        # what has no peak of its own first: its profile is no evidence against others
        for find in [*[continued_groups] * _PASSES, *[claimed_groups] * _PASSES]:
            found = find(models, sources, lights.segments, *lights.as_seen)
            if not found:
                continue
            groups = joined_groups(groups, found)
            new = set(itertools.chain(*found))
            lights = self._of_galaxies([[labels[k] for k in group] for group in groups])
            changed = [group for group in groups if not new.isdisjoint(group)]
            models, sources = lights._put_together(models, sources, population, changed)
        reaching = reaching_over(models, sources, lights.segments, *lights.as_seen)
        members = {group[0]: group for group in groups} | {
            k: [k] for k in reaching if k not in {group[0] for group in groups}
        }
        galaxies = []
        for leader, group in members.items():
            galaxy = None
            if models[leader] is not None:
                of_group = [labels[k] for k in group]
                galaxy = self._divided(models[leader], group, of_group, cut=leader in reaching)
            if galaxy is None:
                # as they were before
                for k in group:
                    models[k] = before[k]
            else:
                models[leader] = None
                galaxies.append(dataclasses.replace(galaxy, number=len(galaxies) + 1))
        return models, galaxies

    @property
    def as_seen(self):
        """Variance, labels of sources, and the smoothed image with its noise: as `continued_groups` takes them."""
        return self.variance, self.others, (self.light, _GAIN)

    def _of_galaxies(self, groups):
        """The same sources, groups of labels as one segment each."""
        lights = copy.copy(self)
        lights.segments = self.segments.merged(groups)
        lights.others = lights.segments.ratio >= _OTHER_SNR
        return lights

    def _put_together(self, models, sources, population, groups):
        """Models and sources with those of each group (row numbers) in its first row."""
        models, sources = list(models), list(sources)
        gone = {sources[k][0] for group in groups for k in group}
        for group in groups:
            leader = group[0]
            label = sources[leader][0]
            for k in group:
                models[k] = None
            place = self.segments.places[label - 1]
            inside = self.segments.labels[place] == label
            y, x = np.unravel_index(
                np.argmax(np.where(inside, self.light[place], -np.inf)), inside.shape
            )
            sources[leader] = label, np.array([x, y]) + _corner(place)
            models[leader] = self._draft(*sources[leader], nodes=False)
        for k, model in enumerate(models):
            if model is not None and not gone.isdisjoint(model.labels):
                # profiles of pieces were no good neighbors
                models[k] = dataclasses.replace(model, labels=(), beside=None)
        fresh = {group[0] for group in groups if models[group[0]] is not None}
        # overlapping profiles are fitted together, as all are
        near = [
            model if any(_overlap(model, models[k]) for k in fresh) else None for model in models
        ]
        for k, model in enumerate(self._joined(near, sources, population)):
            if model is not near[k]:
                models[k] = model
                fresh.add(k)
        sum_of_all = self._paint(models)
        for k in sorted(fresh):
            others = sum_of_all[models[k].around] - models[k].image
            models[k] = self._model(*sources[k], others, population, models[k])
        return self._refined(models, sources, population, first=1), sources

    def _divided(self, whole, rows, labels, *, cut):
        """
        The `_Galaxy` of a model of several segments, None if nothing is left of its light.

        ``rows`` and ``labels`` are those of the pieces. With ``cut`` it has no light on the segments of others.
        """
        template, place = whole.cutout, whole.around
        reach = int(self.fitter.reach)
        low, high = _corner(place)[::-1] - reach, [one.stop + reach for one in place]
        if template is not None:
            # as far as the profile is drawn
            low = np.minimum(low, template.origin)
            high = np.maximum(high, np.add(template.origin, template.data.shape))
        corner, shape = tuple(low.tolist()), tuple((high - low).tolist())
        if template is None:
            parameters = np.array(whole.shape.parameters)
            parameters[:2] += _corner(place) - low[::-1]
            parameters[2] = POINT_SIZE
            image = self.fitter.profiles(shape, parameters)[0]
        else:
            origin = np.subtract(template.origin, low)
            image = self.fitter.convolve(template.data[None], origin, shape)[0]
        image, core = np.array(image, float), np.zeros(shape, bool)
        if template is not None and template.rest is not None:
            rest = template.rest
            image += padded(rest.data, rest.origin, corner, shape, 0.0)
            core = padded(rest.data != 0, rest.origin, corner, shape, False)
        seen = padded(self.segments.labels, (0, 0), corner, shape, 0)
        total = whole.shape.flux / whole.light
        if cut:
            image[self.others[seen] & ~np.isin(seen, labels)] = 0.0
            within = image.sum()
            if not within > 0:
                return None
            image, total = image / within, total * within
        variance = padded(self.variance, (0, 0), corner, shape, np.inf) / total**2
        pieces, shares = divided(image, corner, seen, labels, core, variance)
        record = None if cut else whole.record
        if not cut:
            largest = int(np.argmax(shares))
            pieces[largest] = dataclasses.replace(pieces[largest], whole=template)
        return _Galaxy(rows, pieces, shares, record)

    def _joined(self, models, sources, population):
        """The models, profiles that hold light of each other fitted together."""
        rows = np.full(len(self.segments.ratio), -1)
        for k, (model, (label, _)) in enumerate(zip(models, sources, strict=True)):
            use = model is not None and self.segments.ratio[label] < _BRIGHT
            rows[label] = k if use else -1

        def links(k):
            model, (own, _) = models[k], sources[k]
            if rows[own] < 0:
                return []
            labels, variance = self.segments.labels[model.around], self.variance[model.around]
            power = np.bincount(labels.ravel(), (model.image**2 / variance).ravel())
            some = (one for one in np.flatnonzero(power > _LINKED) if one != own)
            return [(-power[one], k, rows[one]) for one in some if rows[one] >= 0]

        found = parallel_map(links, range(len(models)), executor=self.executor)
        groups = {k: [k] for k in range(len(models))}
        # the strongest first; from groups that would be too large light is taken off
        for _, one, other in sorted(itertools.chain(*found)):
            both, more = groups[one], groups[other]
            if both is not more and len(both) + len(more) <= _TOGETHER:
                both.extend(more)
                groups.update(dict.fromkeys(more, both))
        several = [group for k, group in groups.items() if len(group) > 1 and group[0] == k]
        sum_of_all = self._paint(models)

        def fit(group):
            members, around = [models[k] for k in group], _hull([models[k].around for k in group])
            data = self.data[around].astype(float) - sum_of_all[around]
            for one in members:
                data[_within(one.around, around)] += one.image
            labels = [sources[k][0] for k in group]
            _, weight, _ = self._weight(around, labels[0], labels)
            corner = _corner(around)
            shapes, beside = self.fitter.fit_together(
                data, weight, [sources[k][1] - corner for k in group],
                [population.at(self.segments.brightness(label)) for label in labels],
                [one.shape.moved(_corner(one.around) - corner) for one in members],
            )  # fmt: skip
            found = []
            for one, shape, others in zip(members, shapes, beside, strict=True):
                back = corner - _corner(one.around)
                others = others and others.moved(back)
                shape, image = shape.moved(back), self._image(one.around, shape.moved(back))
                found.append(_Model(one.around, shape, image, labels=labels, beside=others))
            return found

        models = list(models)
        fits = parallel_map(fit, several, executor=self.executor)
        for k, model in zip(itertools.chain(*several), itertools.chain(*fits), strict=True):
            models[k] = model
        return models

    def _population(self, models, sources):
        """The distribution of the shapes of all sources."""
        pairs = zip(models, sources, strict=True)
        some = [
            (one.shape, label) for one, (label, _) in pairs if one and one.shape.nodes is not None
        ]
        if not some:
            return self.fitter.expected
        shapes, labels = zip(*some, strict=True)
        nodes, points = (
            np.array([getattr(one, name) for one in shapes]) for name in ("nodes", "as_point")
        )
        brightness = np.array([self.segments.brightness(label) for label in labels])
        return self.fitter.expected.fitted(nodes, points, brightness)

    def _paint(self, models):
        """The light of all models."""
        image = np.zeros(self.data.shape, np.float32)
        for model in models:
            if model is not None:
                image[model.around] += model.image
        return image

    def _image(self, around, shape):
        """The light of a profile on a stamp."""
        size = tuple(s.stop - s.start for s in around)
        return np.float32(shape.flux) * self.fitter.profiles(size, shape.parameters)[0]

    def _weight(self, around, label, together=()):
        """Inverse noise of the pixels that are free of others, the same for a profile, and own pixels."""
        labels, usable = self.segments.labels[around], self.segments.usable[around]
        own = usable & (labels == label)
        free = own | usable & ~self.others[labels]
        for one in together:
            free |= usable & (labels == one)
        weight = 1.0 / np.sqrt(np.where(free, self.variance[around], np.inf), dtype=float)
        misfit = _MISFIT * np.maximum(self.light[around], 0.0) * weight
        looser = weight / np.sqrt(1.0 + misfit * misfit)
        return weight, looser, own

    def _draft(self, label, xy, nodes):
        """The profile of one source, whatever others there are; of no template yet."""
        around = _around(self.segments.places[label - 1], xy, self.data.shape)
        _, weight, _ = self._weight(around, label)
        data = self.data[around].astype(float)
        shape = self.fitter.fit(data, weight, xy - _corner(around), nodes=nodes)
        return None if shape is None else _Model(around, shape, self._image(around, shape))

    def _model(self, label, xy, others, population, last):
        """Fit one source again, ``others`` being the light of others on its stamp, ``last`` its last model."""
        around = last.around
        weight, looser, own = self._weight(around, label, last.labels)
        data, corner = self.data[around].astype(float) - others, _corner(around)
        prior = population.at(self.segments.brightness(label))
        shape = self.fitter.fit(data, looser, xy - corner, prior, last.shape, last.beside)
        if shape is None:
            # as it was before, and if there was no template yet, as its profile
            drawn = last.cutout is None and last.shape.point <= 0.5
            return self._as_profile(last) if drawn else last
        fitted = {"shape": shape, "image": self._image(around, shape), "others": others}
        new = dataclasses.replace(last, **fitted, cutout=None, light=1.0)
        if self.select and shape.point > 0.5:
            return new
        core = own & self.core[around]
        n = np.count_nonzero(core)
        if self.select:
            excess = np.sum(((data - new.image) * weight)[core] ** 2) - n
            if excess < _EXCESS * np.sqrt(2 * max(n, 1)):
                return self._as_profile(new)
        profile = self._profile(shape, corner, light=shape.flux)
        origin = np.subtract(profile.origin, corner[::-1])

        def convolve(images):
            return self.fitter.convolve(images, origin, weight.shape)

        scale, outer = adjust_wings(
            profile.data,
            shape.semi_major(profile.data.shape, origin),
            max(np.sqrt(n / (np.pi * shape.axes[1])), 2.0),
            convolve=convolve,
            data=data,
            weight=np.where(core, 0.0, looser),
        )
        light = profile.data * scale
        image = convolve(light[None])[0]
        rest = np.where(core, data - image, 0.0)
        total = light.sum() + rest.sum() + outer * (shape.flux - profile.data.sum())
        if not total > 0:
            return self._as_profile(new)
        template = dataclasses.replace(
            profile,
            data=light / total,
            noise=float(self.variance[around][core].sum()) / total**2,
            rest=Cutout(rest / total, (around[0].start, around[1].start)),
        )
        return dataclasses.replace(
            new, image=image + rest, cutout=template, light=shape.flux / total
        )

    def _as_profile(self, model):
        """The same with its profile as the template."""
        return dataclasses.replace(model, cutout=self._profile(model.shape, _corner(model.around)))

    def _profile(self, shape, corner, light=1.0):
        """A fitted profile on the fine grid, as far as the PSF reaches at least: steps at its edge show."""
        reach = min(_DRAWN * shape.axes[0], _FARTHEST)
        return shape.moved(corner).drawn(light, max(self.fitter.reach, reach))


def _corner(around):
    """X and y of the first pixel of a stamp."""
    return np.array([around[1].start, around[0].start])


def _hull(places):
    """The rectangle that holds others."""
    sides = zip(*places, strict=True)
    return tuple(slice(min(s.start for s in one), max(s.stop for s in one)) for one in sides)


def _overlap(model, other):
    """Whether the stamps of two models overlap; not if one is None."""
    if model is None or other is None:
        return False
    pairs = zip(model.around, other.around, strict=True)
    return all(one.start < two.stop and two.start < one.stop for one, two in pairs)


def _within(place, around):
    """Where a rectangle is in another."""
    pairs = zip(place, around, strict=True)
    return tuple(slice(s.start - a.start, s.stop - a.start) for s, a in pairs)


def _around(place, xy, shape):
    """The stamp of a source: as far as its segment goes to either side, and a rim."""
    x, y = round(float(xy[0])), round(float(xy[1]))
    reach = max(place[0].stop - y, y - place[0].start, place[1].stop - x, x - place[1].start)
    half = int(np.clip(reach + _AROUND, _LEAST, _MOST))
    return tuple(
        slice(min(max(c - half, 0), n - 1), max(min(c + half + 1, n), 1))
        for c, n in zip((y, x), shape, strict=True)
    )


def _smooth(data, variance, executor):
    """The image smoothed, and where its signal-to-noise is that of a core."""
    light, core = np.empty(data.shape, np.float32), np.empty(data.shape, bool)
    rim = round(16 * _WIDTH) + 1

    def smooth(rows):
        first = max(rows.start - rim, 0)
        part, own = slice(first, rows.stop + rim), slice(rows.start - first, rows.stop - first)
        usable = np.isfinite(variance[part])
        found, noise = (
            scipy.ndimage.gaussian_filter(np.where(usable, image[part], 0.0), width, output=float)[
                own
            ]
            for image, width in ((data, _WIDTH), (variance, 4 * _WIDTH))
        )
        light[rows] = found
        core[rows] = (noise > 0) & (found > _CORE_SNR * _GAIN * np.sqrt(noise))

    parallel_map(smooth, chunks(len(data), 256), executor=executor)
    return light, core
