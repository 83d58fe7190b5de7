"""
Make the table of the exposure time calculator's set-up and of the residual it implies.

    python tools/make_residual.py

Writes miricigale/refdata/files/instrument/etc.toml and prints its checksum for resources.toml.
Needs the package alone. The set-up (literals below) is that of the script with which the
observatory computes its table of limits: tests/miri/miri_sensitivity_imaging.py of
spacetelescope/pandeia-verification, whose strategy has ``background_subtraction`` off: the sky is
known, and the annulus (verification_tools/calc_limits.py: from 2 radii, with the aperture's area) is
named but not measured. The residual is what photon noise, dark current and read noise leave of the
published 10-sigma limits (ETC 4.0, ``etc_40`` of imager.toml) in that aperture: variances
add, (limit * light / 10)^2 = white + shot + (amplitude * pattern)^2.
"""

import hashlib
import tomllib
from pathlib import Path

import numpy as np

from miricigale.depth import aperture_noise, etc_limit, etc_setup

OUT = Path(__file__).parents[1] / "miricigale/refdata/files/instrument/etc.toml"

# nominal wavelength in um; groups, integrations, exposures
SETUP = {
    "f560w": (5.6, 106, 2, 17),
    "f770w": (7.7, 106, 2, 17),
    "f1000w": (10.0, 106, 2, 17),
    "f1130w": (11.3, 106, 2, 17),
    "f1280w": (12.8, 106, 2, 17),
    "f1500w": (15.0, 22, 4, 41),
    "f1800w": (18.0, 22, 4, 41),
    "f2100w": (21.0, 12, 15, 20),
    "f2550w": (25.5, 12, 15, 20),
}

HEAD = """\
# How the exposure time calculator's published limits are made, and the residual they imply;
# made by tools/make_residual.py, which gives the sources.
[setup]
readout = "FASTR1"
radius_per_um = 0.042                        # arcsec of aperture radius per um of wavelength
annulus = [2.0, 2.23606797749979]            # radii of the sky annulus in those of the aperture
subtract_annulus = false                     # the sky is taken as known
"""


def write(amplitudes):
    lines = [HEAD]
    for name, (wavelength, n_groups, n_integrations, n_exposures) in SETUP.items():
        lines += [
            f"[filters.{name}]",
            f"wavelength = {wavelength}     # um, nominal",
            f"n_groups = {n_groups}",
            f"n_integrations = {n_integrations}",
            f"n_exposures = {n_exposures}",
            "",
        ]
    lines.append(
        "[residual.etc]     # standard deviation over light, correlation 1 pixel, against 4.0"
    )
    lines += [f"{name} = {value:.3g}" for name, value in amplitudes.items()]
    text = "\n".join(lines) + "\n"
    tomllib.loads(text)
    OUT.write_text(text)


def amplitude(name):
    """The amplitude with which the closed form gives the published limit."""
    row = aperture_noise(f"miri.{name}", etc_setup(name).time, n_sigma=10)
    limit = etc_limit(f"miri.{name}").value
    rest = (limit * row["light"] / 10) ** 2 - row["white"] ** 2 - row["shot"] * limit
    print(
        f"{name}: light {row['light']:.3f}, without residual {row['flux']:.4g} uJy "
        f"({row['flux'] / limit:.2f} of {limit})"
    )
    if rest < 0:
        raise SystemExit(f"{name}: the noise alone exceeds the published limit")
    return float(np.sqrt(rest) / row["pattern"])


def main():
    write(dict.fromkeys(SETUP, 0.0))  # the closed form reads the set-up from it
    write({name: amplitude(name) for name in SETUP})
    print(f"etc.toml: sha256 {hashlib.sha256(OUT.read_bytes()).hexdigest()}")


if __name__ == "__main__":
    main()
