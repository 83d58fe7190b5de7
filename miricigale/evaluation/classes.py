"""Galaxy, composite and AGN by the share of the AGN in the infrared."""

import numpy as np

from miricigale.utils.exceptions import argument_error

__all__ = ["CLASS_LIMITS", "CLASS_NAMES", "class_fractions", "classify"]

#: Names in order of rising fracAGN, and the limits between them.
CLASS_NAMES = ("galaxy", "composite", "agn")
CLASS_LIMITS = (0.1, 0.4)


def classify(frac_agn, *, limits=CLASS_LIMITS):
    """
    Class of each source from its fracAGN.

    Parameters
    ----------
    frac_agn : array-like, shape (n,)
        AGN share of the infrared luminosity, 0 to 1; NaN gives ``"unknown"``.
    limits : tuple of float, optional
        Limits between galaxy and composite, and composite and AGN.

    Returns
    -------
    classes : `~numpy.ndarray` of str, shape (n,)

    References
    ----------
    Yang et al. 2021, ApJ 908, 144, section 5; Kirkpatrick et al. 2017, ApJ 849, 111.
    """
    frac_agn = np.asarray(frac_agn, float)
    if np.any((frac_agn < 0) | (frac_agn > 1)):
        raise argument_error(
            "frac_agn", "between 0 and 1", f"{np.nanmin(frac_agn)} to {np.nanmax(frac_agn)}"
        )
    names = np.array([*CLASS_NAMES, "unknown"])
    index = np.searchsorted(limits, frac_agn, side="right")
    index[~np.isfinite(frac_agn)] = len(CLASS_NAMES)
    return names[index]


def class_fractions(frac_agn, **kwargs):
    """
    Share of the sources in each class.

    Returns
    -------
    fractions : dict of str to float
        For each name of `CLASS_NAMES`; sources without a value are left out.
    """
    classes = classify(frac_agn, **kwargs)
    known = classes[classes != "unknown"]
    return {name: float(np.mean(known == name)) if known.size else np.nan for name in CLASS_NAMES}
