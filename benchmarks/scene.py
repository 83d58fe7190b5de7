"""
Time the rendering of scenes and measure their accuracy.

Run as ``python benchmarks/scene.py``; prints a table of wall-clock and CPU times (after compiling)
and the errors that docs/accuracy/scene.rst quotes.
"""

import resource
import time

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from photutils.psf import ImagePSF
from scipy.special import erf

from miricigale.instrument import imager_wcs, north_up_wcs
from miricigale.profiles import sersic_enclosed_fraction, sersic_image
from miricigale.psf import hst_psf, miri_psf, miri_psf_grid
from miricigale.scene import Background, Cutout, Painter, Scene, highres_image, read_catalog


def clock(label, function):
    start, cpu = time.perf_counter(), time.process_time()
    result = function()
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    print(f"{label:55s} {wall:8.3f} s, CPU {cpu:8.3f} s")
    return result


def pixel_gaussian(n, center, sigma, step=1.0):
    at = (np.arange(n) - center) * step
    return 0.5 * (erf((at + 0.5) / sigma / 2**0.5) - erf((at - 0.5) / sigma / 2**0.5))


def speed():
    catalog = read_catalog("catalog.goodss")
    center = SkyCoord(53.13440, -27.83444, unit="deg")
    catalog["miri.f770w"] = np.nan_to_num(catalog["nircam.f444w"])
    wcs = imager_wcs(center, 100 * u.deg)
    psf = clock("PSF, miri.f770w", lambda: miri_psf("miri.f770w"))
    background = Background.low_zodi("miri.f770w")

    def scene():
        one = Scene(catalog, filter="miri.f770w", wcs=wcs, psf=psf, background=background)
        return one, one.render()

    clock("first scene (compiles or loads the kernels)", scene)
    one, _ = clock("scene, 1024 x 1032 pixels", scene)
    truth = one.truth
    inside = (truth["flags"] & 1) == 0
    sersic = inside & (truth["profile"] == "sersic")
    print(f"  sources: {len(truth)}, on the image {inside.sum()}, of these Sersic {sersic.sum()}")
    chosen = catalog[np.flatnonzero(inside)[np.argsort(~sersic[inside], kind="stable")][:500]]
    kind = {"filter": "miri.f770w", "wcs": wcs, "background": background}
    clock(
        "500 sources on the image, the Sersic ones first",
        lambda: Scene(chosen, psf=psf, **kind).render(),
    )
    grid = clock("four PSFs over the field", lambda: miri_psf_grid("miri.f770w", n_psfs=4))
    clock("500 sources through them", lambda: Scene(chosen, psf=grid, **kind).render())
    few = chosen[:50].copy()
    few["profile"] = "cutout"
    y, x = np.mgrid[-50:51, -50:51]
    stamp = Cutout(np.exp(-np.hypot(x, y) / 12), pixel_scale=0.06 * u.arcsec)
    stamps = dict.fromkeys(few["id"].tolist(), stamp)
    clock(
        "50 cutouts of 101 x 101 pixels of 0.06 arcsec",
        lambda: Scene(few, psf=psf, cutouts=stamps, **kind).render(),
    )
    hst = hst_psf("wfc3.f160w")
    fine = north_up_wcs(center, 0.06 * u.arcsec, (2200, 2200))
    clock(
        f"F160W image, 2200 x 2200 pixels (PSF oversampling {hst.oversampling[0]})",
        lambda: highres_image(catalog, wcs=fine, psf=hst, seed=1),
    )
    clock(
        "Sersic on 401 x 401 pixels", lambda: sersic_image((401, 401), x=200, y=200, r_eff=5, n=4)
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    print(f"peak memory {peak:.2f} GiB")


def accuracy():
    rng = np.random.default_rng(1)
    worst_sum, worst_cell = 0.0, 0.0
    for n in (0.3, 0.5, 1.0, 2.0, 4.0, 8.0):
        for r_eff in (0.2, 1.0, 5.0, 50.0):
            for ratio in (0.1, 0.4, 1.0):
                x, y, theta = *rng.uniform(99.5, 100.5, 2), rng.uniform(0, np.pi)
                kwargs = {"r_eff": r_eff, "n": n, "axis_ratio": ratio, "theta": theta}
                image = sersic_image((201, 201), x=x, y=y, **kwargs)
                kwargs["r_eff"] *= 5
                fine = sersic_image((45, 45), x=5 * (x - 96) + 2, y=5 * (y - 96) + 2, **kwargs)
                fine = fine.reshape(9, 5, 9, 5).sum(axis=(1, 3))
                part = image[96:105, 96:105]
                worst_cell = max(worst_cell, np.max(np.abs(fine - part)) / part.max())
                if sersic_enclosed_fraction(99 / r_eff, n) > 0.99999:
                    worst_sum = max(worst_sum, abs(image.sum() - 1))
    print(f"Sersic: total off by at most {worst_sum:.1e}; against 5 x 5 smaller pixels,")
    print(f"  largest difference over the central pixel {worst_cell:.1e}")

    sigma, os_ = 0.8, 4
    grid = pixel_gaussian(121, 60, sigma, 1 / os_)
    psf = ImagePSF(np.outer(grid, grid), oversampling=os_)
    painter = Painter((80, 80), psf, enclosed=0.99999)
    worst = {}
    for r_eff in (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, 5.0):
        for ratio in (0.1, 0.5, 1.0):
            x, y = rng.uniform(39.5, 40.5, 2)
            image, _, _ = painter.paint(
                x=np.array([x]),
                y=np.array([y]),
                flux=np.ones(1),
                is_sersic=np.array([r_eff > 0]),
                r_eff=np.array([r_eff]),
                n=np.array([0.5]),
                axis_ratio=np.array([ratio]),
                theta=np.zeros(1),
            )
            own = r_eff / np.sqrt(2 * np.log(2))
            truth = np.outer(
                pixel_gaussian(80, y, np.hypot(sigma, ratio * own)),
                pixel_gaussian(80, x, np.hypot(sigma, own)),
            )
            error = np.max(np.abs(image - truth)) / truth.max()
            worst[r_eff] = max(worst.get(r_eff, 0.0), error)
    print("Gaussian galaxy through a Gaussian PSF (FWHM 1.9 pixels), largest error over peak:")
    for r_eff, error in worst.items():
        print(f"  r_eff {r_eff:5.2f} pixels: {error:.1e}")


if __name__ == "__main__":
    speed()
    accuracy()
