"""Galaxy, composite and AGN by the share of the AGN in the infrared."""

import dataclasses

import numpy as np

from miricigale.evaluation.estimates import Estimate, weighted_share
from miricigale.evaluation.metrics import one_by_one
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.tables import described_columns

#: Names in order of rising fracAGN, and the limits between them.
CLASS_NAMES = ("galaxy", "composite", "agn")
CLASS_LIMITS = (0.1, 0.4)


def classify(frac_agn, *, limits=CLASS_LIMITS):
    """
    Return the class of each source from its fracAGN.

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

    Examples
    --------
    >>> from miricigale.evaluation import classify
    >>> classify([0.02, 0.3, 0.8]).tolist()
    ['galaxy', 'composite', 'agn']
    """
    frac_agn = floats(frac_agn)
    bad = (frac_agn < 0) | (frac_agn > 1)
    check_that(not np.any(bad), "frac_agn", "between 0 and 1", frac_agn[bad])
    names = np.array(list(CLASS_NAMES) + ["unknown"])
    index = np.searchsorted(limits, frac_agn, side="right")
    index[~np.isfinite(frac_agn)] = len(CLASS_NAMES)
    return names[index]


def confusion(true, found):
    """
    Tell how many sources of each true class were found in each class.

    Parameters
    ----------
    true, found : array-like of str, shape (n,)
        Classes as `classify` gives them.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each of `CLASS_NAMES`: ``class``, ``n``, a column with the number of sources found
        in each class and as ``unknown``, ``completeness`` (share of the sources of the class that
        were found in it, unknown ones among them) and ``purity`` (share of those found in the class that are of
        it), each with its 68 % (Wilson) interval ``_low`` and ``_high``.

    Examples
    --------
    >>> from miricigale.evaluation import confusion
    >>> true = ["galaxy", "galaxy", "agn", "agn"]
    >>> table = confusion(true, ["galaxy", "agn", "agn", "unknown"])
    >>> print(table["class", "n", "galaxy", "agn", "unknown", "completeness"])
      class    n  galaxy agn unknown completeness
    --------- --- ------ --- ------- ------------
       galaxy   2      1   1       0          0.5
    composite   0      0   0       0          nan
          agn   2      0   1       1          0.5
    """
    true, found = one_by_one(str, true=true, found=found)
    is_class = np.array(CLASS_NAMES)[:, None] == true
    columns = {"class": np.array(CLASS_NAMES), "n": is_class.sum(axis=1)}
    for name in CLASS_NAMES + ("unknown",):
        columns[name] = np.sum(is_class & (found == name), axis=1)
    columns |= quality_columns(selection_quality(true == n, found == n) for n in CLASS_NAMES)
    texts = column_texts("miricigale.evaluation", "confusion")
    return described_columns(columns, texts)


@dataclasses.dataclass(frozen=True)
class SelectionQuality:
    """
    How good a selection is.

    Parameters
    ----------
    completeness, purity : `~miricigale.evaluation.Estimate`
        Share of the wanted sources that are selected, and of the selected that are wanted.

    Examples
    --------
    >>> from miricigale.evaluation import selection_quality
    >>> quality = selection_quality([True, True, False, False], [True, True, True, False])
    >>> print(f"{quality.completeness.value:.2f} {quality.purity.value:.2f}")
    1.00 0.67
    """

    completeness: Estimate
    purity: Estimate


def selection_quality(wanted, selected):
    """
    Return the purity and completeness of a selection.

    They mean something only in a sample with the right share of wanted sources: a realistic field, with
    sources that were not detected as rows that are not selected.

    Parameters
    ----------
    wanted, selected : array-like of bool, shape (n,)
        Whether each source is of the kind, and whether it is selected as such.

    Returns
    -------
    quality : `SelectionQuality`

    Examples
    --------
    >>> from miricigale.evaluation import selection_quality
    >>> quality = selection_quality([True, True, False, False], [True, False, False, False])
    >>> quality.completeness.value, quality.purity.value
    (0.5, 1.0)
    """
    wanted, selected = one_by_one(bool, wanted=wanted, selected=selected)
    n_right = np.count_nonzero(wanted & selected)
    shares = (Estimate.of_fraction(n_right, np.count_nonzero(of)) for of in (wanted, selected))
    return SelectionQuality(*shares)


def sky_quality(galaxies, wanted, selected, weight):
    """
    Return the purity and completeness of a selection in skies in which the same galaxies stand more than once.

    Parameters
    ----------
    galaxies : array-like, shape (n,)
        The galaxy of each source.
    wanted, selected : array-like of bool, shape (n,)
        As for `selection_quality`.
    weight : array-like, shape (n,)
        What each source counts for.

    Returns
    -------
    quality : `SelectionQuality`
        With ``n`` sources, wanted or selected ones; the intervals are those of the galaxies, for the sources of
        one are alike.

    Examples
    --------
    >>> from miricigale.evaluation.classes import sky_quality
    >>> wanted, selected = [True, True, False, False], [True, False, True, False]
    >>> quality = sky_quality([1, 1, 2, 3], wanted, selected, [0.5, 0.5, 0.25, 0.25])
    >>> print(f"{quality.completeness.value:.2f} {quality.purity.value:.2f}")
    0.50 0.67
    """
    wanted, selected = one_by_one(bool, wanted=wanted, selected=selected)
    number = np.unique(galaxies, return_inverse=True)[1]
    shares = []
    for of in (wanted, selected):
        weight_right = np.bincount(number, weight * (wanted & selected))
        weight_all = np.bincount(number, weight * of)
        share = weighted_share(weight_right, weight_all)
        shares.append(dataclasses.replace(share, n=np.count_nonzero(of)))
    return SelectionQuality(*shares)


def quality_columns(qualities):
    """Columns ``completeness`` and ``purity``, each with ``_low`` and ``_high``, of `SelectionQuality`."""
    columns = {}
    qualities = list(qualities)
    for kind in ("completeness", "purity"):
        shares = [getattr(item, kind) for item in qualities]
        for end, key in (("", "value"), ("_low", "low"), ("_high", "high")):
            columns[kind + end] = np.array([getattr(item, key) for item in shares])
    return columns
