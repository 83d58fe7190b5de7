"""Templates of sources on the high-resolution image: points, profiles, or the image itself."""

import copy
import dataclasses
import itertools

import numpy as np

from miricigale.photometry._core.source_fits import POINT_SIZE
from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.photometry.shapes.divided_galaxies import (
    claimed_groups,
    continued_groups,
    divided,
    joined_groups,
    linked_groups,
    padded,
    reaching_over,
)
from miricigale.photometry.shapes.rectangles import (
    hull,
    overlap,
    rectangle_corner,
    source_stamp,
    within,
)
from miricigale.photometry.shapes.shapes import ShapeFitter, not_fitted
from miricigale.photometry.shapes.smoothing import SMOOTHED_NOISE, smooth_image
from miricigale.photometry.shapes.source_models import (
    DividedGalaxy,
    Segments,
    SourceModel,
    segment_cutout,
)
from miricigale.photometry.shapes.wings import adjust_wings
from miricigale.utils.arrays import box_shape, nans, quiet_division
from miricigale.utils.parallel import parallel_map

#: Standard deviations of chi^2 by which a profile may miss the core.
_EXCESS = 3.0

#: Least signal-to-noise of a segment that is a source, and no peak of the noise.
_SOURCE_SNR = 4.0

#: Error of a profile, as a fraction of the brightness: no galaxy is one to better than that.
_MISFIT = 0.1

#: Semi-major axis to which profiles are drawn: in half-light radii, and at most (pixels).
_DRAWN_RADII = 6.0
_MAX_DRAWN = 200.0

#: Passes in which the light of neighbors is subtracted.
_PASSES = 4

#: Chi^2 of a change of the neighbors' light from which a source is fitted again.
_CONTAMINATED_CHI2 = 4.0

#: Largest number of sources whose profiles are fitted together, and chi^2 of the light of one on
#: another's segment from which they are.
_MAX_JOINT = 5
_LINKED_CHI2 = 0.3

#: Signal-to-noise from which sources are fitted alone: what a profile misses of a bright galaxy would be taken
#: for light of its neighbors.
_BRIGHT_SNR = 100.0

