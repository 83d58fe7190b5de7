"""AGN of a survey: fits of a catalog, and of the same with AGN of known luminosity."""

import logging
from io import BytesIO
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable, hstack

from miricigale.agn.added_light import (
    NoiseCurve,
    add_light,
    agn_light,
    draw_agn_parameters,
    nucleus_noise_curves,
)
from miricigale.agn.images import N_IMAGES
from miricigale.agn.numbers import FLOOR, SampleNumbers, prior_table
from miricigale.agn.shares import draw_shares
from miricigale.evaluation import classify
from miricigale.evaluation.classes import CLASS_LIMITS
from miricigale.fitting import AGNBins
from miricigale.fitting.catalogs.catalog_calibration import measured_calibration
from miricigale.fitting.catalogs.catalog_rows import read_catalog_nuclei
from miricigale.fitting.catalogs.classes import fit_classes
from miricigale.utils.exceptions import FitWarning, OtherResultsError, argument_error, warn
from miricigale.utils.files import replacing
from miricigale.utils.interactive import Interactive
from miricigale.utils.named_values import places, without
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import declared
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_columns, error_column
from miricigale.utils.units import FNU, LUMINOSITY, check_count, is_number, positive
from miricigale.utils.values import value_class

log = logging.getLogger(__name__)

