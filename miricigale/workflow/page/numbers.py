"""The plain numbers of a study (``report/metrics.json``), from the tables of a run."""

import functools
import itertools

import astropy.units as u
import numpy as np

from miricigale import depth, photometry
from miricigale.evaluation import (
    PUBLISHED_LIGHT,
    fraction_interval,
    integrated_light,
    recovery_metrics,
    sigma_mad,
)
from miricigale.evaluation.coverage import interval_share
from miricigale.instrument import CEERS_FILTERS, ceers_exposures
from miricigale.utils.units import ab_magnitude
from miricigale.workflow.stages.conditions import (
    band_conditions,
    bright_isolated,
    detection_counts,
    fit_conditions,
    has_flag,
    is_complete,
    is_matched,
)
from miricigale.workflow.stages.exposures import pointing_exposures, pointing_time
from miricigale.workflow.stages.fits import true_ranks
from miricigale.workflow.stages.inputs import FitPieces
from miricigale.workflow.stages.sample import NOT_COUNTED, SampleFlags, is_sample

#: Fewest sources of which a median with its error or scatter is shown.
FEWEST = 5
#: AB magnitude of the limit of the mock photometry at 24 um.
MIPS_LIMIT = 19.3

#: Shares of sources detected in two or more bands, by F160W limit: Yang et al. 2021.
PAPER_DETECTED = ((26.0, 0.53), (25.0, 0.75))


def _table(path):
    """Declare a table of a truth, by its path within the run, that is read when it is first asked for."""
    return functools.cached_property(lambda self: self._context.table(path.format(self._name)))


class StudyTables:
    """
    The tables of one truth of a run, each read when it is first asked for.

    Parameters
    ----------
    context : `~miricigale.workflow.Context`
        Of a stage, or of none.
    name : str
        Name of the truth.
    """

    def __init__(self, context, name):
        self._context = context
        self._name = name

    #: The sources of the catalog with their true fluxes (stage 3).
    truth = _table("{}/truth.ecsv")
    #: The same sources row by row with measured fluxes (stage 12).
    matched = _table("{}/matched.ecsv")
    #: The photometry of all detections.
    detections = _table("{}/photometry.ecsv")

    @functools.cached_property
    def errors(self):
        """The error functions (`~miricigale.photometry.ErrorModel`), of the reference truth."""
        return photometry.ErrorModel.read(self._context.path("errors.ecsv"))

    @functools.cached_property
    def results(self):
        """Fits of the sample by set of bands (`~miricigale.workflow.stages.inputs.FitPieces`)."""
        n = len(self.truth)
        results = {}
        for unit in self._context.config.fit.sets:
            results[unit] = FitPieces(self._context, f"{self._name}/fits_{unit}", n)
        return results

    @functools.cached_property
    def points(self):
        """Bright point sources by band; empty where that check was not made."""
        config = self._context.config
        if not config.point_sources.enabled:
            return {}
        return self._context.tables("points", config.exposures.filters)

    @property
    def sample(self):
        """Rows of the truth that were fitted."""
        return self.truth[is_sample(self.matched)]

    @property
    def inside(self):
        """Which sources are in the imaged field."""
        return ~has_flag(self.matched, "selection", SampleFlags.OUTSIDE_FIELD)

    @property
    def field(self):
        """Which of these are galaxies with a model that no cut leaves out."""
        return self.inside & ~has_flag(self.matched, "selection", NOT_COUNTED)

    @functools.cached_property
    def fits(self):
        """The results as tables: dict of str to `~astropy.table.QTable`."""
        return {unit: results.to_table() for unit, results in self.results.items()}

    def galaxies(self, *, field=False):
        """Return rows of the truth that are galaxies with a model, of the imaged field or all."""
        rows = np.isfinite(self.truth["stellar_mass"].value)
        rows &= ~np.asarray(self.truth["star"], bool)
        if field:
            rows &= self.inside
        return self.truth[rows]


def as_ceers(config, name):
    """Tell whether a band is exposed as CEERS did: readout, frames in each dither, number of dithers."""
    if name not in CEERS_FILTERS:
        return False
    exposures = pointing_exposures(config, name)
    return _frames(exposures) == _frames(_of_ceers(exposures[0], name))


def _frames(exposures):
    """Return readout, sub-array and frames of each exposure."""
    # the split of the frames into groups and integrations is not the survey's
    return [(e.readout, e.subarray, e.n_groups * e.n_integrations) for e in exposures]


def _of_ceers(exposure, name):
    """Return the exposures of CEERS in a band, at the pointing of another exposure."""
    return ceers_exposures(exposure.pointing, exposure.roll, filters=[name])


