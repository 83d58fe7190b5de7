"""Peaks of posteriors between nodes, and normal distributions around them, against closed forms."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.grids import photometry_table
from miricigale.fitting import BayesFitter, GridSettings, _core
from miricigale.fitting.grid import adaptive
from miricigale.fitting.grid.placed_models import places_to_values
from miricigale.sed import ModelGrid

BANDS = tuple(f"band{i}" for i in range(6))
PLACE = np.linspace(-1.0, 1.0, len(BANDS))
#: What tau does to ln(flux), partly as redshift does.
BENT = 0.5 * PLACE**2 + 0.3 * PLACE
REDSHIFT = np.linspace(0.5, 1.5, 21)
TAU = np.linspace(0.5, 2.5, 9)
TRUE = {"redshift": 1.02, "tau": 1.4}
ERROR = 0.01


def shapes(z, tau):
    """Ln of the fluxes of a solar mass, up to a constant."""
    z, tau = (np.asarray(x, float)[..., None] for x in (z, tau))
    return z * np.sin(2 * PLACE) + tau * BENT


def shapes_twice(z, tau):
    """The same, with the redshifts of 0.7 and 1.3 alike but for the last band."""
    z, tau = (np.asarray(x, float)[..., None] for x in (z, tau))
    apart = 20.0 * (z - 1.0) ** 2
    return apart * np.sin(2 * PLACE) + tau * 0.5 * PLACE**2 + 0.01 * z * (PLACE > 0.9)


def fitter_of(log_flux):
    """Fitter of a grid of redshifts and tau without AGN, fluxes of which are exp(log_flux)."""
    return BayesFitter(
        ModelGrid(
            filters=BANDS,
            redshift=REDSHIFT,
            galaxy=1e-9 * np.exp(log_flux(REDSHIFT[:, None], TAU)),
            agn=np.zeros((REDSHIFT.size, 0, len(BANDS))),
            agn_multiplicity=np.zeros(0, int),
            agn_parameters=QTable(),
            agn_properties=QTable(),
            dust_luminosity=np.full(TAU.size, 1e27),
            frac_agn=np.zeros(1),
            allowed=np.ones((REDSHIFT.size, TAU.size), bool),
            galaxy_parameters=QTable({"tau": TAU * u.Gyr}),
            galaxy_properties=QTable({"sfr": np.full(TAU.size, 1e-10) / u.yr}),
            axes={"tau": TAU, "redshift": REDSHIFT, "frac_agn": np.zeros(1)},
        ),
        model_error=0.0,
        settings=GridSettings(interpolate=200),
    )


@pytest.fixture
def peaks_of(monkeypatch):
    """Function that fits fluxes: arguments of `find_peaks`, and its `NormalPeaks`."""
    calls = []
    find_peaks = adaptive.find_peaks

    def recorded(*arguments):
        calls.append((arguments, find_peaks(*arguments)))
        return calls[-1][1]

    monkeypatch.setattr(adaptive, "find_peaks", recorded)

    def fitted(fitter, flux, error):
        fitter.fit(photometry_table(BANDS, flux[None], error[None]))
        return calls[-1]

    return fitted


def values_at(space, labels, target, work, label, score):
    """Redshift and tau at scores, (n, n_axes), with what `_core.evaluate_places` says there."""
    n = len(score)
    place = np.empty(score.shape)
    evaluated = np.empty((n, 5))
    of_label = np.full(n, label)
    _core.evaluate_places(space, labels, target, of_label, score, place, evaluated, work)
    names = ("redshift", None, "tau")
    values = {}
    for axis, name in enumerate(names):
        if name is not None:
            values[name] = places_to_values(space, axis, place[:, axis])[1]
    return np.column_stack([values["redshift"], values["tau"]]), evaluated


def test_narrow_peaks_are_normal_distributions(peaks_of):
    """
    Errors of 1 % make the posterior normal, with the covariance of a linear fit.

    Its peak is at the truth, as there is no noise. The integral is that of prior and likelihood, as the scale is
    at its best.
    """
    flux = np.exp(shapes(TRUE["redshift"], TRUE["tau"])) * 10.0
    arguments, peaks = peaks_of(fitter_of(shapes), flux, ERROR * flux)
    space, labels, target, work = arguments[:4]
    assert len(peaks.label) == 1
    label = peaks.label[0]
    n_active = labels.n_active[label]
    axes = labels.axes[label, :n_active]
    assert list(axes) == [0, 2]
    # ln(flux) is linear: derivatives over errors, without what a scale takes up
    derivatives = np.column_stack([np.sin(2 * PLACE), BENT]) / ERROR
    derivatives = derivatives - derivatives.mean(axis=0)
    want = np.linalg.inv(derivatives.T @ derivatives)
    # scores to values
    steps = np.array([peaks.score[0]] * 3)
    width = 1e-4
    for i, axis in enumerate(axes):
        steps[i + 1, axis] += width
    values, evaluated = values_at(space, labels, target, work, label, steps)
    slope = np.diag(values[1:] - values[0]) / width
    apart = values[0] - [TRUE["redshift"], TRUE["tau"]]
    assert np.all(np.abs(apart) < 0.3 * np.sqrt(np.diag(want)))
    cov = peaks.cov[0, :n_active, :n_active]
    cov = np.tril(cov) + np.tril(cov, -1).T
    assert_allclose(slope[:, None] * cov * slope, want, rtol=0.02)
    # nodes are as likely as each other, and their cells as wide as they are apart
    density = 1.0 / (REDSHIFT.size * np.diff(REDSHIFT)[0] * TAU.size * np.diff(TAU)[0])
    log_likelihood = evaluated[0, 4]
    log_evidence = np.log(density) + 0.5 * np.linalg.slogdet(2.0 * np.pi * want)[1]
    assert peaks.log_weight[0] - log_likelihood == pytest.approx(log_evidence, abs=0.02)


def test_both_of_two_peaks_are_found(peaks_of):
    """Of about the same height, at redshifts of 0.7 and 1.3."""
    flux = np.exp(shapes_twice(0.7, 1.4)) * 10.0
    error = 0.02 * flux
    arguments, peaks = peaks_of(fitter_of(shapes_twice), flux, error)
    space, labels, target, work = arguments[:4]
    redshift = []
    for label, score in zip(peaks.label, peaks.score, strict=True):
        values, _ = values_at(space, labels, target, work, label, score[None])
        redshift.append(values[0, 0])
    redshift = np.array(redshift)
    low = np.abs(redshift - 0.7) < 0.02
    high = np.abs(redshift - 1.3) < 0.02
    assert low.any()
    assert high.any()
    assert np.all(low | high)
    # each has about half of the integral
    share = peaks.shares(len(labels.n_active) * 2, 2)
    assert share.sum() == pytest.approx(1.0)
    weight = peaks.weights(np.arange(len(redshift)))
    assert weight[low].sum() == pytest.approx(0.5, abs=0.1)
