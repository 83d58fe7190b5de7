"""AGN of known luminosity added to the galaxies of a catalog, in batches, and fitted as the catalog was."""

import logging
import warnings
from functools import cached_property
from io import BytesIO
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable, hstack, vstack

from miricigale.agn.added_light import (
    NoiseCurve,
    add_light,
    agn_light,
    draw_agn_parameters,
    nucleus_noise_curves,
)
from miricigale.agn.fitted_sample import FittedSample
from miricigale.agn.images import N_IMAGES
from miricigale.agn.injection_draws import InjectionDraws, batch_sizes
from miricigale.evaluation import Estimate
from miricigale.fitting import GridSettings
from miricigale.fitting.catalogs.catalog_calibration import measured_calibration
from miricigale.fitting.catalogs.catalog_rows import read_catalog_nuclei
from miricigale.fitting.catalogs.classes import fit_classes
from miricigale.fitting.data.likelihood import NOT_CONVERGED_TEXT, table_of_fluxes
from miricigale.utils.content_hash import content_sha256
from miricigale.utils.exceptions import FitWarning, OtherResultsError, warn
from miricigale.utils.files import make_folder, replacing
from miricigale.utils.meta import package_version
from miricigale.utils.named_values import places, without
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.random import stream
from miricigale.utils.tables import described_columns
from miricigale.utils.units import FNU, LUMINOSITY

log = logging.getLogger(__name__)

#: Options of a fit that describe the catalog, which that of injected AGN does not need.
_OF_CATALOG = ("catalog_map", "flux_unit", "hdu")
#: Most AGN that are injected by default, where the catalog has fewer objects.
LEAST_INJECTIONS = 200
#: Keyword of the checksum of what was measured on images.
_KEY = "INPUTS"
#: Folder of the batches.
FOLDER = "injected"


