"""Tables of a study: its numbers, the classes that are found, selections."""

import numpy as np

from miricigale.evaluation.classes import (
    CLASS_LIMITS,
    classify,
    confusion,
    quality_columns,
    selection_quality,
)
from miricigale.evaluation.quantities import OF_FITS, REDSHIFT_BINS, measure
from miricigale.utils.missing_values import floats
from miricigale.utils.package_tables import column_texts
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_columns, described_rows


def study_numbers(study, *, seed, n_draws=500):
    """
    Return all numbers of the fits: each truth, each band set, whole sample and bins of redshift.

    Parameters
    ----------
    study : `StudyResults`
        The tables.
    seed : int
        Of the bootstrap; each number has its own stream.
    n_draws : int, optional
        Draws of the bootstrap.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``truth``, ``band_set``, ``quantity``, ``z_low``, ``z_high``, ``value``, ``low``, ``high`` (68 %), ``n``
        and ``completeness``, the share of the sources of the field that the number is of.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import StudyResults, TruthResults
    >>> ids, zero = np.arange(4), np.zeros(4)
    >>> truth = QTable({"id": ids, "redshift": zero + 1, "frac_agn": zero})
    >>> matched = QTable({"id": ids, "selection": zero, "n_detected": zero + 2})
    >>> fit = QTable({"id": ids, "redshift_mean": [1.0, 1.02, 0.98, 1.8]})
    >>> fit["frac_agn_mean"] = [0.01, 0.03, 0.02, 0.3]
    >>> fit["frac_agn_std"] = 0.05
    >>> field = np.ones(4, bool)
    >>> one = TruthResults("agn00", 0.0, truth, matched, {"all": fit}, field)
    >>> study = StudyResults((one,), ("miri.f770w",))
    >>> from miricigale.evaluation import study_numbers
    >>> table = study_numbers(study, seed=1, n_draws=50)
    >>> print(table["band_set", "quantity", "value", "n"][0])
    band_set  quantity  value  n
    -------- ---------- ----- ---
         all z_outliers  0.25   4
    """
    seed = check_seed(seed)
    rows = []
    names = [name for name in OF_FITS if not name.endswith("_ratio")]
    for sky in study.truths:
        for band_set in sky.fits:
            for quantity in names:
                of_power = quantity.startswith("power")
                if of_power and "accretion_power" not in sky.truth.colnames:
                    continue
                # bins of redshift after the whole sample; powers are of few sources
                options = [None]
                if not of_power:
                    options += REDSHIFT_BINS
                for option in options:
                    key = stream(seed, "numbers", sky.name, band_set, quantity, str(option))
                    estimate = measure(
                        study,
                        quantity,
                        truth=sky,
                        band_set=band_set,
                        option=option,
                        seed=key,
                        n_draws=n_draws,
                    )
                    z_low, z_high = option or (0.0, np.inf)
                    row = {"truth": sky.name, "band_set": band_set, "quantity": quantity}
                    row |= {"z_low": z_low, "z_high": z_high}
                    rows.append(row | estimate.columns())
    return described_rows(rows, column_texts("miricigale.evaluation", "numbers"))


def study_confusion(study, band_set="all"):
    """
    Return the classes found of the sources of each true class, of all truths with one AGN fraction together.

    Parameters
    ----------
    study : `StudyResults`
        The tables.
    band_set : str, optional
        Which fit.

    Returns
    -------
    table : `~astropy.table.QTable`
        As `~miricigale.evaluation.confusion`: sources of the field that were not fitted are ``unknown``.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import StudyResults, TruthResults
    >>> ids, zero = np.arange(4), np.zeros(4)
    >>> truth = QTable({"id": ids, "redshift": zero + 1, "frac_agn": zero})
    >>> matched = QTable({"id": ids, "selection": zero, "n_detected": zero + 2})
    >>> fit = QTable({"id": ids, "redshift_mean": [1.0, 1.02, 0.98, 1.8]})
    >>> fit["frac_agn_mean"] = [0.01, 0.03, 0.02, 0.3]
    >>> fit["frac_agn_std"] = 0.05
    >>> field = np.ones(4, bool)
    >>> one = TruthResults("agn00", 0.0, truth, matched, {"all": fit}, field)
    >>> study = StudyResults((one,), ("miri.f770w",))
    >>> from miricigale.evaluation import study_confusion
    >>> print(study_confusion(study)["class", "n", "galaxy", "composite", "agn"])
      class    n  galaxy composite agn
    --------- --- ------ --------- ---
       galaxy   4      3         1   0
    composite   0      0         0   0
          agn   0      0         0   0
    """
    true = [np.empty(0, str)]
    inferred = [np.empty(0, str)]
    for sky in study.truths:
        if sky.frac_agn is None or band_set not in sky.fits:
            continue
        true.append(classify(floats(sky.truth["frac_agn"]))[sky.field])
        # "unknown" of those not in the sample
        mean = sky.of_catalog(sky.fitted(band_set, "frac_agn_mean"))[sky.field]
        inferred.append(classify(np.clip(mean, 0, 1)))
    return confusion(np.concatenate(true), np.concatenate(inferred))


def selection_table(sky, *, limits=CLASS_LIMITS):
    """
    Return the purity and completeness of selections by the fitted AGN fraction in a realistic field.

    Parameters
    ----------
    sky : `TruthResults`
        A truth whose AGN have the numbers and luminosities of a real field.
    limits : tuple of float, optional
        Sources whose true AGN fraction is at least this are wanted. Selected are those whose fraction is at least
        this with a probability of one half: the median of the posterior, ``frac_agn_p50``. Sources that were not
        fitted are not selected.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each band set and limit: ``band_set``, ``limit``, ``n_wanted``, ``n_selected``,
        ``completeness``, ``purity`` and their 68 % (Wilson) intervals ``_low`` and ``_high``.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import StudyResults, TruthResults
    >>> ids, zero = np.arange(4), np.zeros(4)
    >>> truth = QTable({"id": ids, "redshift": zero + 1, "frac_agn": zero})
    >>> matched = QTable({"id": ids, "selection": zero, "n_detected": zero + 2})
    >>> fit = QTable({"id": ids, "redshift_mean": [1.0, 1.02, 0.98, 1.8]})
    >>> fit["frac_agn_mean"] = [0.01, 0.03, 0.02, 0.3]
    >>> fit["frac_agn_p50"] = fit["frac_agn_mean"]
    >>> field = np.ones(4, bool)
    >>> one = TruthResults("agn00", 0.0, truth, matched, {"all": fit}, field)
    >>> from miricigale.evaluation import selection_table
    >>> table = selection_table(one, limits=[0.1])
    >>> print(table["band_set", "limit", "n_wanted", "n_selected", "purity"])
    band_set limit n_wanted n_selected purity
    -------- ----- -------- ---------- ------
         all   0.1        0          1    0.0
    """
    true = floats(sky.truth["frac_agn"])[sky.field]
    columns = {"band_set": [], "limit": []}
    qualities = []
    for band_set in sky.fits:
        median = sky.of_catalog(sky.fitted(band_set, "frac_agn_p50"))[sky.field]
        for limit in limits:
            columns["band_set"].append(band_set)
            columns["limit"].append(limit)
            # NaN is below every limit
            qualities.append(selection_quality(true >= limit, median >= limit))
    columns["n_wanted"] = [quality.completeness.n for quality in qualities]
    columns["n_selected"] = [quality.purity.n for quality in qualities]
    columns |= quality_columns(qualities)
    return described_columns(columns, column_texts("miricigale.evaluation", "selection"))
