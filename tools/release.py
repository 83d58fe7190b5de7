"""
Check the archives of the package, and make the files of the repository those of a release.

    python tools/release.py check [--python python3.13 ...]
    python tools/release.py write 1.0.0 [--date 2026-12-01]

``check`` builds the source archive and the wheel in ``dist``, checks metadata and content, installs each
in a fresh environment of each Python and runs ``tools/smoke.py`` there. ``write`` puts version and date
into CITATION.cff and .zenodo.json, and moves the fragments of docs/changes to CHANGES.rst by towncrier
(extra ``docs``). The version of the package itself is the tag, which setuptools_scm reads.
"""

import argparse
import datetime
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHONS = ("python3.11", "python3.12", "python3.13", "python3.14")
TOOLS = ("build", "twine", "check-wheel-contents")


def run(*command, **options):
    """Run a command, which is shown; it must succeed."""
    print("$", *command, flush=True)
    subprocess.run([str(part) for part in command], check=True, **options)


def environment(python, folder):
    """Make an environment of a Python; return its folder of programs."""
    run(python, "-m", "venv", folder)
    (programs,) = (path.parent for path in folder.glob("*/python*") if path.stem == "python")
    return programs


def found_pythons():
    """The supported Pythons that can be run here."""
    found = []
    for name in PYTHONS:
        command = [name, "--version"]
        if shutil.which(name) and not subprocess.run(command, capture_output=True).returncode:
            found.append(name)
    return found


def check(pythons):
    """Build the archives and check them."""
    dist = ROOT / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix="miricigale-release-") as name:
        folder = Path(name)
        tools = environment(sys.executable, folder / "tools")
        run(tools / "python", "-m", "pip", "install", "-q", *TOOLS)
        run(tools / "python", "-m", "build", "--outdir", dist, ROOT)
        archives = sorted(dist.iterdir())
        run(tools / "twine", "check", "--strict", *archives)
        run(tools / "check-wheel-contents", dist)
        for python in pythons:
            for archive in archives:
                place = folder / f"{Path(python).name}-{archive.suffix[1:]}"
                programs = environment(python, place)
                run(programs / "python", "-m", "pip", "install", "-q", archive)
                # away from the source tree, so that the installed package is imported
                run(programs / "python", ROOT / "tools/smoke.py", cwd=place)
                shutil.rmtree(place)
    print(f"checked on {', '.join(pythons)}: {', '.join(path.name for path in archives)}")


def cite(text, version, date):
    """CITATION.cff with a version and the date of its release."""
    text = re.sub(r"^date-released: .*\n", "", text, flags=re.MULTILINE)
    return re.sub(
        r"^version: .*$", f"version: {version}\ndate-released: {date}", text, flags=re.MULTILINE
    )


def zenodo(text, version, date):
    """The metadata for Zenodo with a version and the date of its release."""
    values = json.loads(text) | {"version": version, "publication_date": date}
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"


def write(version, date):
    """Write version and date, and the changelog."""
    for name, change in (("CITATION.cff", cite), (".zenodo.json", zenodo)):
        path = ROOT / name
        text = path.read_text(encoding="utf-8")
        path.write_text(change(text, version, date), encoding="utf-8")
    command = ["towncrier", "build", "--yes", "--version", version, "--date", date]
    run(sys.executable, "-m", *command, cwd=ROOT)
    print(f"next: git commit -am 'Version {version}'; git tag v{version}")


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    commands = parser.add_subparsers(dest="command", required=True)
    part = commands.add_parser("check", help="build, check, install and smoke-test the archives")
    part.add_argument("--python", nargs="+", help="interpreters (default: all supported ones here)")
    part = commands.add_parser("write", help="write version, date and changelog")
    part.add_argument("version")
    part.add_argument("--date", default=datetime.date.today().isoformat())
    options = parser.parse_args()
    if options.command == "check":
        check(options.python or found_pythons())
    else:
        write(options.version, options.date)


if __name__ == "__main__":
    main()