class Injections:
    """
    AGN that are injected into a catalog, and what is fitted of them.

    Parameters
    ----------
    survey : `~miricigale.agn.AGNSurvey`
        Bins, limit, numbers and seed.
    path : path-like
        The catalog.
    class_fits : dict of str to `~miricigale.fitting.FitResultsFiles`
        Its fits by class.
    sample : `~miricigale.agn.fitted_sample.FittedSample`
        What is taken from these.
    output : `~pathlib.Path`
        Folder of the survey.
    images : `~miricigale.agn.AGNImages` or None
        Images into which AGN are put.
    options : dict
        Those of the fits.
    """

    def __init__(self, survey, path, class_fits, sample, output, images, options):
        self.survey = survey
        self.path = path
        self.results = class_fits["galaxy"]
        self.folder = output / FOLDER
        self.images = images
        self.options = options
        self.n_most = most_injections(survey.n_injections, len(sample))
        self.draws = InjectionDraws(
            self._hosts(sample), survey.bins.log_luminosity, int(survey.seed)
        )

    @property
    def n_models(self):
        """Effective number of models between the nodes for each AGN."""
        of_catalog = self.options.get("interpolate", GridSettings.interpolate)
        return min(of_catalog, self.survey.injected_models)

    def _hosts(self, sample):
        """Rows of the galaxies without an AGN, for each bin of redshift."""
        ones = np.ones(len(sample))
        z_bin, _, _ = self.survey.bins.place(sample.redshift, ones, ones)
        without_agn = sample.used & ~sample.selected & (sample.main == "galaxy")
        n_z = len(self.survey.bins.redshift) - 1
        return [np.flatnonzero(without_agn & (z_bin == i)) for i in range(n_z)]

    def table(self):
        """
        Inject AGN until all bins have enough of them.

        Returns
        -------
        injected : `~astropy.table.QTable`
            A row for each AGN that was injected; without any row if there is no bin with galaxies.
        """
        n_cells = len(self.draws.cells)
        if self.n_most and not n_cells:
            log.warning("no galaxy without an AGN in the bins of redshift: no AGN are injected")
        n_drawn = np.zeros(n_cells, int)
        n_injected = np.zeros(n_cells, int)
        n_selected = np.zeros(n_cells, int)
        batches = []
        while n_cells:
            sizes = batch_sizes(
                n_drawn,
                n_injected,
                n_selected,
                error=self.survey.completeness_error,
                n_left=self.n_most - n_drawn.sum(),
            )
            if not sizes.any():
                break
            cell, batch = self._batch(len(batches), n_drawn, sizes)
            batches.append(batch)
            n_drawn += sizes
            n_injected += np.bincount(cell, minlength=n_cells)
            n_selected += np.bincount(cell[batch["selected"]], minlength=n_cells)
            text = "batch %d: %d AGN injected so far, completeness known to %.1f %% or better"
            log.info(text, len(batches), n_injected.sum(), 100 * _error(n_injected, n_selected))
        n_lost = int(n_drawn.sum() - n_injected.sum())
        if n_lost:
            text = "injected AGN are left out: the best models of their galaxies have no dust, or are too old"
            warn(f"{n_lost} of {n_drawn.sum()} {text}", FitWarning)
        texts = column_texts("miricigale.agn", "injected")
        if not batches:
            return described_columns({name: np.zeros(0) for name in texts}, texts)
        injected = vstack(batches, metadata_conflicts="silent")
        columns = {name: injected[name] for name in texts}
        return described_columns(columns, texts)

    def photon_noise(self):
        """What is known of the photon noise of AGN in images: text by band, of none without images."""
        if self.images is None:
            return {}
        return {band: noise.text for band, noise in self.images.photon_noise.items()}

    def _batch(self, number, first, sizes):
        """Inject a batch: the bin of each AGN that could be injected, and the table of these."""
        cell, rows, log_luminosity = self.draws.draw(first, sizes)
        photometry, truth, usable = self._photometry(number, first.sum(), rows, log_luminosity)
        cell = cell[usable]
        if not len(photometry):
            texts = column_texts("miricigale.agn", "injected")
            empty = {name: np.zeros(0) for name in texts} | {"selected": np.zeros(0, bool)}
            return cell, QTable(empty)
        refits = self._fits(number, photometry)
        fitted = FittedSample.of_fits(refits, self.survey.bins, self.survey.limit)
        batch = QTable({"id": fitted.ids, "host": truth["host"]})
        for name in ("redshift", "log_luminosity", "frac_agn"):
            batch[name] = np.asarray(truth[name])
        batch["selected"] = fitted.selected
        for name in ("redshift", "log_luminosity", "frac_agn"):
            batch[f"{name}_fitted"] = getattr(fitted, name)
        batch[N_IMAGES] = np.asarray(truth[N_IMAGES])
        return cell, batch

    def _fits(self, number, photometry):
        """Fits of a batch as those of the catalog: dict by class."""
        catalog = self.folder / f"{batch_name(number)}.fits"
        write_batch(photometry, catalog, resume=self.options.get("resume", True))
        options = without(self.options, _OF_CATALOG)
        # errors and zero points are those of the catalog
        measured = measured_calibration(self.results)
        if measured is not None:
            options["calibration"] = measured
        options["calibrate"] = False
        options["interpolate"] = self.n_models
        folder = self.folder / batch_name(number)
        with warnings.catch_warnings():
            # only the selection of AGN is taken from these fits, for which their few models suffice
            warnings.filterwarnings("ignore", f".*{NOT_CONVERGED_TEXT}", FitWarning)
            return fit_classes(catalog, folder, agn_bins=self.survey.bins, **options)

    # ------------------------------------------------------------------ photometry

    @cached_property
    def _bands(self):
        return list(self.results[np.zeros(1, int)].fitted_filters)

    @cached_property
    def _zero_points(self):
        """Factors of the bands by which fluxes were multiplied in the fit."""
        points = self.results.job["settings"].get("zero_point", {})
        return np.array([points.get(band, 1.0) for band in self._bands])

    @cached_property
    def _nuclei(self):
        """Fluxes of the nuclei of all objects; None if they are not fitted."""
        if not self.options.get("nuclei"):
            return None
        of_catalog = {name: self.options.get(name) for name in _OF_CATALOG}
        return read_catalog_nuclei(self.path, self._bands, **of_catalog)

    @cached_property
    def _curves(self):
        """`NoiseCurve` of each band of the catalog, and of each column of nuclei."""
        curves = _noise_curves(self.results, self._bands, self._zero_points)
        if self._nuclei is not None:
            curves |= nucleus_noise_curves(self._nuclei)
        return curves

    def _photometry(self, number, first, rows, log_luminosity):
        """Photometry of the hosts with AGN, what is known of the AGN, and which of them could be injected."""
        seed = self.survey.seed
        hosts = self.results[rows]
        bands = self._bands
        points = self._zero_points
        columns = places(bands, hosts.filters)
        flux = hosts.flux[:, columns] / points
        error = hosts.flux_err[:, columns] / points
        ids = [f"agn{first + i + 1:06d}" for i in range(len(hosts))]
        table = table_of_fluxes(ids, bands, flux, error, hosts.limit[:, columns])
        if self._nuclei is not None:
            table = hstack([table, self._nuclei[rows]])
        redshift = self.options.get("redshift")
        if isinstance(redshift, str):
            table[redshift] = hosts.best["redshift"].value
        luminosity = (10.0**log_luminosity * u.erg / u.s).to(LUMINOSITY)
        check_that("frac_agn" in hosts.axes, "models", "with several AGN fractions", "others")
        parameters = draw_agn_parameters(
            hosts.axes, len(hosts), stream(seed, "agn", "parameters", number)
        )
        lit_bands = bands
        if self.images is not None:
            lit_bands = bands + _bands_of_images(self.images, bands)
        light, fraction = agn_light(
            self.results.model,
            hosts,
            luminosity,
            parameters,
            lit_bands,
            quantity=self.survey.bins.quantity,
        )
        usable = np.all([np.isfinite(light[band]) for band in bands], axis=0)
        for j, band in enumerate(bands):
            light[band] = np.where(usable, light[band].to_value(FNU) / points[j], 0.0) * FNU
        of_bands = {band: light[band] for band in bands}
        lit = add_light(table, of_bands, curves=self._curves, seed=seed)
        truth = QTable({"host": hosts.ids, "redshift": hosts.best["redshift"].value})
        truth["log_luminosity"] = log_luminosity
        truth["frac_agn"] = fraction
        truth[N_IMAGES] = np.zeros(len(truth), int)
        table = table[usable]
        lit = lit[usable]
        truth = truth[usable]
        if self.images is None or not len(lit):
            return lit, truth, usable
        of_usable = {band: values[usable] for band, values in light.items()}
        lit = self._on_images(number, table, lit, truth["host"], of_usable)
        truth[N_IMAGES] = lit[N_IMAGES]
        lit.remove_column(N_IMAGES)
        return lit, truth, usable

    def _on_images(self, number, table, lit, hosts, light):
        """What `AGNImages.add_agn` measures of a batch, which is kept in a file."""
        path = self.folder / f"{batch_name(number)}-images.fits"
        inputs = [table, lit, np.asarray(hosts), light, self.images.content]
        key = content_sha256([*inputs, self.survey.seed, package_version()])
        resume = self.options.get("resume", True)
        if not resume or not path.exists() or fits.getheader(path, 1).get(_KEY) != key:
            measured = self.images.add_agn(table, lit, hosts, light, seed=self.survey.seed)
            measured.meta = {_KEY: key}
            make_folder(path.parent)
            with replacing(path, overwrite=True) as partial:
                measured.write(partial, format="fits")
        else:
            log.info("%s: measured by an earlier call", path)
        # as it is in the file, whether it was just measured or not
        measured = QTable.read(path)
        measured.meta = {}
        return measured


