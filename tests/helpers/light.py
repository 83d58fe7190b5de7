"""Gaussian light in closed form."""

import numpy as np
from scipy.special import erf


def gaussian(dx, dy, sigma):
    """Surface density of a round Gaussian of unit light at distances from its middle."""
    return np.exp(-0.5 * (dx**2 + dy**2) / sigma**2) / (2 * np.pi * sigma**2)


def gaussian_image(n, sigma, x=0.0, y=0.0):
    """A Gaussian in n x n pixels, x and y off their middle, not integrated over the pixels."""
    axis = np.arange(n) - (n - 1) / 2
    return gaussian(axis - x, (axis - y)[:, None], sigma)


def pixel_gaussian(n, center, sigma, step=1.0):
    """Light of a one-dimensional Gaussian in n intervals of unit width, ``step`` apart."""
    at = (np.arange(n) - center) * step
    return 0.5 * (erf((at + 0.5) / sigma / 2**0.5) - erf((at - 0.5) / sigma / 2**0.5))
