"""
Score, and fit again, the constants of the parametric torus (``torus.parametric``).

The constants stand in miricigale/refdata/files/sed/torus_parametric.toml. They come from
least-squares fits to the 50 SKIRTOR SEDs with p = 1, q = 0, oa = 40 deg, R = 20 that lightningpy
distributes (SKIRTOR.fits.gz, MIT license; Stalevski et al. 2012, 2016), which are not part of
this package.

    python tools/make_torus.py SKIRTOR.fits.gz [--fit]

prints how well they do; ``--fit`` repeats the fits of the emission (2-40 um), the light
that comes straight through and the scattered light, starting from the constants, and prints
new ones.
"""

import argparse

import numpy as np
from astropy.io import fits
from scipy.optimize import least_squares

from miricigale.sed import _core
from miricigale.sed._core import DISK_MEAN
from miricigale.sed.components import ParametricTorus
from miricigale.sed.components.parametric_torus import _constants


class Library:
    """The SEDs, as lambda L_lambda."""

    def __init__(self, path):
        rows = fits.getdata(path, 1)
        order = np.argsort(rows["WAVE_REST"][0])
        self.tau = rows["TAU"].astype(float)
        self.inclination = rows["INCLINATION"].astype(float)
        self.wave = rows["WAVE_REST"][0][order].astype(float)
        nu = rows["NU_REST"][0][order]
        get = lambda name: (rows[name][:, order] * nu).astype(float)  # noqa: E731
        self.dust = get("LNU_DUST_TOTAL")
        self.direct = get("LNU_DISK_DIRECT")
        self.scattered = get("LNU_DISK_SCATTERED")
        self.transparent = get("LNU_TRANSPARENT")
        self.face_on = self.transparent[0]

    def on(self, grid, spectra):
        """Values on another grid, interpolated in log wavelength."""
        x, y = np.log(grid), np.log(self.wave)
        return np.array([np.interp(x, y, row) for row in spectra])


def score(library):
    """Print residuals of shape and scale of the dust emission."""
    torus = ParametricTorus()
    wave, grid = torus.nodes(), np.geomspace(2.0, 40.0, 61)
    accretion = DISK_MEAN * np.trapezoid(library.face_on / library.wave, library.wave)
    theirs = np.log10(np.maximum(library.on(grid, library.dust), 1e-30))
    shape, scale = [], []
    defaults = {name: par.default for name, par in torus.parameters.items()}
    for k, (tau, inclination) in enumerate(zip(library.tau, library.inclination, strict=True)):
        values = defaults | {"tau97": tau, "inclination": inclination, "q": 0.0}
        dust = torus.torus_spectra(wave, values).dust
        residual = np.log10(np.interp(grid, wave, dust * wave)) - theirs[k]
        shape.append(residual - residual.mean())
        total = np.trapezoid(library.dust[k] / library.wave, library.wave) / accretion
        scale.append(np.log10(np.trapezoid(dust, wave) / total))
    rms = np.sqrt(np.mean(np.square(shape), axis=1))
    worst = rms.argmax()
    good = ~((library.tau == 5) & (library.inclination == 80))
    print(f"shape, 2-40 um: rms {np.sqrt(np.mean(rms**2)):.4f} dex, without tau 5 i 80 "
          f"{np.sqrt(np.mean(rms[good] ** 2)):.4f}, worst {rms[worst]:.3f} "
          f"(tau {library.tau[worst]:g}, i {library.inclination[worst]:g})")  # fmt: skip
    print(
        f"dust light over disk light: mean {np.mean(scale):+.4f}, scatter {np.std(scale):.4f} dex"
    )
    for angle in np.unique(library.inclination):
        row = library.inclination == angle
        print(f"  i {angle:3.0f}: shape {np.sqrt(np.mean(rms[row] ** 2)):.3f}, "
              f"scale {np.mean(np.array(scale)[row]):+.3f}")  # fmt: skip


