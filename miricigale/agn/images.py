"""AGN put into the images of a field as points, and measured as their user measures the field."""

import dataclasses
import logging
import warnings
from functools import cached_property

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting.data.nuclei import CORRELATION, IS_LIMIT, NUCLEUS
from miricigale.injection.field import check_psfs, field_psfs
from miricigale.injection.light import light_on_file
from miricigale.injection.photon_noise import photon_noise
from miricigale.injection.trials import APART
from miricigale.photometry import MosaicFile
from miricigale.photometry.commands.file_inputs import Inputs, Pixels
from miricigale.utils.column_units import quantity_table
from miricigale.utils.content_hash import content_sha256, file_sha256
from miricigale.utils.exceptions import CatalogWarning, PhotometryWarning
from miricigale.utils.files import file_place, is_path
from miricigale.utils.named_values import field_names
from miricigale.utils.options import check_that
from miricigale.utils.random import stream
from miricigale.utils.tables import error_column, match_sky
from miricigale.utils.units import ANGLE, FNU, to_array
from miricigale.workflow.recorded_inputs import PATHS

log = logging.getLogger(__name__)

#: Column of the number of images on which the light of an AGN was measured.
N_IMAGES = "n_images"


class AGNImages:
    """
    Images of a field, into which AGN are injected.

    Parameters
    ----------
    image, highres
        One image for each band, and the prior, as for `~miricigale.photometry.measure_files`. All filters are
        those of bands that are fitted, but that of the prior, which may be another.
    n_threads : int, optional
        Threads; they change nothing.
    **options
        Further ones of `~miricigale.photometry.measure_files` but ``detection``, with which the catalog was
        measured: ``segmentation``, ``catalog``, ``components`` and others.

    Raises
    ------
    ValueError, `~miricigale.utils.exceptions.DataError`
        If an image or option is not what it should be.

    Notes
    -----
    The photon noise of the light is drawn where an image states what it is (`photon_noise`).
    """

    def __init__(self, image, highres, *, n_threads=None, **options):
        check_that("detection" not in options, "detection", "left out", options.get("detection"))
        self.inputs = Inputs.of(image, highres, **options)
        self.inputs.check()
        self.n_threads = n_threads

    def __repr__(self):
        return f"<AGNImages {', '.join(self.bands)}, prior {self.prior_band}>"

    @property
    def bands(self):
        """Filters of the images that are measured."""
        return tuple(self.inputs.bands)

    @property
    def prior_band(self):
        """Filter of the prior."""
        return self.inputs.highres.header.filter

    @cached_property
    def content(self):
        """Checksum of all files and options, by which a measurement that was kept is known to be theirs."""
        inputs = self.inputs
        parts = [_content(path) for path in inputs.kernels]
        parts += [_content(inputs.segmentation), _content(inputs.catalog)]
        for file in (*inputs.images, inputs.highres):
            for name in field_names(MosaicFile):
                value = getattr(file, name)
                parts.append((name, _content(value) if name in PATHS else repr(value)))
        parts += [inputs.confidence, inputs.psf_stars, inputs.seed]
        parts += sorted((name, repr(value)) for name, value in inputs.options.items())
        return content_sha256(parts)

    @cached_property
    def photon_noise(self):
        """Photon noise of light in the images: `~miricigale.injection.photon_noise.PhotonNoise` by band."""
        noises = {}
        for band, file in zip(self.bands, self.inputs.images, strict=True):
            noises[band] = photon_noise(file)
            log.info("photon noise of AGN in %s: %s", band, noises[band].text)
        return noises

    @cached_property
    def _photometers(self):
        photometers = self.inputs.photometers(self.n_threads)
        for photometer in photometers.values():
            check_psfs(photometer)
        return photometers

    @cached_property
    def _base(self):
        """The `_Base` of the field without injected AGN."""
        measurement = self._measure(None, None)
        psfs = {}
        fwhm = []
        correlation = {}
        for band, result in measurement.results.items():
            psfs[band], prior_psf = field_psfs(
                self._photometers[band], self.inputs.highres.header, result
            )
            fwhm.append(result.psf_fwhm.to_value(ANGLE))
            correlation[band] = result.noise_correlation
        return _Base(measurement.table, psfs, prior_psf, max(fwhm) * ANGLE, correlation)

    def _measure(self, sources, light, key=()):
        """Measure the images, with points of the light of each band: a `Measurement`; ``key`` is that of noise."""
        inputs = self.inputs
        prior_light = None
        images = {}
        for band, file in zip(inputs.bands, inputs.images, strict=True):
            own_light = None
            added_variance = None
            if sources is not None:
                own_light = light_on_file(
                    file, sources, light[band], self._base.psfs[band], self.n_threads
                )
                own_light, added_variance = self.photon_noise[band].add(
                    own_light, self._base.correlation[band], stream(*key, band)
                )
            images[band] = file.read(own_light, added_variance)
        if sources is not None:
            prior_light = light_on_file(
                inputs.highres,
                sources,
                light[self.prior_band],
                self._base.prior_psf,
                self.n_threads,
            )
        pixels = Pixels(inputs.highres.read(prior_light), [], images)
        segments, catalog = inputs.find_sources(pixels, inputs.catalog)
        return inputs.measure(pixels, self._photometers, segments, catalog)

    def add_agn(self, photometry, lit, hosts, light, *, seed=1):
        """
        Put what is measured of AGN on the images into photometry.

        Flux and point of a host change by what its measurement with the AGN is more than that without, and errors
        by the ratio of the two, so that the catalog may have been corrected since. Where it has no flux, or an
        upper limit, it gets the measured one.

        Parameters
        ----------
        photometry, lit : `~astropy.table.QTable`
            Photometry of n hosts, and the same with the light of their AGN (`add_light`).
        hosts : `~numpy.ndarray`, shape (n,)
            Ids of the hosts, which are those of the photometry of the images.
        light : dict of str to `~astropy.units.Quantity`, shape (n,)
            Light of the AGN in the bands of the images and of the prior.
        seed : int, optional
            Seed of the photon noise of the light, which goes by the ids of ``lit``.

        Returns
        -------
        photometry : `~astropy.table.QTable`
            A copy of ``lit`` with the columns of the bands of the images from these, where the host is on them,
            and ``n_images``.

        Raises
        ------
        ValueError
            If no host is on the images, or points were measured in none of the bands in which the catalog has
            nuclei.
        """
        base = self._base
        for band in self.bands:
            needs_points = band + NUCLEUS in photometry.colnames
            has_points = f"{band}_flux_point" in base.table.colnames
            check_that(
                has_points or not needs_points, "components", "2 for images with 'nuclei'", "1"
            )
        before = _rows_of_ids(base.table, hosts)
        wanted = "a catalog with the ids of the photometry of the images"
        check_that(np.any(before >= 0), "images", wanted, f"ids {list(base.table['id'][:3])}")
        n_off = int(np.count_nonzero(before < 0))
        if n_off:
            text = "galaxies that no image has: light is added to their photometry"
            log.info("%d of %d injected AGN are in %s", n_off, len(hosts), text)
        sky = base.table["sky"][before]
        trials = separate_trials(sky, before >= 0, APART * base.fwhm)
        log.info("injecting AGN into %d sets of images", trials.max() + 1)
        table = quantity_table(lit, copy=True)
        table[N_IMAGES] = np.zeros(len(table), int)
        for trial in range(trials.max() + 1):
            rows = np.flatnonzero(trials == trial)
            points = _points(sky[rows])
            light_of_rows = {band: light[band][rows] for band in [*self.bands, self.prior_band]}
            with warnings.catch_warnings():
                # what the images are warned of was said of those without AGN
                warnings.simplefilter("ignore", CatalogWarning)
                warnings.simplefilter("ignore", PhotometryWarning)
                key = (seed, "agn", "photons", str(lit["id"][rows[0]]))
                measured = self._measure(points, light_of_rows, key).table
            after, _ = match_sky(measured["sky"], sky[rows], radius=base.fwhm / 2)
            n_lost = int(np.count_nonzero(after < 0))
            if n_lost:
                text = "galaxies that the prior shows no more: light is added to their photometry"
                log.info("%d AGN are in %s", n_lost, text)
            kept = after >= 0
            pairs = _Pairs(rows[kept], base.table, before[rows[kept]], measured, after[kept])
            for band in self.bands:
                pairs.put_band(table, photometry, band)
        return table


