"""
What a study of many units costs its own process: three stages of units that do nothing, and one that reads all.

    python benchmarks/driver.py [--n 150000] [--profile]

Printed are the CPU seconds of making the plan, of the units and of a second call that finds all done, with the
peak memory, beside the loop that does nothing but the units' function. Units are named as those of exposures are.
"""

import argparse
import cProfile
import pstats
import resource
import tempfile
import time
from pathlib import Path

from miricigale.workflow.config import StudyConfig
from miricigale.workflow.engine.runner import StudyRunner
from miricigale.workflow.engine.stage import Stage, run_unit

#: Exposures of a pointing in a band.
DITHERS = 4


def nothing(context, unit):
    """A unit without products."""


def stages(n):
    names = [f"sky/T{i // DITHERS}-F770W-{i % DITHERS}" for i in range(n // 3)]
    declared = {"units": lambda _: names}
    return (
        Stage("ramps", nothing, "ramps", **declared),
        Stage("images", nothing, "images", needs=("ramps",), **declared),
        Stage("tables", nothing, "tables", needs=("images",), **declared),
        Stage("page", nothing, "page", needs=("tables",)),
    )


def clocked(text, function):
    start = time.process_time()
    result = function()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{text}: {time.process_time() - start:.1f} CPU-s; peak {peak:.2f} GB", flush=True)
    return result


def main(n):
    config = StudyConfig()
    made = stages(n)
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        few = range(n // 100)
        loop = "function of every hundredth unit alone"
        clocked(
            loop, lambda: [run_unit(config, folder, made, "ramps", f"{i}", inputs=[]) for i in few]
        )
        runner = clocked("plan", lambda: StudyRunner(config, folder / "run", made))
        clocked("units", runner.run)
        clocked("all stand", runner.run)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--n", type=int, default=150_000)
    parser.add_argument("--profile", action="store_true", help="where the time goes")
    args = parser.parse_args()
    if args.profile:
        with cProfile.Profile() as profile:
            main(args.n)
        pstats.Stats(profile).sort_stats("cumulative").print_stats(30)
    else:
        main(args.n)
