"""
Signs, factors and comparisons of the science code changed one at a time: does a test fail?

    python tools/mutate.py [--n 300] [--seed 1] [--only psf ...] [--minutes 10] [--list]

A seeded sample of changes (a sign, product and quotient exchanged, a number times 1.02, an edge in or out) in the
modules of ``TARGETS`` is made in a copy of the package, and the tests of the module are run until one fails.
Printed are the changes that no test noticed. Those that change nothing (an equivalent formula, a tolerance of a
solver, the size of a block) have to be judged by a reader.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Modules of the science, and the files of tests or their folders that hold them.
TARGETS = {
    "reduction/_core/drawing.py": "reduction/test_drawn",
    "reduction/_core/[lpr]*.py": "reduction/test_rampfit",
    "reduction/calibration.py": "reduction/test_calibration",
    "detector/_core/*.py": "detector/test_core detector/test_detector detector/test_effects",
    "psf/_core.py": "psf/test_optics psf/test_model psf/test_resample",
    "psf/wiener.py": "psf/test_kernels",
    "psf/optics.py": "psf/test_optics",
    "profiles/_core.py": "profiles",
    "photometry/_core/*.py": "photometry/test_core photometry/test_forced photometry/test_shapes",
    "photometry/error_model.py": "photometry/test_error_model photometry/test_errors",
    "photometry/error_curves.py": "photometry/test_errors",
    "sed/_core/igm.py": "test_constants sed/test_igm",
    "sed/_core/attenuation.py": "sed/test_attenuation",
    "sed/_core/disk.py": "test_constants sed/test_agn",
    "sed/_core/polar.py": "sed/test_agn",
    "sed/_core/nebular.py": "test_constants sed/test_nebular",
    "sed/_core/histories.py": "sed/test_sfh sed/test_stellar",
    "sed/_core/xray.py": "test_constants sed/test_xray",
    "sed/_core/[brt]*.py": "sed/test_core sed/test_model",
    "sed/chain.py": "sed/test_chain sed/test_model",
    "sed/components/agn.py": "sed/test_agn",
    "sed/components/dust.py": "sed/test_dust",
    "sed/components/attenuation.py": "sed/test_attenuation",
    "sed/xray*.py": "test_constants sed/test_xray sed/test_xray_bands",
    "fitting/_core/*.py": "fitting/test_grid_engine fitting/test_between fitting/test_limits "
    "fitting/test_outliers fitting/test_pairs fitting/test_engine_corners",
    "depth/noise.py": "depth",
    "depth/limits.py": "depth",
    "evaluation/counts.py": "test_constants evaluation/test_counts",
    "evaluation/classes.py": "evaluation/test_classes",
    "evaluation/xray.py": "evaluation/test_xray",
    "evaluation/population.py": "test_constants evaluation/test_population",
    "scene/background.py": "scene/test_background",
    "instrument/photometric.py": "instrument/test_photometric",
}
_OPERATORS = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
}


class Sites(ast.NodeVisitor):
    """Places of a source that can be changed: line, first and last column, new text."""

    def __init__(self, text):
        self.lines, self.found = text.splitlines(), []
        self.visit(ast.parse(text))

    def _add(self, line, first, last, new):
        self.found.append((line, first, last, new))

    def _between(self, left, right, operator):
        if operator not in _OPERATORS or left.end_lineno != right.lineno:
            return
        old, new = _OPERATORS[operator]
        gap = (
            self.lines[left.end_lineno - 1]
            .encode()[left.end_col_offset : right.col_offset]
            .decode()
        )
        if gap.count(old) == 1 and gap.strip(" ()") == old:
            first = left.end_col_offset + gap.index(old)
            self._add(left.end_lineno, first, first + len(old), new)

    def visit_BinOp(self, node):
        self._between(node.left, node.right, type(node.op))
        self.generic_visit(node)

    def visit_AugAssign(self, node):
        swap = {ast.Add: ("+=", "-="), ast.Sub: ("-=", "+="), ast.Mult: ("*=", "/=")}.get(
            type(node.op)
        )
        line = self.lines[node.lineno - 1].encode()
        if swap and node.value.lineno == node.lineno:
            first = line.index(swap[0].encode(), node.target.end_col_offset)
            self._add(node.lineno, first, first + 2, swap[1])
        self.generic_visit(node)

    def visit_Compare(self, node):
        if len(node.ops) == 1:
            self._between(node.left, node.comparators[0], type(node.ops[0]))
        self.generic_visit(node)

    def visit_UnaryOp(self, node):
        if isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self._add(node.lineno, node.col_offset, node.col_offset + 1, "")
        self.generic_visit(node)

    def visit_Constant(self, node):
        if (
            isinstance(node.value, float)
            and node.value not in (0.0, 1.0)
            and node.lineno == node.end_lineno
        ):
            self._add(node.lineno, node.col_offset, node.end_col_offset, repr(1.02 * node.value))

    def visit_Subscript(self, node):
        self.visit(node.value)

    def visit_FunctionDef(self, node):
        for child in node.body:
            self.visit(child)


def all_sites(only):
    """Every change: module, its tests, and the place."""
    out = []
    for pattern, tests in TARGETS.items():
        for path in sorted((ROOT / "miricigale").glob(pattern)):
            name = str(path.relative_to(ROOT / "miricigale"))
            if not only or any(part in name for part in only):
                out += [(path, tests, site) for site in Sites(path.read_text()).found]
    return out


def changed(path, site):
    """Source with a change, and its line before and after."""
    line, first, last, new = site
    lines = path.read_text().splitlines(keepends=True)
    old = lines[line - 1].encode()
    lines[line - 1] = (old[:first] + new.encode() + old[last:]).decode()
    return "".join(lines), old.decode().strip(), lines[line - 1].strip()


def noticed(copy, path, text, tests, minutes):
    """How the tests of a module end with a change: 'killed', 'survived' or 'too long'."""
    place = copy / path.relative_to(ROOT)
    before = place.read_bytes()
    place.write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(copy), "MPLBACKEND": "agg"}
    files = [
        f"tests/{name}" if (copy / "tests" / name).is_dir() else f"tests/{name}.py"
        for name in tests.split()
    ]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *files]
    try:
        done = subprocess.run(
            command,
            cwd=copy,
            env=environment,
            capture_output=True,
            timeout=60 * minutes,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "too long"
    finally:
        place.write_bytes(before)
    return "survived" if done.returncode == 0 else "killed"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", help="parts of names of modules")
    parser.add_argument("--minutes", type=float, default=10.0, help="for the tests of one change")
    parser.add_argument("--list", action="store_true", help="print the changes and stop")
    args = parser.parse_args()
    sites = all_sites(args.only)
    chosen = random.Random(args.seed).sample(sites, min(args.n, len(sites)))
    print(f"{len(chosen)} of {len(sites)} changes")
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "copy"
        skipped = shutil.ignore_patterns(".git", ".venv", "docs", "_build", "*.log")
        shutil.copytree(ROOT, copy, ignore=skipped)
        counts = {"killed": 0, "survived": 0, "too long": 0}
        for path, tests, site in chosen:
            text, before, after = changed(path, site)
            where = f"{path.relative_to(ROOT)}:{site[0]}"
            if args.list:
                print(f"{where}\n    {before}\n    {after}")
                continue
            begin = time.monotonic()
            how = noticed(copy, path, text, tests, args.minutes)
            counts[how] += 1
            print(f"{how} in {time.monotonic() - begin:.0f} s: {where}", flush=True)
            if how != "killed":
                print(f"    {before}\n    {after}", flush=True)
    print(counts)


if __name__ == "__main__":
    main()