def _content(source):
    """Checksum of a file, or of the table that takes its place, and the extension that is meant; None of none."""
    if not is_path(source):
        return content_sha256(source)
    name, *part = file_place(source)
    return file_sha256(name), *part


@dataclasses.dataclass(frozen=True)
class _Base:
    """
    Photometry of a field, PSFs of its images by band and of the prior, and the largest width of them.

    ``correlation`` is the covariance of the noise of pixels by band.
    """

    table: QTable
    psfs: dict
    prior_psf: object
    fwhm: u.Quantity
    correlation: dict


@dataclasses.dataclass(frozen=True)
class _Pairs:
    """Rows of hosts in a table, and their rows in the photometry of the field without and with AGN."""

    rows: np.ndarray
    without: QTable
    before: np.ndarray
    measured: QTable
    after: np.ndarray

    def put_band(self, table, photometry, band):
        """Put flux, point and errors of a band into ``table``; ``photometry`` is that without AGN."""
        on_image = self._is_measured(band)
        self._put(table, photometry, band, band, on_image)
        table[N_IMAGES][self.rows[on_image]] += 1
        name = band + NUCLEUS
        if name not in table.colnames:
            return
        column = f"{band}_flux_point"
        has_point = self._is_measured(column)
        self._put(table, photometry, name, column, has_point)
        correlation = _numbers(self.measured, column + CORRELATION)[self.after][has_point]
        table[name + CORRELATION][self.rows[has_point]] = correlation

    def _is_measured(self, name):
        """Whether the column has flux and error with the AGN: bool, shape (n,)."""
        flux = _column(self.measured, name)[self.after]
        error = _column(self.measured, error_column(name))[self.after]
        return np.isfinite(flux) & np.isfinite(error)

    def _put(self, table, photometry, name, measured_name, chosen):
        """Change flux and error of the ``chosen`` of the rows."""
        rows = self.rows[chosen]
        values = {}
        for state, source, index in (
            ("before", self.without, self.before),
            ("after", self.measured, self.after),
        ):
            values[state] = _column(source, measured_name)[index][chosen]
            error = _column(source, error_column(measured_name))
            values[f"{state}_err"] = error[index][chosen]
        own = _column(photometry, name)[rows]
        own_error = _column(photometry, error_column(name))[rows]
        limited = np.zeros(len(rows), bool)
        if name + IS_LIMIT in photometry.colnames:
            limited = np.asarray(photometry[name + IS_LIMIT], bool)[rows]
        flux = own + values["after"] - values["before"]
        error = own_error * values["after_err"] / values["before_err"]
        replaced = limited | ~np.isfinite(flux) | ~np.isfinite(error)
        flux = np.where(replaced, values["after"], flux)
        error = np.where(replaced, values["after_err"], error)
        _set(table, name, rows, flux)
        _set(table, error_column(name), rows, error)
        if name + IS_LIMIT in table.colnames:
            is_limit = np.array(table[name + IS_LIMIT], bool)
            is_limit[rows] = False
            table[name + IS_LIMIT] = is_limit


