"""Cutouts: the light of each source of the high-resolution image, before convolution."""

import dataclasses

import numpy as np
import scipy.ndimage

from miricigale.photometry import _core
from miricigale.photometry.flags import ForcedFlags
from miricigale.photometry.shapes import ShapeFitter
from miricigale.profiles import ellipse_to_pixels, sersic_stamp
from miricigale.utils.parallel import parallel_map

__all__ = ["RIM", "Cutout", "convolve_padded", "cutouts", "own_segments", "sersic_cutouts"]

#: Rim of zeros around fine stamps, for the splines and the pixel response to fade in.
RIM = 8


@dataclasses.dataclass(frozen=True, eq=False)
class Cutout:
    """
    The light of one source on the fine grid, before convolution, of unit total.

    Attributes
    ----------
    data : `~numpy.ndarray`, shape (h, w)
        Light to be convolved.
    origin : (int, int)
        Fine pixel (y, x) of its corner.
    noise : float
        Sum of the noise variances of the light, for the errors-in-variables correction.
    convolved : bool
        Whether ``data`` has the sharp PSF already (a cutout) or not (a profile).
    rest : `Cutout` or None
        What is added to a profile: the image less the profile, which has the sharp PSF.
    """

    data: np.ndarray
    origin: tuple
    noise: float = 0.0
    convolved: bool = True
    rest: "Cutout | None" = None

    @property
    def kind(self):
        """``"cutout"`` if any of it is the image itself, else ``"sersic"``."""
        return "cutout" if self.convolved or self.rest is not None else "sersic"

    @property
    def layers(self):
        """The profile and the rest, or the one there is."""
        return (self,) if self.rest is None else (self, self.rest)


def own_segments(segmentation, labels, xy):
    """
    Give each segment to one source.

    Parameters
    ----------
    segmentation : int `~numpy.ndarray`, shape (ny, nx)
        Label of each fine pixel, 0 for none.
    labels : int `~numpy.ndarray`, shape (n,), or None
        The label that each source says it has; by default the one at its position.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the fine grid.

    Returns
    -------
    label : int `~numpy.ndarray`, shape (n,)
        The source's own label, 0 if it has none.
    flags : int `~numpy.ndarray`, shape (n,)
        ``NO_SEGMENT`` and ``SHARED_SEGMENT``. Of several sources on a segment the one
        nearest to the segment's middle owns it.
    """
    ny, nx = segmentation.shape
    x, y = np.rint(np.where(np.isfinite(xy), xy, -1)).astype(int).T
    if labels is None:
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        labels = np.where(
            inside, segmentation[np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1)], 0
        ).astype(int)
    label = np.array(labels, dtype=int)
    flags = np.where(label > 0, 0, int(ForcedFlags.NO_SEGMENT))
    values, counts = np.unique(label[label > 0], return_counts=True)
    for value in values[counts > 1]:
        rows = np.flatnonzero(label == value)
        member = np.argwhere(segmentation == value)
        middle = member.mean(axis=0) if len(member) else np.zeros(2)
        distance = np.hypot(xy[rows, 1] - middle[0], xy[rows, 0] - middle[1])
        losers = np.delete(rows, np.nanargmin(np.nan_to_num(distance, nan=np.inf)))
        label[losers] = 0
        flags[losers] |= int(ForcedFlags.SHARED_SEGMENT)
    return label, flags