#: Default bins of redshift and of log10 of the luminosity in erg/s.
REDSHIFT = (0.0, 1.0, 2.0, 4.0)
LOG_LUMINOSITY = (43.0, 44.0, 45.0, 46.0)
#: Options of a fit that describe the catalog, which that of injected AGN does not need.
_OF_CATALOG = ("catalog_map", "flux_unit", "hdu")
#: Files that a run writes besides the folders of fits.
FILES = ("numbers.ecsv", "totals.ecsv", "prior.ecsv", "sources.ecsv", "injected.ecsv")
#: Solid angle of the whole sky in square degrees.
_SKY = (4.0 * np.pi * u.sr).to_value(u.deg**2)
#: Classes whose fits have an AGN luminosity.
_WITH_AGN = ("galaxy", "quasar")


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
        selected objects. ``constrained`` is false where most of the injected AGN have smaller fractions.
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
            with replacing(Path(folder) / name, overwrite=overwrite) as partial:
                table.write(partial, format="ascii.ecsv")


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
        AGN that are added to the photometry; none leaves the selection function out.
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
        n_injections=200,
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
        self.n_injections = check_count(n_injections, "n_injections", least=0)
        self.n_draws = check_count(n_draws, "n_draws")
        self.seed = check_seed(seed)

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
        sample = _Sample.of_fits(fits, self.bins, self.limit)
        check_that(sample.used.any(), "path", "a catalog of which objects can be fitted", "none")
        injected = self._inject(path, fits, sample, output, images, options)
        result = self._result(sample, injected)
        output.mkdir(parents=True, exist_ok=True)
        result.write(output, overwrite=True)
        from miricigale.agn.page import write_page

        write_page(result, output / "page.html", Path(path).name)
        return result

    # ------------------------------------------------------------------- injection

    def _inject(self, path, fits, sample, output, images, options):
        """Table of injected AGN and what was fitted of them."""
        results = fits["galaxy"]
        texts = declared("miricigale.agn", "columns.toml")["injected"]
        truth = self._injections(results, sample) if self.n_injections else None
        if truth is None:
            columns = {}
            for name in texts:
                columns[name] = np.zeros(0)
            return described_columns(columns, texts)
        photometry, truth = self._photometry(path, results, truth, images, options)
        catalog = output / "injected.fits"
        _write_injected(photometry, catalog, resume=options.get("resume", True))
        fit_options = without(options, _OF_CATALOG)
        # errors and zero points are those of the catalog
        measured = measured_calibration(results)
        if measured is not None:
            fit_options["calibration"] = measured
        fit_options["calibrate"] = False
        refits = fit_classes(catalog, output / "injected", agn_bins=self.bins, **fit_options)
        refitted = _Sample.of_fits(refits, self.bins, self.limit)
        columns = {
            "id": refitted.ids,
            "host": truth["host"],
            "redshift": truth["redshift"],
            "log_luminosity": truth["log_luminosity"],
            "frac_agn": truth["frac_agn"],
            "selected": refitted.selected,
            "redshift_fitted": refitted.redshift,
            "log_luminosity_fitted": refitted.log_luminosity,
            "frac_agn_fitted": refitted.frac_agn,
            "n_images": np.zeros(len(truth), int),
        }
        if N_IMAGES in truth.colnames:
            columns["n_images"] = np.asarray(truth[N_IMAGES])
        return described_columns(columns, texts)

    def _injections(self, results, sample):
        """Hosts, and redshifts and luminosities of the AGN that they get: the same number in each bin."""
        n_z = len(self.bins.redshift) - 1
        edges = self.bins.log_luminosity
        # above the last edge as far as below the last but one
        step = edges[-1] - edges[-2] if len(edges) > 1 else 1.0
        edges = np.append(edges, edges[-1] + step)
        z_bin, _, _ = self.bins.place(sample.redshift, np.ones(len(sample)), np.ones(len(sample)))
        without_agn = sample.used & ~sample.selected & (sample.main == "galaxy")
        hosts = [np.flatnonzero(without_agn & (z_bin == i)) for i in range(n_z)]
        cells = []
        for i in range(n_z):
            if hosts[i].size:
                cells += [(i, k) for k in range(len(edges) - 1)]
        if not cells:
            log.warning("no galaxy without an AGN in the bins of redshift: no AGN are injected")
            return None
        rng = stream(self.seed, "agn", "injections")
        chosen = []
        luminosity = []
        for number in range(self.n_injections):
            i, k = cells[number % len(cells)]
            chosen.append(rng.choice(hosts[i]))
            luminosity.append(rng.uniform(edges[k], edges[k + 1]))
        rows = np.array(chosen)
        return {"row": rows, "log_luminosity": np.array(luminosity), "rng": rng}

    def _photometry(self, path, results, truth, images, options):
        """Photometry of the hosts with AGN, and what is known of the AGN: two tables."""
        hosts = results[truth["row"]]
        bands = list(hosts.fitted_filters)
        columns = places(bands, hosts.filters)
        points = results.job["settings"].get("zero_point", {})
        points = np.array([points.get(band, 1.0) for band in bands])
        flux = hosts.flux[:, columns] / points
        error = hosts.flux_err[:, columns] / points
        table = QTable({"id": [f"agn{i + 1:06d}" for i in range(len(hosts))]})
        for j, band in enumerate(bands):
            table[band] = flux[:, j] * FNU
            table[error_column(band)] = error[:, j] * FNU
            table[f"{band}_limit"] = hosts.limit[:, columns[j]]
        curves = _noise_curves(results, bands, points)
        if options.get("nuclei"):
            of_catalog = {}
            for name in _OF_CATALOG:
                of_catalog[name] = options.get(name)
            nuclei = read_catalog_nuclei(path, bands, **of_catalog)
            curves |= nucleus_noise_curves(nuclei)
            table = hstack([table, nuclei[truth["row"]]])
        redshift = options.get("redshift")
        if isinstance(redshift, str):
            table[redshift] = hosts.best["redshift"].value
        luminosity = (10.0 ** truth["log_luminosity"] * u.erg / u.s).to(LUMINOSITY)
        parameters = draw_agn_parameters(hosts.axes, len(hosts), truth["rng"])
        check_that("frac_agn" in hosts.axes, "models", "with several AGN fractions", "others")
        lit_bands = bands
        if images is not None:
            lit_bands = bands + _bands_of_images(images, bands)
        light, fraction = agn_light(
            results.model, hosts, luminosity, parameters, lit_bands, quantity=self.bins.quantity
        )
        usable = np.all([np.isfinite(light[band]) for band in bands], axis=0)
        for j, band in enumerate(bands):
            light[band] = np.where(usable, light[band].to_value(FNU) / points[j], 0.0) * FNU
        of_bands = {band: light[band] for band in bands}
        lit = add_light(table, of_bands, curves=curves, seed=self.seed)
        truth_table = QTable({"host": hosts.ids, "redshift": hosts.best["redshift"].value})
        truth_table["log_luminosity"] = truth["log_luminosity"]
        truth_table["frac_agn"] = fraction
        n_lost = int(np.count_nonzero(~usable))
        if n_lost:
            text = "injected AGN are left out: the best models of their galaxies have no dust, or are too old"
            warn(f"{n_lost} of {len(hosts)} {text}", FitWarning)
        if images is None:
            return lit[usable], truth_table[usable]
        of_usable = {band: values[usable] for band, values in light.items()}
        truth_table = truth_table[usable]
        lit = images.add_agn(table[usable], lit[usable], truth_table["host"], of_usable)
        truth_table[N_IMAGES] = lit[N_IMAGES]
        lit.remove_column(N_IMAGES)
        return lit, truth_table

    # ---------------------------------------------------------------------- result

    def _result(self, sample, injected):
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
        columns = {"id": sample.ids, "used": sample.used, "selected": sample.selected}
        for name, values in probability.items():
            columns[name] = np.full(len(sample), np.nan)
            columns[name][sample.used] = values
        columns |= {"redshift": sample.redshift, "log_luminosity": sample.log_luminosity}
        texts = declared("miricigale.agn", "columns.toml")["sources"]
        sources = described_columns(columns, texts)
        selected = sample.selected & sample.used
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
            pure=self._counts(
                sample.redshift,
                sample.log_luminosity,
                selected,
                np.nan_to_num(columns["agn_probability"]),
            ),
            injected=self._injected_counts(injected),
            seed=self.seed,
        )
        meta = {"area_deg2": float(self.area), "limit": self.limit, "seed": self.seed}
        meta |= {"n_all": len(sample), "n_used": int(sample.used.sum())}
        meta |= {"classes": list(sample.tables)}
        return AGNResult(
            numbers=numbers.by_luminosity(),
            totals=numbers.totals(),
            prior=prior_table(bins, prior, draws, all_redshifts),
            sources=sources,
            injected=injected,
            meta=meta,
        )

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


