"""Tables of a study with several truths."""

import dataclasses
import functools

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.utils.arrays import nans, spread_over
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_shape, check_that
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.units import FNU, ab_magnitude
from miricigale.utils.values import value_class


@value_class
class TruthResults:
    """
    What was found of one truth.

    Parameters
    ----------
    name : str
        Its name.
    frac_agn : float or None
        AGN fraction that all sources were given; None if it differs from source to source.
    truth : `~astropy.table.QTable`
        A row for each source of the catalog: ``id``, ``redshift``, ``frac_agn``, true fluxes by band;
        where there are, ``accretion_power``, ``l_6um``, ``sersic_index`` and ``profile``.
    matched : `~astropy.table.QTable`
        The same rows: measured fluxes, errors (``_err``) and true fluxes (``_true``) of the MIRI bands,
        ``selection`` (0 for sources of the sample) and ``n_detected``.
    fits : dict of str to `~astropy.table.QTable`
        Tables of the fits (`~miricigale.fitting.FitResults.to_table`) by band set (``"none"``, ``"all"``,
        ``"blue"``, ``"red"``), with the rows of the sample.
    field : `~numpy.ndarray` of bool, shape (n,)
        Sources in the field of all bands that could have been found: no stars, with a model.
    crowded : dict of str to `~numpy.ndarray` of bool, shape (n,), optional
        Sources with a bright neighbor, by band.

    Raises
    ------
    ValueError
        If the tables do not have the same sources.

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
    >>> one
    <TruthResults 'agn00', 4 fitted>
    >>> one.redshift_error("all").round(3).tolist()
    [0.0, 0.01, -0.01, 0.4]
    """

    name: str
    frac_agn: float | None
    truth: QTable
    matched: QTable
    fits: dict
    field: np.ndarray
    crowded: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        require_columns(self.truth, ["id", "redshift", "frac_agn"], "truth")
        require_columns(self.matched, ["id", "selection", "n_detected"], "matched")
        ids = np.asarray(self.truth["id"])
        good = np.array_equal(ids, np.asarray(self.matched["id"]))
        check_that(good, "matched", "of the sources of 'truth', row by row", "others")
        check_shape(self.field, ids.shape, "field")
        for name, table in self.fits.items():
            if not np.array_equal(ids[self.sample], np.asarray(table["id"])):
                wanted = "tables of the sample ('selection' 0), row by row"
                raise argument_error("fits", wanted, f"other sources in {name!r}")

    def __repr__(self):
        return f"<TruthResults {self.name!r}, {np.count_nonzero(self.sample)} fitted>"

    @functools.cached_property
    def sample(self):
        """Which sources were fitted: array of bool, shape (n,)."""
        return np.asarray(self.matched["selection"]) == 0

    def true(self, name):
        """Return the true values of the sample."""
        return floats(self.truth[name])[self.sample]

    def fitted(self, band_set, name):
        """Return a column of a fit as plain numbers; NaN throughout if the truth has no such fit."""
        if band_set not in self.fits:
            return nans(np.count_nonzero(self.sample))
        column = self.fits[band_set][name]
        return floats(column)

    def redshift_error(self, band_set):
        """Return (z_fit - z) / (1 + z) of the sample."""
        z = self.true("redshift")
        return (self.fitted(band_set, "redshift_mean") - z) / (1 + z)

    def fraction_error(self, band_set):
        """Return the fitted minus true AGN fraction of the sample."""
        return self.fitted(band_set, "frac_agn_mean") - self.true("frac_agn")

    def power_error(self, band_set):
        """Log of fitted over true accretion power (dex) of the sample; NaN without an AGN."""
        if band_set not in self.fits:
            return nans(np.count_nonzero(self.sample))
        true = self.truth["accretion_power"][self.sample]
        ratio = self.fits[band_set]["accretion_power_mean"] / np.where(true > 0, true, np.nan)
        return np.log10(ratio.to_value(u.one))

    def magnitude_error(self, band):
        """Return the measured minus true magnitude of all sources in a band; NaN where not both are positive."""
        measured = self.matched[band].to_value(FNU)
        true = self.matched[f"{band}_true"].to_value(FNU)
        good = (measured > 0) & (true > 0)
        ratio = np.divide(measured, true, out=nans(true.size), where=good)
        return -2.5 * np.log10(ratio)

    def is_bright(self, band):
        """Tell whether the true flux of all sources is above 5 sigma of the measured one in a band."""
        # by measured flux it would be those that noise made brighter
        return self.matched[f"{band}_true"] > 5 * self.matched[error_column(band)]

    @functools.cached_property
    def shapes(self):
        """Which sources are points and which of low and of high Sersic index: dict of arrays of bool."""
        index = floats(self.truth["sersic_index"])
        point = np.asarray(self.truth["profile"]) == "point"
        return {"point": point, "n < 2": ~point & (index < 2), "n >= 2": ~point & (index >= 2)}

    def of_catalog(self, values):
        """Return the values of the sample at the rows of the catalog, NaN elsewhere."""
        return spread_over(values, self.sample, len(self.truth))


@value_class(repr=False)
class StudyResults:
    """
    What was found of several truths with the same sources.

    Parameters
    ----------
    truths : tuple of `TruthResults`
        In the order of their AGN fractions.
    bands : tuple of str
        MIRI bands.
    prior_band : str, optional
        Band of the magnitudes by which sources are counted.
    limits, etc_limits : dict of str to float, optional
        5-sigma limits (AB) by band: of the error function, by the statistic of the paper, and of the exposure
        time calculator for these exposures.
    extra : dict of str to `Estimate`, optional
        Numbers by key that are of other products: detection, point sources, Source Extractor.

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
    >>> study.at(0.0)
    <TruthResults 'agn00', 4 fitted>
    >>> study.with_agn
    ()
    """

    truths: tuple
    bands: tuple
    prior_band: str = "wfc3.f160w"
    limits: dict = dataclasses.field(default_factory=dict)
    etc_limits: dict = dataclasses.field(default_factory=dict)
    extra: dict = dataclasses.field(default_factory=dict)

    def __repr__(self):
        names = ", ".join(truth.name for truth in self.truths)
        return f"<StudyResults of {names or 'no truth'}: {', '.join(self.bands)}>"

    def at(self, frac_agn):
        """Return the truth of an AGN fraction, or None."""
        for sky in self.truths:
            if sky.frac_agn is not None and np.isclose(sky.frac_agn, frac_agn, atol=1e-6):
                return sky
        return None

    @property
    def with_agn(self):
        """Truths of one AGN fraction above 0."""
        return tuple(sky for sky in self.truths if sky.frac_agn)

    def prior_magnitude(self, sky):
        """Return the AB magnitudes of all sources of a truth in the prior's band."""
        return ab_magnitude(sky.truth[self.prior_band])