def separate_trials(sky, chosen, distance):
    """
    Divide positions into sets in which they are apart from each other.

    Parameters
    ----------
    sky : `~astropy.coordinates.SkyCoord`, shape (n,)
        Positions; some may be the same.
    chosen : bool `~numpy.ndarray`, shape (n,)
        Which are divided.
    distance : `~astropy.units.Quantity`
        Least distance in a set.

    Returns
    -------
    trial : int `~numpy.ndarray`, shape (n,)
        Number of the set, from 0; each position is in the first set that has room. It is -1 if not chosen.
    """
    trial = np.full(len(sky), -1)
    for i in np.flatnonzero(chosen):
        near = sky[i].separation(sky) < distance
        taken = set(trial[near].tolist())
        number = 0
        while number in taken:
            number += 1
        trial[i] = number
    return trial


def _points(sky):
    """Sources that are points at positions."""
    n = len(sky)
    sources = QTable({"sky": sky, "profile": np.full(n, "point")})
    sources["half_light_radius"] = np.zeros(n) * ANGLE
    sources["sersic_index"] = np.ones(n)
    sources["axis_ratio"] = np.ones(n)
    sources["position_angle"] = np.zeros(n) * u.deg
    return sources


def _rows_of_ids(table, ids):
    """Find the rows of ids in a table, as text: -1 for those that it lacks."""
    row_of_id = {}
    for row, key in enumerate(np.asarray(table["id"]).tolist()):
        row_of_id[str(key)] = row
    return np.array([row_of_id.get(str(key), -1) for key in np.asarray(ids).tolist()], int)


def _column(table, name):
    """Read fluxes in uJy, NaN where masked."""
    return np.ma.filled(np.ma.asarray(to_array(table[name], FNU, name)), np.nan)


def _numbers(table, name):
    """Read numbers, NaN where masked."""
    return np.ma.filled(np.ma.asarray(table[name], float), np.nan)


def _set(table, name, rows, values):
    """Replace some fluxes (uJy) of a column."""
    column = _column(table, name)
    column[rows] = values
    table[name] = column * FNU
