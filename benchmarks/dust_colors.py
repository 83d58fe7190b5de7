"""
Dust of input SEDs against MIRI fluxes of CEERS: what `ceers_dust` draws from, measured and tested.

    MIRICIGALE_DATA=../shared/data python benchmarks/dust_colors.py [--field] [--features]

Sources of the part of the catalog of Lisiecki et al. 2025 in $MIRICIGALE_DATA/ceers with F444W > 1 uJy and a flux
in MIRI are fitted in HST and NIRCam bands as a study fits its input SEDs, and scaled to F160W. MIRI fluxes are
those of the starlight and of the dust times an excess, with alpha as a study draws it. The likelihood has four
times the catalog's errors (`calibrate` finds 4.1 and 3.8), 0.12 dex for starlight and apertures, one flux in 20
that is anything within 3 dex, and the condition that a flux is there because it is above the 5th percentile of its
band. The excess is measured where 40 % of the flux or more are the dust's by energy balance. Each half of the
sources, every other one, is predicted with what the other half gives.

``--features`` prints the likelihood of strengths of the 3.3 um feature, ``--field`` the light and counts of the
bundled field.
"""

import argparse
import os
from pathlib import Path
from types import SimpleNamespace

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.stats import mad_std
from ceers import sample
from scipy.optimize import minimize
from scipy.special import log_ndtr, logsumexp

from miricigale.evaluation import PUBLISHED_LIGHT, integrated_light, uvj_quiescent
from miricigale.scene import read_catalog
from miricigale.sed import SEDModel
from miricigale.workflow import load_config
from miricigale.workflow.stages.inputs import bright_sources, fit_seds
from miricigale.workflow.stages.truth import galaxy_parameters

BANDS = [f"miri.f{n}w" for n in (560, 770, 1000, 1280, 1500, 1800)]
ALPHA, EXCESS = np.linspace(1.5, 2.5, 5), np.linspace(-2.5, 2.0, 91)
ERRORS, SCATTER, WRONG = 4.0, 0.12, 0.05
#: log10 of stellar masses between which the mean rises, of specific star-formation rates, and least share of the
#: dust in a flux.
MASSES, RATES, DUSTY = (8.5, 10.3), (-12.0, -8.0), 0.4
#: Fluxes (uJy) above which sources are counted.
LEAST = (0.1, 0.2, 1.0, 10.0)
SEDS = SimpleNamespace(axes="galaxy", catalog_error=0.05, max_wavelength=3.0)


def fitted(catalog, **sed):
    """Parameters of the galaxies of a catalog, as a study has them."""
    config = load_config("goodss", overrides={"sed": {"infrared": "fit", **sed}})
    best = fit_seds(catalog, SEDS, model_error=config.fit.model_error).to_table()
    return galaxy_parameters(config, catalog, best, seed=1)


