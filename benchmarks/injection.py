"""
Completeness by injection against the truth.

    python benchmarks/injection.py [--trials 12] [--fields 10] [--seed 1]

A field of stars in white noise is simulated. Stars are injected into it, detected and measured at their
positions. The truth of forced photometry is a closed form: the normal distribution function of the
signal-to-noise less 5. That of detection is counted on other simulated fields, in which the stars are from the
start. Compared are sources on free sky.
"""

import argparse
import tempfile
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from scipy.special import ndtr

from miricigale.injection import CompletenessCurve, Injection
from miricigale.injection.light import light_on_image, psf_on_pixels
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import MosaicFile, detect_sources
from miricigale.psf import gaussian_psf
from miricigale.utils.tables import match_sky
from miricigale.utils.units import ab_magnitude

CENTER = SkyCoord(53.1, -27.8, unit="deg")
SIDE = 700
PIXEL = 0.11 * u.arcsec
WIDTH = 0.25  # rms of the PSF (arcsec)
NOISE = 0.004  # uJy in a pixel
FWHM = WIDTH * np.sqrt(8 * np.log(2)) * u.arcsec
ERROR = NOISE * np.sqrt(4 * np.pi) * WIDTH / PIXEL.value
PRESET = "default"
BAND = "irac.ch4"


def positions(rng, side, spacing, jitter):
    """Positions on a lattice, each moved at random."""
    at = (np.arange(side) - (side - 1) / 2) * spacing
    east, north = (a.ravel() + rng.uniform(-jitter, jitter, side**2) for a in np.meshgrid(at, at))
    return CENTER.spherical_offsets_by(east * u.arcsec, north * u.arcsec)


def magnitudes(rng, n):
    """Magnitudes about the 5-sigma limit."""
    return ab_magnitude(5 * ERROR * u.uJy) + rng.uniform(-1.6, 0.6, n)


def write_field(path, sky, flux, psf, rng):
    """Write an image of stars in white noise."""
    shape = (SIDE, SIDE)
    wcs = north_up_wcs(CENTER, PIXEL, shape)
    stars = QTable({"sky": sky, "profile": np.full(len(sky), "point")})
    stars["half_light_radius"] = np.zeros(len(sky)) * u.arcsec
    stars["sersic_index"] = np.ones(len(sky))
    stars["axis_ratio"] = np.ones(len(sky))
    stars["position_angle"] = np.zeros(len(sky)) * u.deg
    light = light_on_image(stars, flux, wcs, shape, psf_on_pixels(psf, wcs, shape), 1)
    data = light * pixel_area_map(wcs, shape) * 1e12 + rng.normal(0, NOISE, shape)
    header = wcs.to_header()
    header["BUNIT"] = "uJy"
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(data, header, name="SCI")]
    hdus.append(fits.ImageHDU(np.full(shape, NOISE), header, name="ERR"))
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def flux_of(magnitude):
    return 10 ** (0.4 * (23.9 - magnitude)) * u.uJy


def simulated(folder, psf, n_fields, rng):
    """Magnitudes of stars of simulated fields, and which are detected."""
    magnitude = []
    detected = []
    for _ in range(n_fields):
        sky = positions(rng, 15, 4.6, 1.0)
        own = magnitudes(rng, len(sky))
        path = write_field(folder / "simulated.fits", sky, flux_of(own), psf, rng)
        image = MosaicFile(path, filter=BAND).read()
        _, detections = detect_sources(image, preset=PRESET)
        rows, _ = match_sky(detections["sky"], sky, radius=FWHM)
        magnitude.append(own)
        detected.append(rows >= 0)
    return np.concatenate(magnitude), np.concatenate(detected)


def free_sky(result):
    """Sources that are far from others and from the edges."""
    sources = result.sources
    _, apart, _ = sources["sky"].match_to_catalog_sky(result.photometry["sky"])
    inside = np.abs(np.stack([sources["x"], sources["y"]]) - SIDE / 2) < SIDE / 2 - 10
    return (apart.arcsec > 2.5) & inside.all(axis=0)


def report(question, curve, limit, shares):
    """Print limits and the largest difference of completeness within a magnitude of the limit."""
    fine = np.linspace(limit - 1.0, limit + 0.6, 100)
    off = np.max(np.abs(curve(fine) - shares(fine)))
    print(
        f"{question:<10} limit {curve.limit:.3f} +- {curve.limit_err:.3f}, truth {limit:.3f}; "
        f"completeness off by at most {off:.1%}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=12)
    parser.add_argument("--fields", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    psf = gaussian_psf(FWHM, pixel_scale=0.03 * u.arcsec, fov=4 * u.arcsec)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        psf.write(folder / "psf.fits")
        sky = positions(rng, 6, 12.0, 2.0)
        flux = ERROR * 10 ** rng.uniform(1, 2, len(sky)) * u.uJy
        write_field(folder / "field.fits", sky, flux, psf, rng)
        stars = QTable({BAND: flux_of(magnitudes(rng, 180 * args.trials))})
        injection = Injection(stars, n_trials=args.trials, n_sources=180, preset=PRESET)
        image = MosaicFile(folder / "field.fits", filter=BAND, psf=folder / "psf.fits")
        result = injection.run(image, folder=folder / "run")
        truth = CompletenessCurve.fit(*simulated(folder, psf, args.fields, rng))
    free = free_sky(result)
    magnitude = np.asarray(result.sources["magnitude"])[free]
    forced = CompletenessCurve.fit(magnitude, np.asarray(result.sources["recovered"])[free])
    detection = CompletenessCurve.fit(magnitude, np.asarray(result.sources["detected"])[free])
    limit = float(ab_magnitude(5 * ERROR * u.uJy))
    report("forced", forced, limit, lambda m: ndtr(flux_of(m).value / ERROR - 5))
    report("detection", detection, truth.limit, truth)
    numbers = result.errors()
    print(
        f"pulls of {numbers['n_measured']}: median {numbers['pull_median']:+.2f}, "
        f"rms {numbers['pull_rms']:.3f}; bias {numbers['bias']:+.2%} +- {numbers['bias_err']:.2%}"
    )


if __name__ == "__main__":
    main()
