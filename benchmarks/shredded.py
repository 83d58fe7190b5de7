"""
Forced photometry of scenes of which a fifth of the galaxies is divided into several segments.

    python benchmarks/shredded.py                   6 scenes
    python benchmarks/shredded.py --scenes 1        a look

Scenes are those of ``pulls.py`` (GalSim; prior like F160W, image like F770W), except that a fifth of the galaxies
is large (0.4 to 1 arcsec) and bright on the prior (signal-to-noise 60 to 300 in about the area of the source).
Their segments are divided among three to six places, as catalogs do that take clumps and noise for sources. Each
scene is measured with the segments as detected and with the divided ones. Printed are pulls of whole sources,
totals of divided galaxies over the truth, and how many fluxes of pieces are negative by 5 sigma, or without a flag
above twice the image's light in the segment (a bare segment through the kernel).
"""

import argparse
import warnings

import astropy.units as u
import numpy as np
from pulls import FINE, PRIOR_NOISE, Field, scene

from miricigale.photometry import ErrorSettings, ForcedFlags, ForcedPhotometer, detect_sources
from miricigale.psf import MatchingKernel, hst_psf, miri_psf, psf_mosaic

DIVIDED = 0.2


def large_scene(seed):
    """A scene of ``pulls.py`` with some large galaxies, and which those are."""
    catalog, rng = scene(seed), np.random.default_rng([seed, 7])
    large = ~catalog["point"] & (rng.random(len(catalog["point"])) < DIVIDED)
    n = np.count_nonzero(large)
    radius = 10 ** rng.uniform(np.log10(0.4), 0.0, n)
    snr = 10 ** rng.uniform(np.log10(60), np.log10(300), n)
    catalog["radius"][large] = radius
    high = snr * PRIOR_NOISE * np.sqrt(np.pi) * np.hypot(1.2 * radius, 0.17) / FINE / 0.6
    catalog["high"][large] = high
    catalog["flux"][large] = high * 10 ** rng.normal(0.1, 0.3, n)
    return catalog, large


def divide(prior, segments, detections, rows, rng):
    """
    Divide the segments of some detections.

    Returns
    -------
    labels, catalog
        Segmentation, and the catalog with a row for each piece.
    pieces : list of int `~numpy.ndarray`
        Rows of the catalog for each divided detection.
    """
    labels, catalog = segments.data.copy(), detections.copy()
    catalog.keep_columns(["label", "sky"])
    pieces = []
    for row in rows:
        label = detections["label"][row]
        y, x = np.nonzero(labels == label)
        light = np.maximum(prior.data[y, x], 0.0)
        n = rng.integers(3, 7)
        seeds = rng.choice(len(y), n, replace=False, p=light / light.sum())
        nearest = np.argmin((y[:, None] - y[seeds]) ** 2 + (x[:, None] - x[seeds]) ** 2, axis=1)
        own = [row]
        for k in range(n):
            part = nearest == k
            weight = light[part] + 1e-9
            at = np.average(x[part], weights=weight), np.average(y[part], weights=weight)
            sky = prior.wcs.pixel_to_world(*at).transform_to(catalog["sky"].frame)
            if k == 0:
                catalog["sky"][row] = sky
                continue
            new = int(labels.max()) + 1
            labels[y[part], x[part]] = new
            catalog.add_row({"label": new, "sky": sky})
            own.append(len(catalog) - 1)
        pieces.append(np.array(own))
    return labels, catalog, pieces


def line(name, values):
    values = np.asarray(values)
    values = values[np.isfinite(values)]
    middle = np.median(values)
    spread = 1.4826 * np.median(np.abs(values - middle))
    print(
        f"{name:44s} {len(values):4d}  median {middle:+.3f}  MAD {spread:.3f}  std {np.std(values):.3f}  "
        f"largest {np.max(np.abs(values)):.2f}"
    )


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--first", type=int, default=1)
    args = parser.parse_args()
    hst = hst_psf("wfc3.f160w", pixel_scale=FINE * u.arcsec)
    target = psf_mosaic(miri_psf("miri.f770w"), FINE * u.arcsec, 40 * u.deg)
    kernel = MatchingKernel.from_psfs(hst, target, pixel_scale=FINE * u.arcsec, extent=9 * u.arcsec)
    photometer = ForcedPhotometer(kernel, background_order=0)
    bare = ForcedPhotometer(
        kernel, background_order=0, template="cutout", wings=False,
        errors=ErrorSettings(size_scatter=None),
    )  # fmt: skip
    pulls = {name: [] for name in ("whole", "whole, beside pieces", "large, whole", "divided")}
    ratio = {name: [] for name in ("large, whole", "divided")}
    change, beyond, negative, n_pieces = [], 0, 0, 0
    for seed in range(args.first, args.first + args.scenes):
        catalog, large = large_scene(seed)
        field = Field(seed, kernel, kernel.target, catalog)
        prior, image = field.image("prior"), field.image("own")
        segments, detections = detect_sources(prior)
        index, distance, _ = catalog["sky"].match_to_catalog_sky(detections["sky"])
        back, _, _ = detections["sky"].match_to_catalog_sky(catalog["sky"])
        matched = (distance < 0.25 * u.arcsec) & (back[index] == np.arange(len(index)))
        taken = np.bincount(index[distance < 1.2 * u.arcsec], minlength=len(detections)) == 1
        matched &= ~catalog["pair"] | taken[index]
        rows = np.flatnonzero(matched & large)
        rng = np.random.default_rng([seed, 8])
        labels, divided, pieces = divide(prior, segments, detections, index[rows], rng)
        plain = photometer.measure(image, prior, segments, detections)
        result = photometer.measure(image, prior, labels, divided)
        light = bare.measure(image, prior, labels, divided)
        truth = catalog["flux"]
        small = np.flatnonzero(matched & ~large)
        for name, measured in (("whole", plain), ("whole, beside pieces", result)):
            flux, error = measured.flux.value[index[small]], measured.flux_err.value[index[small]]
            pulls[name].extend((flux - truth[small]) / error)
        flux, error = plain.flux.value[index[rows]], plain.flux_err.value[index[rows]]
        pulls["large, whole"].extend((flux - truth[rows]) / error)
        ratio["large, whole"].extend(flux / truth[rows] - 1)
        for k, own in zip(rows, pieces, strict=True):
            own = own[np.isfinite(result.flux.value[own])]
            flux, error = result.flux.value[own], result.flux_err.value[own]
            total = np.sqrt(result.covariance[own][:, own].sum())
            pulls["divided"].append((flux.sum() - truth[k]) / total)
            ratio["divided"].append(flux.sum() / truth[k] - 1)
            change.append(flux.sum() / plain.flux.value[index[k]] - 1)
            n_pieces += len(own)
            negative += np.count_nonzero(flux < -5 * error)
            seen = np.maximum(light.flux.value[own], 0.0)
            # that a source is a piece is no warning
            warned = (result.flags[own] & ~int(ForcedFlags.SHREDDED)) != 0
            beyond += np.count_nonzero((flux - 2 * seen > 3 * error) & ~warned)
        print(
            f"scene {seed}: {len(rows)} galaxies divided into {sum(map(len, pieces))}", flush=True
        )
    for name, values in pulls.items():
        line(f"pulls, {name}", values)
    for name, values in ratio.items():
        line(f"flux over truth - 1, {name}", values)
    line("divided over whole - 1", change)
    print(f"pieces: {n_pieces}; below -5 sigma {negative}; beyond their light, no flag {beyond}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