def _bands_of_images(images, bands):
    """List the filters of images that no band is, which is that of the prior alone."""
    lacking = [band for band in images.bands if band not in bands]
    check_that(not lacking, "images", f"of bands that are fitted ({', '.join(bands)})", lacking)
    check_that(
        images.prior_band is not None, "images", "with a prior whose filter is known", "another"
    )
    if images.prior_band in bands:
        return []
    return [images.prior_band]


def _write_injected(photometry, path, *, resume):
    """Write photometry with AGN, unless the fits beside it, which are to be resumed, are of another one."""
    content = BytesIO()
    photometry.write(content, format="fits")
    content = content.getvalue()
    fits = path.with_name("injected")
    if resume and fits.exists() and path.exists() and path.read_bytes() != content:
        reason = f"{fits} holds fits of other injected AGN, of another number or seed"
        reason += " (without this folder they alone are fitted anew)"
        raise OtherResultsError(reason, "resume=False to replace them")
    with replacing(path, overwrite=True) as partial:
        Path(partial).write_bytes(content)


def _agn_probability(probability, first):
    """Probability of an AGN fraction from a bin on, of all classes that have them."""
    total = 0.0
    for weights in probability.values():
        if weights.ndim > 1:
            total = total + weights[:, :, first:].sum(axis=(1, 2, 3))
    if "quasar" in probability and probability["quasar"].ndim == 1:
        total = total + probability["quasar"]
    return total


def _noise_curves(results, bands, points):
    """`NoiseCurve` of each band of the catalog."""
    flux = []
    error = []
    for part in results.parts():
        columns = places(bands, part.filters)
        measured = np.isfinite(part.sigma[:, columns]) & ~part.limit[:, columns]
        flux.append(np.where(measured, part.flux[:, columns] / points, np.nan))
        error.append(np.where(measured, part.flux_err[:, columns] / points, np.nan))
    flux = np.concatenate(flux)
    error = np.concatenate(error)
    return {band: NoiseCurve.of_band(flux[:, j], error[:, j]) for j, band in enumerate(bands)}


