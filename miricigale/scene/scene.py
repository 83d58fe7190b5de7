"""A noiseless image of a catalogue of sources, and the truth that belongs to it."""

import functools

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData
from astropy.table import QTable
from astropy.wcs import WCS

from miricigale.instrument import pixel_area_map
from miricigale.profiles import ellipse_to_pixels
from miricigale.scene.background import Background
from miricigale.scene.catalog import CatalogFlags, check_catalog, read_catalog
from miricigale.scene.render import Painter
from miricigale.utils.exceptions import argument_error
from miricigale.utils.meta import provenance
from miricigale.utils.tables import Flags
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS, to_array

__all__ = ["Scene", "SceneFlags"]

#: uJy per sr in MJy per sr.
_UJY_TO_MJY = 1e-12


class SceneFlags(Flags):
    """What happened to a source on its way into an image."""

    OUTSIDE_IMAGE = 1  # its centre is on no pixel
    NEAR_EDGE = 2  # its centre is on the image, but less than 95 % of its painted light
    CUT_PROFILE = 4  # more than 1 % of its light lies beyond the isophote where it was cut
    NO_FLUX = 8  # its flux is not finite or negative: not painted
    DRAWN_AS_POINT = 16  # a Sersic profile whose parameters cannot be used


def local_jacobian(wcs, x, y):
    """
    Local linear map from the sky to the pixels.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        World coordinates, distorted or not.
    x, y : `~numpy.ndarray`, shape (N,)
        Pixel positions.

    Returns
    -------
    jacobian : `~numpy.ndarray`, shape (N, 2, 2)
        Pixels per arcsec: ``[dx, dy] = jacobian @ [east, north]``.
    """

    def world(dx, dy):
        return np.asarray(wcs.all_pix2world(x + dx, y + dy, 0))

    _, dec = world(0, 0)
    columns = []
    for step in ((0.5, 0.0), (0.0, 0.5)):
        d_ra, d_dec = world(*step) - world(-step[0], -step[1])
        d_ra = (d_ra + 180.0) % 360.0 - 180.0
        columns.append(3600.0 * np.stack([d_ra * np.cos(np.radians(dec)), d_dec], axis=-1))
    return np.linalg.inv(np.stack(columns, axis=-1))


def pixel_positions(wcs, sky, shape):
    """
    Pixel positions, by the distortion where it is defined and linear far from the image.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        World coordinates.
    sky : `~astropy.coordinates.SkyCoord`, shape (N,)
        Positions.
    shape : tuple of int
        ``(ny, nx)`` of the image.

    Returns
    -------
    x, y : `~numpy.ndarray`, shape (N,)
        Pixels; NaN on the other side of the sky.
    near : `~numpy.ndarray` of bool, shape (N,)
        Within half an image of the image.
    """
    ny, nx = shape
    ra, dec = sky.icrs.ra.deg, sky.icrs.dec.deg
    x, y = np.asarray(wcs.wcs_world2pix(ra, dec, 0), dtype=float)
    near = (x > -0.5 * nx) & (x < 1.5 * nx) & (y > -0.5 * ny) & (y < 1.5 * ny)
    if np.any(near):
        x[near], y[near] = wcs.all_world2pix(ra[near], dec[near], 0, quiet=True)
    return x, y, near


