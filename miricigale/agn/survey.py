"""AGN of a survey: fits of a catalog, and of the same with AGN of known luminosity."""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.agn.fitted_sample import FittedSample
from miricigale.agn.injections import Injections
from miricigale.agn.numbers import FLOOR, SampleNumbers, prior_table
from miricigale.agn.shares import draw_shares
from miricigale.evaluation.classes import CLASS_LIMITS
from miricigale.fitting import AGNBins
from miricigale.fitting.catalogs.classes import fit_classes
from miricigale.fitting.data.template_error import pivots
from miricigale.utils.arrays import spread_over
from miricigale.utils.exceptions import CatalogWarning, warn
from miricigale.utils.files import make_folder
from miricigale.utils.interactive import Interactive
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.random import check_seed
from miricigale.utils.table_files import write_table
from miricigale.utils.tables import described_columns
from miricigale.utils.units import check_count, is_number, positive
from miricigale.utils.values import value_class

#: Default bins of redshift and of log10 of the luminosity in erg/s.
REDSHIFT = (0.0, 1.0, 2.0, 4.0)
LOG_LUMINOSITY = (43.0, 44.0, 45.0, 46.0)
#: Files that a run writes besides the folders of fits.
FILES = ("numbers.ecsv", "totals.ecsv", "prior.ecsv", "sources.ecsv", "injected.ecsv")
#: Objects for each square arcmin that no catalog has: the deepest fields of JWST have about 1000.
MAX_DENSITY = 3000.0
#: Wavelength in um from which bands observe the dust of an AGN at the redshifts of most catalogs.
MIN_WAVELENGTH = 5.0
#: Solid angle of the whole sky in square degrees.
_SKY = (4.0 * np.pi * u.sr).to_value(u.deg**2)


@value_class
class AGNResult(Interactive):
    """
    AGN of a survey; made by `AGNSurvey.run`.

    Attributes
    ----------
    numbers : `~astropy.table.QTable`
        A row for each bin of redshift and luminosity: ``n`` AGN with a fraction of 0.1 or more by the measured
        prior and ``n_shipped`` by that of the fits, the share ``obscured`` of them, the luminosity function
        ``density``, the selection function ``completeness``, and ``n_selected``, ``purity``, ``n_corrected`` of
        selected objects. ``constrained`` is false where most of the injected AGN have smaller fractions,
        or fewer than 10 % of those from the limit on are selected.
    totals : `~astropy.table.QTable`
        The same of all AGN with a fraction of 0.1 or more, and of those from the limit on.
    prior : `~astropy.table.QTable`
        Prior of the AGN fraction as shipped and as measured, for all redshifts and by redshift.
    sources : `~astropy.table.QTable`
        A row for each object of the catalog: whether it is selected, and its probabilities of being an AGN.
    injected : `~astropy.table.QTable`
        A row for each injected AGN, with what was fitted.
    meta : dict
        Settings.
    """

    numbers: QTable
    totals: QTable
    prior: QTable
    sources: QTable
    injected: QTable
    meta: dict

    def __repr__(self):
        n_agn = np.count_nonzero(self.sources["selected"])
        return f"<AGNResult {len(self.sources)} sources, {n_agn} selected AGN>"

    def _facts(self):
        facts = {"sources": len(self.sources), "selected AGN": int(self.totals["n_selected"][0])}
        for row in self.totals:
            interval = f"{row['n_low']:.0f} to {row['n_high']:.0f}"
            facts[f"AGN with fracAGN >= {row['frac_agn']:g}"] = f"{row['n']:.0f} ({interval})"
        return facts

    def write(self, folder, *, overwrite=False):
        """
        Write the tables into a folder.

        Parameters
        ----------
        folder : path-like
            The folder, which exists.
        overwrite : bool, optional
            Whether tables that are there are replaced.

        Raises
        ------
        OSError
            If a table is there and ``overwrite`` is not set.
        """
        tables = (self.numbers, self.totals, self.prior, self.sources, self.injected)
        for name, table in zip(FILES, tables, strict=True):
            write_table(table, Path(folder) / name, overwrite=overwrite)