#: Least number of sources on which the population is measured, if there are as many.
_POPULATION_SIZE = 500


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
    scaled with radius to what is seen (see `~miricigale.photometry.shapes.wings.adjust_wings`). Sources
    whose pixels hold light of others' models are fitted again without that light; the profiles of up to five that
    overlap are fitted together, on the pixels of all of them.
    """
    # sources whose segment is bright enough to be looked at
    segments = Segments.of(data, variance, segmentation)
    flags = np.zeros(len(label), int)
    snr = nans(len(label))
    templates = [None] * len(label)
    fitted = not_fitted(len(label))
    chosen = []
    for k, number in enumerate(label):
        if number <= 0:
            continue
        if number >= len(segments.ratio) or segments.places[number - 1] is None:
            flags[k] = int(ForcedFlags.NO_SEGMENT)
            continue
        snr[k] = segments.ratio[number]
        if segments.totals[number] > 0 and snr[k] >= min_snr:
            chosen.append(k)
        else:
            flags[k] = int(ForcedFlags.NOISY_SEGMENT)
    if not wings:
        for k in chosen:
            templates[k] = segment_cutout(data, variance, segments, label[k])
        return templates, flags, snr, fitted
    # fits of all sources, and galaxies that the segmentation divides
    lights = _Lights(data, variance, ShapeFitter(psf, scale), segments, select, executor)
    sources = [(label[k], xy[k]) for k in chosen]
    models, population = lights.fit(sources)
    models, galaxies = lights.rejoined(models, sources, population)
    for galaxy in galaxies:
        for row, piece, record in zip(galaxy.rows, galaxy.pieces, galaxy.records(), strict=True):
            templates[chosen[row]] = piece
            fitted[chosen[row]] = record
            flags[chosen[row]] |= ForcedFlags.SHREDDED
    in_pieces = set(itertools.chain.from_iterable(galaxy.rows for galaxy in galaxies))
    final_templates = parallel_map(lights.template, models, executor=executor)
    for row, (k, model, template) in enumerate(zip(chosen, models, final_templates, strict=True)):
        if model is not None:
            templates[k] = template
            fitted[k] = (*model.record, 0.0, 1.0)
        elif templates[k] is None or row not in in_pieces:
            flags[k] |= ForcedFlags.NOISY_SEGMENT
    # sources without a fit have the shape that is expected of them
    lacking = int(ForcedFlags.NOISY_SEGMENT | ForcedFlags.SHREDDED)
    for k in np.flatnonzero(flags & lacking == int(ForcedFlags.NOISY_SEGMENT)):
        shape = lights.fitter.unfitted(xy[k], population.at(segments.brightness(label[k])))
        fitted[k] = shape.parameters, shape.covariance, shape.point, 1.0, 0.0, 1.0
    return templates, flags, snr, fitted


class _Lights:
    """All sources of one image, whose pixels may hold light of each other."""

    def __init__(self, data, variance, fitter, segments, select, executor):
        self.data = data
        self.variance = variance
        self.fitter = fitter
        self.segments = segments
        self.select = select
        self.executor = executor
        self.light, self.core = smooth_image(data, variance, executor)
        # what is no more than a peak of the noise hides nothing
        self.is_source = segments.ratio >= _SOURCE_SNR

    def fit(self, sources):
        """Fit the model of each (label, position); None where no light fits."""
        # the population is that of some of the sources, of all parts of the list
        step = max(1, len(sources) // _POPULATION_SIZE)

        def draft(k):
            label, xy = sources[k]
            return self._draft(label, xy, nodes=k % step == 0)

        models = parallel_map(draft, range(len(sources)), executor=self.executor)
        # the prior of each shape is that of all sources
        population = self._population(models, sources)
        models = self._joined(models, sources, population)
        return self._refined(models, sources, population), population

    def _refined(self, models, sources, population, first=0):
        """Fit models again without the light of others; those that hold none of it in the first pass only."""
        for turn in range(first, _PASSES):
            # light of sources that are not in the group is subtracted
            sum_of_all = self._paint(models)

            def refit(pair, sum_of_all=sum_of_all, turn=turn):
                model, (label, xy) = pair
                if model is None:
                    return None
                neighbor_light = sum_of_all[model.stamp] - model.image
                if turn and not self._is_contaminated(model, label, neighbor_light):
                    return model
                return self._model(label, xy, neighbor_light, population, model)

            models = parallel_map(refit, zip(models, sources, strict=True), executor=self.executor)
        return models

    def _is_contaminated(self, model, label, neighbor_light):
        """Return whether the light of neighbors is another than when a model was fitted, by its chi^2."""
        change = neighbor_light - model.neighbor_light
        with quiet_division():
            chi2 = change * change / self.variance[model.stamp]
        # an upper limit, on all pixels of the stamp, is enough for most
        if np.sum(chi2, dtype=float) < 0.99 * _CONTAMINATED_CHI2:
            return False
        _, is_free = self._own_and_free(model.stamp, label, model.labels)
        return np.sum(chi2[is_free], dtype=float) >= _CONTAMINATED_CHI2

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
        galaxies : list of `DividedGalaxy`
            Galaxies of several pieces, and sources whose profile reaches over those of others although it touches
            none of them.
        """
        labels = [label for label, _ in sources]
        before = list(models)
        groups = []
        lights = self
        # what has no peak of its own first: its profile is no evidence against others
        for find in (continued_groups, claimed_groups):
            for _ in range(_PASSES):
                new_groups = find(models, sources, lights.segments, *lights.as_seen)
                if not new_groups:
                    # models are the same in the next pass
                    break
                groups = joined_groups(groups, new_groups)
                new = set(itertools.chain.from_iterable(new_groups))
                lights = self._of_galaxies([[labels[k] for k in group] for group in groups])
                changed = [group for group in groups if not new.isdisjoint(group)]
                models, sources = lights._put_together(models, sources, population, changed)
        reaching = reaching_over(
            models, sources, lights.segments, lights.variance, lights.is_source
        )
        members = {group[0]: group for group in groups}
        for k in reaching:
            members.setdefault(k, [k])
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
        return self.variance, self.is_source, (self.light, SMOOTHED_NOISE)

    def _of_galaxies(self, groups):
        """Return a copy with groups of labels as one segment each."""
        lights = copy.copy(self)
        lights.segments = self.segments.merged(groups)
        lights.is_source = lights.segments.ratio >= _SOURCE_SNR
        return lights

    def _put_together(self, models, sources, population, groups):
        """Put models and sources of each group (row numbers) together in its first row."""
        models = list(models)
        sources = list(sources)
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
            sources[leader] = label, np.array([x, y]) + rectangle_corner(place)
            label, xy = sources[leader]
            models[leader] = self._draft(label, xy, nodes=False)
        for k, model in enumerate(models):
            if model is not None and not gone.isdisjoint(model.labels):
                # profiles of pieces were no good neighbors
                models[k] = dataclasses.replace(model, labels=(), neighbors=None)
        changed = {group[0] for group in groups if models[group[0]] is not None}
        # overlapping profiles are fitted together, as all are
        candidates = [None] * len(models)
        for k, model in enumerate(models):
            if model is not None and any(overlap(model.stamp, models[j].stamp) for j in changed):
                candidates[k] = model
        for k, model in enumerate(self._joined(candidates, sources, population)):
            if model is not candidates[k]:
                models[k] = model
                changed.add(k)
        sum_of_all = self._paint(models)
        for k in sorted(changed):
            neighbor_light = sum_of_all[models[k].stamp] - models[k].image
            label, xy = sources[k]
            models[k] = self._model(label, xy, neighbor_light, population, models[k])
        return self._refined(models, sources, population, first=1), sources

    def _divided(self, model, rows, labels, *, cut):
        """
        Divide the model of several segments (a `DividedGalaxy`), None if nothing is left of its light.

        ``rows`` and ``labels`` are those of the pieces. With ``cut`` it has no light on the segments of others.
        """
        # the rectangle that holds the light of the galaxy
        template = self.template(model)
        place = model.stamp
        reach = int(self.fitter.reach)
        low = rectangle_corner(place)[::-1] - reach
        high = np.array([place[0].stop, place[1].stop]) + reach
        if template is not None:
            # as far as the profile is drawn
            low = np.minimum(low, template.origin)
            high = np.maximum(high, np.add(template.origin, template.data.shape))
        corner = tuple(low.tolist())
        shape = tuple((high - low).tolist())
        if template is None:
            parameters = np.array(model.shape.parameters)
            parameters[:2] += rectangle_corner(place) - low[::-1]
            parameters[2] = POINT_SIZE
            image = self.fitter.profiles(shape, parameters)[0]
        else:
            origin = np.subtract(template.origin, low)
            image = self.fitter.convolve(template.data[None], origin, shape)[0]
        image = np.array(image, float)
        core = np.zeros(shape, bool)
        if template is not None and template.correction is not None:
            remainder = template.correction
            image += padded(remainder.data, remainder.origin, corner, shape, 0.0)
            core = padded(remainder.data != 0, remainder.origin, corner, shape, False)
        # which segment each of its pixels is in
        labels_around = padded(self.segments.labels, (0, 0), corner, shape, 0)
        total = model.shape.flux / model.light
        if cut:
            image[self.is_source[labels_around] & ~np.isin(labels_around, labels)] = 0.0
            within = image.sum()
            if not within > 0:
                return None
            image = image / within
            total = total * within
        variance = padded(self.variance, (0, 0), corner, shape, np.inf) / total**2
        pieces, shares = divided(image, corner, labels_around, labels, core, variance)
        record = None
        if not cut:
            record = model.record
            largest = int(np.argmax(shares))
            pieces[largest] = dataclasses.replace(pieces[largest], galaxy=template)
        return DividedGalaxy(rows, pieces, shares, record)

    def _joined(self, models, sources, population):
        """Fit profiles that hold light of each other together, and return all models."""
        # the row of each label, but for bright sources
        rows = np.full(len(self.segments.ratio), -1)
        for k, (model, (label, _)) in enumerate(zip(models, sources, strict=True)):
            if model is not None and self.segments.ratio[label] < _BRIGHT_SNR:
                rows[label] = k

        def links(k):
            return self._links(k, models[k], sources[k][0], rows)

        links_of_rows = parallel_map(links, range(len(models)), executor=self.executor)
        # from groups that would be too large light is taken off
        all_links = itertools.chain.from_iterable(links_of_rows)
        joint_groups = linked_groups(all_links, len(models), _MAX_JOINT)
        sum_of_all = self._paint(models)

        def fit(group):
            members = [models[k] for k in group]
            return self._fitted(members, [sources[k] for k in group], population, sum_of_all)

        models = list(models)
        fits = parallel_map(fit, joint_groups, executor=self.executor)
        for group, group_models in zip(joint_groups, fits, strict=True):
            for k, model in zip(group, group_models, strict=True):
                models[k] = model
        return models

    def _links(self, k, model, label, rows):
        """List links of a source, chi-square (negative) and both rows, to those on whose segments its light is."""
        if rows[label] < 0:
            return []
        labels = self.segments.labels[model.stamp]
        variance = self.variance[model.stamp]
        # chi^2 of the model's light on each segment
        power = np.bincount(labels.ravel(), (model.image**2 / variance).ravel())
        row_links = []
        for other_label in np.flatnonzero(power > _LINKED_CHI2):
            other_row = rows[other_label]
            if other_label != label and other_row >= 0:
                row_links.append((-power[other_label], k, other_row))
        return row_links

    def _fitted(self, members, sources, population, sum_of_all):
        """Fit the profiles of a group together to what all other models leave; return its models."""
        hull_of_group = hull([member.stamp for member in members])
        data = self.data[hull_of_group].astype(float) - sum_of_all[hull_of_group]
        for member in members:
            data[within(member.stamp, hull_of_group)] += member.image
        corner = rectangle_corner(hull_of_group)
        labels = []
        places = []
        populations = []
        starts = []
        for (label, xy), member in zip(sources, members, strict=True):
            labels.append(label)
            places.append(xy - corner)
            populations.append(population.at(self.segments.brightness(label)))
            starts.append(member.shape.moved(rectangle_corner(member.stamp) - corner))
        _, is_free = self._own_and_free(hull_of_group, labels[0], labels)
        weight = self._weight(hull_of_group, is_free)
        shapes, neighbors = self.fitter.fit_together(data, weight, places, populations, starts)
        fitted = []
        for member, shape, neighbor in zip(members, shapes, neighbors, strict=True):
            back = corner - rectangle_corner(member.stamp)
            shape = shape.moved(back)
            image = self._image(member.stamp, shape)
            neighbor = neighbor and neighbor.moved(back)
            fitted.append(
                SourceModel(member.stamp, shape, image, labels=labels, neighbors=neighbor)
            )
        return fitted

    def _population(self, models, sources):
        """Measure the distribution of the shapes of all sources."""
        nodes = []
        points = []
        brightness = []
        for model, (label, _) in zip(models, sources, strict=True):
            if model is not None and model.shape.nodes is not None:
                nodes.append(model.shape.nodes)
                points.append(model.shape.as_point)
                brightness.append(self.segments.brightness(label))
        if not nodes:
            return self.fitter.expected
        return self.fitter.expected.fitted(np.array(nodes), np.array(points), np.array(brightness))

    def _paint(self, models):
        """Draw the light of all models."""
        image = np.zeros(self.data.shape, np.float32)
        for model in models:
            if model is not None:
                image[model.stamp] += model.image
        return image

    def _image(self, stamp, shape):
        """Draw the light of a profile on a stamp."""
        profile = self.fitter.profiles(box_shape(stamp), shape.parameters)[0]
        return np.float32(shape.flux) * profile

    def _own_and_free(self, stamp, label, together=()):
        """Return which pixels are a source's own, and which are free of others; those fitted together are none."""
        labels = self.segments.labels[stamp]
        usable = self.segments.usable[stamp]
        is_own = usable & (labels == label)
        is_free = is_own | usable & ~self.is_source[labels]
        for other_label in together:
            is_free |= usable & (labels == other_label)
        return is_own, is_free

    def _weight(self, stamp, is_free):
        """Return the inverse noise of free pixels for a profile, zero on others."""
        # no profile is right to better than a part of the brightness
        misfit = np.maximum(_MISFIT * self.light[stamp], 0.0, dtype=float)
        variance = self.variance[stamp] + misfit * misfit
        return 1.0 / np.sqrt(np.where(is_free, variance, np.inf))

    def _draft(self, label, xy, nodes):
        """Fit the profile of one source, whatever others there are; there is no template yet."""
        stamp = source_stamp(self.segments.places[label - 1], xy, self.data.shape)
        _, is_free = self._own_and_free(stamp, label)
        weight = self._weight(stamp, is_free)
        data = self.data[stamp].astype(float)
        shape = self.fitter.fit(data, weight, xy - rectangle_corner(stamp), nodes=nodes)
        if shape is None:
            return None
        return SourceModel(stamp, shape, self._image(stamp, shape))

    def _model(self, label, xy, neighbor_light, population, last):
        """Fit one source again, ``others`` being the light of others on its stamp, ``last`` its last model."""
        stamp = last.stamp
        # the profile, without the light of neighbors
        is_own, is_free = self._own_and_free(stamp, label, last.labels)
        weight = self._weight(stamp, is_free)
        data = self.data[stamp].astype(float) - neighbor_light
        corner = rectangle_corner(stamp)
        prior = population.at(self.segments.brightness(label))
        shape = self.fitter.fit(data, weight, xy - corner, prior, last.shape, last.neighbors)
        if shape is None:
            # as it was before, and if there was no template yet, as its profile
            has_template = last.is_profile or last.cutout is not None
            if not has_template and last.shape.point <= 0.5:
                return dataclasses.replace(last, is_profile=True)
            return last
        fitted = {
            "shape": shape,
            "image": self._image(stamp, shape),
            "neighbor_light": neighbor_light,
        }
        new = dataclasses.replace(last, **fitted, cutout=None, is_profile=False, light=1.0)
        if self.select and shape.point > 0.5:
            return new
        # is the profile as good as the image in the core?
        core = is_own & self.core[stamp]
        if self.select:
            n = np.count_nonzero(core)
            # chi^2 of the profile on the core beyond that of noise
            residual = (data - new.image)[core]
            excess = np.sum(residual**2 / self.variance[stamp][core]) - n
            if excess < _EXCESS * np.sqrt(2 * max(n, 1)):
                return dataclasses.replace(new, is_profile=True)
        return self._with_image(new, data, weight, core)

    def _with_image(self, new, data, weight, core):
        """Return a model whose template is the image in the core, beyond it the profile as far as it is seen."""
        stamp = new.stamp
        shape = new.shape
        corner = rectangle_corner(stamp)
        profile = self._profile(shape, corner, light=shape.flux)
        origin = np.subtract(profile.origin, corner[::-1])

        def convolve(images):
            return self.fitter.convolve(images, origin, data.shape)

        scale, outer, image = adjust_wings(
            profile.data,
            shape.semi_major(profile.data.shape, origin),
            max(np.sqrt(np.count_nonzero(core) / (np.pi * shape.axes[1])), 2.0),
            convolve=convolve,
            data=data,
            weight=np.where(core, 0.0, weight),
        )
        light = profile.data * scale
        remainder = np.where(core, data - image, 0.0)
        # light of the profile, of the core's difference from it, and beyond the stamp
        total = light.sum() + remainder.sum() + outer * (shape.flux - profile.data.sum())
        if not total > 0:
            return dataclasses.replace(new, is_profile=True)
        template = dataclasses.replace(
            profile,
            data=light / total,
            noise=float(self.variance[stamp][core].sum()) / total**2,
            correction=Cutout(remainder / total, (stamp[0].start, stamp[1].start)),
        )
        return dataclasses.replace(
            new, image=image + remainder, cutout=template, light=shape.flux / total
        )

    def template(self, model):
        """Return the template (a `Cutout`) of a model, None for a point and without a model."""
        if model is None:
            return None
        if model.is_profile:
            return self._profile(model.shape, rectangle_corner(model.stamp))
        return model.cutout

    def _profile(self, shape, corner, light=1.0):
        """Draw a fitted profile on the fine grid, as far as the PSF reaches at least: steps at its edge show."""
        reach = min(_DRAWN_RADII * shape.axes[0], _MAX_DRAWN)
        return shape.moved(corner).drawn(light, max(self.fitter.reach, reach))
