"""How templates may change, as far as their shapes are not known."""

import dataclasses

import numpy as np
import scipy.ndimage

from miricigale.photometry._core.shape_fits import draw_curves
from miricigale.photometry._core.shapes import INDEX_RANGE, shape_curves
from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.shapes.shape_models import ShapeModels
from miricigale.photometry.shapes.shapes import POINT_SIZE, normal_nodes

#: Half-width (fine pixels) of the stamps of changes, least and most, in half-light radii and in rms
#: widths of the PSF.
_HALF, _MOST, _REACH, _WIDTHS = 16, 160, 5.0, 4.0

#: Least power of a change (see `TemplateChanges.of`) below which stamps are larger than that.
_SEEN = 0.01


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
        self._size_scatter = size_scatter

    def of(self, cutout, fitted, least):
        """
        Changes of one template, and the variance of ln flux by noise of the pixels that are the image's.

        ``cutout`` is the template, None for a point, ``fitted`` what is known of it. Changes with less than the
        part ``least`` of the root of the sum of squares of the template are left out.
        """
        if cutout is not None and cutout.rest is not None:
            return self._of_image(cutout, fitted, least)
        parameters = fitted["parameters"]
        middle = np.rint(parameters[:2])
        # the wings of a brighter source's changes are seen farther out
        widths = _WIDTHS * np.clip(_SEEN / least, 1.0, 4.0)
        reach = _REACH * np.exp(parameters[2] + 0.5 * np.hypot(*parameters[4:]))
        half = min(reach, _MOST) + widths * self._width
        half = int(np.ceil(max(half, _HALF)))
        plan = self._target.plan(2 * half + 1)
        # nodes about the mean, and the profile that is scaled
        covariance = fitted["covariance"][3:, 3:]
        nodes = parameters[2:] + normal_nodes() @ _root(covariance).T
        nodes[:, 1] = np.clip(nodes[:, 1], *np.log(INDEX_RANGE))
        step = np.array([0.5 * self._size_scatter, 0.0, 0.0, 0.0])
        some = [parameters[2:], parameters[2:] + step, parameters[2:] - step]
        curves = shape_curves(plan.kx, plan.ky, np.concatenate([nodes, some]))
        profile, *sides = curves[len(nodes) :]
        curves = curves[: len(nodes)]
        # a point has no size
        odds = fitted["point"]
        base = np.ones_like(profile) if cutout is None else profile
        mean = (1.0 - odds) * curves.mean(axis=0) + odds
        steps = np.sqrt((1.0 - odds) / len(nodes)) * (curves - mean)
        scatter = (1.0 - odds) * (sides[0] - sides[1])
        steps = np.concatenate([steps, [np.sqrt(odds) * (1.0 - mean), scatter]])
        # light is blurred by what is not known of the center
        kx, ky = plan.kx, plan.ky
        cxx, cxy, _, cyy = fitted["covariance"][1:3, 1:3].ravel()
        blur = np.exp(-0.5 * (cxx * kx * kx + 2 * cxy * kx * ky + cyy * ky * ky))
        limit = least**2 * np.sum(plan.weight * base**2)
        value, vector = np.linalg.eigh((steps * plan.weight) @ steps.T)
        kept = value > limit
        found = np.concatenate([vector.T[kept] @ steps, [mean * blur - base]])
        fixed = np.sum(plan.weight * found[-1] ** 2) > limit
        place = parameters[:2] - middle + half
        found = (found if fixed else found[:-1]).astype(np.float32)
        if not len(found):
            return [], 0.0
        images = draw_curves(plan, found, *place, 0).swapaxes(0, 1)
        origin = int(middle[1]) - half, int(middle[0]) - half
        last = len(images) - 1 if fixed else len(images)
        return [Change(Cutout(one, origin), fixed=k == last) for k, one in enumerate(images)], 0.0

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
        template, *derivatives = self._blurred(np.stack([image, *images]))
        power = np.sum(template**2)
        changes = [
            Change(Cutout(np.tensordot(step, derivatives, 1), rest.origin), float(step @ light))
            for step in _steps(_root(fitted["covariance"]), derivatives, least**2 * power)
        ]
        # more or less of the light may be in the middle than in the other band, unless a point on top of it
        # is that light: the center is open only then
        middle = self._target.profiles(shape, [*parameters[:2], POINT_SIZE, 0.0, 0.0, 0.0])[0]
        middle = middle - self._blurred(rest.data)
        middle -= self._target.convolve(profile.data[None], profile.origin - corner, shape)[0]
        seen = self._size_scatter**2 * np.sum(middle**2) > least**2 * power
        if seen and not fitted["covariance"][1, 1]:
            changes.append(Change(Cutout(self._size_scatter * middle, rest.origin)))
        # each pixel adds to the light, and to what is taken off by the fit
        weight = 1.0 - self._blurred(template) / power
        each = cutout.noise / max(np.count_nonzero(core), 1)
        return changes, float(each * np.sum(weight[core] ** 2))

    def pixel_noise(self, cutout):
        """Variance of ln flux by the noise of a cutout's pixels."""
        template = self._blurred(cutout.data.astype(float))
        seen = cutout.data != 0
        weight = 1.0 - self._blurred(template) / np.sum(template**2)
        return float(cutout.noise * np.mean(weight[seen] ** 2))

    def _blurred(self, images):
        """Images, (..., ny, nx), as blurred as the image is beside the high-resolution one."""
        return scipy.ndimage.gaussian_filter(images, self._blur, mode="constant", axes=(-2, -1))


def _root(covariance):
    """A root of a covariance that may be singular."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0.0))


def _steps(root, derivatives, least):
    """Steps of the parameters that are independent in the image, of those with enough power."""
    flat = np.reshape(derivatives, (len(derivatives), -1))
    value, vector = np.linalg.eigh(root.T @ (flat @ flat.T) @ root)
    return [root @ vector[:, k] for k in range(len(value)) if value[k] > least]
