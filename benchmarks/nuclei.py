"""
What fluxes of nuclei change in fits of strong AGN in the sky of the study: photometry without images.

    python benchmarks/nuclei.py [--frac-agn 0.8 0.99] [--every 1] [--radius R] [--seed 1]

Galaxies, AGN, noise and fits are those of ``frac_agn.py``, case ``agn-error-30-model-error-2``. In the six bands
of MIRI each galaxy with a point that forced photometry can tell from its smooth light gets the flux of its AGN as
measured with two components. Errors of points and totals and their correlation are those that
`miricigale.ForcedPhotometer` states for galaxies of its half-light radius (exponential profiles, F160W as prior),
scaled to the depth of the band, and 3 % of the flux. Stars in the center are a share of the host's light of 0 +-
0.03, in 20 % of the galaxies 0 +- 0.1. ``--radius`` gives all galaxies one half-light radius in arcsec.

Galaxies without points are fitted alike, so only those with points are fitted, with MIRI's totals and with points
too. Each fraction gives the outliers of redshifts; sigma_MAD of dz / (1 + z); the share of redshifts in the 68 %
interval; median offset of fracAGN; and the change of the outliers among all galaxies with its error, which counts
galaxies that change sides. Minutes a fraction.
"""

import argparse
import dataclasses
import functools
import warnings

import astropy.units as u
import frac_agn as study
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale import ForcedPhotometer
from miricigale.evaluation import photoz_metrics
from miricigale.instrument import CEERS_FILTERS, north_up_wcs
from miricigale.photometry import SourceTemplates
from miricigale.psf import MatchingKernel, filter_psf, hst_psf
from miricigale.scene import read_catalog
from miricigale.utils.random import stream

CASE = study.CASES["agn-error-30-model-error-2"]
#: Half-light radii in arcsec of the galaxies of which errors are measured, and what lies between them in pixels.
RADII = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0])
APART = 60
#: Part of a flux that is its error, as in the photometry of the study.
FRACTIONAL = 0.03
#: Standard deviations of the share of the host that is a point, and the part of the galaxies with the larger one.
NUCLEAR_STARS = (0.03, 0.1)
LARGER = 0.2


@dataclasses.dataclass(frozen=True)
class PointErrors:
    """
    Errors of points in a band, by half-light radius (arcsec).

    ``point`` is the error of the point over that of the total of an unresolved source, ``total`` the error of the
    total with two components over that with one, and ``correlation`` that of point and total. NaN where no point
    is told from the smooth light.
    """

    point: np.ndarray
    total: np.ndarray
    correlation: np.ndarray

    @classmethod
    @functools.cache
    def of_band(cls, band):
        """Measure them on an image of galaxies without neighbors."""
        n = RADII.size
        center = SkyCoord(53.1, -27.8, unit="deg")
        wcs = north_up_wcs(center, 0.11 * u.arcsec, (APART, n * APART))
        columns = APART * (0.5 + np.arange(n))
        galaxies = QTable({"id": np.arange(n)})
        galaxies["sky"] = SkyCoord.from_pixel(columns, np.full(n, 0.5 * APART), wcs)
        galaxies["flux"] = np.full(n, 5.0) * u.uJy
        galaxies["half_light_radius"] = RADII * u.arcsec
        for name, value in (("sersic_index", 1.0), ("axis_ratio", 0.7)):
            galaxies[name] = value
        galaxies["position_angle"] = np.full(n, 30.0) * u.deg
        galaxies["components"] = 2
        psf = filter_psf(band, pixel_scale=0.06 * u.arcsec, pa=0 * u.deg)
        kernel = MatchingKernel.from_psfs(hst_psf("F160W"), psf, extent=6 * u.arcsec)
        photometer = ForcedPhotometer(kernel)
        noise = np.full((APART, n * APART), 0.01)
        data = np.random.default_rng(1).normal(0, noise)
        image = CCDData(data, unit="MJy/sr", wcs=wcs, uncertainty=StdDevUncertainty(noise))
        errors = {}
        for components in (1, 2):
            galaxies["components"] = components
            templates = SourceTemplates.from_catalog(galaxies, template="sersic")
            if components == 1:
                image.data += photometer.render(image, templates, galaxies["flux"]).value
            errors[components] = photometer.measure(image, templates=templates)
        one = errors[1].flux_err.value
        two = errors[2]
        point = two.flux_point_err.value / one[0]
        return cls(point, two.flux_err.value / one, two.flux_point_corr)

    def at(self, radius):
        """Errors of points and totals, and correlations, at half-light radii; points are NaN where unresolved."""
        good = np.isfinite(self.point)
        unresolved = radius < RADII[good][0]
        point, total, correlation = (
            np.interp(radius, RADII[good], values[good])
            for values in (self.point, self.total, self.correlation)
        )
        return np.where(unresolved, np.nan, point), np.where(unresolved, 1.0, total), correlation