def cutouts(
    data, variance, segmentation, label, xy, source_psf, *, scale, min_snr, wings, select=True,
    executor=None,
):  # fmt: skip
    """
    Make the template of each source from the high-resolution image.

    Parameters
    ----------
    data, variance : `~numpy.ndarray`, shape (ny, nx)
        Light per pixel (any unit, background subtracted) and its variance, zero and
        infinite where not usable.
    segmentation : int `~numpy.ndarray`, shape (ny, nx)
        Labels.
    label : int `~numpy.ndarray`, shape (n,)
        Label of each source, 0 for none.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of the sources on the image.
    source_psf : `~numpy.ndarray`, shape (k, k)
        PSF of the image, odd and centred.
    scale : float
        Arcsec per pixel.
    min_snr : float
        Least signal-to-noise of a segment.
    wings : bool
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

    Notes
    -----
    With ``wings`` a point and a Sersic profile through the PSF are fitted to the pixels about
    each source, other sources' segments left out. A source is a point if that is the more probable
    (see `~miricigale.photometry.shapes.ShapeFitter`). It is the profile where that leaves
    nothing but noise on the core, which are the pixels whose smoothed signal-to-noise is
    above 4; otherwise the core is taken from the image, and everything beyond from the profile.
    """
    slices = scipy.ndimage.find_objects(segmentation)
    usable = np.isfinite(variance)
    smooth = _smooth_snr(data, variance, executor) if wings else None
    fitter = ShapeFitter(source_psf, scale) if wings else None
    reach = source_psf.shape[0] / 2
    snr = np.full(len(label), np.nan)
    flags = np.zeros(len(label), int)
    totals = np.zeros(len(slices) + 1)
    ratio = np.zeros(len(slices) + 1)
    members = [None] * (len(slices) + 1)
    for one, place in enumerate(slices, 1):
        if place is None:
            continue
        members[one] = member = (segmentation[place] == one) & usable[place]
        totals[one] = data[place][member].sum()
        noise = variance[place][member].sum()
        ratio[one] = totals[one] / np.sqrt(noise) if noise > 0 else np.inf
    # what is no more than a peak of the noise hides nothing
    others = np.where(ratio >= _OTHER_SNR, np.arange(len(ratio)), 0)

    def make(k):
        one = label[k]
        place = slices[one - 1] if 0 < one <= len(slices) else None
        if place is None:
            return None, int(ForcedFlags.NO_SEGMENT) if one > 0 else 0
        snr[k] = ratio[one]
        if not (totals[one] > 0 and snr[k] >= min_snr):
            return None, int(ForcedFlags.NOISY_SEGMENT)
        if not wings:
            light = np.where(members[one], data[place], 0.0) / totals[one]
            noise = float(variance[place][members[one]].sum()) / totals[one] ** 2
            return Cutout(light, (place[0].start, place[1].start), noise=noise), 0
        around = _around(place, xy[k], data.shape)
        labels = segmentation[around]
        free = usable[around] & ((labels == one) | (others[labels] == 0))
        weight = np.where(free, 1.0 / np.sqrt(np.where(free, variance[around], 1.0)), 0.0)
        corner = np.array([around[1].start, around[0].start])
        shape = fitter.fit(data[around], weight, xy[k] - corner)
        if shape is None:
            return None, int(ForcedFlags.NOISY_SEGMENT)
        if select and shape.point > 0.5:
            return None, 0
        core = (labels == one) & free & (smooth[around] > _CORE_SNR)
        model = shape.flux * fitter.model(weight.shape, shape.parameters)
        n = np.count_nonzero(core)
        excess = np.sum(((data[around] - model) * weight)[core] ** 2) - n
        if select and excess < _EXCESS * np.sqrt(2 * max(n, 1)):
            return _profile(shape, corner, reach), 0
        # what the profile cannot explain in the core must not bend its wings
        looser = weight / np.hypot(1.0, _MISFIT * model * weight)
        shape = fitter.fit(data[around], looser, xy[k] - corner) or shape
        model = shape.flux * fitter.model(weight.shape, shape.parameters)
        rest = np.where(core, data[around] - model, 0.0)
        total = shape.flux + rest.sum()
        noise = float(variance[around][core].sum()) / total**2
        return dataclasses.replace(
            _profile(shape, corner, reach, light=shape.flux / total),
            noise=noise,
            rest=Cutout(rest / total, (around[0].start, around[1].start)),
        ), 0

    found = parallel_map(make, range(len(label)), executor=executor)
    flags[:] = [flag for _, flag in found]
    return [one for one, _ in found], flags, snr