class Sources:
    """Fluxes of sources, and those of their starlight and dust."""

    def __init__(self, table, feature):
        bands = [n for n in table.colnames if f"{n}_err" in table.colnames]
        optical = [n for n in bands if not n.startswith("miri")]
        names = [*optical, *(f"{n}_err" for n in optical)]
        model, parameters = SEDModel.yang2021(agn=False), fitted(table["id", "redshift", *names])
        self.flux = np.array([table[n].to_value(u.uJy) for n in BANDS]).T
        self.error = ERRORS * np.array([table[f"{n}_err"].to_value(u.uJy) for n in BANDS]).T
        self.least = np.nanpercentile(self.flux, 5, axis=0)
        if "pah_33" in model.parameters:
            parameters["pah_33"] = feature
        light = []
        for alpha, excess in [(2.0, 0.0), *((a, 1.0) for a in ALPHA)]:
            parameters["alpha"], parameters["dust_excess"] = alpha, excess
            got = model.fluxes(parameters, BANDS)
            light.append(np.array([got[n].to_value(u.uJy) for n in BANDS]).T)
        self.stars, self.dust = (
            light[0],
            np.array(light[1:]).transpose(1, 2, 0) - light[0][..., None],
        )
        self.mass, balance = (np.log10(got[n].value) for n in ("stellar_mass", "dust_luminosity"))
        self.balance = balance - np.log10(u.Lsun.to(u.W)) - self.mass
        rate = np.log10(np.maximum(got["sfr_100myr"].value, 1e-9)) - self.mass
        self.rate = np.clip(rate, *RATES)
        self.passive = uvj_quiescent(got["u_v"], got["v_j"], np.asarray(table["redshift"], float))
        self.library = model.component("dust").name

    def models(self):
        """log10 of fluxes, shape (n, band, alpha, excess)."""
        return np.log10(self.stars[..., None, None] + 10**EXCESS * self.dust[..., None])

    def log_likelihood(self, dusty):
        """Of each alpha and excess, shape (n, alpha, excess), where the dust's share is ``dusty`` or more."""
        dust = self.dust[..., ALPHA.size // 2]
        flux = np.log10(np.where(dust >= dusty * (self.stars + dust), self.flux, np.nan))
        models, out = self.models(), 0.0
        sigma = np.minimum(np.hypot(SCATTER, self.error / self.flux / np.log(10)), 0.6)
        for i in range(len(BANDS)):
            s, model = sigma[:, i, None, None], models[:, i]
            right = -0.5 * ((flux[:, i, None, None] - model) / s) ** 2 - np.log(
                s * np.sqrt(2 * np.pi)
            )
            right -= log_ndtr((model - np.log10(self.least[i])) / s)
            right = np.where(np.isfinite(right), right, -np.inf)
            both = np.logaddexp(np.log(1 - WRONG) + right, np.log(WRONG / 3.0))
            out = out + np.where(np.isfinite(flux[:, i, None, None]), both, 0.0)
        return out


def log_weights(values, sources, rows):
    """Of each excess, shape (n, excess), for values as in CEERS_DUST but the last two."""
    mass, passive = np.clip(sources.mass[rows], *MASSES) - MASSES[1], sources.passive[rows]
    forming = values[0] + values[1] * mass + values[2] * (sources.rate[rows] + 9.3)
    mean = np.where(passive, values[4], forming - sources.balance[rows])
    width = np.where(passive, values[5], values[3])
    out = -0.5 * ((EXCESS - mean[:, None]) / width[:, None]) ** 2
    return out - logsumexp(out, axis=1, keepdims=True)


def measure(likelihood, sources, rows):
    """Values, errors, and log likelihood; quiescent galaxies have a prior of 0.7 dex, within 30 %."""

    def values_of(v):
        return np.array([*v[:3], np.exp(v[3]), v[4], np.exp(v[5])])

    def loss(v):
        each = likelihood[rows] + log_weights(values_of(v), sources, rows)[:, None]
        prior = 0.5 * ((v[5] - np.log(0.7)) / 0.3) ** 2 + 0.5 * (v[3] - np.log(0.3)) ** 2
        return prior - logsumexp(each - np.log(ALPHA.size), axis=(1, 2)).sum()

    found = minimize(loss, [0.7, 0.4, 0.5, np.log(0.3), -0.7, np.log(0.7)], method="BFGS")
    values, error = values_of(found.x), np.sqrt(np.diag(found.hess_inv))
    return values, error * [1, 1, 1, values[3], 1, values[5]], -found.fun


def draws(sources, rows, values, n, rng):
    """log10 of fluxes drawn for some sources, shape (source, n, band)."""
    weight = np.exp(log_weights(values, sources, rows))
    models, out = sources.models()[rows], []
    for w, model in zip(weight, models, strict=True):
        excess = rng.choice(EXCESS.size, n, p=w / w.sum())
        out.append(model[:, rng.integers(ALPHA.size, size=n), excess].T)
    return np.array(out)


def report(sources, drawn, balance):
    """Print offsets and scatter by band, and colors; ``balance`` are sources with all of the feature."""
    rng, flux = np.random.default_rng(2), np.log10(sources.flux)
    noisy = 10**drawn + sources.error[:, None] * rng.normal(size=drawn.shape)
    seen = noisy > 5 * sources.error[:, None]
    good = sources.flux > 5 * sources.error
    plain = np.log10(balance.stars + balance.dust[..., ALPHA.size // 2])
    print("band          n   offset +-    scatter  without noise +-  balance: offset scatter")
    for i, band in enumerate(BANDS):
        rows = np.flatnonzero(good[:, i])
        # median of those that would have been seen
        rows = rows[seen[rows, :, i].any(axis=1)]
        best = np.array([np.median(drawn[r, seen[r, :, i], i]) for r in rows])
        off, old = flux[rows, i] - best, flux[rows, i] - plain[rows, i]
        noise = np.sqrt(np.mean((sources.error / sources.flux / np.log(10))[rows, i] ** 2))
        s = mad_std(off)
        wide = np.std([mad_std(rng.choice(off, off.size)) for _ in range(300)])
        print(
            f"{band:11s} {off.size:4d} {np.median(off):+8.3f} {1.25 * s / np.sqrt(off.size):.3f} {s:8.3f} "
            f"{np.sqrt(max(s**2 - noise**2, 0)):10.3f} {wide:.3f} {np.median(old):+13.3f} {mad_std(old):8.3f}"
        )
    print("color           n   real: 16, 50, 84 %        drawn")
    for a, b in ((0, 1), (2, 3), (2, 4), (3, 4), (3, 5), (4, 5)):
        rows = good[:, a] & good[:, b]
        real = -2.5 * (flux[rows, a] - flux[rows, b])
        with np.errstate(invalid="ignore", divide="ignore"):
            color = -2.5 * np.log10(noisy[rows, :, a] / noisy[rows, :, b])
        both = seen[rows, :, a] & seen[rows, :, b]
        # each source has the same weight
        weight = (both / np.maximum(both.sum(axis=1, keepdims=True), 1))[both]
        order = np.argsort(color[both])
        place = np.interp(
            (0.16, 0.5, 0.84), np.cumsum(weight[order]) / weight.sum(), color[both][order]
        )
        one = " ".join(f"{x:6.2f}" for x in np.quantile(real, (0.16, 0.5, 0.84)))
        print(
            f"{BANDS[a][5:]} - {BANDS[b][5:]:7s} {rows.sum():3d}   {one}   ",
            *(f"{x:6.2f}" for x in place),
        )


def field():
    """Print the light and counts of the bundled field."""
    config = load_config("goodss")
    table = bright_sources(read_catalog(config.catalog.source), config.catalog, "wfc3.f160w")
    pointing, radius = config.pointing, 95 * u.arcsec
    center = SkyCoord(pointing.ra, pointing.dec, unit="deg")
    table = table[(table["sky"].separation(center) < radius) & ~np.asarray(table["star"], bool)]
    table = table[table["redshift"] > 0]
    area, model = np.pi * radius**2, SEDModel.yang2021(agn=False)
    best = fit_seds(table, SEDS, model_error=config.fit.model_error).to_table()
    bands = [*BANDS, "miri.f2100w"]
    for kind in ("fit", "main-sequence", "ceers"):
        one = load_config("goodss", overrides={"sed": {"infrared": kind}})
        light = model.fluxes(galaxy_parameters(one, table, best, seed=config.run.seed), bands)
        light = light[np.isfinite(light[BANDS[0]])]
        print(f"\n{kind}, {len(light)} galaxies")
        for band, wave, least, value, low, high, _ in PUBLISHED_LIGHT:
            flux = light[band][light[band].to_value(u.uJy) > least]
            total, error = integrated_light(flux, area, wave * u.um)
            print(
                f"{band} > {least:g}: {total.value:.2f} +- {error.value:.2f}, published {value} -{low} +{high}"
            )
        for band in bands:
            flux = light[band].to_value(u.uJy)
            many = [np.sum(flux > least) / area.to_value(u.arcmin**2) for least in LEAST]
            text = ", ".join(
                f"{n:.3g} above {least:g}" for n, least in zip(many, LEAST, strict=True)
            )
            print(f"{band}, sources per square arcmin: {text} uJy")


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--field", action="store_true", help="light and counts of the bundled field"
    )
    parser.add_argument("--features", action="store_true", help="strengths of the 3.3 um feature")
    args = parser.parse_args()
    if args.field:
        field()
        return
    table, _, _ = sample(Path(os.environ["MIRICIGALE_DATA"]) / "ceers/ceers_photometry_part.fits")
    table = table[table["nircam.f444w"] > 1 * u.uJy]
    table = table[np.any([np.isfinite(table[n]) for n in BANDS], axis=0)]
    half = np.arange(len(table)) % 2
    for feature in (0.0, 0.05, 0.1, 0.2, 0.4, 1.0) if args.features else (0.1,):
        sources = Sources(table, feature)
        likelihood = sources.log_likelihood(0.0 if args.features else DUSTY)
        seen = np.any(likelihood != 0.0, axis=(1, 2))
        print(f"\n{sources.library}, 3.3 um feature of {feature}")
        for label, some in (
            ("all", seen),
            ("half 0", seen & (half == 0)),
            ("half 1", seen & (half == 1)),
        ):
            values, error, best = measure(likelihood, sources, some)
            text = " ".join(f"{x:+.2f} +- {e:.2f}" for x, e in zip(values, error, strict=True))
            n = f"{some.sum():4d} sources, {sources.passive[some].sum()} quiescent"
            print(f"{label:7s} {n}: {text}; ln L {best:.1f}")
    if args.features:
        return
    rng, drawn = np.random.default_rng(1), np.zeros((len(table), 400, len(BANDS)))
    for h in (0, 1):
        others, rows = seen & (half != h), np.flatnonzero(half == h)
        values, _, _ = measure(likelihood, sources, others)
        drawn[rows] = draws(sources, rows, values, 400, rng)
    report(sources, drawn, Sources(table, 1.0))


if __name__ == "__main__":
    main()