def with_points(photometry, truth, radius, seed):
    """Photometry as two components give it: totals with their larger errors, and points with theirs."""
    table = photometry.copy()
    host = truth.copy()
    host["frac_agn"] = np.zeros(len(host))
    host = study.model_of(CASE.dust, CASE.torus).fluxes(host, list(CEERS_FILTERS))
    rng = stream(seed, "nuclei")
    larger = rng.random(len(table)) < LARGER
    # the same share in all bands
    stars = np.where(larger, NUCLEAR_STARS[1], NUCLEAR_STARS[0]) * rng.standard_normal(len(table))
    for band in CEERS_FILTERS:
        point, total, correlation = PointErrors.of_band(band).at(radius)
        true = truth[band].to_value(u.uJy)
        host_flux = host[band].to_value(u.uJy)
        error = table[study.error_column(band)].to_value(u.uJy)
        noise = (table[band].to_value(u.uJy) - true) / error
        depth = np.sqrt(error**2 - (FRACTIONAL * true) ** 2)
        new_error = np.hypot(total * depth, FRACTIONAL * true)
        new_noise = new_error * noise
        light = true - host_flux + stars * host_flux
        point_error = np.hypot(point * depth, FRACTIONAL * light)
        covariance = correlation * point * depth * total * depth + FRACTIONAL**2 * light * true
        rho = covariance / (point_error * new_error)
        own = np.sqrt(1.0 - rho**2) * rng.standard_normal(len(table))
        table[band] = (true + new_noise) * u.uJy
        table[study.error_column(band)] = new_error * u.uJy
        table[f"{band}_nucleus"] = (light + point_error * (rho * noise + own)) * u.uJy
        table[f"{band}_nucleus_err"] = point_error * u.uJy
        table[f"{band}_nucleus_corr"] = np.where(np.isfinite(point), rho, 0.0)
    return table


def fit(table, nuclei):
    """Mean redshift and fracAGN of each galaxy, and the 68 % interval of its redshift, by name."""
    options = {
        "prior_f": CASE.prior_f,
        "interpolate": CASE.interpolate,
        "agn_error": CASE.agn_error,
    }
    fitter = study.fitter_of(CASE.dust, CASE.torus, "all", CASE.model_error, **options)
    results = fitter.replace(nuclei=nuclei).fit(table)
    low, high = results.percentile("redshift", (0.16, 0.84)).value.T
    means = {name: results.mean(name).value for name in ("redshift", "frac_agn")}
    return QTable(means | {"low": low, "high": high})


def scores(label, fits, truth, frac_agn):
    """Print the numbers of fits, and return which redshifts are outliers."""
    true = truth["redshift"]
    metrics = photoz_metrics(true, fits["redshift"])
    inside = np.mean((true >= fits["low"]) & (true <= fits["high"]))
    offset = np.median(fits["frac_agn"] - frac_agn)
    outlier = np.abs(fits["redshift"] - true) > 0.15 * (1.0 + true)
    print(
        f"  {label:10s} outliers {outlier.sum():3d} ({100 * outlier.mean():4.1f} %)  "
        f"sigma_MAD {metrics.sigma_mad:.4f}  in 68 % {100 * inside:3.0f} %  fracAGN {offset:+.3f}",
        flush=True,
    )
    return outlier


def half_light_radii(ids):
    """Half-light radii of galaxies of the catalog in arcsec."""
    catalog = read_catalog("catalog.goodss")
    radius = catalog["half_light_radius"].to_value(u.arcsec)
    of_id = dict(zip(catalog["id"], radius, strict=True))
    return np.array([of_id[key] for key in ids])


def compare(frac_agn, every, radius, seed):
    """Print the numbers of the same galaxies with and without points."""
    truth = study.make_truth(CASE, frac_agn, seed)
    photometry, detected = study.observe(truth, CASE.limits, seed)
    rows = np.flatnonzero(detected)[::every]
    truth = truth[rows]
    photometry = photometry[rows]
    if radius is None:
        radii = half_light_radii(truth["id"])
    else:
        radii = np.full(len(rows), radius)
    points = with_points(photometry, truth, radii, seed)
    measured = np.any([np.isfinite(points[f"{band}_nucleus"]) for band in CEERS_FILTERS], axis=0)
    smallest = radii[measured].min()
    print(
        f"fracAGN {frac_agn:g}: {len(rows)} galaxies, {measured.sum()} with points, "
        f"from a half-light radius of {smallest:.2f} arcsec on",
        flush=True,
    )
    before = scores("totals", fit(photometry[measured], False), truth[measured], frac_agn)
    after = scores("and points", fit(points[measured], True), truth[measured], frac_agn)
    gained = np.sum(before & ~after)
    lost = np.sum(~before & after)
    change = 100 * (lost - gained) / len(rows)
    error = 100 * np.sqrt(lost + gained) / len(rows)
    print(
        f"  outliers of all change by {change:+.1f} +- {error:.1f} % ({gained} fewer, {lost} more)"
    )


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--frac-agn", nargs="+", type=float, default=[0.8, 0.99])
    parser.add_argument(
        "--every", type=int, default=1, help="of the galaxies one in so many is taken"
    )
    parser.add_argument("--radius", type=float, help="half-light radius of all galaxies in arcsec")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    for frac_agn in args.frac_agn:
        compare(frac_agn, args.every, args.radius, args.seed)


if __name__ == "__main__":
    main()
