"""
How well AGN fractions are recovered with and without fluxes of nuclei: photometry without images.

    python benchmarks/nuclear_points.py coverage [--n 300] [--chain] [--model-error 0.05] [--above F]
    python benchmarks/nuclear_points.py detection [--n 100] [--shallow 1 5] [--miri miri.f770w]
    python benchmarks/nuclear_points.py pulls [--n 40]

Galaxies at known redshifts of 0.5 to 2.5 in ten bands with the errors of `DEPTHS` and 5 % of the flux, 2 to 40
uJy in F770W. Points have 1.5 times the errors of the totals, a correlation of -0.2, and a share of the host's
light of 0 +- 0.05, as the fit has it.

coverage: models between the nodes of the axes of surveys, drawn with the prior of the fit, in which 80 % have an
AGN of any fraction (``--chain``: their fluxes by the chain, not by interpolation). Each line: median offset of
fracAGN and share of truths in the 68 % interval (randomized ranks) of all, of points above 10 sigma, of galaxies
without dust, whose AGN have no light at any fraction, and of the others by true fraction. With ``--above`` true
fractions are above F.

detection: the fits have `agn_fraction_prior` (92.5 % without an AGN). Galaxies without an AGN whose median
fraction is above 0.2, and AGN of 10^44 erg/s with fractions of 0.1 to 0.95 whose 16th percentile is above 0.1,
with errors of MIRI that are ``--shallow`` times as large. ``--miri`` leaves out its other bands.

pulls: points as forced photometry measures them with two components on images of galaxies without neighbors, by
the templates of their profiles, total S/N 20: mean and standard deviation of the pulls of points and totals, and
their correlation, stated and measured. Sizes are half-light radii in arcsec.
"""

import argparse
import warnings

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale import ForcedPhotometer
from miricigale.evaluation import posterior_ranks
from miricigale.fitting import BayesFitter, GridSettings, agn_fraction_prior
from miricigale.instrument import north_up_wcs
from miricigale.photometry import SourceTemplates
from miricigale.psf import MatchingKernel, filter_psf, hst_psf
from miricigale.sed import SEDModel
from miricigale.utils.tables import error_column
from miricigale.utils.units import LUMINOSITY

#: Errors in uJy.
DEPTHS = {
    "acs.f435w": 0.02, "acs.f606w": 0.015, "acs.f814w": 0.02, "nircam.f115w": 0.01, "nircam.f200w": 0.01,
    "nircam.f356w": 0.01, "nircam.f444w": 0.012, "miri.f770w": 0.08, "miri.f1000w": 0.12, "miri.f1500w": 0.3,
}  # fmt: skip
MIRI = [band for band in DEPTHS if band.startswith("miri")]
#: Smallest and largest flux in F770W in uJy.
FLUXES = (2.0, 40.0)
#: Errors of points over those of totals, their correlation, and the standard deviation of the stars' share.
POINT_ERROR = 1.5
CORRELATION = -0.2
NUCLEAR_STARS = 0.05
#: Prior of no AGN where truths are drawn from the prior.
WITHOUT_AGN = 0.2
#: S/N of points that are looked at.
BRIGHT = 10.0
#: erg/s.
LUMINOSITY_OF_AGN = 1e44
#: Smallest fraction that counts as an AGN, and that of a false one.
AGN, FALSE = 0.1, 0.2
HALF_OF_INTERVAL = 0.3413
#: Pixels between galaxies on images, their total flux in uJy and its S/N, and the part of it that is a point.
APART = 60
TOTAL, SIGNAL, PART = 5.0, 20.0, 0.3
#: Half-light radii in arcsec and Sersic indices.
PROFILES = ((0.45, 1.0), (0.2, 1.0), (0.25, 4.0))
EFFECTIVE = 200


def make_fitter(bands, prior, model_error):
    """Fitter at redshifts of 0.5 to 2.5, with a prior of the fractions."""
    axes = SEDModel.survey_axes()
    z = axes["redshift"]
    axes["redshift"] = z[(z > 0.45) & (z < 2.6)]
    if prior is None:
        prior = agn_fraction_prior(axes["frac_agn"])
    settings = GridSettings(interpolate=EFFECTIVE, nuclear_stars=NUCLEAR_STARS)
    return BayesFitter(
        SEDModel.survey(),
        bands,
        axes=axes,
        priors={"frac_agn": prior},
        calibration=None,
        model_error=model_error,
        settings=settings,
    )


