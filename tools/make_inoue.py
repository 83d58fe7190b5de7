"""
Make ``igm.inoue2014``: the Lyman series of Inoue et al. 2014, their table 2.

The numbers are read from the source of eazy 0.8.7 (MIT license; ``pip download --no-deps eazy==0.8.7``),
which has them with six digits. They are rounded to the four of the paper; wavelengths are in um.

    python tools/make_inoue.py [--archive PATH] [--output PATH]
"""

import argparse
import tarfile
from pathlib import Path

from _wheel import find_wheel, sha256

OUTPUT = Path(__file__).parents[1] / "miricigale/refdata/files/sed/igm_inoue2014.toml"
#: Forest (LAF) and damped systems (DLA): number and wavelength of the line, then coefficients
MEMBERS = ("eazy-0.8.7/eazy/data/LAFcoeff.txt", "eazy-0.8.7/eazy/data/DLAcoeff.txt")
HEAD = """\
# Lyman series absorption by the intergalactic medium: Inoue et al. 2014, MNRAS 442, 1805, table 2.
# Optical depths at x = observed wavelength / wavelength of the line:
# forest laf1 x^1.2 below x = 2.2, laf2 x^3.7 below 5.7, laf3 x^5.5 above (eq. 21),
# damped systems dla1 x^2 below x = 3, dla2 x^3 above (eq. 22).
"""
COLUMNS = ("n", "wavelength", "laf1", "laf2", "laf3", "dla1", "dla2")


def main():
    """Write the table and print its checksum."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--archive", help="source archive of eazy 0.8.7")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    with tarfile.open(find_wheel(options.archive, "eazy==0.8.7", "eazy-*.tar.gz")) as archive:
        forest, damped = (
            [line.split() for line in archive.extractfile(member).read().decode().splitlines()]
            for member in MEMBERS
        )
    rows = [
        row[:2] + [f"{float(value):.3e}" for value in row[2:] + other[2:]]
        for row, other in zip(forest, damped, strict=True)
    ]
    if len(rows) != 39 or any(len(row) != len(COLUMNS) for row in rows):
        raise SystemExit(f"{MEMBERS} have not the 39 rows of 7 columns of table 2")
    text = HEAD
    for name, column in zip(COLUMNS, zip(*rows, strict=True), strict=True):
        if name == "wavelength":
            text += "\n# um, in vacuum\n"
            column = [f"{float(value) / 1e4:.7f}" for value in column]
        text += f"{name} = [\n"
        for start in range(0, len(column), 8):
            text += f"    {', '.join(column[start : start + 8])},\n"
        text += "]\n"
    options.output.write_text(text)
    print(
        f"{options.output}: {options.output.stat().st_size} bytes, sha256 {sha256(options.output)}"
    )


if __name__ == "__main__":
    main()
