"""Images that astropy can write."""

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, Cutout2D, NoOverlapError
from astropy.wcs.utils import proj_plane_pixel_scales

from miricigale.filters import find_filter
from miricigale.instrument.dq import dq_planes
from miricigale.instrument.header_wcs import as_wcs
from miricigale.instrument.image_planes import standard_deviation
from miricigale.instrument.product_files import jwst_product, write_product
from miricigale.utils.exceptions import argument_error
from miricigale.utils.interactive import Interactive
from miricigale.utils.meta import fits_meta
from miricigale.utils.options import check_that
from miricigale.utils.positions import as_position
from miricigale.utils.units import ANGLE


class Image(Interactive, CCDData):
    """
    An `~astropy.nddata.CCDData` whose meta may hold more than a FITS header does.

    ``write`` and ``to_hdu`` put numbers and short text on cards, and all of it as JSON on the card ``META``; the
    data are the primary HDU, with uncertainty (as standard deviation) and mask as extensions, as astropy has
    them, and flags as JWST has them (``DQ``).

    Parameters
    ----------
    *args, **kwargs
        As for `~astropy.nddata.CCDData`.
    filter : str or `~miricigale.filters.Filter`, optional
        Filter of the image, kept as ``meta["filter"]``.
    wcs : `~astropy.wcs.WCS` or `~astropy.io.fits.Header`, optional
        World coordinates; those of a header are read from it.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.instrument import Image
    >>> image = Image(np.ones((4, 4)), unit="MJy/sr", filter="F770W", meta={"dithers": [0, 1]})
    >>> image
    <Image 4 x 4, MJy / sr, miri.f770w>
    >>> image.write("image.fits")  # doctest: +SKIP
    >>> image.meta["dithers"]
    [0, 1]
    """

    def __init__(self, *args, filter=None, wcs=None, **kwargs):
        if isinstance(wcs, fits.Header):
            wcs = as_wcs(wcs)
        super().__init__(*args, wcs=wcs, **kwargs)
        if filter is not None:
            name = str(getattr(filter, "name", filter))
            # a filter of the user's own has its own name
            self.meta["filter"] = find_filter(name) or name

    def __repr__(self):
        if self.ndim == 0:
            # a sum or a mean of pixels
            return f"<Image {self.data} {self.unit}>"
        facts = [f"{self.shape[0]} x {self.shape[1]}" if self.ndim == 2 else str(self.shape)]
        facts += [str(self.unit), str(self.meta.get("filter") or "")]
        if self._has_sky:
            facts.append(self._center.to_string("hmsdms", precision=1))
        return f"<Image {', '.join(fact for fact in facts if fact)}>"

    __str__ = __repr__

    @property
    def _has_sky(self):
        return self.ndim == 2 and self.wcs is not None and self.wcs.has_celestial

    @property
    def _center(self):
        ny, nx = self.shape
        return self.wcs.pixel_to_world(nx / 2 - 0.5, ny / 2 - 0.5)

    @property
    def pixel_scale(self):
        """Side of a pixel, arcsec: the mean of the two axes."""
        check_that(self._has_sky, "image", "one with celestial world coordinates", repr(self))
        scales = proj_plane_pixel_scales(self.wcs.celestial)
        return (np.sqrt(np.prod(scales)) * u.deg).to(ANGLE)

    @property
    def filter(self):
        """Name of the filter; None if ``meta`` has none."""
        return self.meta.get("filter")

    @property
    def pixel_area(self):
        """Area of a pixel, arcsec2: that of the mean scale."""
        return self.pixel_scale**2

    @property
    def err(self):
        """Standard deviations as an array, in the unit of the image; None without an uncertainty."""
        if self.uncertainty is None:
            return None
        return standard_deviation(self).array

    def cutout(self, position, size):
        """
        Cut a rectangle out, with its world coordinates, uncertainty and mask.

        Parameters
        ----------
        position : `~astropy.coordinates.SkyCoord`, pair or str
            Center on the sky; text such as ``"150.1 +2.2"`` or a pair is right ascension and declination.
        size : `~astropy.units.Quantity` or pair
            Side, or sides along y and x, as angles or in pixels. At the edge of the image the part that is on it
            is cut out.

        Returns
        -------
        image : `Image`

        Raises
        ------
        ValueError
            If the image has no celestial world coordinates, or the rectangle is not on it.
        """
        check_that(self._has_sky, "image", "one with celestial world coordinates", repr(self))
        position = as_position(position, "position")
        try:
            part = Cutout2D(self.data, position, size, wcs=self.wcs)
        except NoOverlapError:
            raise argument_error("position", "one on the image", position.to_string()) from None
        return self[part.slices_original]

    def _facts(self):
        ny, nx = self.shape
        entries = {} if self.mask is None else {"masked": f"{100 * np.mean(self.mask):.3g} %"}
        if self._has_sky:
            entries["center"] = self._center.to_string("hmsdms")
        shown = ("filter", "subarray", "n_exposures", "exposure_time", "background", "steps")
        entries |= {name.replace("_", " "): self.meta[name] for name in shown if name in self.meta}
        return {"pixels": f"{ny} x {nx}", "unit": self.unit, **entries}

    def plot(self, ax=None, **kwargs):
        """
        Draw the image, scaled by asinh.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where; the current axes by default.
        **kwargs
            Passed to `~matplotlib.axes.Axes.imshow`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.axes import plain_text
        from miricigale.plotting.scene import plot_scene

        label = f"{plain_text(self.meta.get('filter') or '')} ({self.unit})".strip()
        return plot_scene(self.data, ax=ax, label=label, **kwargs)

    def write(self, path, *args, overwrite=False, **kwargs):
        """
        Write the image; see `astropy.nddata.CCDData.write`.

        Parameters
        ----------
        path : path-like
            The file. One named as a product of JWST (``x_rate.fits``, ``x_cal.fits``, ``x_i2d.fits``) has JWST's
            layout, as `miricigale.reduction.write_image` writes it.
        overwrite : bool, optional
            Whether a file of this name may be replaced.
        *args, **kwargs
            Others of `astropy.nddata.CCDData.write`, such as ``format``; not for products of JWST.

        Raises
        ------
        OSError
            If the file exists and ``overwrite`` is False.
        ValueError
            If the image is none that the name promises: ramps, another unit, a filter that is not MIRI's.
        """
        if jwst_product(path) is not None:
            names = [repr(value) for value in args] + list(kwargs)
            check_that(
                not names,
                "path",
                "another name for a file with options of CCDData.write",
                ", ".join(names),
            )
            write_product(self, path, overwrite=overwrite)
            return
        if overwrite:
            kwargs["overwrite"] = True
        super().write(path, *args, **kwargs)

    def to_hdu(self, *args, **kwargs):
        """Return the HDUs that ``write`` writes; see `astropy.nddata.CCDData.to_hdu`."""
        ccd = CCDData(self, copy=False)
        ccd.flags = None
        if self.uncertainty is not None:
            ccd.uncertainty = standard_deviation(self)
        ccd.meta = fits.Header(fits_meta(self.meta))
        hdus = ccd.to_hdu(*args, **kwargs)
        if self.flags is not None:
            planes = dq_planes(np.asarray(self.flags))
            hdus += [fits.ImageHDU(plane, legend, name=name) for name, plane, legend in planes]
        return hdus