class Scene:
    """
    A catalogue of sources as an instrument would see it without noise.

    Parameters
    ----------
    catalog : `~astropy.table.Table` or str
        As checked by `~miricigale.scene.check_catalog`, with a flux column called
        ``filter``; or what `~miricigale.scene.read_catalog` takes.
    filter : str
        The flux column, such as ``"miri.f770w"``.
    wcs : `~astropy.wcs.WCS`
        World coordinates of the image with their ``pixel_shape``, distorted or not.
    psf : `~photutils.psf.ImagePSF`
        PSF on the image's pixels with the pixel response in it. If its meta gives a
        ``pixel_scale`` (arcsec) or, in the frame of the sky, an ``angle`` (deg), they are
        compared with the WCS; a ``filter`` in it must be ``filter``.
    background : `~miricigale.scene.Background` or `~astropy.units.Quantity`, optional
        Background, or its constant level; none by default.
    enclosed : float, optional
        Sersic profiles are painted to the isophote that holds this fraction.
    max_radius : `~astropy.units.Quantity`, optional
        Largest semi-major axis of that isophote.
    workers : int, optional
        Threads of the Fourier transforms; the image does not depend on it.

    Raises
    ------
    ValueError
        If the WCS has no shape, or the PSF belongs to other pixels or another filter.

    Notes
    -----
    Positions, sizes and angles go through the local Jacobian of the WCS. All sources are
    painted on one grid with the oversampling of the PSF and convolved once. Fluxes are
    conserved: ``sum(brightness * pixel area)`` of the image less its background is the sum
    of ``flux_in_image`` of the truth.
    """

    def __init__(
        self,
        catalog,
        *,
        filter,
        wcs,
        psf,
        background=None,
        enclosed=0.9995,
        max_radius=12 * u.arcsec,
        workers=None,
    ):
        if not isinstance(catalog, QTable):
            catalog = read_catalog(catalog) if not hasattr(catalog, "colnames") else catalog
        self._filter = filter if isinstance(filter, str) else filter.name
        self._catalog = check_catalog(catalog, filters=[self._filter])
        if not isinstance(wcs, WCS):
            raise argument_error("wcs", "an astropy WCS", type(wcs).__name__)
        if wcs.pixel_shape is None:
            raise argument_error("wcs", "a WCS with its pixel_shape", "one without")
        self._wcs = wcs
        self._shape = tuple(int(n) for n in wcs.pixel_shape[::-1])
        self._background = self._check_background(background)
        scale = self._pixel_scale()
        self._check_psf(psf, scale)
        radius = float(to_array(max_radius, ANGLE, "max_radius", ndim=0))
        self._painter = Painter(
            self._shape, psf, enclosed=enclosed, max_radius=radius / scale, workers=workers
        )

    def __repr__(self):
        ny, nx = self._shape
        return f"<Scene {self._filter}: {len(self._catalog)} sources on {nx} x {ny} pixels>"

    @property
    def catalog(self):
        """The checked catalogue."""
        return self._catalog

    @property
    def filter(self):
        """Name of the flux column."""
        return self._filter

    @property
    def wcs(self):
        """World coordinates of the image."""
        return self._wcs

    @property
    def psf(self):
        """The PSF."""
        return self._painter.psf

    @property
    def background(self):
        """The background, or None."""
        return self._background

    @staticmethod
    def _check_background(background):
        if background is None or isinstance(background, Background):
            return background
        if not hasattr(background, "unit"):
            raise argument_error("background", "a Background or a Quantity", repr(background))
        return Background(background)

    def _center_jacobian(self):
        ny, nx = self._shape
        return local_jacobian(self._wcs, np.array([(nx - 1) / 2]), np.array([(ny - 1) / 2]))[0]

    def _pixel_scale(self):
        return float(np.abs(np.linalg.det(self._center_jacobian())) ** -0.5)

    def _check_psf(self, psf, scale):
        meta = getattr(psf, "meta", None) or {}
        if "pixel_scale" in meta:
            have = u.Quantity(meta["pixel_scale"], ANGLE).value
            if abs(have / scale - 1) > 0.03:
                got = f"pixels of {have:.4f} arcsec where the WCS has {scale:.4f}"
                raise argument_error("psf", "on the pixels of the WCS", got)
        if meta.get("frame") == "sky" and meta.get("angle") is not None:
            # the direction on the sky in which +y points
            east, north = np.linalg.inv(self._center_jacobian()) @ [0.0, 1.0]
            angle = np.degrees(np.arctan2(east, north))
            turn = (float(u.Quantity(meta["angle"], u.deg).value) - angle + 180) % 360 - 180
            if abs(turn) > 1:
                got = f"turned by {turn:.1f} deg (see miricigale.psf.rotate_psf)"
                raise argument_error("psf", "in the orientation of the WCS", got)
        have = meta.get("filter")
        if isinstance(have, str):
            # other packages write F770W where we write miri.f770w
            wanted, have = self._filter.lower(), have.lower()
            if have not in (wanted, wanted.rpartition(".")[2]):
                raise argument_error("psf", f"one of the filter {self._filter}", f"one of {have}")

    @functools.cached_property
    def _painted(self):
        """The light in each pixel (uJy), and the table of truth."""
        catalog, shape = self._catalog, self._shape
        ny, nx = shape
        flux = catalog[self._filter].to_value(FNU)
        x, y, near = pixel_positions(self._wcs, catalog["sky"], shape)
        flags = np.zeros(len(catalog), dtype=int)
        inside = near & (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
        flags[~inside] |= SceneFlags.OUTSIDE_IMAGE
        valid = np.isfinite(flux) & (flux >= 0)
        flags[~valid] |= SceneFlags.NO_FLUX
        sersic = catalog["profile"] == "sersic"
        spoilt = (catalog["flags"] & int(CatalogFlags.unusable_profile())) != 0
        flags[sersic & spoilt] |= SceneFlags.DRAWN_AS_POINT
        sersic &= ~spoilt

        use = near & valid
        in_image, kept = np.zeros(len(catalog)), np.ones(len(catalog))
        radius, ratio, theta = np.zeros((3, len(catalog)))
        if np.any(use):
            radius[use], ratio[use], theta[use] = ellipse_to_pixels(
                local_jacobian(self._wcs, x[use], y[use]),
                radius=np.where(sersic, catalog["half_light_radius"].to_value(ANGLE), 0)[use],
                axis_ratio=np.where(sersic, catalog["axis_ratio"], 1.0)[use],
                position_angle=np.nan_to_num(catalog["position_angle"].to_value(u.rad))[use],
            )
        image, in_image[use], kept[use] = self._painter.paint(
            x=x[use],
            y=y[use],
            flux=flux[use],
            is_sersic=sersic[use],
            r_eff=radius[use],
            n=catalog["sersic_index"][use],
            axis_ratio=ratio[use],
            theta=theta[use],
        )
        flags[use & (kept < 0.99)] |= SceneFlags.CUT_PROFILE
        enclosed = self._painter.enclosed_by_psf
        flags[inside & valid & (in_image < 0.95 * flux * kept * enclosed)] |= SceneFlags.NEAR_EDGE
        truth = QTable(
            {
                "id": catalog["id"],
                "sky": catalog["sky"],
                "x": x,
                "y": y,
                "profile": np.where(sersic, "sersic", "point"),
                "flux_total": flux * FNU,
                "flux_in_image": in_image * FNU,
                "flags": flags,
            },
            meta=provenance(filter=self._filter),
        )
        truth["flux_total"].info.description = "light to infinity"
        truth[
            "flux_in_image"
        ].info.description = "light that the image holds, through PSF and edges"
        truth["flags"].info.description = SceneFlags.describe()
        return image, truth

    @property
    def truth(self):
        """
        What is in the image, one row for each row of the catalogue.

        A `~astropy.table.QTable` with ``id``, ``sky``, ``x``, ``y`` (pixels), ``profile`` as
        painted, ``flux_total``, ``flux_in_image`` and ``flags`` (`SceneFlags`).
        """
        return self._painted[1].copy()

    def render(self):
        """
        Make the image.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
            Surface brightness in MJy/sr on the WCS; ``meta["psf_includes"]`` says what of
            the detector is in the PSF already, ``meta["background"]`` the level at the
            centre.
        """
        light = self._painted[0]
        brightness = light * _UJY_TO_MJY / pixel_area_map(self._wcs, self._shape)
        meta = provenance(
            filter=self._filter,
            psf_includes=list(self.psf.meta.get("includes", ())),
            n_sources=len(self._catalog),
        )
        if self._background is not None:
            brightness += self._background.image(self._wcs, self._shape)
            meta["background"] = float(self._background.level.value)
        return CCDData(brightness, unit=SURFACE_BRIGHTNESS, wcs=self._wcs, meta=meta)

    def plot(self, ax=None, *, background=False, sources=False, **kwargs):
        """
        Draw the image, scaled by asinh.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where; the current axes by default.
        background : bool, optional
            Whether the background is in the picture (its gradient hides faint sources).
        sources : bool, optional
            Whether positions are marked.
        **kwargs
            Passed to `~matplotlib.axes.Axes.imshow`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.scene import plot_scene

        truth = self._painted[1]
        marks = None
        if sources:
            shown = (truth["flags"] & int(SceneFlags.OUTSIDE_IMAGE)) == 0
            marks = truth["x"][shown], truth["y"][shown]
        label = f"{self._filter} [MJy/sr]"
        image = self.render().data
        if self._background is not None and not background:
            image = image - self._background.image(self._wcs, self._shape)
        return plot_scene(image, ax=ax, marks=marks, label=label, **kwargs)
