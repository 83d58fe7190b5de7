"""
Signs, factors and comparisons of the science code changed one at a time: does a test fail?

    python tools/mutate.py [--n 300] [--seed 1] [--only psf ...] [--log mutants.jsonl] [--again] [--list]

A seeded sample of changes (a sign, product and quotient exchanged, a number times 1.02, an edge in or out) of
all modules that make a number (`targets`), or those of it in some modules, is made in a copy of the package, and
the tests of the module are run until one fails: those first that noticed other changes of the file. A run that
takes too long is ended and counts as noticed. Printed are the changes that no test noticed. Those that change
nothing (an equivalent formula, a tolerance of a solver, the size of a block) have to be judged by a reader.

Results are added to a file, one line each, and a run goes on where the last one ended; with ``--again``
those changes are tried again that no test had noticed, with the tests of today. At last all tests that
noticed a change are run without any: they must pass.
"""

import argparse
import ast
import collections
import contextlib
import functools
import hashlib
import importlib
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: Imported once: each run of tests is a fork of this process.
HEAVY = "numba scipy.stats scipy.integrate scipy.optimize scipy.ndimage scipy.signal astropy.units"
HEAVY += " astropy.wcs astropy.nddata astropy.table astropy.coordinates astropy.cosmology"
HEAVY += " astropy.modeling.models matplotlib.pyplot photutils.psf synphot reproject drizzle"
#: Put into the copy: some tests go first.
ORDER = """
import json, os
def pytest_collection_modifyitems(items):
    first = json.loads(os.environ["MUTATE_FIRST"])
    place = {name: i for i, name in enumerate(first)}
    items.sort(key=lambda item: place.get(item.nodeid, len(first)))
"""
#: Tests that take minutes, with the kernels that they compile: their changes come last.
SLOW = ("reduction/test_drawn", "detector/test_detector", "fitting/test_grid_engine")
#: Modules whose numbers are places on a page or a screen, or limits of time: whatever else is there makes numbers
#: that users see, and is changed.
NO_SCIENCE = (
    "__main__.py _version.py cli/*.py pages/*.py plotting/*.py workflow/page/*.py */page.py */browser.py "
    "utils/compilation.py utils/exceptions.py utils/interactive.py utils/lock.py utils/outputs.py "
    "utils/progress.py workflow/engine/display.py workflow/warmup.py"
)
#: Modules whose tests are chosen by hand, and the files of tests or their folders that hold them. Those of all
#: others are derived (`tests_of`).
TARGETS = {
    "reduction/_core/drawing.py": "reduction/test_drawn",
    "reduction/_core/[bpr]*.py": "reduction/test_rampfit",
    "reduction/references/calibration.py": "reduction/test_calibration",
    "reduction/mosaic/mosaic.py": "reduction/test_mosaic",
    "reduction/mosaic/outliers.py": "reduction/test_mosaic",
    "detector/_core/*.py": "test_constants detector/test_core detector/test_detector detector/test_effects",
    "psf/_core.py": "psf/test_optics psf/test_model psf/test_resample psf/test_stars",
    "psf/wiener.py": "psf/test_kernels",
    "psf/kernels.py": "psf/test_kernels",
    "psf/resample.py": "psf/test_resample",
    "psf/optics.py": "test_constants psf/test_optics",
    "profiles/_core.py": "profiles",
    "photometry/_core/*.py": "photometry/test_stamps photometry/test_core photometry/test_offsets "
    "photometry/test_forced photometry/test_shapes",
    "photometry/fit/template_fit.py": "photometry/test_core photometry/test_forced",
    "photometry/errors/error_model.py": "photometry/test_error_model photometry/test_errors",
    "photometry/errors/error_curves.py": "photometry/test_errors",
    "sed/_core/igm.py": "test_constants sed/test_igm",
    "sed/_core/attenuation.py": "sed/test_attenuation",
    "sed/_core/disk.py": "test_constants sed/test_agn",
    "sed/_core/polar.py": "sed/test_agn",
    "sed/_core/nebular.py": "test_constants sed/test_nebular",
    "sed/_core/histories.py": "sed/test_sfh sed/test_stellar",
    "sed/_core/xray.py": "test_constants sed/test_xray",
    "sed/_core/[bn]*.py": "sed/test_core sed/test_model sed/test_stellar",
    "sed/_core/thermal.py": "sed/test_dust sed/test_agn",
    "sed/chain.py": "sed/test_chain sed/test_model",
    "sed/components/agn.py": "test_constants sed/test_agn",
    "sed/components/dust.py": "test_constants sed/test_dust",
    "sed/components/attenuation.py": "sed/test_attenuation",
    "sed/xray*.py": "test_constants sed/test_xray sed/test_xray_bands",
    "fitting/_core/*.py": "fitting/test_grid_engine fitting/test_between fitting/test_limits "
    "fitting/test_between_likelihood fitting/test_outliers fitting/test_pairs fitting/test_engine_corners",
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


@functools.cache
def _test_files():
    """Files of tests, and their text."""
    return {
        file: file.read_text(encoding="utf-8")
        for file in sorted((ROOT / "tests").rglob("test_*.py"))
    }


def tests_of(path):
    """
    Files of tests of a module that has none by hand, those that are most about it first.

    They are those of its subpackage that have its name or import it; if there are none, the files of the
    whole tree that import it, and at last the folder of the subpackage.
    """
    inside = path.relative_to(ROOT / "miricigale").with_suffix("")
    folder = ROOT / "tests" / inside.parts[0]
    module = ".".join(["miricigale", *inside.parts])
    imported = re.compile(rf"(from|import) {re.escape(module)}\b")
    own, others = [], []
    for file, text in _test_files().items():
        if file.stem == f"test_{inside.name}" and folder in file.parents:
            own.insert(0, file)
        # the plain search is fast, and leaves few texts for the pattern
        elif module in text and imported.search(text):
            (own if folder in file.parents else others).append(file)
    files = own or others
    names = [str(file.relative_to(ROOT / "tests").with_suffix("")) for file in files]
    return " ".join(names) or inside.parts[0]


def targets():
    """Every module that makes a number, and its tests: dict of path to text."""
    package, out = ROOT / "miricigale", {}
    skipped = {path for pattern in NO_SCIENCE.split() for path in package.glob(pattern)}
    for pattern, tests in TARGETS.items():
        for path in sorted(package.glob(pattern)):
            out.setdefault(path, tests)
    for path in sorted({*package.rglob("*.py")} - skipped - out.keys()):
        if Sites(path.read_text(encoding="utf-8")).found:
            out[path] = tests_of(path)
    return out


def all_sites():
    """Every change: module, its tests, and the place."""
    return [
        (path, tests, site)
        for path, tests in targets().items()
        for site in Sites(path.read_text(encoding="utf-8")).found
    ]


def drawn(change, seed):
    """A random order of changes in which one keeps its place when other lines are edited."""
    path, _, site = change
    _, before, after = changed(path, site)
    text = f"{seed} {path.relative_to(ROOT)} {before} {after}"
    return hashlib.sha256(text.encode()).hexdigest()


def changed(path, site):
    """Source with a change, and its line before and after."""
    line, first, last, new = site
    lines = path.read_text().splitlines(keepends=True)
    old = lines[line - 1].encode()
    lines[line - 1] = (old[:first] + new.encode() + old[last:]).decode()
    return "".join(lines), old.decode().strip(), lines[line - 1].strip()


def kernels_that_call(path):
    """Files of kernels whose compiled code may hold that of a file of kernels, itself among them."""
    package = ROOT / "miricigale"
    imports, names = {}, {}
    for one in [*package.glob("*/_core.py"), *package.glob("*/_core/*.py")]:
        parts = one.relative_to(ROOT).with_suffix("").parts
        names[one] = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        imports[one] = one.read_text()
    found, new = set(), {path} & names.keys()
    while new:
        found |= new
        called = [re.compile(rf"(from|import) {re.escape(names[one])}\b(?!\.)") for one in new]
        new = {one for one in imports if any(c.search(imports[one]) for c in called)} - found
    return found


class Copy:
    """
    A copy of the repository in which files are changed and tests are run.

    Kernels that cannot hold the change keep their compiled code, whose marker is written anew.
    """

    def __init__(self, place):
        self.root = Path(place) / "copy"
        skipped = shutil.ignore_patterns(
            ".git", ".tmp", ".venv", "_build", "*.log", "*.pyc", "build"
        )
        shutil.copytree(ROOT, self.root, ignore=skipped)
        (self.root / "mutate_order.py").write_text(ORDER)
        self.kills = collections.defaultdict(collections.Counter)

    def run(self, tests, first=(), *, seconds, keep=False):
        """The status of pytest and what it printed; it is ended after so many seconds of the processor."""
        printed = self.root / "printed.txt"
        child = os.fork()
        if not child:
            os.chdir(self.root)
            with printed.open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
            sys.path[0], sys.dont_write_bytecode = str(self.root), not keep
            os.environ |= {"PYTHONPATH": str(self.root), "MUTATE_FIRST": json.dumps(first)}
            options = ["-q", "-p", "no:cacheprovider", "-p", "mutate_order", "--tb=line"]
            status = pytest.main([*options, *(() if keep else ("-x",)), *tests])
            sys.stdout.flush()
            os._exit(int(status))
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return status, printed.read_text()

    def noticed(self, path, text, tests, seconds):
        """How the tests of a module end with a change, and the test that noticed it."""
        kills, place = self.kills[path], self.root / path.relative_to(ROOT)
        files = [f"tests/{n}" if (ROOT / "tests" / n).is_dir() else f"tests/{n}.py" for n in tests]
        before, stamp = place.read_bytes(), place.stat()
        kept = self.root / "kept"
        shutil.rmtree(kept, ignore_errors=True)
        stale = [self.root / one.relative_to(ROOT) for one in kernels_that_call(path)]
        code = [p for s in stale for p in s.parent.glob(f"__pycache__/{s.stem}.*.nb?")]
        for one in code:
            (kept / one.relative_to(self.root)).parent.mkdir(parents=True, exist_ok=True)
            one.rename(kept / one.relative_to(self.root))
        place.write_text(text)
        self.mark()
        try:
            first = [name for name, _ in kills.most_common()]
            status, printed = self.run(files, first, seconds=seconds)
        finally:
            place.write_bytes(before)
            os.utime(place, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
            for one in stale:
                for compiled in one.parent.glob(f"__pycache__/{one.stem}.*.nb?"):
                    compiled.unlink()
            for one in code:
                (kept / one.relative_to(self.root)).rename(one)
            self.mark()
        failed = re.findall(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", printed, flags=re.MULTILINE)
        return {0: "survived", -signal.SIGXCPU: "too long"}.get(status, "killed"), *failed[:1]

    def mark(self):
        """Note the checksum of the files of kernels, as `miricigale.utils.compilation` does."""
        code, root = hashlib.sha256(), self.root / "miricigale"
        for path in sorted([*root.glob("*/_core.py"), *root.glob("*/_core/*.py")]):
            code.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
        for marker in root.glob("*/**/kernels.sha256"):
            marker.write_text(code.hexdigest())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", help="parts of names of modules")
    parser.add_argument("--seconds", type=int, default=600, help="of the processor for one change")
    parser.add_argument("--log", type=Path, default="mutants.jsonl", help="file of the results")
    parser.add_argument("--again", action="store_true", help="try again what no test had noticed")
    parser.add_argument("--list", action="store_true", help="print the changes and stop")
    args = parser.parse_args()
    sites = all_sites()
    chosen = sorted(sites, key=lambda one: drawn(one, args.seed))[: args.n]
    if args.only:
        chosen = [one for one in chosen if any(part in str(one[0]) for part in args.only)]
    chosen.sort(key=lambda one: any(name in one[1] for name in SLOW))
    print(f"{len(chosen)} of {len(sites)} changes")
    done = {}
    if args.log.exists() and not args.list:
        records = [json.loads(line) for line in args.log.read_text().splitlines()]
        done = {(one["place"].split(":")[0], one["before"], one["after"]): one for one in records}
    counts, killers = collections.Counter(), collections.Counter()
    os.environ["MPLBACKEND"] = "agg"
    for name in () if args.list else HEAVY.split():
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    with tempfile.TemporaryDirectory() as place:
        copy = None if args.list else Copy(place)
        for path, tests, site in chosen:
            text, before, after = changed(path, site)
            where = f"{path.relative_to(ROOT)}:{site[0]}:{site[1]}"
            if args.list:
                print(f"{where}\n    {before}\n    {after}")
                continue
            record = done.get((str(path.relative_to(ROOT)), before, after))
            if record is None or (args.again and record["how"] == "survived"):
                begin = time.monotonic()
                how, *by = copy.noticed(path, text, tests.split(), args.seconds)
                seconds = round(time.monotonic() - begin)
                record = {"place": where, "how": how, "seconds": seconds, "by": by[0] if by else ""}
                record |= {"before": before, "after": after}
                with args.log.open("a") as log:
                    log.write(json.dumps(record) + "\n")
                print(f"{how} in {seconds} s: {where}", flush=True)
                if how == "survived":
                    print(f"    {before}\n    {after}", flush=True)
            counts[record["how"]] += 1
            if record["by"]:
                killers[record["by"]] += 1
                copy.kills[path][record["by"]] += 1
        if killers:
            status, printed = copy.run(sorted(killers), seconds=10**6, keep=True)
            if status:
                print(f"fail without a change:\n{printed[-2000:]}")
    print(dict(counts))


if __name__ == "__main__":
    main()