def _profile(shape, corner, reach, light=1.0):
    """A fitted profile on the fine grid, as far as the PSF reaches at least."""
    x, y = shape.parameters[:2] + corner
    radius, axis_ratio, angle = shape.axes
    stamp, origin = sersic_stamp(
        x=x, y=y, total_flux=light, r_eff=radius, n=np.exp(shape.parameters[3]),
        axis_ratio=axis_ratio, theta=angle, max_radius=max(reach, 2 * radius),
    )  # fmt: skip
    return Cutout(stamp, origin, convolved=False)


#: Width (pixels) of the Gaussian that tells the core, its least signal-to-noise, how many standard
#: deviations of chi^2 a profile may miss it by, and the signal-to-noise that makes a neighbour.
_WIDTH, _CORE_SNR, _EXCESS, _OTHER_SNR = 1.5, 4.0, 3.0, 4.0

#: Error of a profile that does not explain the core, as a fraction of its brightness.
_MISFIT = 0.1

#: Half-width (pixels) of the stamps that profiles are fitted on: beyond the segment, least and most.
_AROUND, _LEAST, _MOST = 6, 16, 48


def _around(place, xy, shape):
    """The stamp of a source: as far as its segment goes to either side, and a rim."""
    x, y = round(float(xy[0])), round(float(xy[1]))
    reach = max(place[0].stop - y, y - place[0].start, place[1].stop - x, x - place[1].start)
    half = int(np.clip(reach + _AROUND, _LEAST, _MOST))
    return tuple(
        slice(min(max(c - half, 0), n - 1), max(min(c + half + 1, n), 1))
        for c, n in zip((y, x), shape, strict=True)
    )


def _smooth_snr(data, variance, executor):
    usable = np.isfinite(variance)

    def smooth(what):
        image, width = what
        return scipy.ndimage.gaussian_filter(np.where(usable, image, 0.0), width)

    images = [(variance, 4 * _WIDTH), (data, _WIDTH)]
    noise, light = parallel_map(smooth, images, executor=executor)
    noise = np.sqrt(noise)
    gain = 1.0 / (2.0 * np.sqrt(np.pi) * _WIDTH)
    return light / np.where(noise > 0, noise * gain, np.inf)


def sersic_cutouts(rows, xy, jacobian):
    """
    Draw Sersic profiles on the fine grid.

    Parameters
    ----------
    rows : `~numpy.ndarray`, shape (n, 4)
        Half-light radius (arcsec), Sersic index, axis ratio and position angle (rad);
        NaN for a point source.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the fine grid.
    jacobian : `~numpy.ndarray`, shape (2, 2)
        Fine pixels per arcsec, ``[dx, dy] = jacobian @ [east, north]``.

    Returns
    -------
    cutout : list of `Cutout` or None
        None for point sources. The profile is cut at the isophote of 99.5 % of the light.
    """
    found = []
    for (radius, index, ratio, angle), (x, y) in zip(rows, xy, strict=True):
        if not np.isfinite(radius):
            found.append(None)
            continue
        r_eff, q, theta = ellipse_to_pixels(
            jacobian, radius=radius, axis_ratio=ratio, position_angle=angle
        )
        stamp, origin = sersic_stamp(
            x=x, y=y, r_eff=float(r_eff), n=index, axis_ratio=float(q), theta=float(theta)
        )
        found.append(Cutout(stamp, origin, convolved=False))
    return found


def convolve_padded(array, response):
    """Convolve one array with a rim around it, by the transform that ``response(shape)`` gives."""
    shape = tuple(n + 2 * RIM for n in array.shape)
    return _core.convolve_batch(np.pad(array, RIM)[None], response(shape), shape)