def most_injections(n_injections, n_objects):
    """
    Most AGN that are injected.

    Parameters
    ----------
    n_injections : int or None
        As for `~miricigale.agn.AGNSurvey`.
    n_objects : int
        Objects of the catalog.

    Returns
    -------
    n_most : int
        By default as many as there are objects, so that AGN take no more time than the catalog itself.
    """
    if n_injections is None:
        return max(LEAST_INJECTIONS, n_objects)
    return n_injections


def batch_name(number):
    """Name of the files of a batch, of which the first has the number 0."""
    return f"batch-{number + 1:02d}"


def write_batch(photometry, path, *, resume):
    """
    Write photometry with AGN, unless the fits beside it, which are to be resumed, are of another one.

    Parameters
    ----------
    photometry : `~astropy.table.QTable`
        The photometry.
    path : `~pathlib.Path`
        The file; the fits are in the folder of its name without ``.fits``.
    resume : bool
        Whether fits are kept.

    Raises
    ------
    `~miricigale.utils.exceptions.OtherResultsError`
        If there are fits of other photometry.
    """
    content = BytesIO()
    photometry.write(content, format="fits")
    content = content.getvalue()
    folder = path.with_suffix("")
    if resume and folder.exists() and path.exists() and path.read_bytes() != content:
        reason = f"{folder} holds fits of other injected AGN, of another number or seed"
        reason += f" (without the folder {path.parent} they alone are fitted anew)"
        raise OtherResultsError(reason, "resume=False to replace them")
    make_folder(path.parent)
    with replacing(path, overwrite=True) as partial:
        Path(partial).write_bytes(content)


def _error(n_injected, n_selected):
    """Error of the completeness of the bin in which it is known least."""
    worst = 0.0
    for n, selected in zip(n_injected, n_selected, strict=True):
        if n:
            share = Estimate.of_fraction(selected, n)
            worst = max(worst, share.high - share.value, share.value - share.low)
    return worst


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
