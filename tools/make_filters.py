"""
Make ``filters.megacam2015`` and ``filters.wfcam``: curves of MegaCam's filters of 2015, and of WFCAM's Z and Y.

MegaCam: speclite 1.0.0 (BSD-3-Clause), total transmission with 1.25 air masses of atmosphere. The numbers of the
filters in its tables are those of the first set for g to z; the edges of the curves are those of the third.
WFCAM: snpy 2.7.4 (MIT), transmission of the filters alone, in per cent. Curves are scaled to their peak.

    python tools/make_filters.py [--speclite WHEEL] [--snpy ARCHIVE] [--output FOLDER]
"""

import argparse
import tarfile
from pathlib import Path

from _wheel import extract, find_wheel, sha256

OUTPUT = Path(__file__).parents[1] / "miricigale/refdata/files/filters"
HEAD = "# Filter curves made by tools/make_filters.py: name, wavelength in Angstrom, photon response (peak 1).\n"


def numbers(text):
    """Rows of two numbers in a text."""
    rows = []
    for line in text.splitlines():
        try:
            wave, response = map(float, line.split())
        except ValueError:
            continue
        rows.append((wave, response))
    return rows


def main():
    """Write the table and print its checksum."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--speclite", help="wheel of speclite 1.0.0")
    parser.add_argument("--snpy", help="source archive of snpy 2.7.4")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    wheel = find_wheel(options.speclite, "speclite==1.0.0", "speclite-*.whl")
    curves = {
        f"megacam2015.{band}": extract(
            wheel, f"speclite/data/filters/cfht_megacam-{band}.ecsv"
        ).read_text()
        for band in "ugriz"
    }
    folder = "snpy-2.7.4/snpy/filters/filters/UKIRT/WFCAM"
    with tarfile.open(find_wheel(options.snpy, "snpy==2.7.4", "snpy-*.tar.gz")) as archive:
        for band in "zY":
            text = archive.extractfile(f"{folder}/{band}_WFCAM.dat").read().decode()
            curves[f"wfcam.{band.lower()}"] = text
    texts = {}
    for name, curve in curves.items():
        rows = numbers(curve)
        peak = max(response for _, response in rows)
        lines = "".join(f"{name} {wave:g} {max(value, 0) / peak:.4g}\n" for wave, value in rows)
        file = f"{name.partition('.')[0]}.txt"
        texts[file] = texts.get(file, HEAD) + lines
    for file, text in texts.items():
        path = options.output / file
        path.write_text(text)
        print(f"{path}: {path.stat().st_size} bytes, sha256 {sha256(path)}")


if __name__ == "__main__":
    main()