def _proposal(name, exposure):
    """Return the limit that the CEERS proposal quotes for a band, and the time that it is for."""
    if name not in CEERS_FILTERS:
        return {"proposal": np.nan, "proposal_time": np.nan}
    time = sum(dither.exposure_time for dither in _of_ceers(exposure, name))
    limit = float(depth.proposal_limit(name).value)
    return {"proposal": limit, "proposal_time": time.to_value(u.s)}


def above_proposal(truth, bands):
    """Count bands with a true flux above the limit of the CEERS proposal, by source; None if a band has none."""
    if not set(bands) <= set(CEERS_FILTERS):
        return None
    counts = np.zeros(len(truth), int)
    for name in bands:
        counts += ab_magnitude(truth[name]) < depth.proposal_limit(name).value
    return counts


def as_paper(config):
    """Tell whether exposures, bands and selection are those of Yang et al. 2021."""
    bands = config.exposures.filters
    if set(bands) != set(CEERS_FILTERS) or config.highres.filter != "wfc3.f160w":
        return False
    return all(as_ceers(config, name) for name in bands)


#: Exposure times, in units of that of one pointing, that limit the rows of depths.
_TIMES = (0.0, 0.8, 1.5, np.inf)


def _depth_by_time(tables, name, time):
    """Count galaxies of the field by exposure time in a band, with its median and the limit there."""
    times = (tables.matched[f"{name}_time"] / time).to_value(u.one)
    rows = []
    for low, high in itertools.pairwise(_TIMES):
        chosen = tables.field & (times >= low) & (times < high)
        if np.any(chosen):
            share = float(np.median(times[chosen]))
            # the error at a flux is that of one pointing, over the root of the share
            limit = tables.errors.limiting_magnitude(name, 5.0 / np.sqrt(share))
            rows.append({"n": int(chosen.sum()), "share": share, "limit": float(limit.value)})
    return rows


def _light(galaxies, bands, area):
    """Measure the light of all galaxies together, where it is published."""
    rows = []
    for name, wave, min_flux, published, down, up, reference in PUBLISHED_LIGHT:
        if name in bands:
            flux = galaxies[name][galaxies[name] >= min_flux * u.uJy]
            light, error = integrated_light(flux, area, wave * u.um)
            row = {
                "band": name,
                "wavelength": wave,
                "least": min_flux,
                "n": len(flux),
                "light": light.value,
                "light_err": error.value,
                "published": published,
                "down": down,
                "up": up,
                "reference": reference,
            }
            if len(flux) == 0:
                # without sources the error is undefined too
                row["light"] = np.nan
                row["light_err"] = np.nan
            rows.append(row)
    return rows


def _detected(config, tables, n_bands):
    """Measure shares of the galaxies of the field detected in enough bands, by limit of the prior's magnitude."""
    prior = ab_magnitude(tables.truth[config.highres.filter])
    proposal = above_proposal(tables.truth, config.exposures.filters)
    detected = tables.matched["n_detected"] >= n_bands
    rows = []
    for limit, paper in PAPER_DETECTED:
        if limit > config.catalog.mag_limit:
            continue
        chosen = tables.field & (prior < limit)
        n = int(chosen.sum())
        fraction, low, high = fraction_interval(int(np.count_nonzero(chosen & detected)), n)
        to_proposal = np.nan
        if proposal is not None and n > 0:
            to_proposal = float(np.mean(proposal[chosen] >= n_bands))
        row = {
            "limit": limit,
            "n": n,
            "fraction": fraction,
            "low": low,
            "high": high,
            "to_proposal": to_proposal,
            "paper": paper,
        }
        rows.append(row)
    return rows


