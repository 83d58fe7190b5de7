"""How templates may change, as far as their shapes are not known."""

import dataclasses
from typing import ClassVar

import numpy as np
import scipy.ndimage

from miricigale.photometry._core.profile_images import Plan, draw_curves
from miricigale.photometry._core.shapes import INDEX_RANGE, shape_curves
from miricigale.photometry._core.source_fits import POINT_SIZE
from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.shapes.shape_models import ShapeModels
from miricigale.photometry.shapes.shapes import major_radius, normal_nodes
from miricigale.utils.values import value_class

#: Half-width (fine pixels) of the stamps of changes, least and most, in half-light radii and in rms
#: widths of the PSF.
_HALF = 16
_MOST = 160
_REACH = 5.0
_WIDTHS = 4.0

#: Least power of a change (see `TemplateChanges.of`) below which stamps are larger than that.
_SEEN = 0.01


@value_class
class Change:
    """How a template changes along one direction."""

    #: The change by one standard deviation on the fine grid, at the resolution of the image.
    cutout: "Cutout | DrawnCutout"
    light: float = 0.0  # How much light it adds.
    #: Whether it is no deviation but the mean's: what all templates that are possible have in the
    #: mean beyond the one that fits best.
    fixed: bool = False


@value_class
class DrawnCutout:
    """
    A `~miricigale.photometry.detection.cutouts.Cutout` that keeps its transform alone.

    Of thousands of sources the images of all changes are much larger.
    """

    plan: Plan
    curve: np.ndarray  # As `~miricigale.photometry._core.profile_images.draw_curves` takes it.
    #: Place of its center on the square.
    x: float
    y: float
    origin: tuple  # Fine pixel (y, x) of its corner.
    # as those of a cutout at the resolution of the image
    noise: ClassVar[float] = 0.0
    convolved: ClassVar[bool] = True
    correction: ClassVar[None] = None
    galaxy: ClassVar[None] = None
    kind: ClassVar[str] = "cutout"

    @property
    def shape(self):
        """Shape of ``data``."""
        size = 2 * self.plan.waves_x.shape[2] - 1
        return size, size

    @property
    def data(self):
        """The image, which is drawn anew each time."""
        return draw_curves(self.plan, self.curve[None], self.x, self.y, 0)[0]

    @property
    def layers(self):
        """The cutout alone."""
        return (self,)