class AGNSurvey:
    """
    Numbers of AGN in a catalog of photometry, with a selection function.

    Parameters
    ----------
    area : `~astropy.units.Quantity`
        Solid angle of the survey.
    redshift : tuple of float, optional
        Edges of the bins of redshift.
    log_luminosity : tuple of float, optional
        Edges of the bins of luminosity: log10 of that of the accretion disk over all directions in erg/s. Above
        the last edge there is another bin.
    limit : float, optional
        AGN fraction, by the posterior's median, from which an object is selected as an AGN; from 0.1 to below 1.
    n_injections : int, optional
        Most AGN that are added to the photometry; 0 leaves the selection function out. By default as many as the
        catalog has objects, but 200 at least.
    completeness_error : float, optional
        Error of the completeness of a bin with which no more AGN are added to it; 0: as many as may be.
    injected_models : int, optional
        Largest effective number of models between the nodes for each injected AGN (``interpolate`` of the fits).
        Fewer than for the catalog suffice to say whether it is selected.
    n_draws : int, optional
        Draws of the numbers.
    seed : int, optional
        Seed of the injected AGN, their noise and the draws.

    Raises
    ------
    ValueError, `~astropy.units.UnitsError`
        If a value is of the wrong kind or outside its limits.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.agn import AGNSurvey
    >>> survey = AGNSurvey(25 * u.arcmin**2, redshift=(0.5, 1.5, 3.0), seed=1)
    >>> result = survey.run("catalog.fits", "agn")  # doctest: +SKIP
    >>> result.numbers["redshift_low", "log_luminosity_low", "n", "completeness"]  # doctest: +SKIP
    """

    def __init__(
        self,
        area,
        *,
        redshift=REDSHIFT,
        log_luminosity=LOG_LUMINOSITY,
        limit=CLASS_LIMITS[1],
        n_injections=None,
        completeness_error=0.02,
        injected_models=100,
        n_draws=2000,
        seed=1,
    ):
        self.area = positive(area, u.deg**2, "area")
        check_that(
            self.area <= 1.000001 * _SKY, "area", f"at most the sky of {_SKY:.0f} deg2", area
        )
        good = is_number(limit) and CLASS_LIMITS[0] <= limit < 1
        check_that(good, "limit", f"from {CLASS_LIMITS[0]:g} to below 1", limit)
        self.limit = float(limit)
        edges = sorted(set(AGNBins(redshift, log_luminosity).frac_agn) | {FLOOR, self.limit})
        self.bins = AGNBins(redshift, log_luminosity, tuple(edges))
        self.n_injections = n_injections
        if n_injections is not None:
            self.n_injections = check_count(n_injections, "n_injections", least=0)
        good = is_number(completeness_error) and 0 <= completeness_error < 1
        check_that(good, "completeness_error", "from 0 to below 1", completeness_error)
        self.completeness_error = float(completeness_error)
        self.injected_models = check_count(injected_models, "injected_models")
        self.n_draws = check_count(n_draws, "n_draws")
        self.seed = check_seed(seed)

    def __repr__(self):
        return f"<AGNSurvey of {self.area:.4g} deg2: frac_agn from {self.limit:g}>"

    def run(self, path, output, *, images=None, **options):
        """
        Fit a catalog, and the same with AGN added to it, and count AGN.

        Parameters
        ----------
        path : path-like
            The catalog.
        output : path-like
            Folder: ``fits`` and ``injected`` in it hold the fits, which a later call resumes; the tables of the
            result and ``page.html`` are made anew.
        images : `AGNImages`, optional
            Images of the field, whose photometry has the ids of the catalog: AGN are injected into them and
            measured in their bands, and added to the photometry of other bands alone.
        **options
            As for `~miricigale.fitting.catalogs.classes.fit_classes`, with which both are fitted alike.

        Returns
        -------
        result : `AGNResult`

        Raises
        ------
        ValueError
            If models between nodes are left out (``interpolate=0``), the models have no AGN fraction, or nothing
            was fitted.
        `~miricigale.utils.exceptions.OtherResultsError`
            If the folder has fits of another catalog, of other settings or of other injected AGN.
        """
        output = Path(output)
        check_that(options.get("interpolate", 1), "interpolate", "above 0 for numbers of AGN", 0)
        fits = fit_classes(path, output / "fits", agn_bins=self.bins, **options)
        sample = FittedSample.of_fits(fits, self.bins, self.limit)
        check_that(sample.used.any(), "path", "a catalog of which objects can be fitted", "none")
        self.warn_of_density(len(sample))
        _warn_of_bands(fits["galaxy"])
        injections = Injections(self, path, fits, sample, output, images, options)
        result = self._result(sample, injections)
        make_folder(output)
        result.write(output, overwrite=True)
        from miricigale.agn.page import write_page

        write_page(result, output / "page.html", Path(path).name)
        return result

    def warn_of_density(self, n):
        """
        Warn of an area that is too small for a catalog, as of a wrong unit.

        Parameters
        ----------
        n : int
            Objects of the catalog.
        """
        area = (self.area * u.deg**2).to_value(u.arcmin**2)
        density = n / area
        if density > MAX_DENSITY:
            text = f"{n} objects in {area:.4g} square arcmin are {density:.3g} for each, and the deepest fields"
            warn(f"{text} have about 1000: is the area right?", CatalogWarning)

    # ---------------------------------------------------------------------- result

    def _result(self, sample, injections):
        injected = injections.table()
        bins = self.bins
        prior = bins.prior(sample.axis)
        table = sample.tables["galaxy"][sample.used]
        other_classes = sample.other_classes()
        options = {"n_draws": self.n_draws, "seed": self.seed, "others": other_classes}
        draws = draw_shares(table, prior, **options)
        all_redshifts = draw_shares(
            table.sum(axis=1, keepdims=True), prior, **options | {"others": None}
        )
        shipped = sample.shipped()
        shipped_numbers = {}
        for name, weights in shipped.items():
            if weights.ndim > 1:
                shipped_numbers[name] = weights.sum(axis=0)
        first = bins.frac_agn.index(self.limit) + 1
        probability = {
            "agn_probability": _agn_probability(draws.probability, first),
            "agn_probability_shipped": _agn_probability(shipped, first),
        }
        sources = _table_of_sources(sample, probability)
        selected = sample.selected & sample.used
        pure = {}
        for name in probability:
            weight = np.nan_to_num(np.asarray(sources[name]))
            pure[name] = self._counts(sample.redshift, sample.log_luminosity, selected, weight)
        numbers = SampleNumbers(
            bins=bins,
            limit=self.limit,
            floor=FLOOR,
            draws=draws,
            shipped=shipped_numbers,
            area=self.area,
            n_all=len(sample),
            n_used=int(sample.used.sum()),
            selected=self._counts(sample.redshift, sample.log_luminosity, selected),
            pure=pure["agn_probability"],
            pure_shipped=pure["agn_probability_shipped"],
            injected=self._injected_counts(injected),
            seed=self.seed,
        )
        return AGNResult(
            numbers=numbers.by_luminosity(),
            totals=numbers.totals(),
            prior=prior_table(bins, prior, draws, all_redshifts),
            sources=sources,
            injected=injected,
            meta=self._meta(sample, injections),
        )

    def _meta(self, sample, injections):
        """Return what the result says of its making."""
        return {
            "area_deg2": float(self.area),
            "limit": self.limit,
            "seed": self.seed,
            "redshift_column": injections.options.get("redshift"),
            "n_all": len(sample),
            "n_used": int(sample.used.sum()),
            "classes": list(sample.tables),
            "n_most": injections.n_most,
            "completeness_error": self.completeness_error,
            "injected_models": injections.n_models,
            "photon_noise": injections.photon_noise(),
        }

    def _injected_counts(self, injected):
        """Injected AGN by redshift and luminosity: all, and those that count; see `SampleNumbers`."""
        fraction = np.asarray(injected["frac_agn"], float)
        selected = np.asarray(injected["selected"], bool)
        chosen = {
            "all": np.ones(len(injected), bool),
            "above": fraction >= FLOOR,
            "limit": fraction >= self.limit,
            "selected": selected,
            "right": selected & (fraction >= self.limit),
        }
        counts = {}
        for name, rows in chosen.items():
            counts[name] = self._counts(injected["redshift"], injected["log_luminosity"], rows)
        return counts

    def _counts(self, redshift, log_luminosity, chosen, weight=None):
        """Numbers of objects, or sums of their weights, by redshift and luminosity."""
        redshift = np.asarray(redshift, float)
        luminosity = 10.0 ** np.nan_to_num(np.asarray(log_luminosity, float))
        z_bin, _, l_bin = self.bins.place(redshift, np.ones(redshift.size), luminosity)
        n_z, _, n_lum = self.bins.shape
        flat = np.ravel_multi_index((z_bin[chosen], l_bin[chosen]), (n_z, n_lum))
        if weight is not None:
            weight = weight[chosen]
        return np.bincount(flat, weight, n_z * n_lum).reshape(n_z, n_lum)