def draw_values(fitter, n, rng):
    """Parameters drawn from the prior of a fitter, at redshifts of 0.5 to 2.5: dict of arrays."""
    priors = fitter.priors
    galaxy = rng.choice(priors.galaxy.size, n, p=priors.galaxy / priors.galaxy.sum())
    values = {}
    for name, axis in fitter.backend.between.axes.items():
        low, high = np.clip(axis.cells(), axis.values[0], axis.values[-1])
        if axis.kind == "galaxy":
            node = np.argmax(axis.share[:, galaxy], axis=0)
        else:
            node = rng.choice(axis.values.size, n, p=axis.weights)
        values[name] = low[node] + (high - low)[node] * rng.random(n)
    values["redshift"] = rng.uniform(0.5, 2.5, n)
    return values


def fluxes_of(fitter, values, *, chain=False):
    """Fluxes of models and of their AGN, (n, nb), and AGN powers, (n,), of a solar mass formed; NaN for none."""
    models = fitter.backend.between.models
    redshift = values["redshift"]
    fraction = values["frac_agn"]
    flux, power = models.fluxes(values, redshift, fraction)
    light = power[:, None] * models.agn_fluxes(values, redshift)
    light = np.where(fraction[:, None] > 0, light, 0.0)
    if chain:
        model = SEDModel.survey()
        table = QTable()
        for name, column in (values | fitter.backend.constants).items():
            table[name] = column * np.ones(len(redshift)) * (model.parameters[name].unit or 1)
        total = model.fluxes(table, list(fitter.bands))
        table["frac_agn"] = 0.0
        host = model.fluxes(table, list(fitter.bands))
        exist = np.isfinite(flux)
        flux = np.stack([total[band].to_value(u.uJy) for band in fitter.bands], axis=1)
        light = np.maximum(
            flux - np.stack([host[b].to_value(u.uJy) for b in fitter.bands], axis=1), 0.0
        )
        flux = np.where(exist, flux, np.nan)
    return flux, light, power


def observe(bands, flux, light, values, model_error, depth_factor, rng):
    """Photometry with points, of fluxes (n, nb) and those of their AGN in uJy."""
    n = len(flux)
    table = QTable({"id": np.arange(n), "redshift": values["redshift"]})
    stars = NUCLEAR_STARS * rng.standard_normal(n)
    for j, band in enumerate(bands):
        error = DEPTHS[band]
        if band in MIRI:
            error = depth_factor * error
        noise = rng.standard_normal(n)
        part = model_error * flux[:, j] * rng.standard_normal(n)
        table[band] = (flux[:, j] + part + error * noise) * u.uJy
        table[error_column(band)] = np.full(n, error) * u.uJy
        if band not in MIRI:
            continue
        host = flux[:, j] - light[:, j]
        own = np.sqrt(1.0 - CORRELATION**2) * rng.standard_normal(n)
        point = light[:, j] * (1.0 + model_error * rng.standard_normal(n)) + stars * host
        point += POINT_ERROR * error * (CORRELATION * noise + own)
        table[f"{band}_nucleus"] = point * u.uJy
        table[f"{band}_nucleus_err"] = np.full(n, POINT_ERROR * error) * u.uJy
        table[f"{band}_nucleus_corr"] = np.full(n, CORRELATION)
    return table


def fits(fitter, table):
    """Yield a label and results of fits without and with points."""
    without = table.copy()
    without.remove_columns([name for name in table.colnames if "_nucleus" in name])
    yield "totals", fitter.fit(without, redshift="redshift")
    yield "points", fitter.replace(nuclei=True).fit(table, redshift="redshift")


def signal_of_points(table):
    """Largest S/N of the points of each galaxy."""
    signal = []
    for band in MIRI:
        if band in table.colnames:
            signal.append((table[f"{band}_nucleus"] / table[f"{band}_nucleus_err"]).value)
    return np.max(signal, axis=0)


