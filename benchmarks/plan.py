"""
The plan of the CEERS exposures, compared with what the imaging run of the same exposures measured.

    python benchmarks/plan.py [--sources 500]

No AGN, as in the run of docs/accuracy/study.rst; prints each number of both and the processor time.
"""

import argparse
import time

import numpy as np

from miricigale.evaluation import Estimate
from miricigale.planning import Planner, load_plan
from miricigale.utils.parallel import threads

#: docs/accuracy/study.rst: 342 sources. The run's errors are the plan's, scaled to as many sources, and of shares
#: those of its own counts.
N_RUN = 342
RUN = {
    "existing bands": {
        "z_scatter": 0.0377, "z_outliers": 0.076, "frac_bias": 0.2331, "frac_scatter": 0.1301,
        "frac_width": 0.195,
    },
    "all": {
        "z_scatter": 0.0119, "z_outliers": 0.006, "frac_bias": 0.0229, "frac_scatter": 0.0302,
        "frac_width": 0.045,
    },
}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--sources", type=int, default=500)
    args = parser.parse_args()
    begin, clock = time.process_time(), time.monotonic()
    config = load_plan(
        overrides={
            "sample": {"n_sources": args.sources},
            "agn": {"frac_agn": 0.0},
            # as in the run: two bands, energy balance, and no noise beyond that of the simulation
            "sed": {"infrared": "fit"},
            "fit": {"min_detected": 2, "dust_excess": ()},
            "noise": {"excess": 1.0},
        }
    )
    with threads() as executor:
        planner = Planner(config, executor=executor)
        plans = planner.compare()
    elapsed, used = time.monotonic() - clock, time.process_time() - begin
    chosen = planner.common(plans)
    print(f"{chosen.sum()} of {len(chosen)} sources detected in two bands")
    for plan in plans:
        numbers = planner.accuracy(plan, chosen)
        for name, run in RUN[plan.name].items():
            one = numbers[name]
            own = one.error * np.sqrt(one.n / N_RUN)
            if name == "z_outliers":
                own = Estimate.of_fraction(round(run * N_RUN), N_RUN).error
            error = np.hypot(one.error, own)
            sigma = (one.value - run) / error
            print(
                f"{plan.name:15s} {name:13s} plan {one.value:+.4f} +- {one.error:.4f}  run {run:+.4f}"
                f"  difference {sigma:+.1f} sigma"
            )
    print(f"{elapsed:.0f} s, {used:.0f} s of processor time")


if __name__ == "__main__":
    main()
