"""Places of narrow posteriors by a rising power of the likelihood, against distributions in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import multivariate_normal, norm

from miricigale.fitting import _core
from miricigale.fitting.grid.tempering import TemperedPlaces, prior_mixture, temper
from miricigale.fitting.posterior.quantities import percentile_error

#: Prior and likelihood: two labels, in the second of which the second axis has no effect.
LABEL_PRIOR = np.array([0.7, 0.3])
ACTIVE = np.array([[True, True], [True, False]])
WIDTH = 0.01
#: Means of the two peaks of the likelihood of the first label, and what they count.
MEANS = np.array([[1.5, -0.5], [-1.0, 1.0]])
HEIGHTS = np.array([0.2, 0.8])
#: Mean of the likelihood of the second label.
MEAN = 0.3


def _log_likelihood(label, score):
    likelihood = np.zeros(len(label))
    for mean, height in zip(MEANS, HEIGHTS, strict=True):
        likelihood += height * norm.pdf(score, mean, WIDTH).prod(axis=1)
    alone = norm.pdf(score[:, 0], MEAN, WIDTH)
    with np.errstate(divide="ignore"):
        log = np.log(np.where(label == 0, likelihood, alone))
    return np.maximum(log, -1e5)


def _evaluate(label, score):
    evaluated = np.zeros((len(label), 5))
    evaluated[:, 4] = _log_likelihood(label, score)
    evaluated[:, 0] = evaluated[:, 4] + np.log(LABEL_PRIOR[label])
    evaluated[:, 0] += norm.logpdf(score).sum(axis=1)
    return evaluated, score.copy()


def _truths():
    """Evidences of the two peaks of the first label and of the second: priors times likelihoods, integrated."""
    peaks = multivariate_normal.pdf(MEANS, np.zeros(2), (1.0 + WIDTH**2) * np.eye(2))
    alone = norm.pdf(MEAN, 0.0, np.sqrt(1.0 + WIDTH**2))
    return np.array([*(LABEL_PRIOR[0] * HEIGHTS * peaks), LABEL_PRIOR[1] * alone])


def _tempered(seed):
    rng = np.random.default_rng(seed)
    n = 4096
    label = (rng.random(n) > LABEL_PRIOR[0]).astype(int)
    score = rng.standard_normal((n, 2))
    evaluated, place = _evaluate(label, score)
    log_density = np.log(LABEL_PRIOR[label]) + norm.logpdf(score).sum(axis=1)
    places = TemperedPlaces(label, score, evaluated, place, np.arange(n), 0.0)
    return temper(_evaluate, places, log_density, ACTIVE, rng, 2048)[0]


@pytest.mark.slow
def test_labels_and_peaks_have_the_weights_of_their_evidences():
    """Peaks are 290 widths apart."""
    truths = _truths()
    shares = []
    log_evidences = []
    for seed in range(16):
        places = _tempered(seed)
        is_first = (places.label == 0) & (places.score[:, 0] > 0)
        is_second = (places.label == 0) & (places.score[:, 0] < 0)
        shares.append([is_first.mean(), is_second.mean(), (places.label == 1).mean()])
        log_evidences.append(places.log_evidence)
    shares = np.array(shares)
    error = shares.std(axis=0, ddof=1) / np.sqrt(len(shares))
    assert np.all(error < 0.03)
    assert np.all(np.abs(shares.mean(axis=0) - truths / truths.sum()) < 3.5 * error)
    # the mean of evidences, not of their logarithms, has no bias
    evidences = np.exp(log_evidences)
    error = evidences.std(ddof=1) / np.sqrt(len(evidences))
    assert error < 0.07 * truths.sum()
    assert abs(evidences.mean() - truths.sum()) < 3.5 * error


def test_places_have_the_shape_of_each_peak():
    places = _tempered(1)
    assert_array_equal(places.evaluated, _evaluate(places.label, places.score)[0])
    rows = (places.label == 0) & (places.score[:, 0] < 0)
    peak = places.score[rows]
    assert_allclose(peak.mean(axis=0), MEANS[1], atol=0.002)
    assert_allclose(peak.std(axis=0), WIDTH, rtol=0.12)
    alone = places.score[places.label == 1]
    assert_allclose(alone[:, 0].mean(), MEAN, atol=0.002)
    assert_allclose(alone[:, 0].std(), WIDTH, rtol=0.15)
    # an axis without effect keeps its prior
    assert_allclose(alone[:, 1].std(), 1.0, rtol=0.2)


def test_impossible_places_count_as_such():
    """Half of the places have no model, as ages above that of the universe: the evidence is halved."""
    rng = np.random.default_rng(7)
    score = rng.standard_normal((8192, 2))
    is_possible = score[:, 0] > 0

    def evaluate(label, score):
        evaluated = np.zeros((len(score), 5))
        evaluated[:, 0] = norm.logpdf(score).sum(axis=1)
        impossible = score[:, 0] < 0
        evaluated[impossible, 0] = _core.NEVER
        # what a kernel says of the likelihood of no model means nothing
        evaluated[impossible, 4] = np.nan
        return evaluated, score.copy()

    label = np.zeros(8192, int)
    evaluated, place = evaluate(label, score)
    places = TemperedPlaces(label, score, evaluated, place, np.arange(8192), 0.0)
    tempered, _ = temper(evaluate, places, norm.logpdf(score).sum(axis=1), ACTIVE, rng, 2048)
    assert_allclose(tempered.log_evidence, np.log(is_possible.mean()), atol=1e-12)
    assert tempered.score[:, 0].min() > 0
    assert_allclose(tempered.score[:, 0].mean(), np.sqrt(2.0 / np.pi), atol=0.06)


def test_the_same_seed_gives_the_same_places():
    assert_array_equal(_tempered(2).score, _tempered(2).score)


def test_the_prior_mixture_has_the_densities_of_t_distributions():
    """By draws of the mixture: the density integrates to 1 over each label, whose share is that of its cells."""
    labels = SimpleNamespace(
        first=np.array([[0, 0], [1, 0]]),
        count=np.array([[1, 3], [2, 3]]),
        below=np.array([[0.0, 0.25, 0.5, 1.0], [0.0, 0.2, 0.6, 1.0]]),
        n_active=np.array([1, 2]),
    )
    mixture = prior_mixture(labels)
    assert_allclose(mixture.share, [0.25, 0.75])
    freedom = _core.FREEDOM
    for top, n_active in zip(mixture.top, labels.n_active, strict=True):
        # the density is top (1 + r^2 / freedom)^-((freedom + n) / 2)
        radius = np.linspace(0.0, 400.0, 400001)
        density = top * (1.0 + radius**2 / freedom) ** (-0.5 * (freedom + n_active))
        area = {1: 2.0, 2: 2.0 * np.pi * radius}[int(n_active)]
        assert_allclose(np.trapezoid(density * area, radius), 1.0, rtol=1e-6)


def test_draws_of_one_lineage_count_as_one():
    rng = np.random.default_rng(4)
    values = rng.standard_normal(3000)
    weight = rng.random(3000)
    weight /= weight.sum()
    alone = percentile_error(values, weight)
    copies = percentile_error(
        np.repeat(values, 5), np.repeat(weight, 5) / 5.0, np.repeat(np.arange(3000), 5)
    )
    assert_allclose(copies, alone, rtol=0.05)
    unrelated = percentile_error(values, weight, np.arange(3000))
    assert_allclose(unrelated, alone, rtol=0.05)
    assert percentile_error(np.repeat(values, 5), np.repeat(weight, 5) / 5.0) < 0.6 * alone
