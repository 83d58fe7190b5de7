"""
CPU seconds until each command has begun, and of each compile job in an empty cache.

    python benchmarks/start.py [--compile]

A plain loop of Python and the import of numpy and astropy's tables are timed beside them.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time

COMMANDS = (
    ["--version"],
    ["fit", "--help"],
    ["filters", "miri"],
    ["data", "list"],
    ["data", "check"],
    ["run", "goodss", "--quick", "--print-config"],
    ["run", "absent.toml"],
    ["fit", "absent.fits"],
    ["photometry", "a.fits", "b.fits", "--filter", "miri.f770w", "--pa-aper", "0"],
    ["plan", "--quick"],
)


def cpu(arguments, **env):
    """CPU seconds of a process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *arguments], env={**os.environ, **env}, capture_output=True, check=False
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--compile", action="store_true", help="time the compile jobs too")
    options = parser.parse_args()
    start = time.process_time()
    total = 0
    for i in range(5_000_000):
        total += i & 7
    print(f"{time.process_time() - start:7.2f}  loop of Python")
    print(f"{cpu(['-c', 'import numpy']):7.2f}  import numpy")
    print(f"{cpu(['-c', 'import astropy.table, astropy.units']):7.2f}  import astropy.table")
    for command in COMMANDS:
        print(f"{cpu(['-m', 'miricigale', *command]):7.2f}  miricigale {' '.join(command)}")
    if options.compile:
        with tempfile.TemporaryDirectory() as folder:
            for name in ("fit", "images", "photometry"):
                code = f"from miricigale.workflow.warmup import compile_job; compile_job({name!r})"
                first, second = (cpu(["-c", code], NUMBA_CACHE_DIR=folder) for _ in range(2))
                print(f"{first:7.2f}  compile {name}; from the cache {second:.2f}")


if __name__ == "__main__":
    main()