def _warn_of_bands(results):
    """Warn of a catalog whose bands do not show the dust of AGN."""
    bands = results[np.zeros(1, int)].fitted_filters
    longest = pivots(bands).max().to_value(u.um)
    if longest < MIN_WAVELENGTH:
        text = f"no band beyond {MIN_WAVELENGTH:g} um (the longest is at {longest:.2g} um): fractions of AGN are"
        warn(f"{text} hardly measured, and numbers of AGN go by their prior", CatalogWarning)


def _table_of_sources(sample, probability):
    """Make the table of sources with their probabilities, NaN of those that were not used."""
    columns = {"id": sample.ids, "used": sample.used, "selected": sample.selected}
    for name, values in probability.items():
        columns[name] = spread_over(values, sample.used, len(sample))
    columns |= {"redshift": sample.redshift, "log_luminosity": sample.log_luminosity}
    return described_columns(columns, column_texts("miricigale.agn", "sources"))


def _agn_probability(probability, first):
    """Probability of an AGN fraction from a bin on, of all classes that have them."""
    total = 0.0
    for weights in probability.values():
        if weights.ndim > 1:
            total = total + weights[:, :, first:].sum(axis=(1, 2, 3))
    if "quasar" in probability and probability["quasar"].ndim == 1:
        total = total + probability["quasar"]
    return total