class TemplateChanges:
    """
    Finds the independent changes of a template that its fit to the high-resolution image leaves open.

    The covariance of the profile's parameters is turned to the directions that are independent of each
    other at the image's resolution. Between point and profile the difference of the two counts as the
    probabilities say. The mean of all that is possible is another than the template that fits best:
    half of what two steps to either side differ from it, and the other of point and profile times its
    probability.

    Parameters
    ----------
    source, target : `~numpy.ndarray`
        PSFs of the high-resolution image and of the image, on fine pixels.
    size_scatter : float
        Standard deviation of ln size between the bands of the two images.
    """

    def __init__(self, source, target, size_scatter):
        self._source = ShapeModels(source)
        self._target = ShapeModels(target)
        target_variance = _gaussian_variance(target)
        self._width = np.sqrt(target_variance)
        self._blur = np.sqrt(max(target_variance - _gaussian_variance(source), 0.0))
        self._size_scatter = size_scatter

    def of(self, cutout, fitted, min_power):
        """
        Find the changes of one template, and the variance of ln flux by noise of the pixels that are the image's.

        Parameters
        ----------
        cutout : `~miricigale.photometry.detection.cutouts.Cutout` or None
            The template, None for a point.
        fitted : record of `~miricigale.photometry.shapes.shapes.FITTED`
            What is known of it.
        min_power : float
            Changes with less than this part of the root of the template's sum of squares are left out.

        Returns
        -------
        changes : list of `Change`
        noise : float
            The variance.
        """
        if cutout is not None and cutout.correction is not None:
            return self._of_image(cutout, fitted, min_power)
        parameters = fitted["parameters"]
        middle = np.rint(parameters[:2])
        # the wings of a brighter source's changes are seen farther out
        widths = _WIDTHS * np.clip(_SEEN / min_power, 1.0, 4.0)
        half = min(_REACH * major_radius(parameters), _MOST) + widths * self._width
        half = int(np.ceil(max(half, _HALF)))
        plan = self._target.plan(2 * half + 1)
        # nodes about the mean, and the profile that is scaled
        covariance = fitted["covariance"][3:, 3:]
        nodes = parameters[2:] + normal_nodes() @ _root(covariance).T
        low, high = np.log(INDEX_RANGE)
        nodes[:, 1] = np.clip(nodes[:, 1], low, high)
        step = np.array([0.5 * self._size_scatter, 0.0, 0.0, 0.0])
        best = [parameters[2:], parameters[2:] + step, parameters[2:] - step]
        curves = shape_curves(plan.kx, plan.ky, np.concatenate([nodes, best]))
        # the last is a point, which has no size
        curves = np.concatenate([curves, np.ones_like(curves[:1])])
        # all that follows is linear in the curves, and so are its products
        white = curves * np.sqrt(plan.weight, dtype=float)
        products = white @ white.T
        steps, mean = _deviations(len(nodes), float(fitted["point"]))
        base = -1 if cutout is None else len(nodes)
        limit = min_power**2 * products[base, base]
        # directions that are independent in the image: eigenvectors of the products of the steps
        value, vector = np.linalg.eigh(steps @ products @ steps.T)
        directions = vector.T[value > limit] @ steps
        directions = directions.astype(np.float32) @ curves
        # what the mean of all that is possible has beyond the best, which is no deviation
        beyond = mean.astype(np.float32) @ curves
        beyond = beyond * _center_blur(plan, fitted["covariance"]) - curves[base]
        fixed = np.sum(plan.weight * beyond**2, dtype=float) > limit
        if fixed:
            directions = np.concatenate([directions, beyond[None]])
        if not len(directions):
            return [], 0.0
        x, y = parameters[:2] - middle + half
        origin = int(middle[1]) - half, int(middle[0]) - half
        changes = [Change(DrawnCutout(plan, curve, x, y, origin)) for curve in directions]
        if fixed:
            changes[-1] = dataclasses.replace(changes[-1], fixed=True)
        return changes, 0.0

    def _of_image(self, cutout, fitted, min_power):
        """Find changes as `of`, where the core is the image: its own noise, and the profile elsewhere."""
        profile, remainder = cutout.layers
        shape = remainder.data.shape
        corner = np.array(remainder.origin)
        core = remainder.data != 0
        parameters = fitted["parameters"] - np.array([corner[1], corner[0], 0, 0, 0, 0])
        image = self._source.convolve(profile.data[None], profile.origin - corner, shape)[0]
        image = image + remainder.data
        images = self._source.profiles(shape, parameters, 6)
        images = np.where(core, 0.0, fitted["light"] * images)
        # the full profile's light, of which that in the core is replaced by the image's
        light = images.sum(axis=(1, 2))
        blurred = self._blurred(np.concatenate([image[None], images]))
        template = blurred[0]
        derivatives = blurred[1:]
        power = np.sum(template**2)
        changes = []
        for step in _steps(_root(fitted["covariance"]), derivatives, min_power**2 * power):
            cutout_of_step = Cutout(np.tensordot(step, derivatives, 1), remainder.origin)
            changes.append(Change(cutout_of_step, float(step @ light)))
        # more or less of the light may be in the middle than in the other band, unless a point on top of it
        # is that light: the center is open only then
        point = np.array([parameters[0], parameters[1], POINT_SIZE, 0.0, 0.0, 0.0])
        middle = self._target.profiles(shape, point)[0]
        middle = middle - self._blurred(remainder.data)
        middle -= self._target.convolve(profile.data[None], profile.origin - corner, shape)[0]
        is_strong = self._size_scatter**2 * np.sum(middle**2) > min_power**2 * power
        if is_strong and not fitted["covariance"][1, 1]:
            changes.append(Change(Cutout(self._size_scatter * middle, remainder.origin)))
        # each pixel adds to the light, and to what is taken off by the fit
        weight = 1.0 - self._blurred(template) / power
        pixel_variance = cutout.noise / max(np.count_nonzero(core), 1)
        return changes, float(pixel_variance * np.sum(weight[core] ** 2))

    def pixel_noise(self, cutout):
        """Return the variance of ln flux by the noise of a cutout's pixels."""
        template = self._blurred(cutout.data.astype(float))
        has_light = cutout.data != 0
        weight = 1.0 - self._blurred(template) / np.sum(template**2)
        return float(cutout.noise * np.mean(weight[has_light] ** 2))

    def _blurred(self, images):
        """Blur images, (..., ny, nx), as much as the image is blurred compared with the high-resolution one."""
        return scipy.ndimage.gaussian_filter(images, self._blur, mode="constant", axes=(-2, -1))


def _center_blur(plan, covariance):
    """Return what is left of each frequency where the center is not known, 1 if it is."""
    cxx, cxy, _, cyy = covariance[1:3, 1:3].ravel().tolist()
    if not (cxx or cyy):
        return np.float32(1.0)
    kx = plan.kx
    ky = plan.ky
    return np.exp(-0.5 * (cxx * kx * kx + 2 * cxy * kx * ky + cyy * ky * ky))


def _deviations(n, point):
    """
    Return how templates may deviate from their mean.

    Parameters
    ----------
    n : int
        Number of shapes that are possible.
    point : float
        Probability of a point.

    Returns
    -------
    steps : `~numpy.ndarray`, shape (n + 2, n + 4)
        Independent deviations, as sums of the shapes, the best one, it larger and smaller, and a point: those of
        the shapes, that of point and profile, and that of the size between bands.
    mean : `~numpy.ndarray`, shape (n + 4,)
        The mean, in the same way.
    """
    mean = np.zeros(n + 4)
    mean[:n] = (1.0 - point) / n
    mean[-1] = point
    steps = np.zeros((n + 2, n + 4))
    steps[:n, :n] = np.eye(n)
    steps[:n] -= mean
    steps[:n] *= np.sqrt((1.0 - point) / n)
    steps[n] = -mean
    steps[n, -1] += 1.0
    steps[n] *= np.sqrt(point)
    steps[n + 1, n + 1] = 1.0 - point
    steps[n + 1, n + 2] = point - 1.0
    return steps, mean


def _gaussian_variance(psf):
    """Return the variance along an axis (pixels^2) of a Gaussian as peaked as a PSF."""
    return np.sum(psf) ** 2 / (4 * np.pi * np.sum(psf**2))


def _root(covariance):
    """Return a root of a covariance that may be singular."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0.0))


def _steps(root, derivatives, min_power):
    """Find steps of the parameters that are independent in the image, and have enough power there."""
    flat = np.reshape(derivatives, (len(derivatives), -1))
    # eigenvectors of the products of the images of unit deviations
    value, vector = np.linalg.eigh(root.T @ (flat @ flat.T) @ root)
    return [root @ vector[:, k] for k in range(len(value)) if value[k] > min_power]
