"""Chains and axes of published studies."""

import numpy as np

from miricigale.sed import components as c
from miricigale.sed.component import COMPONENTS
from miricigale.utils.exceptions import argument_error

__all__ = ["yang2021_axes", "yang2021_components"]


def yang2021_components(*, agn=True, igm="meiksin2006"):
    """Components of the chain of Yang et al. 2021, from the bundled libraries."""
    parts = [
        c.DelayedSFH(),
        c.BC03(),
        c.CalzettiLeitherer(),
        c.DraineLi2007Alpha(),
        COMPONENTS.get(igm)(),
    ]
    if agn:
        parts.append(c.ParametricTorus())
    return parts


def yang2021_axes(kind="fit"):
    """
    Axes of the grids of Yang et al. 2021 (table 1 and 3).

    Parameters
    ----------
    kind : {"fit", "galaxy", "quick"}
        ``"fit"``: the grid of the fits, 560 galaxies, 60 AGN, 11 fractions, 65 redshifts;
        ``"galaxy"``: the same without AGN; ``"quick"``: a thinner one, 96 galaxies, 9 AGN
        (polar dust at 100 and 300 K), 6 fractions, 33 redshifts.

    Returns
    -------
    axes : dict of str to `~numpy.ndarray`
        In the units of the parameters (Gyr, mag, K); to be changed at will.
    """
    if kind not in ("fit", "galaxy", "quick"):
        raise argument_error("kind", "'fit', 'galaxy' or 'quick'", repr(kind))
    if kind == "quick":
        return {
            "tau": np.array([0.1, 1.0, 5.0]),
            "age": np.array([0.5, 1.0, 3.0, 5.0]),
            "ebv": np.array([0.1, 0.3, 0.5, 0.9]),
            "alpha": np.array([1.5, 2.5]),
            "tau97": np.array([3.0, 7.0, 11.0]),
            "ebv_polar": np.array([0.0, 0.2]),
            "temperature_polar": np.array([100.0, 300.0]),
            "frac_agn": np.array([0.0, 0.2, 0.4, 0.6, 0.8, 0.99]),
            "redshift": _redshifts(0.06),
        }
    axes = {
        "tau": np.array([0.1, 0.5, 1.0, 5.0]),
        "age": np.array([0.5, 1.0, 3.0, 5.0, 7.0]),
        "ebv": np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9]),
        "alpha": np.array([1.0, 1.5, 2.0, 2.5]),
    }
    if kind == "fit":
        axes |= {
            "tau97": np.array([3.0, 5.0, 7.0, 9.0, 11.0]),
            "ebv_polar": np.array([0.0, 0.1, 0.2, 0.3]),
            "temperature_polar": np.array([100.0, 200.0, 300.0]),
            "frac_agn": np.append(np.round(np.arange(10) * 0.1, 10), 0.99),
        }
    return axes | {"redshift": _redshifts(0.03)}


def _redshifts(step, first=0.01, last=6.0):
    n = int(np.floor(np.log((1.0 + last) / (1.0 + first)) / step)) + 1
    return (1.0 + first) * np.exp(step * np.arange(n)) - 1.0
