"""Templates of sources on the high-resolution image: points, profiles, or the image itself."""

import dataclasses

import numpy as np
import scipy.ndimage

from miricigale.photometry.cutouts import Cutout
from miricigale.photometry.flags import ForcedFlags
from miricigale.photometry.shapes import Shape, ShapeFitter, not_fitted
from miricigale.photometry.wings import adjust_wings
from miricigale.utils.parallel import parallel_map

#: Width (pixels) of the Gaussian that defines the core, its least signal-to-noise, how many standard
#: deviations of chi^2 a profile may miss it by, and the signal-to-noise that makes a neighbor.
_WIDTH, _CORE_SNR, _EXCESS, _OTHER_SNR = 1.5, 4.0, 3.0, 4.0

#: Error of a profile, as a fraction of the brightness: no galaxy is one to better than that.
_MISFIT = 0.1

#: Half-width (pixels) of the stamps that profiles are fitted on: beyond the segment, least and most.
_AROUND, _LEAST, _MOST = 6, 16, 160

#: Semi-major axis to which profiles are drawn: in half-light radii, and at most (pixels).
_DRAWN, _FARTHEST = 6.0, 200.0

#: Passes in which neighbors' light is taken off, chi^2 of that light from which a source is fitted
#: again, and sources that are painted at a time.
_PASSES, _CONTAMINATED, _AT_A_TIME = 4, 4.0, 512


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
    fitted : `~numpy.ndarray` of `~miricigale.photometry.shapes.FITTED`, shape (n,)
        The profiles, and how well they are known. Sources whose segment is too noisy have the shape that
        is expected beforehand.

    Notes
    -----
    With ``wings`` a point and a Sersic profile through the PSF are fitted to the pixels about
    each source, other sources' segments left out. A source is a point if that is the more probable
    (see `~miricigale.photometry.shapes.ShapeFitter`). It is the profile where that leaves
    nothing but noise on the core, which are the pixels whose smoothed signal-to-noise is
    above 4; otherwise the core is taken from the image, and everything beyond from the profile,
    scaled with radius to what is seen (see `~miricigale.photometry.wings.adjust_wings`). Sources
    whose pixels hold light of others' models are fitted again without that light.
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
    models, population = lights.fit([(label[k], xy[k]) for k in chosen])
    for k, model in zip(chosen, models, strict=True):
        if model is None:
            flags[k] = int(ForcedFlags.NOISY_SEGMENT)
        else:
            found[k], fitted[k] = model.cutout, model.record
    for k in np.flatnonzero(flags & int(ForcedFlags.NOISY_SEGMENT)):
        shape = lights.fitter.unfitted(xy[k], population.at(segments.brightness(label[k])))
        fitted[k] = shape.parameters, shape.covariance, shape.point, 1.0
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
        flat, n = labels.ravel(), len(places) + 1
        totals = np.bincount(flat, np.where(usable, data, 0.0).ravel(), n)
        noise = np.bincount(flat, np.where(usable, variance, 0.0).ravel(), n)
        # infinite for noiseless images, zero for segments without data
        ratio = np.where(totals > 0, np.inf, 0.0)
        np.divide(totals, np.sqrt(noise), out=ratio, where=noise > 0)
        totals[0] = ratio[0] = 0.0
        return cls(labels, usable, places, totals, ratio)

    def brightness(self, label):
        """Ln of the light of a label."""
        return np.log(max(self.totals[label], 1e-300))


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

    ``light`` is the profile's part of it, ``others`` that on the stamp that was taken off before.
    """

    around: tuple
    shape: Shape
    cutout: Cutout | None
    total: float = 1.0
    light: float = 1.0
    others: np.ndarray | float = 0.0

    @property
    def record(self):
        """What is kept of the fit."""
        corner = [self.around[1].start, self.around[0].start, 0, 0, 0, 0]
        return self.shape.parameters + corner, self.shape.covariance, self.shape.point, self.light


class _Lights:
    """All sources of one image, whose pixels may hold light of each other."""

    def __init__(self, data, variance, fitter, segments, select, executor):
        self.data, self.variance, self.fitter, self.segments = data, variance, fitter, segments
        self.select, self.executor = select, executor
        self.light, self.snr = _smooth(data, variance, executor)
        # what is no more than a peak of the noise hides nothing
        self.others = segments.ratio >= _OTHER_SNR

    def fit(self, sources):
        """The model of each (label, position); None where no light fits."""
        models = parallel_map(lambda one: self._model(*one), sources, executor=self.executor)
        population = self.fitter.expected
        for turn in range(_PASSES):
            sum_of_all = self._paint(models)
            if turn == 0:
                population = self._population(models, sources)

            def again(one, sum_of_all=sum_of_all, turn=turn, population=population):
                model, (label, xy) = one
                if model is None:
                    return None
                others = sum_of_all[model.around] - self._image(model)
                weight, _, _ = self._weight(model.around, label)
                if turn and np.sum(((others - model.others) * weight) ** 2) < _CONTAMINATED:
                    return model
                new = self._model(label, xy, others, model.shape, population)
                return model if new is None else dataclasses.replace(new, others=others)

            pairs = zip(models, sources, strict=True)
            models = parallel_map(again, pairs, executor=self.executor)
        return models, population

    def _population(self, models, sources):
        """The distribution of the shapes of all sources."""
        some = [(one.shape, label) for one, (label, _) in zip(models, sources, strict=True) if one]
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
        some = [model for model in models if model is not None]
        for first in range(0, len(some), _AT_A_TIME):
            part = some[first : first + _AT_A_TIME]
            stamps = parallel_map(self._image, part, executor=self.executor)
            for model, stamp in zip(part, stamps, strict=True):
                image[model.around] += stamp
        return image

    def _image(self, model):
        """The light of a model on its stamp."""
        size = tuple(s.stop - s.start for s in model.around)
        if model.cutout is None or model.cutout.rest is None:
            return model.shape.flux * self.fitter.profiles(size, model.shape.parameters)[0]
        corner = [s.start for s in model.around]
        profile, rest = model.cutout.layers
        origin = np.subtract(profile.origin, corner)
        image = self.fitter.convolve(profile.data[None], origin, size)[0]
        return model.total * (image + rest.data)

    def _weight(self, around, label):
        """Inverse noise of the pixels that are free of others, the same for a profile, and own pixels."""
        labels = self.segments.labels[around]
        free = self.segments.usable[around] & ((labels == label) | ~self.others[labels])
        variance = np.where(free, self.variance[around], 1.0)
        weight = np.where(free, 1.0 / np.sqrt(variance), 0.0)
        looser = weight / np.hypot(1.0, _MISFIT * np.maximum(self.light[around], 0.0) * weight)
        return weight, looser, free & (labels == label)

    def _model(self, label, xy, others=0.0, start=None, population=None):
        """Fit one source, ``others`` being the light of others on its stamp, ``start`` its last shape."""
        around = _around(self.segments.places[label - 1], xy, self.data.shape)
        weight, looser, own = self._weight(around, label)
        data = self.data[around] - others
        corner = np.array([around[1].start, around[0].start])
        prior = None if population is None else population.at(self.segments.brightness(label))
        shape = self.fitter.fit(data, looser, xy - corner, prior, start)
        if shape is None:
            return None
        if self.select and shape.point > 0.5:
            return _Model(around, shape, None)
        core = own & (self.snr[around] > _CORE_SNR)
        n = np.count_nonzero(core)
        if self.select:
            model = shape.flux * self.fitter.profiles(weight.shape, shape.parameters)[0]
            excess = np.sum(((data - model) * weight)[core] ** 2) - n
            if excess < _EXCESS * np.sqrt(2 * max(n, 1)):
                return _Model(around, shape, self._profile(shape, corner))
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
        rest = np.where(core, data - convolve(light[None])[0], 0.0)
        total = light.sum() + rest.sum() + outer * (shape.flux - profile.data.sum())
        if not total > 0:
            return None
        template = dataclasses.replace(
            profile,
            data=light / total,
            noise=float(self.variance[around][core].sum()) / total**2,
            rest=Cutout(rest / total, (around[0].start, around[1].start)),
        )
        return _Model(around, shape, template, float(total), shape.flux / total)

    def _profile(self, shape, corner, light=1.0):
        """A fitted profile on the fine grid, as far as the PSF reaches at least: steps at its edge show."""
        placed = dataclasses.replace(shape, parameters=shape.parameters + [*corner, 0, 0, 0, 0])
        reach = min(_DRAWN * shape.axes[0], _FARTHEST)
        return placed.drawn(light, max(self.fitter.reach, reach))


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
    """The image smoothed, and its signal-to-noise."""
    usable = np.isfinite(variance)

    def smooth(what):
        image, width = what
        return scipy.ndimage.gaussian_filter(np.where(usable, image, 0.0), width)

    images = [(variance, 4 * _WIDTH), (data, _WIDTH)]
    noise, light = parallel_map(smooth, images, executor=executor)
    noise = np.sqrt(noise)
    gain = 1.0 / (2.0 * np.sqrt(np.pi) * _WIDTH)
    return light, light / np.where(noise > 0, noise * gain, np.inf)
