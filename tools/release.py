"""
Make the files of the repository those of a release.

    python tools/release.py 0.1.0 [--date 2026-12-01]

The version and date are written into CITATION.cff, the fragments of docs/changes are moved to
CHANGES.rst by towncrier (extra ``docs``), and the next steps are printed. The version of the package
itself is the tag, which setuptools_scm reads.
"""

import argparse
import datetime
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def cite(text, version, date):
    """CITATION.cff with a version and the date of its release."""
    text = re.sub(r"^date-released: .*\n", "", text, flags=re.MULTILINE)
    return re.sub(
        r"^version: .*$", f"version: {version}\ndate-released: {date}", text, flags=re.MULTILINE
    )


def main():
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("version")
    parser.add_argument("--date", default=datetime.date.today().isoformat())
    options = parser.parse_args()
    path = ROOT / "CITATION.cff"
    path.write_text(
        cite(path.read_text(encoding="utf-8"), options.version, options.date), encoding="utf-8"
    )
    command = [sys.executable, "-m", "towncrier", "build", "--yes"]
    command += ["--version", options.version, "--date", options.date]
    subprocess.run(command, cwd=ROOT, check=True)
    print(f"next: git commit -am 'Version {options.version}'; git tag v{options.version}")


if __name__ == "__main__":
    main()
