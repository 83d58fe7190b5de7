"""How templates may change, as far as their shapes are not known."""

import dataclasses

import numpy as np
import scipy.ndimage

from miricigale.photometry._core.shapes import INDEX_RANGE
from miricigale.photometry.cutouts import Cutout
from miricigale.photometry.shapes import ShapeModels

#: Half-width (fine pixels) of the stamps of changes, least and most, in half-light radii and in rms
#: widths of the PSF.
_HALF, _MOST, _REACH, _WIDTHS = 16, 160, 5.0, 4.0

#: Radius (fine pixels) of a profile that is as good as a point; largest step of ln radius, ln index
#: or ellipticity that is taken as linear.
_POINT, _LINEAR = 0.05, 0.15


@dataclasses.dataclass(frozen=True, eq=False)
class Change:
    """How a template changes along one direction."""

    #: The change by one standard deviation on the fine grid, at the resolution of the image.
    cutout: Cutout
    light: float = 0.0  # How much light it adds.
    #: Whether it is no deviation but the mean's: what all templates that are possible have in the
    #: mean beyond the one that fits best.
    fixed: bool = False


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
        self._source, self._target = ShapeModels(source), ShapeModels(target)
        # of Gaussians as peaked as the PSFs
        widths = [np.sum(psf) ** 2 / (4 * np.pi * np.sum(psf**2)) for psf in (target, source)]
        self._width = np.sqrt(widths[0])
        self._blur = np.sqrt(max(widths[0] - widths[1], 0.0))
        self._size_variance = size_scatter**2

    def of(self, cutout, fitted, least):
        """
        Changes of one template, and the variance of ln flux by noise of the pixels that are the image's.

        ``cutout`` is the template, None for a point, ``fitted`` what is known of it. Changes with less than the
        part ``least`` of the root of the sum of squares of the template are left out.
        """
        parameters = fitted["parameters"]
        middle = np.rint(parameters[:2])
        half = min(_reach(parameters), _MOST) + _WIDTHS * self._width
        half = int(np.ceil(max(half, _HALF)))
        origin = int(middle[1]) - half, int(middle[0]) - half

        def images(parameters, derivatives=0):
            moved = parameters + np.array([half - middle[0], half - middle[1], 0, 0, 0, 0])
            found = self._target.profiles((2 * half + 1,) * 2, moved, derivatives)
            return found.astype(float)

        profile, *derivatives = images(parameters, 6)
        spread = np.zeros((6, 6))
        spread[2, 2] = self._size_variance
        found, noise = [], 0.0
        if cutout is not None and cutout.rest is not None:
            found, noise = self._of_image(cutout, fitted, least)
            share, limit = fitted["light"] ** 2, least**2 * np.sum(profile**2)
            point = None
        else:
            spread += fitted["covariance"][1:, 1:]
            share = 1.0 if cutout is not None else 1.0 - fitted["point"]
            point = _as_point(images, parameters) if 0 < fitted["point"] < 1 else None
            template = point if cutout is None and point is not None else profile
            limit = least**2 * np.sum(template**2)
        mean = np.zeros_like(profile)
        for step in _steps(_root(share * spread), derivatives, limit):
            change = np.tensordot(step, derivatives, 1)
            if np.max(np.abs(step[2:])) > _LINEAR:
                sides = [images(_moved(parameters, sign * step))[0] for sign in (1, -1)]
                change = 0.5 * (sides[0] - sides[1])
                mean += 0.5 * (sides[0] + sides[1]) - profile
            found.append(Change(Cutout(change, origin)))
        if point is not None:
            odds = fitted["point"]
            change = np.sqrt(odds * (1.0 - odds)) * (point - profile)
            mean += (1.0 - odds if cutout is None else odds) * (
                profile - point if cutout is None else point - profile
            )
            if np.sum(change**2) > limit:
                found.append(Change(Cutout(change, origin)))
        if np.sum(mean**2) > limit:
            found.append(Change(Cutout(mean, origin), fixed=True))
        return found, noise

    def _of_image(self, cutout, fitted, least):
        """The same where the core is the image: its own noise, and the profile elsewhere."""
        profile, rest = cutout.layers
        shape, corner = rest.data.shape, np.array(rest.origin)
        core = rest.data != 0
        parameters = fitted["parameters"] - np.array([corner[1], corner[0], 0, 0, 0, 0])
        image = self._source.convolve(profile.data[None], profile.origin - corner, shape)[0]
        image = image + rest.data
        images = self._source.profiles(shape, parameters, 6)
        images = np.where(core, 0.0, fitted["light"] * images)
        # the full profile's light, of which that in the core is replaced by the image's
        light = images.sum(axis=(1, 2))
        template, *derivatives = (self._blurred(one) for one in (image, *images))
        power = np.sum(template**2)
        changes = [
            Change(Cutout(np.tensordot(step, derivatives, 1), rest.origin), float(step @ light))
            for step in _steps(_root(fitted["covariance"]), derivatives, least**2 * power)
        ]
        # each pixel adds to the light, and to what is taken off by the fit
        weight = 1.0 - self._blurred(template) / power
        each = cutout.noise / max(np.count_nonzero(core), 1)
        return changes, float(each * np.sum(weight[core] ** 2))

    def _blurred(self, image):
        return scipy.ndimage.gaussian_filter(image, self._blur, mode="constant")


def _reach(parameters):
    """Some half-light radii (pixels)."""
    return _REACH * np.exp(parameters[2] + 0.5 * np.hypot(*parameters[4:]))


def _as_point(images, parameters):
    point = np.array(parameters)
    point[2], point[4:] = np.log(_POINT), 0.0
    return images(point)[0]


def _root(covariance):
    """A root of a covariance that may be singular."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0.0))


def _steps(root, derivatives, least):
    """Steps of the parameters that are independent in the image, of those with enough power."""
    flat = np.reshape(derivatives, (len(derivatives), -1))
    value, vector = np.linalg.eigh(root.T @ (flat @ flat.T) @ root)
    return [root @ vector[:, k] for k in range(len(value)) if value[k] > least]


def _moved(parameters, step):
    moved = parameters + step
    moved[3] = np.clip(moved[3], *np.log(INDEX_RANGE))
    return moved
