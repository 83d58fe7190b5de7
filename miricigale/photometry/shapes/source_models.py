"""Segments of the high-resolution image, and models of the sources on them."""

import numpy as np
import scipy.ndimage

from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.shapes.rectangles import hull, rectangle_corner
from miricigale.photometry.shapes.shapes import Neighbors, Shape, not_fitted
from miricigale.utils.arrays import quiet_division
from miricigale.utils.parallel import chunks
from miricigale.utils.values import value_class


@value_class
class Segments:
    """Segments of an image: where each is, and its light and signal-to-noise."""

    labels: np.ndarray  # (ny, nx): Label of each pixel, 0 for the sky.
    usable: np.ndarray  # (ny, nx): Pixels with data.
    places: list  # Rectangle of each label, label 1 first; None without pixels.
    totals: np.ndarray  # Light of each label, from label 0.
    ratio: np.ndarray  # Signal-to-noise of each label, from label 0.

    @classmethod
    def of(cls, data, variance, labels):
        """Measure the segments of an image, whose variance is infinite where it is not usable."""
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
        """Return ln of the light of a label."""
        return np.log(max(self.totals[label], 1e-300))

    def merged(self, groups):
        """Return a copy with each group of labels as one segment, which has the first of them."""
        names = np.arange(len(self.totals))
        places = list(self.places)
        totals = self.totals.copy()
        ratio = self.ratio.copy()
        with quiet_division():
            # noise from light and signal-to-noise
            variance = np.where(self.ratio > 0, (self.totals / self.ratio) ** 2, 0.0)
        for group in groups:
            leader = group[0]
            names[group] = leader
            places[leader - 1] = hull([self.places[label - 1] for label in group])
            totals[leader] = self.totals[group].sum()
            noise = np.sqrt(variance[group].sum())
            ratio[leader] = np.inf
            if noise > 0:
                ratio[leader] = totals[leader] / noise
        labels = names.astype(self.labels.dtype)[self.labels]
        return Segments(labels, self.usable, places, totals, ratio)


def segment_cutout(data, variance, segments, label):
    """Make a cutout of the pixels of a segment as they are."""
    place = segments.places[label - 1]
    total = segments.totals[label]
    member = (segments.labels[place] == label) & segments.usable[place]
    light = np.where(member, data[place], 0.0) / total
    noise = float(variance[place][member].sum()) / total**2
    return Cutout(light, (place[0].start, place[1].start), noise=noise)


@value_class
class SourceModel:
    """A fitted source: its profile, and its template of unit light."""

    stamp: tuple  # The rectangle that it was fitted on.
    shape: Shape  # Its profile, on the pixels of the stamp.
    image: np.ndarray  # Its light on the stamp.
    cutout: Cutout | None = None  # Its template; None for a point, and for a profile.
    is_profile: bool = False  # Whether the profile is its template, which is drawn at the end.
    light: float = 1.0  # The profile's part of the light of the template.
    neighbor_light: np.ndarray | float = 0.0  # Light that was taken off the stamp before the fit.
    labels: tuple = ()  # Of the sources that it was fitted together with.
    neighbors: Neighbors | None = None  # The shapes of these.

    @property
    def record(self):
        """Parameters on the whole image, their covariance, probability of a point, and part of the light."""
        shape = self.shape.moved(rectangle_corner(self.stamp))
        return shape.parameters, shape.covariance, shape.point, self.light


@value_class
class DividedGalaxy:
    """A galaxy whose light is divided among sources."""

    rows: list  # Numbers of its sources.
    pieces: list  # The `Cutout` of each, None without light; that of the largest has the template of the whole.
    shares: np.ndarray  # Their parts of the light.
    record: tuple | None  # What is known of the whole, None if templates are taken without error.
    number: int = 0

    def records(self):
        """Make the records (`~miricigale.photometry.shapes.shapes.FITTED`) of the pieces."""
        records = not_fitted(len(self.rows))
        for k, (piece, share) in enumerate(zip(self.pieces, self.shares, strict=True)):
            if piece is not None and self.record is not None:
                records[k] = (*self.record, self.number, share)
        return records
