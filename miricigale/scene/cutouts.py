"""Images of galaxies as sources: stamps with a scale and an angle."""

import dataclasses
import functools
import math

import astropy.units as u
import numpy as np
from astropy.nddata import NDData

from miricigale.scene.sky import local_jacobian
from miricigale.utils.arrays import check_light
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.positions import middle_pixel
from miricigale.utils.units import ANGLE, Frozen, frozen_array, frozen_quantity, positive
from miricigale.utils.values import value_class

# two points of Gauss and Legendre in a cell: the light's variance in it is exact
_GAUSS = 0.5 / math.sqrt(3.0)

# largest cell in pixels of the image: the error is its fourth power over 4320 times the fourth
# derivative of the PSF, 1e-5 for one as narrow as a sigma of 0.8 pixel
_CELL = 0.375


@value_class
class Cutout(Frozen):
    """
    An image of a source, to be painted into a scene.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Light per pixel in any unit, background subtracted; the scene scales its sum to the
        flux of the catalog.
    pixel_scale : `~astropy.units.Quantity`
        Side of a pixel.
    angle : `~astropy.units.Quantity`, optional
        Position angle of +y, east of north; +x is west of it, as on any image of the sky.
    center : tuple of float, optional
        Pixel x, y (0-based) that stands at the catalog's position; the middle of the
        stamp if not given.

    Raises
    ------
    ValueError
        If the data are no finite 2D array with a positive sum, or the scale is not positive.

    Notes
    -----
    The stamp is taken for the light outside the telescope: the scene's PSF blurs it once
    more. A stamp of another telescope brings that one's PSF, and its noise, with it.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale.scene import Cutout
    >>> y, x = np.mgrid[-20:21, -20:21]
    >>> light = np.exp(-np.hypot(x, y) / 4)
    >>> Cutout(light, pixel_scale=0.06 * u.arcsec, angle=30 * u.deg)
    <Cutout 41 x 41 pixels of 0.06 arcsec, angle 30 deg>
    """

    data: np.ndarray
    _: dataclasses.KW_ONLY
    pixel_scale: u.Quantity
    angle: u.Quantity = 0.0 * u.deg
    center: tuple | None = None

    def __post_init__(self):
        data = frozen_array(floats(self.data))
        check_light(data)
        scale = positive(self.pixel_scale, ANGLE, "pixel_scale") * ANGLE
        angle = frozen_quantity(self.angle, u.deg, "angle", ndim=0, finite=True)
        center = self.center
        if center is None:
            center = middle_pixel(data.shape)
        if len(center) != 2 or not np.all(np.isfinite(center)):
            raise argument_error("center", "a pixel x, y", self.center)
        center = (float(center[0]), float(center[1]))
        self.__dict__.update(data=data, pixel_scale=scale, angle=angle, center=center)

    @classmethod
    def from_image(cls, image, position=None):
        """
        Take the stamp, its scale, its angle and its center from an image with a WCS.

        Parameters
        ----------
        image : `~astropy.nddata.NDData`
            Background subtracted, such as a `~astropy.nddata.Cutout2D` of a mosaic made a
            CCDData; all of its pixels hold light.
        position : `~astropy.coordinates.SkyCoord`, optional
            What stands at the catalog's position; the middle of the stamp if not given.

        Returns
        -------
        cutout : `Cutout`
            Turned round along x where the image has east to the right.

        Raises
        ------
        ValueError
            If there is no WCS, its pixels are not square to a per cent, or pixels are masked
            or not finite.
        """
        if not isinstance(image, NDData) or image.wcs is None:
            raise argument_error("image", "NDData with a WCS", type(image).__name__)
        data = np.array(image.data, dtype=float)
        check_that(data.ndim == 2, "image", "a 2D image", f"shape {data.shape}")
        bad = ~np.isfinite(data)
        if image.mask is not None:
            bad |= np.asarray(image.mask, dtype=bool)
        got = f"{bad.sum()} of {bad.size} pixels that are"
        check_that(not bad.any(), "image", "without masked or infinite pixels (fill them)", got)
        x, y = middle_pixel(data.shape)
        # columns: the steps along x and y in (east, north), arcsec
        steps = np.linalg.inv(local_jacobian(image.wcs, x, y))
        sides = np.hypot(steps[0], steps[1])
        cosine = float(steps[:, 0] @ steps[:, 1]) / float(np.prod(sides))
        if abs(sides[1] / sides[0] - 1) > 0.01 or abs(cosine) > 0.01:
            wanted = "with square pixels (resample it first)"
            got = f"sides of {sides[0]:.4g} and {sides[1]:.4g} arcsec, cosine {cosine:.3g}"
            raise argument_error("image", wanted, got)
        if position is not None:
            x, y = map(float, image.wcs.world_to_pixel(position))
        # east of north is counter-clockwise where +x is west of +y
        if np.linalg.det(steps) > 0:
            data = data[:, ::-1]
            x = data.shape[1] - 1 - x
        angle = math.degrees(math.atan2(steps[0, 1], steps[1, 1]))
        scale = float(np.sqrt(np.prod(sides)))
        return cls(data, pixel_scale=scale * ANGLE, angle=angle * u.deg, center=(x, y))

    def __repr__(self):
        ny, nx = self.data.shape
        size = f"{nx} x {ny} pixels of {self.pixel_scale:.4g}"
        return f"<Cutout {size}, angle {self.angle:.4g}>"

    @functools.cached_property
    def _steps(self):
        """East and north of a step along x and along y, arcsec, as columns."""
        a = self.angle.to_value(u.rad)
        s = self.pixel_scale.value
        return s * np.array([[-math.cos(a), math.sin(a)], [math.sin(a), math.cos(a)]])

    @functools.cached_property
    def half_light_radius(self):
        """Radius of the circle around the center that holds half of the light."""
        y, x = np.indices(self.data.shape)
        radius = np.hypot(x - self.center[0], y - self.center[1]).ravel()
        order = np.argsort(radius, kind="stable")
        share = np.append(0.0, np.cumsum(self.data.ravel()[order]) / self.data.sum())
        radius = np.append(0.0, radius[order])
        # noise may take the sum up and down: where it first has the half
        k = int(np.argmax(share >= 0.5))
        step = (0.5 - share[k - 1]) / (share[k] - share[k - 1])
        return (radius[k - 1] + step * (radius[k] - radius[k - 1])) * self.pixel_scale

    def pieces(self, jacobian):
        """
        Return the stamp as many small points on the pixels of an image.

        Parameters
        ----------
        jacobian : `~numpy.ndarray`, shape (2, 2)
            Pixels of the image per arcsec, ``[dx, dy] = jacobian @ [east, north]``.

        Returns
        -------
        dx, dy, share : `~numpy.ndarray`, shape (n,)
            Offsets from the source's position in pixels, and shares of the light, which add
            up to 1.
        """
        steps = np.asarray(jacobian) @ self._steps
        cells = max(1, math.ceil(float(np.hypot(steps[0], steps[1]).max()) / _CELL))
        inner = (np.arange(cells) + 0.5) / cells - 0.5
        inner = (inner[:, None] + np.array([-_GAUSS, _GAUSS]) / cells).ravel()
        rows, columns = np.nonzero(self.data)
        value = self.data[rows, columns] / self.data.sum() / inner.size**2
        v, u_ = (t.ravel() for t in np.meshgrid(inner, inner, indexing="ij"))
        x = (columns[:, None] - self.center[0] + u_).ravel()
        y = (rows[:, None] - self.center[1] + v).ravel()
        dx, dy = steps @ np.stack([x, y])
        return dx, dy, np.repeat(value, inner.size**2)