def coverage(n, chain, model_error, above, seed):
    """Print offsets and coverage of truths drawn from the prior."""
    rng = np.random.default_rng(seed)
    prior = np.array([WITHOUT_AGN] + 6 * [(1.0 - WITHOUT_AGN) / 6])
    fitter = make_fitter(list(DEPTHS), prior, model_error)
    n_drawn = 2 * n
    if above > 0:
        n_drawn = 20 * n
    values = draw_values(fitter, n_drawn, rng)
    if above > 0:
        chosen = np.flatnonzero(values["frac_agn"] > above)
        values = {name: column[chosen] for name, column in values.items()}
    flux, light, _ = fluxes_of(fitter, values, chain=chain)
    rows = np.flatnonzero(np.isfinite(flux).all(axis=1))[:n]
    values = {name: column[rows] for name, column in values.items()}
    band = list(DEPTHS).index("miri.f770w")
    wanted = np.exp(rng.uniform(*np.log(FLUXES), rows.size))
    scale = (wanted / flux[rows, band])[:, None]
    light = scale * light[rows]
    table = observe(fitter.bands, scale * flux[rows], light, values, model_error, 1.0, rng)
    fraction = values["frac_agn"]
    bright = signal_of_points(table) > BRIGHT
    samples = {"all": np.full(rows.size, True), "point > 10": bright, "none": fraction == 0}
    dark = (fraction > 0) & (light.max(axis=1) == 0)
    samples["no dust"] = dark
    for low, high in ((0.0, 0.15), (0.15, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.95)):
        samples[f"{low:g}-{high:g}"] = (fraction > low) & (fraction <= high) & ~dark
    for label, results in fits(fitter, table):
        ranks = posterior_ranks(fraction, *_cdf(results), seed=1)
        median = results.median("frac_agn").value
        low, high = results.percentile("frac_agn", (0.16, 0.84)).value.T
        for name, chosen in samples.items():
            if not chosen.any():
                continue
            held = np.mean(np.abs(ranks[chosen] - 0.5) < HALF_OF_INTERVAL)
            offset = np.median((median - fraction)[chosen])
            width = np.median((high - low)[chosen]) / 2.0
            print(
                f"{label} {name:10s} {chosen.sum():4d} offset {offset:+.3f} half-width {width:.3f} "
                f"in 68 % {100 * held:3.0f} %",
                flush=True,
            )
        print(f"{label} ranks in fifths {np.histogram(ranks, 5, (0.0, 1.0))[0]}", flush=True)


def _cdf(results):
    """Values and levels of the distribution of the AGN fraction."""
    values, levels = results.cdf("frac_agn")
    return values.value, levels


def detection(n, bands, factors, model_error, seed):
    """Print false AGN, and AGN of a luminosity that are found."""
    fitter = make_fitter(bands, None, model_error)
    band = bands.index("miri.f770w")
    models = fitter.backend.between.models
    for factor in factors:
        rng = np.random.default_rng(seed)
        for kind in ("no AGN", "AGN of 1e44 erg/s"):
            values = draw_values(fitter, 8 * n, rng)
            values["frac_agn"] = np.zeros(8 * n)
            if kind != "no AGN":
                values["frac_agn"] = rng.uniform(AGN, 0.95, 8 * n)
            flux, light, power = fluxes_of(fitter, values)
            scale = np.exp(rng.uniform(*np.log(FLUXES), 8 * n)) / flux[:, band]
            if kind != "no AGN":
                derived = models.describe(values, values["redshift"], power, np.ones(8 * n))
                scale = LUMINOSITY_OF_AGN / (derived["accretion_power"] * LUMINOSITY.to("erg / s"))
            total = scale * flux[:, band]
            good = np.isfinite(flux).all(axis=1) & (total > FLUXES[0]) & (total < FLUXES[1])
            rows = np.flatnonzero(good)[:n]
            chosen = {name: column[rows] for name, column in values.items()}
            scale = scale[rows, None]
            light = scale * light[rows]
            table = observe(bands, scale * flux[rows], light, chosen, model_error, factor, rng)
            bright = np.mean(signal_of_points(table) > 5.0)
            for label, results in fits(fitter, table):
                high = results.median("frac_agn").value > FALSE
                found = results.percentile("frac_agn", 0.16).value.ravel() > AGN
                print(
                    f"errors x {factor:g}, {kind}, {label}: {rows.size}, points above 5 sigma "
                    f"{100 * bright:.0f} %, median > {FALSE:g} {high.sum()}, "
                    f"16th percentile > {AGN:g} {found.sum()}",
                    flush=True,
                )