def fit_emission(library, start):
    """Fit the twelve constants of the emission."""
    names = ["s1", "c0", "g18", "w97", "w18", "b", "c", "te", "tl", "tl_power", "i0", "gi"]
    grid, rho = np.geomspace(2.0, 40.0, 61), np.geomspace(1.0, 20.0, 40)
    theirs = np.log10(np.maximum(library.on(grid, library.dust), 1e-30))

    def residual(vector):
        e = start | dict(zip(names, vector, strict=True))
        k = e["c0"] * (grid / 9.7) ** -e["s1"] + _core.drude(grid, 9.7, e["w97"])
        k += e["g18"] * _core.drude(grid, 18.0, e["w18"])
        planck = _core.planck_lambda(grid[:, None], e["temperature"] * rho ** -e["b"])
        shape = grid * np.trapezoid(planck * rho ** e["c"], np.log(rho), axis=1)
        depth = library.tau[:, None] / 7.0
        sight = e["tl"] * depth ** e["tl_power"]
        sight = sight * np.maximum(0, 1 + e["gi"] * (library.inclination[:, None] - 60) / 30)
        sight = sight / (1 + np.exp(-(library.inclination[:, None] - e["i0"]) / e["width"]))
        ours = shape * -np.expm1(-e["te"] * depth ** e["te_power"] * k) * np.exp(-sight * k)
        out = np.log10(ours) - theirs
        return (out - out.mean(axis=1, keepdims=True)).ravel()

    vector = [start[name] for name in names]
    upper = [25.0001 if name == "w18" else np.inf for name in names]
    best = least_squares(residual, vector, bounds=(-np.inf, upper), x_scale=np.abs(vector))
    values = dict(zip(names, np.round(best.x, 4).tolist(), strict=True))
    print("emission", values, f"rms {np.sqrt(np.mean(best.fun**2)):.4f}")


def fit_extinction(library):
    """Fit the optical depth of what comes straight through, i 60-80 deg."""
    grid = np.geomspace(0.7, 40.0, 60)
    rows = (library.inclination >= 60) & (library.inclination <= 80)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = library.direct[rows] / library.transparent[rows]
    depth = -np.log(np.maximum(library.on(grid, ratio), 1e-30))
    seen = depth < 25
    tau = library.tau[rows][:, None]

    def residual(v):
        curve = v[0] * grid ** -v[1] + v[2] * _core.drude(grid, 9.7, v[3])
        curve = curve + v[4] * _core.drude(grid, 18.0, v[5])
        return ((tau * curve - depth) / np.maximum(depth, 0.5))[seen]

    best = least_squares(residual, [6, 1.8, 0.9, 2.4, 0.45, 8], bounds=(0.01, 30))
    print(
        "extinction", np.round(best.x, 3), f"rms {np.sqrt(np.mean(best.fun**2)):.3f} of the depth"
    )


def fit_scattering(library):
    """Fit the scattered light over the face-on disk in 0.1-4 um."""
    grid = np.geomspace(0.1, 4.0, 40)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(library.scattered / library.face_on)
    theirs = np.log10(np.maximum(library.on(grid, ratio), 1e-6))
    x, depth = np.log10(grid), np.log(library.tau / 7)[:, None]
    angle = library.inclination[:, None]

    def residual(v):
        clear = v[0] + v[1] * x - np.log10(1 + (grid / 1.5) ** v[2])
        hidden = (
            v[3] + v[4] * x + v[5] * x**2 + (v[6] + v[7] * x) * depth + v[8] * (angle - 70) / 20
        )
        edge = 1 / (1 + np.exp(-(angle - 52.5) / 1.5))
        return (clear * (1 - edge) + hidden * edge - theirs).ravel()

    start = [-1.5, 0.1, 2, -3.5, 1, 0, -0.4, 0, -0.3]
    best = least_squares(residual, start, loss="soft_l1", f_scale=0.2)
    print(
        "scattering", np.round(best.x, 3), f"rms {np.sqrt(np.mean(residual(best.x) ** 2)):.3f} dex"
    )


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("skirtor", help="SKIRTOR.fits.gz as lightningpy distributes it")
    parser.add_argument("--fit", action="store_true")
    args = parser.parse_args()
    library = Library(args.skirtor)
    score(library)
    if args.fit:
        fit_emission(library, _constants(ParametricTorus().path)["emission"])
        fit_extinction(library)
        fit_scattering(library)


if __name__ == "__main__":
    main()
