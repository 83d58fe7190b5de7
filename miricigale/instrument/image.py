"""Images that astropy can write."""

from astropy.io import fits
from astropy.nddata import CCDData

from miricigale.utils.meta import fits_meta


class Image(CCDData):
    """
    An `~astropy.nddata.CCDData` whose meta may hold more than a FITS header does.

    ``write`` and ``to_hdu`` put numbers and short text on cards, and all of it as JSON on the card ``META``; the
    data are the primary HDU, with uncertainty and mask as extensions, as astropy has them.
    """

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
        from miricigale.plotting.scene import plot_scene

        label = f"{self.meta.get('filter') or ''} [{self.unit.to_string('vounit')}]".strip()
        return plot_scene(self.data, ax=ax, label=label, **kwargs)

    def to_hdu(self, *args, **kwargs):
        """The HDUs that ``write`` writes; see `astropy.nddata.CCDData.to_hdu`."""
        plain = CCDData(self, copy=False)
        plain.meta = fits.Header(fits_meta(self.meta))
        return plain.to_hdu(*args, **kwargs)