def galaxies_on_image(n, radius, index, wcs, rng):
    """Catalog of galaxies in a row."""
    table = QTable({"id": np.arange(n)})
    columns = APART * (0.5 + np.arange(n)) + rng.uniform(-0.5, 0.5, n)
    rows = 0.5 * APART + rng.uniform(-0.5, 0.5, n)
    table["sky"] = SkyCoord.from_pixel(columns, rows, wcs)
    table["half_light_radius"] = np.full(n, radius) * u.arcsec
    table["sersic_index"] = index
    table["axis_ratio"] = 0.7
    table["position_angle"] = rng.uniform(0.0, 180.0, n) * u.deg
    return table


def pulls(n, seed):
    """Print pulls of points and totals."""
    center = SkyCoord(53.1, -27.8, unit="deg")
    wcs = north_up_wcs(center, 0.11 * u.arcsec, (APART, n * APART))
    for band in ("F770W", "F1500W"):
        psf = filter_psf(band, pixel_scale=0.06 * u.arcsec, pa=0 * u.deg)
        kernel = MatchingKernel.from_psfs(hst_psf("F160W"), psf, extent=6 * u.arcsec)
        photometer = ForcedPhotometer(kernel)
        for radius, index in PROFILES:
            rng = np.random.default_rng(seed)
            table = galaxies_on_image(n, radius, index, wcs, rng)
            smooth = SourceTemplates.from_catalog(table, template="sersic")
            points = SourceTemplates.from_catalog(table, template="psf")
            table["components"] = 2
            templates = SourceTemplates.from_catalog(table, template="sersic")
            sigma = 0.01
            normal = rng.standard_normal((APART, n * APART))
            # errors go as the noise: the second image has the S/N that is wanted
            for _ in range(2):
                error = StdDevUncertainty(np.full(normal.shape, sigma))
                image = CCDData(sigma * normal, unit="MJy/sr", wcs=wcs, uncertainty=error)
                light = photometer.render(image, smooth, np.full(n, (1.0 - PART) * TOTAL) * u.uJy)
                light += photometer.render(image, points, np.full(n, PART * TOTAL) * u.uJy)
                image.data += light.value
                result = photometer.measure(image, templates=templates)
                signal = TOTAL / np.nanmedian(result.flux_err.value)
                sigma *= signal / SIGNAL
            point = (result.flux_point.value - PART * TOTAL) / result.flux_point_err.value
            total = (result.flux.value - TOTAL) / result.flux_err.value
            measured = np.corrcoef(point, total)[0, 1]
            print(
                f"{band} {radius} {index}: points {point.mean():+.2f}, {point.std():.2f}, "
                f"totals {total.mean():+.2f}, {total.std():.2f}, correlation "
                f"{np.median(result.flux_point_corr):.2f}, {measured:.2f}",
                flush=True,
            )


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("what", choices=("coverage", "detection", "pulls"))
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--chain", action="store_true")
    parser.add_argument("--shallow", type=float, nargs="+", default=[1.0, 5.0])
    parser.add_argument("--miri", nargs="+", default=MIRI, help="bands, with F770W")
    parser.add_argument("--model-error", type=float, default=0.05, help="part of the flux")
    parser.add_argument("--above", type=float, default=0.0, help="least true fraction")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    if args.what == "coverage":
        coverage(args.n, args.chain, args.model_error, args.above, args.seed)
    elif args.what == "pulls":
        pulls(args.n, args.seed)
    else:
        bands = [band for band in DEPTHS if band not in MIRI or band in args.miri]
        detection(args.n, bands, args.shallow, args.model_error, args.seed)


if __name__ == "__main__":
    main()