@value_class
class _Sample:
    """
    What is taken from the fits of a catalog, by object.

    ``tables`` are posteriors in bins of the classes with AGN, ``log_evidence`` is of all classes, and ``main`` the
    class of the highest evidence.
    """

    ids: np.ndarray
    used: np.ndarray
    selected: np.ndarray
    main: np.ndarray
    redshift: np.ndarray
    log_luminosity: np.ndarray
    frac_agn: np.ndarray
    tables: dict
    log_evidence: dict
    axis: object

    def __len__(self):
        return len(self.ids)

    @classmethod
    def of_fits(cls, fits, bins, limit):
        """Of fits of the same catalog by class."""
        columns = {name: _columns(results, bins) for name, results in fits.items()}
        evidence = np.array([values["log_evidence"] for values in columns.values()])
        names = np.array(list(columns))
        main = names[np.argmax(np.where(np.isnan(evidence), -np.inf, evidence), axis=0)]
        galaxy = columns["galaxy"]
        usable = np.isfinite(galaxy["weights"].sum(axis=(1, 2, 3)))
        values = {}
        for name in ("redshift", "log_luminosity", "frac_agn"):
            values[name] = galaxy[name].copy()
            if "quasar" in columns:
                quasars = main == "quasar"
                values[name][quasars] = columns["quasar"][name][quasars]
        fraction = np.where(np.isfinite(values["frac_agn"]), values["frac_agn"], np.nan)
        selected = classify(fraction, limits=(CLASS_LIMITS[0], limit)) == "agn"
        selected &= np.isin(main, _WITH_AGN)
        tables = {}
        for name in _WITH_AGN:
            if name in columns:
                tables[name] = columns[name]["weights"]
        log_evidence = {}
        for name, of_class in columns.items():
            log_evidence[name] = of_class["log_evidence"]
        first = next(iter(fits["galaxy"].parts()))
        axis = first.axes.get("frac_agn")
        if axis is None:
            raise argument_error("axes", "a grid with several AGN fractions", "one without")
        return cls(
            galaxy["ids"], usable, selected, main, **values, tables=tables,
            log_evidence=log_evidence, axis=axis,
        )  # fmt: skip

    def other_classes(self):
        """Other classes of the objects that are used, as `draw_shares` takes them."""
        posteriors = {}
        for name, evidence in self.log_evidence.items():
            if name == "galaxy":
                continue
            ratio = (evidence - self.log_evidence["galaxy"])[self.used]
            table = self.tables.get(name)
            if table is not None:
                table = np.nan_to_num(table[self.used])
            posteriors[name] = ratio, table
        return posteriors

    def shipped(self):
        """Posteriors as they were fitted, all classes being equally frequent: as `ShareDraws.probability`."""
        other_classes = self.other_classes()
        evidence = [np.zeros(int(self.used.sum()))]
        evidence += [
            np.where(np.isnan(ratio), -np.inf, ratio) for ratio, _ in other_classes.values()
        ]
        evidence = np.array(evidence)
        weight = np.exp(evidence - evidence.max(axis=0))
        weight = weight / weight.sum(axis=0)
        probability = {}
        for name, part in zip(["galaxy"] + list(other_classes), weight, strict=True):
            table = self.tables.get(name)
            if table is None:
                probability[name] = part
            else:
                probability[name] = part[:, None, None, None] * np.nan_to_num(table[self.used])
        return probability


def _columns(results, bins):
    """Arrays of a class for all objects: dict by name."""
    by_name = {}
    for part in results.parts():
        n = len(part)
        columns = {"ids": np.array(part.ids), "log_evidence": np.array(part.log_evidence)}
        columns["weights"] = part.agn_weights
        if part.agn_weights is None:
            columns["weights"] = np.full((n,) + tuple(bins.shape), np.nan)
        for name in ("redshift", "frac_agn", bins.quantity):
            values = np.full(n, np.nan)
            if name in part.parameters:
                values = part.median(name)
            elif name in part.best:
                values = part.best[name]
            columns[name] = np.array(u.Quantity(values).value, float)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_luminosity = np.log10(columns.pop(bins.quantity) * LUMINOSITY.to("erg / s"))
        columns["log_luminosity"] = log_luminosity
        for name, values in columns.items():
            by_name.setdefault(name, []).append(values)
    return {name: np.concatenate(parts) for name, parts in by_name.items()}
