"""Small pictures of sources: the prior, and mosaic, model and residual of each band, many in one file."""

import numpy as np
from astropy.nddata import block_reduce
from astropy.stats import mad_std
from astropy.wcs.utils import proj_plane_pixel_scales
from PIL import Image

from miricigale.plotting.images import asinh_places, filled
from miricigale.utils.parallel import chunks
from miricigale.utils.values import value_class

#: Side of the pictures, and the finest pixels of those of the bands, in arcsec.
BOX = 5.3
FINEST = 0.1
#: Pictures that are made at once, to limit memory.
_AT_ONCE = 1000
#: Shades of gray, and the color of pixels without data.
N_GRAY = 48
NO_DATA = (242, 226, 208)
#: Stretch: asinh of the value over twice the noise, from -3 to at least 10 times the noise.
SOFTENING = 2.0
LOWEST = -3.0
HIGHEST = 10.0


@value_class(repr=False)
class _Panels:
    """
    Images on one grid that are shown with one stretch.

    ``planes`` are padded by ``n``, the side of the pictures in pixels, with NaN; ``sigma`` is the noise of
    a pixel of the last, and the brightest pixel of the middle one ends the stretch.
    """

    planes: tuple
    wcs: object
    shape: tuple
    n: int
    sigma: float

    @classmethod
    def of_images(cls, images, *, finest=0.0):
        """Of images with the mask of the first, averaged to pixels of about ``finest`` arcsec or larger."""
        first = images[0]
        scale = float(proj_plane_pixel_scales(first.wcs)[0] * 3600)
        factor = max(1, round(finest / scale))
        bad = ~np.isfinite(filled(first))
        planes = []
        for image in images:
            planes.append(block_reduce(np.where(bad, np.nan, filled(image)), factor, np.mean))
        n = 2 * round(0.5 * BOX / (factor * scale)) + 1
        sigma = float(mad_std(planes[-1][np.isfinite(planes[-1])]))
        if not sigma > 0:
            # without noise, or data, the brightest pixel makes the stretch
            sigma = float(np.nan_to_num(np.abs(planes[len(planes) // 2])).max()) / 1000 or 1.0
        return cls(
            tuple(np.pad(p.astype(np.float32), n, constant_values=np.nan) for p in planes),
            first.wcs[::factor, ::factor],
            planes[0].shape,
            n,
            sigma,
        )

    def squares(self, sky):
        """Return the pictures about positions, north up: array of shape (n_positions, n_planes, n, n)."""
        half = self.n // 2
        parts = []
        for value, size in zip(self.wcs.world_to_pixel(sky), self.shape[::-1], strict=True):
            # positions far off give pictures of the padding alone
            middle = np.clip(np.nan_to_num(value, nan=-np.inf), -half - 1, size + half)
            parts.append(np.round(middle).astype(int)[:, None] + np.arange(self.n) + self.n - half)
        columns, rows = parts
        squares = [plane[rows[:, :, None], columns[:, None, :]] for plane in self.planes]
        return np.stack(squares, axis=1)[:, :, ::-1]

    def shades(self, sky):
        """
        Return the pictures as shades of gray, dark where bright, and where their stretch ends.

        Returns
        -------
        shades : `~numpy.ndarray` of uint8, shape (n_positions, n_planes, n, n)
            0 (white) to ``N_GRAY`` - 1, and ``N_GRAY`` where there are no data.
        tops : `~numpy.ndarray`, shape (n_positions,)
            Value of the darkest shade.
        """
        squares = self.squares(sky)
        brightest = np.nan_to_num(squares[:, len(self.planes) // 2], nan=-np.inf).max(axis=(1, 2))
        tops = np.maximum(HIGHEST * self.sigma, brightest)
        soft = SOFTENING * self.sigma
        level = asinh_places(squares, LOWEST * self.sigma, tops[:, None, None, None], soft)
        shades = np.clip(np.nan_to_num(level) * N_GRAY, 0, N_GRAY - 1).astype(np.uint8)
        return np.where(np.isfinite(squares), shades, np.uint8(N_GRAY)), tops


class Cutouts:
    """
    Pictures of sources.

    Parameters
    ----------
    prior : `~astropy.nddata.CCDData`
        The high-resolution image.
    bands : dict of str to sequence of `~astropy.nddata.CCDData`
        Mosaic, model and residual of each band, on one grid.
    """

    def __init__(self, prior, bands):
        self.prior = _Panels.of_images([prior])
        self.bands = {
            name: _Panels.of_images(images, finest=FINEST) for name, images in bands.items()
        }

    def describe(self):
        """Tell where the pictures are in a sheet, in pixels, and their stretch: plain values."""
        side = max(panels.n for panels in self.bands.values())
        return {
            "box": BOX,
            "prior": self.prior.n,
            "side": side,
            "height": max(self.prior.n, 3 * side),
            "unit": "MJy/sr",
            "sigma": [float(f"{p.sigma:.3g}") for p in (self.prior, *self.bands.values())],
            "softening": SOFTENING,
            "lowest": LOWEST,
        }

    def on_image(self, sky):
        """Tell whether a picture about each position has data in any band: bool, shape (n,)."""
        is_covered = np.zeros(len(sky), bool)
        # pictures of all sources of a large catalog would not fit in memory
        for part in chunks(len(sky), _AT_ONCE):
            for panels in self.bands.values():
                is_covered[part] |= np.isfinite(panels.squares(sky[part])[:, 0]).any(axis=(1, 2))
        return is_covered

    def sheet(self, sky):
        """
        Return one picture of all positions: a strip for each, with the prior at its left.

        At the right of it each band has a column of mosaic, model and residual, north up, east left.

        Parameters
        ----------
        sky : `~astropy.coordinates.SkyCoord`, shape (n,)
            The positions.

        Returns
        -------
        sheet : `PIL.Image.Image`
            In shades of gray.
        tops : `~numpy.ndarray`, shape (n, n_bands + 1)
            Values at which the stretches of the prior and of each band end, in the unit of the images.
        """
        layout = self.describe()
        side = layout["side"]
        width = self.prior.n + layout["side"] * len(self.bands)
        strips = np.full((len(sky), layout["height"], width), N_GRAY, np.uint8)
        shades, tops = self.prior.shades(sky)
        strips[:, : self.prior.n, : self.prior.n] = shades[:, 0]
        limits = [tops]
        for k, panels in enumerate(self.bands.values()):
            shades, tops = panels.shades(sky)
            limits.append(tops)
            x_start = self.prior.n + k * side
            for row in range(3):
                top = row * side
                strips[:, top : top + panels.n, x_start : x_start + panels.n] = shades[:, row]
        sheet = Image.fromarray(strips.reshape(-1, strips.shape[2]))
        gray = np.repeat(255 - np.round(255 * np.arange(N_GRAY) / (N_GRAY - 1)).astype(int), 3)
        sheet.putpalette(gray.tolist() + list(NO_DATA))
        return sheet, np.transpose(limits)