def _band_numbers(config, tables, name):
    """Measure recovery, limits and conditions of one band."""
    matched = tables.matched
    usable = is_matched(matched)
    flux = matched[name].value
    true = matched[f"{name}_true"].value
    formal = matched[f"{name}_formal_err"].value
    isolated = bright_isolated(matched, name)
    bright = recovery_metrics(true[isolated], flux[isolated], relative=True)
    faint = usable & is_complete(matched, name) & (true < 20 * formal) & np.isfinite(flux)
    pulls = (flux[faint] - true[faint]) / formal[faint]
    time = pointing_time(config, name)
    median = np.nan
    if usable.any():
        median = np.nanmedian(formal[usable])
    entry = {
        "n_measured": int(np.count_nonzero(usable & np.isfinite(flux))),
        "formal_limit": float(ab_magnitude(5 * median * u.uJy)),
        "pull_n": int(pulls.size),
        "pull_median": float(np.median(pulls)) if pulls.size else np.nan,
        "pull_scatter": sigma_mad(pulls),
        "limit": float(tables.errors.limiting_magnitude(name).value),
        "etc_limit": float(depth.scaled_limit(name, time).to_value(u.ABmag)),
        "coverage": _depth_by_time(tables, name, time) if config.errors.coverage else [],
        **_proposal(name, pointing_exposures(config, name)[0]),
        "ceers": as_ceers(config, name),
        "bright_n": bright.n,
        "bright_median": bright.median,
        "bright_median_err": bright.median_err,
        "conditions": band_conditions(matched, name),
    }
    if name in tables.points:
        points = tables.points[name]
        inside = points[np.asarray(points["in_field"], bool)]
        recovery = recovery_metrics(inside["flux_true"].value, inside["flux"].value, relative=True)
        entry["points_n"] = recovery.n
        entry["points_median"] = recovery.median
        entry["points_scatter"] = recovery.sigma_mad
        for key in ("f_scaling", "f_scaling_err", "f_aper"):
            entry[key] = float(points.meta.get(key, np.nan))
    return entry


def study_metrics(config, tables, area):
    """
    Measure the numbers of the field and of its bands, as plain values for ``report/metrics.json``.

    ``tables`` are those of the reference truth, ``area`` is the solid angle of the imaged
    field; NaN where there is nothing to count.
    """
    bands = config.exposures.filters
    field = tables.field
    left_out = {}
    for flag in SampleFlags:
        rows = has_flag(tables.matched, "selection", flag)
        if flag != SampleFlags.OUTSIDE_FIELD:
            # what else a source outside of the field may be is no matter
            rows &= tables.inside
        left_out[flag.name.lower()] = int(np.count_nonzero(rows))
    # with a single band, detections in that band are counted
    n_bands = min(2, len(bands))
    return {
        "n_catalog": len(tables.truth),
        "n_field": int(field.sum()),
        "n_matched": int((field & np.asarray(tables.matched["matched"])).sum()),
        "n_sample": len(tables.sample),
        "n_left_out": left_out,
        "area": float(area.to_value(u.arcmin**2)),
        "as_paper": as_paper(config),
        "detections": detection_counts(tables.detections, bands),
        "n_bands_detected": n_bands,
        "bands": {name: _band_numbers(config, tables, name) for name in bands},
        "detected": _detected(config, tables, n_bands),
        "light": _light(tables.galaxies(field=True), bands, area),
    }


#: Numbers of a fit by the quantities of `~miricigale.evaluation.study_numbers` that they are.
_OF_FIT = {
    "photoz_bias": "z_bias",
    "photoz_sigma_mad": "z_scatter",
    "photoz_outliers": "z_outliers",
    "frac_agn_bias": "frac_offset",
    "frac_agn_sigma_mad": "frac_scatter",
    "frac_agn_width": "width",
}


def whole_sample(numbers):
    """
    Return the rows that are of all redshifts, by truth, set of bands and quantity.

    ``numbers`` is the table of `~miricigale.evaluation.study_numbers`.
    """
    rows = numbers[(numbers["z_low"] == 0) & np.isinf(numbers["z_high"])]
    return {(row["truth"], row["band_set"], row["quantity"]): row for row in rows}


def truth_metrics(truth, tables, numbers, bands, seed):
    """
    Return numbers of one truth as plain values: recovery of redshift and fracAGN, by set of bands.

    ``truth`` is a `~miricigale.workflow.truths.Truth`, ``tables`` are its `StudyTables`, ``numbers`` those of
    `whole_sample`, and ``seed`` is that of the ranks (`true_ranks`).
    """
    sample = tables.sample
    matched = tables.matched[is_sample(tables.matched)]
    fits = {}
    for unit, table in tables.fits.items():
        outliers = numbers[truth.name, unit, "z_outliers"]
        n = int(outliers["n"])
        fit = {"n": n}
        for key, quantity in _OF_FIT.items():
            fit[key] = float(numbers[truth.name, unit, quantity]["value"])
        if n:
            fit["photoz_n_outliers"] = round(n * fit["photoz_outliers"])
        else:
            fit["photoz_n_outliers"] = 0
        fit["photoz_outliers_low"] = float(outliers["low"])
        fit["photoz_outliers_high"] = float(outliers["high"])
        rank = np.empty(0)
        if len(table):
            rank = true_ranks(tables.results[unit], sample, "redshift", seed)
        # as in the table of the coverage of all parameters
        fit["redshift_coverage"] = interval_share(rank)
        fit["conditions"] = fit_conditions(matched, sample["redshift"], table, bands)
        fits[unit] = fit
    return {**truth.values(), "n_sample": len(sample), "fits": fits}
