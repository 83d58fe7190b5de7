"""Mock studies: tables as a run would have them, from analytic draws."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.evaluation import StudyResults, TruthResults

BANDS = tuple(
    f"miri.{name}" for name in ("f770w", "f1000w", "f1280w", "f1500w", "f1800w", "f2100w")
)
LIMITS = dict(zip(BANDS, (25.5, 24.8, 24.3, 23.8, 22.9, 22.8), strict=True))
#: Scatter of dz/(1+z), share of outliers, and width of fracAGN by band set.
FITS = {"none": (0.05, 0.10, 0.15), "all": (0.02, 0.02, 0.05), "blue": (0.03, 0.04, 0.1),
        "red": (0.04, 0.06, 0.1)}  # fmt: skip


def mock_truth(frac_agn, n=600, *, seed=1, sets=tuple(FITS)):
    """One truth: MIRI fluxes with Gaussian noise, fits with Gaussian errors and outliers at z + 1."""
    base = np.random.default_rng(seed)
    rng = np.random.default_rng([seed, round(1000 * frac_agn)])
    z = base.uniform(0.1, 4.0, n)
    prior = base.uniform(21, 26.5, n)
    truth = QTable({"id": np.arange(n), "redshift": z, "frac_agn": np.full(n, frac_agn)})
    truth["wfc3.f160w"] = 10 ** (-0.4 * (prior - 23.9)) * u.uJy
    truth["mips.24"] = 3 * truth["wfc3.f160w"]
    truth["sersic_index"] = base.uniform(0.5, 5, n)
    truth["profile"] = np.where(base.uniform(size=n) < 0.2, "point", "sersic")
    power = 10 ** base.normal(44.0, 0.8, n) * frac_agn / (1 - frac_agn + 1e-9) * u.erg / u.s
    truth["l_6um"] = 0.3 * power
    truth["accretion_power"] = power.to(u.W)
    truth["ir_luminosity"] = 10 ** (base.normal(10.5, 0.5, n) + 0.3 * z) * u.Lsun
    matched = QTable({"id": truth["id"]})
    crowded = {}
    agn = 20 * (truth["l_6um"] / (1e44 * u.erg / u.s)).to_value(u.one) / (1 + z) ** 3
    for k, name in enumerate(BANDS):
        sigma = 0.2 * 10 ** (-0.4 * (LIMITS[name] - 23.9))
        true = 0.3 * truth["wfc3.f160w"].value * (1 + k) + agn
        matched[f"{name}_true"] = true * u.uJy
        matched[name] = (true + rng.normal(0, sigma, n)) * u.uJy
        matched[f"{name}_err"] = np.full(n, sigma) * u.uJy
        crowded[name] = base.uniform(size=n) < 0.15
    field = np.ones(n, bool)
    field[:20] = False
    matched["n_detected"] = sum((matched[b] > 5 * matched[f"{b}_err"]).astype(int) for b in BANDS)
    matched["selection"] = np.where(matched["n_detected"] >= 2, 0, 16) | np.where(field, 0, 1)
    sample = np.asarray(matched["selection"]) == 0
    fits = {name: mock_fit(truth[sample], rng, *FITS[name]) for name in sets}
    return TruthResults(
        f"agn{round(100 * frac_agn):02d}", frac_agn, truth, matched, fits, field, crowded
    )


def mock_fit(truth, rng, scatter, outliers, width):
    """Table of a fit of some sources."""
    n, z = len(truth), np.asarray(truth["redshift"])
    fit = QTable({"id": truth["id"]})
    fit["redshift_mean"] = z + scatter * (1 + z) * rng.normal(size=n)
    fit["redshift_mean"][rng.uniform(size=n) < outliers] += 1.0
    fit["redshift_std"] = scatter * (1 + z)
    fit["frac_agn_mean"] = np.clip(truth["frac_agn"] + rng.normal(0, width, n), 0, 1)
    fit["frac_agn_std"] = np.full(n, width)
    power = truth["accretion_power"]
    fit["accretion_power_mean"] = power * 10 ** rng.normal(-0.1, 0.3, n)
    return fit


def mock_study(fractions=(0.0, 0.2, 0.6, 0.99), **kwargs):
    """A study of several truths."""
    truths = tuple(mock_truth(f, **kwargs) for f in fractions)
    limits = {name: limit - 0.5 for name, limit in LIMITS.items()}
    return StudyResults(truths, BANDS, limits=limits, etc_limits=dict(LIMITS))
