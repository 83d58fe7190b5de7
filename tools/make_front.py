"""
Make the picture of the front page from a run with all six bands.

    miricigale run goodss --set exposures.kind=rates -o RUN
    python tools/make_front.py RUN

writes docs/images/front_field.png: F770W in blue, the mean of F1000W and F1280W in green, that of
F1500W and F1800W in red, each scaled to the median flux of its bright pixels.
"""

import argparse
from pathlib import Path

import numpy as np
from astropy.visualization import make_lupton_rgb
from matplotlib.image import imsave
from scipy.ndimage import gaussian_filter

from miricigale.instrument.image_files import read_image

BANDS = {"red": ("f1500w", "f1800w"), "green": ("f1000w", "f1280w"), "blue": ("f770w",)}
#: Rows and columns of the picture, and how much of the color is kept.
SHAPE, SATURATION = (520, 1400), 0.65


def plane(path):
    """A mosaic without its sky, slightly smoothed, in units of the median of its bright pixels."""
    data = read_image(path).data
    data = gaussian_filter(np.nan_to_num(data - np.nanmedian(data)), 1.6)
    noise = 1.4826 * np.median(np.abs(data[data != 0]))
    return data / np.median(data[data > 8 * noise])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    mosaics = parser.parse_args().run / "agn00"
    colors = [
        np.mean([plane(mosaics / f"mosaic_miri.{band}_fine.fits") for band in bands], axis=0)
        for bands in BANDS.values()
    ]
    gray = np.mean(colors, axis=0)
    # east up: the field is longer from north to south
    colors = [np.rot90(SATURATION * one + (1 - SATURATION) * gray) for one in colors]
    rows, columns = np.nonzero(colors[2])
    middle = int(np.median(rows)), int(np.median(columns))
    cut = tuple(slice(m - n // 2, m + n // 2) for m, n in zip(middle, SHAPE, strict=True))
    colors = [one[cut] for one in colors]
    noise = 1.4826 * np.median(np.abs(colors[0]))
    picture = make_lupton_rgb(*colors, minimum=0.5 * noise, stretch=0.8, Q=6)
    imsave(Path(__file__).parents[1] / "docs" / "images" / "front_field.png", picture)


if __name__ == "__main__":
    main()
