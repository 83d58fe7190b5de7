"""Time the PSFs and kernels and print how they compare with the telescope in flight.

python benchmarks/psf.py
"""

import time

import astropy.units as u

from miricigale.psf import (
    MatchingKernel,
    encircled_energy,
    fwhm,
    hst_psf,
    jwst_pupil,
    miri_psf,
    miri_psf_grid,
    psf_mosaic,
    radius_of_encircled_energy,
    rotate_psf,
)
from miricigale.psf.miri import _miri_data
from miricigale.psf.telescope import Telescope

# arcsec; jwst-docs, MIRI Point Spread Functions, table 1 (commissioning, PID 1028)
IN_FLIGHT = dict(
    zip(
        (560, 770, 1000, 1130, 1280, 1500, 1800, 2100, 2550),
        (0.207, 0.269, 0.328, 0.375, 0.420, 0.488, 0.591, 0.674, 0.803),
        strict=True,
    )
)
SCALE = 0.06 * u.arcsec


def timed(function, *args, repeat=3, clock=time.perf_counter, **kwargs):
    """Result and shortest time in s."""
    best = float("inf")
    for _ in range(repeat):
        start = clock()
        result = function(*args, **kwargs)
        best = min(best, clock() - start)
    return result, best


def make(name):
    """One PSF without the cache."""
    _miri_data.cache_clear()
    Telescope.image.cache_clear()
    return miri_psf(name)


def main():
    """Print the tables."""
    _, first = timed(jwst_pupil.__wrapped__, 384)
    print(f"pupil (once a process) {first:.2f} s")
    print("filter    s CPU   FWHM  Gauss  flight ratio   r80  EE 0.5  1.0   1.5   2.5   5.0  grid")
    psfs = {}
    for number, flight in IN_FLIGHT.items():
        psf, seconds = timed(make, f"miri.f{number}w", clock=time.process_time)
        psfs[number] = psf
        gauss = fwhm(psf, method="gaussian").value
        energies = encircled_energy(psf, [0.5, 1.0, 1.5, 2.5, 5.0] * u.arcsec)
        print(
            f"F{number}W".ljust(8),
            f"{seconds:6.2f} {fwhm(psf).value:6.3f} {gauss:6.3f} {flight:6.3f}",
            f"{gauss / flight:6.3f} {radius_of_encircled_energy(psf, 0.8).value:5.2f} ",
            " ".join(f"{e:.3f}" for e in (*energies, psf.enclosed)),
        )
    _miri_data.cache_clear()
    Telescope.image.cache_clear()
    grid, seconds = timed(miri_psf_grid, "miri.f770w", repeat=1, clock=time.process_time)
    print(f"miri_psf_grid, {len(grid.data)} places {seconds:.2f} s CPU")
    hst, seconds = timed(hst_psf)
    print(f"hst_psf (cached optics) {seconds:.2f} s, FWHM {hst.fwhm:.4f}")
    print(f"rotate_psf {timed(rotate_psf, psfs[770], 33 * u.deg)[1]:.2f} s")
    print(f"psf_mosaic {timed(psf_mosaic, psfs[770], SCALE, 33 * u.deg)[1]:.2f} s")
    print(
        "kernel from F160W at 0.06 arcsec: largest error of the encircled energy in %, noise gain"
    )
    print("filter     mu 0.03         mu 1e-3         auto                     s")
    for number, psf in psfs.items():
        cells = []
        for mu in ("yang2021", 1e-3, "auto"):
            kernel, seconds = timed(
                MatchingKernel.from_psfs,
                hst,
                psf,
                pixel_scale=SCALE,
                lo_angle=0 * u.deg,
                regularization=mu,
                repeat=1,
            )
            text = f"{100 * kernel.meta['max_error']:5.2f} {kernel.noise_gain:7.4f}"
            cells.append(text + (f"  mu {kernel.regularization:.1e}" if mu == "auto" else ""))
        print(f"F{number}W".ljust(8), "   ".join(cells), f"  {seconds:.2f}")


if __name__ == "__main__":
    main()
