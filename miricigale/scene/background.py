"""The background of a scene: a level and a gradient that stands on the sky."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from scipy.interpolate import RectBivariateSpline

from miricigale.instrument import background_level
from miricigale.instrument.sky_axes import pixel_to_radec
from miricigale.utils.options import check_that
from miricigale.utils.positions import middle_pixel
from miricigale.utils.units import SURFACE_BRIGHTNESS, frozen_quantity


@dataclasses.dataclass(frozen=True)
class Background:
    """
    A background with a linear gradient on the sky.

    Parameters
    ----------
    level : `~astropy.units.Quantity`
        Surface brightness at the center.
    gradient : `~astropy.units.Quantity`, optional
        Relative change per angle (such as ``0.05 / u.arcmin``).
    position_angle : `~astropy.units.Quantity`, optional
        Direction in which it grows, east of north.
    center : `~astropy.coordinates.SkyCoord`, optional
        Where the level holds; the center of each image if not given. Dithers of one field
        share a background only with one common center.

    Raises
    ------
    ValueError
        If the level is negative or not finite.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.scene import Background
    >>> tilted = Background(5 * u.MJy / u.sr, gradient=0.05 / u.arcmin)
    >>> tilted.level
    <Quantity 5. MJy / sr>
    >>> Background.low_zodi("F770W").level.round(2)
    <Quantity 4.93 MJy / sr>
    """

    level: u.Quantity
    gradient: u.Quantity = 0 / u.arcmin
    position_angle: u.Quantity = 45 * u.deg
    center: SkyCoord | None = None

    def __post_init__(self):
        level = frozen_quantity(self.level, SURFACE_BRIGHTNESS, "level", ndim=0)
        check_that(0 <= level.value < np.inf, "level", "finite and not negative", self.level)
        options = {"ndim": 0, "finite": True}
        gradient = frozen_quantity(self.gradient, 1 / u.arcmin, "gradient", **options)
        angle = frozen_quantity(self.position_angle, u.deg, "position_angle", **options)
        self.__dict__.update(level=level, gradient=gradient, position_angle=angle)

    @classmethod
    def low_zodi(cls, filter, *, center=None):
        """
        Return the background of a MIRI filter at low zodiacal light, with a gradient of 5 % per arcmin.

        Parameters
        ----------
        filter : str
            One of `~miricigale.instrument.imager_filters`.
        center : `~astropy.coordinates.SkyCoord`, optional
            As of the class.

        Examples
        --------
        >>> from miricigale.scene import Background
        >>> Background.low_zodi("miri.f770w").gradient
        <Quantity 0.05 1 / arcmin>
        """
        return cls(background_level(filter), gradient=0.05 / u.arcmin, center=center)

    def image(self, wcs, shape):
        """
        Return the background in each pixel.

        Parameters
        ----------
        wcs : `~astropy.wcs.WCS`
            World coordinates of the image.
        shape : tuple of int
            ``(ny, nx)``.

        Returns
        -------
        image : `~numpy.ndarray`, shape (ny, nx)
            MJy/sr.

        Raises
        ------
        ValueError
            If the gradient makes the background negative somewhere.
        """
        ny, nx = shape
        level = self.level.value
        gradient = self.gradient.value
        if gradient == 0:
            return np.full(shape, level)
        center = self.center
        if center is None:
            ra, dec = pixel_to_radec(wcs, *middle_pixel(shape))
            center = SkyCoord(ra, dec, unit="deg")
        # smooth, so a coarse grid is enough
        nodes = [np.linspace(-0.5, n - 0.5, 12) for n in (ny, nx)]
        x, y = np.meshgrid(nodes[1], nodes[0])
        ra, dec = np.radians(pixel_to_radec(wcs, x.ravel(), y.ravel())).reshape((2,) + x.shape)
        ra0 = center.icrs.ra.rad
        dec0 = center.icrs.dec.rad
        cos = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(ra - ra0)
        east = np.cos(dec) * np.sin(ra - ra0) / cos
        north = (np.cos(dec0) * np.sin(dec) - np.sin(dec0) * np.cos(dec) * np.cos(ra - ra0)) / cos
        angle = self.position_angle.to_value(u.rad)
        along = np.degrees(east * np.sin(angle) + north * np.cos(angle)) * 60.0
        spline = RectBivariateSpline(nodes[0], nodes[1], along)
        smooth = spline(np.arange(ny), np.arange(nx))
        image = level * (1 + gradient * smooth)
        if image.min() < 0:
            msg = f"the background's gradient of {self.gradient} makes it negative within the image"
            raise ValueError(msg)
        return image
