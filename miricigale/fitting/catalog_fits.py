"""How a catalog goes through a fit: its photometry is read, checked, divided into pieces and fitted."""

import logging

import numpy as np

from miricigale.filters import as_photometry
from miricigale.filters.catalog_files import count_negative_errors, negative_error_message
from miricigale.filters.photometry_table import names_of_columns
from miricigale.fitting.data.likelihood import (
    FitFlags,
    PhotometryReader,
    check_fluxes,
    flags_of_fits,
    unused_bands,
)
from miricigale.fitting.data.nuclei import (
    WHOLE,
    NucleusColumns,
    nucleus_columns,
    read_nuclei,
    with_units,
)
from miricigale.fitting.data.whole_points import WholePoints
from miricigale.fitting.fitter_text import engine_name
from miricigale.fitting.posterior.priors import known_redshifts
from miricigale.fitting.results.results import FitResults
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import FitWarning, warn
from miricigale.utils.ids import warn_of_duplicates
from miricigale.utils.interactive import Interactive
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_that
from miricigale.utils.parallel import chunks, parallel_map, single_threaded
from miricigale.utils.random import check_seed
from miricigale.utils.tables import error_column, read_ids
from miricigale.utils.units import FNU, check_count

logger = logging.getLogger(__name__)


class CatalogFits(Interactive):
    """
    Fits of catalogs, or of parts of them, by the backend of a fitter.

    The base of `~miricigale.fitting.BayesFitter`, which sets the attributes: ``backend``, ``engine``, ``filters``,
    ``bands``, ``nuclei``, ``calibration``, ``model``, ``curves``, ``zero_points`` and ``_reader``, which reads
    photometry.
    """

    def _settings(self, filters=None):
        """Return what `~miricigale.fitting.BayesFitter.settings` does."""
        optional = {}
        if self.calibration is not None:
            optional["calibration"] = self.calibration.name
            optional["zero_point"] = self.zero_points
            optional["error_factor"] = self._reader.error_factor
        if self.nuclei:
            optional["nuclei"] = self.nuclei
        if self.nuclei is True:
            optional["nuclear_stars"] = float(self.backend.given.nuclear_stars)
        return {
            "engine": engine_name(self),
            "filters": list(filters or self.filters or self.bands),
            "model_error": dict(self._reader.model_error),
            "error_floor": dict(self._reader.error_floor),
            "n_bands_min": self.n_bands_min,
            **optional,
            **self.backend.settings(),
        }

    def _table_of(self, photometry, unit=None):
        """
        Convert a catalog to our names, fluxes without a unit in ``unit``, and warn of what looks wrong.

        A band of ``filters`` that it lacks is missing for all objects.
        """
        table = as_photometry(photometry, self.filters or self.bands, units=unit)
        if self.nuclei:
            table = with_units(table, unit)
        missing = [name for name in self.filters or () if name not in table.colnames]
        if missing and len(missing) < len(self.filters):
            text = f"the photometry has no {', '.join(missing)}: missing bands of all objects"
            warn(text, FitWarning)
            table = table.copy(copy_data=False)
            for name in missing:
                table[name] = nans(len(table)) * FNU
                table[error_column(name)] = nans(len(table)) * FNU
        user_names = names_of_columns(photometry, self.filters or self.bands)
        check_fluxes(table, self._reader.fitted(table), user_names)
        warn_of_duplicates(read_ids(table), "photometry")
        self._warn_of_bands(table)
        text = negative_error_message(count_negative_errors(table, self._reader.fitted(table)))
        if text:
            warn(text, FitWarning)
        return table

    def _read_bands(self, photometry, bands):
        """
        Read the photometry of bands, with zero points and without errors of models.

        Returned is `~miricigale.fitting.data.likelihood.FitData`.
        """
        zero = dict.fromkeys(bands, 0.0)
        return PhotometryReader(bands, bands, zero, zero, 1, self.zero_points).read(photometry)

    def _nucleus_columns(self, photometry):
        """Find the `NucleusColumns` of a catalog, at least one band."""
        columns = NucleusColumns.of_table(
            photometry.colnames, self.filters or self._reader.fitted(photometry)
        )
        wanted = "a table with columns <filter>_flux_point and <filter>_flux_point_err for 'nuclei'"
        check_that(columns.bands, "photometry", wanted, f"columns {photometry.colnames}")
        return columns

    def _warn_of_bands(self, photometry):
        """Warn of bands that are not fitted, if the fitter does not name those that are."""
        nuclei = nucleus_columns(photometry.colnames)
        if nuclei and not self.nuclei:
            text = "fluxes of nuclei are not fitted (nuclei=True does)"
            warn(f"{text}: {', '.join(nuclei)}", FitWarning)
        fitted = self._reader.fitted(photometry)
        if self.nuclei and self.filters is None:
            without_total = [column for column, band in nuclei.items() if band not in fitted]
            if without_total:
                text = "fluxes of nuclei in bands that have no total flux are not fitted"
                warn(f"{text}: {', '.join(without_total)}", FitWarning)
        unused = unused_bands(photometry, fitted)
        if unused and self.filters is None:
            text = "bands of the photometry that the grid lacks are not fitted"
            warn(f"{text}: {', '.join(unused)}", FitWarning)

    def _fit_part(
        self,
        photometry,
        *,
        redshift,
        redshift_prior,
        pairs,
        seed,
        parallel,
        chunk_size=None,
        repeated=None,
    ):
        """Do what `fit` does, without warnings; earlier parts of the catalog had the ``repeated`` rows."""
        if chunk_size is None:
            chunk_size = self.backend.chunk_size
        chunk_size = check_count(chunk_size, "chunk_size")
        if self.engine == "grid":
            seed = None
        else:
            seed = check_seed(seed)
        data, priors, settings = self._prepare(photometry, redshift, redshift_prior, repeated)
        backend = self.backend
        points = None
        if self.nuclei:
            columns = self._nucleus_columns(photometry)
            values, left_out = read_nuclei(photometry, columns, data, self._reader)
            flags = data.flags | np.where(left_out, int(FitFlags.NUCLEUS_LEFT_OUT), 0)
            data = data._changed(flags=flags)
            if self.nuclei == WHOLE:
                bands = [self.bands.index(band) for band in columns.bands]
                points = WholePoints.of_values(data, values, bands, backend.wrong_part)
                settings |= {"nuclei": list(columns.bands), "nuclear_light": WHOLE}
            else:
                backend = backend.with_nuclei(columns.bands)
                data = data._changed(nuclei=values)
                settings |= backend.settings()
        task = backend.task(pairs, seed, priors)
        # the measured errors take no part, and what goes to other processes is kept small
        task_data = data._changed(flux_err=None)
        if points is not None:
            task_data = points.combined._changed(flux_err=None)
        slices = list(chunks(len(data), chunk_size)) or [slice(0, 0)]
        pieces = [(task_data[rows], priors[rows]) for rows in slices]
        # numerical libraries use one thread each, in threads too, which share this setting with their process
        with single_threaded():
            results = FitResults.concatenate(parallel_map(task, pieces, desc="fit", **parallel))
        if points is not None:
            results = points.put_into(results)
        logger.debug("fitted %d objects", len(data))
        if seed is not None:
            settings["seed"] = seed
        fixed = settings["redshift"] == "fixed"
        edge = None
        if not fixed:
            edge = self.backend.edge_weight
        return results._changed(
            flags=flags_of_fits(results, data.measured, edge),
            flux_err=data.flux_err,
            fitted_filters=tuple(settings["filters"]),
            redshift_fixed=fixed,
            model=self.model,
            curves=self.curves,
            meta=provenance(fit=settings, **self.backend.provenance()),
        )

    def _prepare(self, photometry, redshift, redshift_prior, repeated=None):
        """Read photometry with flags, the prior of the redshift of every object, and the settings."""
        filters = self._reader.fitted(photometry)
        is_single = redshift is None or redshift_prior is None
        check_that(is_single, "redshift_prior", "left out where 'redshift' is given", "both")
        data = self._reader.read(photometry, repeated)
        self.backend.check_data(data)
        flags = np.array(data.flags)
        priors, n_free, kind = self.backend.redshifts(photometry, redshift, redshift_prior, flags)
        n_wanted = 3
        if kind == "fixed":
            n_wanted = 2
        n_detected = np.sum(data.measured & (data.flux >= 2.0 * data.flux_err), axis=1)
        is_fitted = (flags & FitFlags.UNFITTED) == 0
        too_few = is_fitted & (n_detected < min(n_free, n_wanted))
        flags[too_few] |= FitFlags.FEW_FOR_PARAMETERS
        settings = self._settings(filters) | {"redshift": kind}
        settings["unused_bands"] = unused_bands(photometry, filters)
        if kind == "fixed":
            # 0 was checked above, where a grid has it
            known_z = known_redshifts(photometry, redshift, zero=True)
            data = data._changed(redshift=np.where(known_z > 0, known_z, np.nan))
        return data._changed(flags=flags), priors, settings
