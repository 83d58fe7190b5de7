"""
What a user waits for, of two versions of the package side by side.

    python benchmarks/pair.py OLD NEW
    python benchmarks/pair.py OLD NEW --uds DATA/uds photometry
    python benchmarks/pair.py OLD NEW --catalog FILE --z-spec z fit known

OLD and NEW are checkouts, which the Python that runs this script imports. Jobs alternate between them, so that
other work on the machine slows both. Medians of processor seconds (of all processes of a job), the ratio of the
new to the old ones, and the largest memory of a process. Jobs of the kernels begin with an empty cache, the
others with a run that is not counted.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

#: Jobs that begin with an empty cache of kernels.
COLD = ("compile", "first")

#: Code of a job that makes its input first, and prints the seconds of what is measured after that.
CODE = """
import sys, time
sys.path.insert(0, "benchmarks")
import numpy as np
{input}
start = time.process_time()
{work}
print(time.process_time() - start)
"""

POINTS = {
    "input": """
import photometry
wide = {"pixel_scale": photometry.FINE, "fov": 3.1 * photometry.u.arcsec}
psfs = [photometry.gaussian_psf(k * photometry.u.arcsec, **wide) for k in (0.2, 0.5)]
kernel = photometry.MatchingKernel.from_psfs(*psfs, pixel_scale=photometry.FINE)
scale = 0.11 * photometry.u.arcsec
rng = np.random.default_rng(1)
wcs, image, sky, _ = photometry.point_scene(100_000, (10_000, 10_000), scale, 1.93, rng)
image, catalog = photometry.mosaic(image, wcs, 1.0), photometry.QTable({"sky": sky})
""",
    "work": """
photometry.ForcedPhotometer(kernel, template="psf").measure(image, catalog=catalog)
""",
}

CROWDED = {
    "input": """
import photometry
kernel, rng = photometry.cutout_kernel(), np.random.default_rng(1)
prior, light, sky, flux = photometry.galaxy_field(6400, 166, kernel, rng)
image = photometry.mosaic(light + rng.normal(0, 0.02, light.shape), prior.wcs, 0.02)
segmentation, detected = photometry.detect_sources(prior, threshold=1.0, n_pixels=8)
print(len(detected), "segments")
""",
    "work": """
photometer = photometry.ForcedPhotometer(kernel, background_order=0)
photometer.measure(image, prior, segmentation, detected)
""",
}

SPECTRA = {
    "input": """
import sed
table, filters = sed.rows(5000, repeat=False), sed.FilterSet.from_names(sed.BANDS)
model = sed.SEDModel.yang2021()
model.fluxes(sed.rows(300, repeat=True), filters)
""",
    "work": "model.fluxes(table, filters)",
}


def commands(options):
    """Arguments of Python for each job, by name; ``FOLDER`` stands for an empty one."""
    miricigale = ["-m", "miricigale"]
    coded = {"points": POINTS, "crowded": CROWDED, "spectra": SPECTRA}
    jobs = {name: ["-c", CODE.format(**parts)] for name, parts in coded.items()}
    jobs["compile"] = [*miricigale, "compile"]
    jobs["first"] = [*miricigale, "run", "goodss", "--quick", "-o", "FOLDER/run"]
    sets = ["f770w,f1000w,f1500w", "f770w,f2100w"]
    jobs["plan"] = [
        *miricigale, "plan", "--bands", "f770w", "f1000w", "f1500w", "f2100w", "--time", "1000",
        "--sets", *sets, "--sources", "400", "-o", "FOLDER/plan",
    ]  # fmt: skip
    if options.catalog is not None:
        fit = [*miricigale, "fit", options.catalog, "-o", "FOLDER/fits"]
        jobs["fit"] = fit
        jobs["known"] = [*fit, "--redshift", options.z_spec]
        jobs["calibrate"] = [*fit, "--calibrate", options.z_spec]
    if options.uds is not None:
        start, psfs = f"{options.uds}/uds-test", f"{options.uds}/psf/uds-test-f444w"
        jobs["photometry"] = [
            *miricigale, "photometry", "-o", "FOLDER/table.ecsv", "--overwrite",
            "--image", f"{start}-f770w_sci.fits.gz", "--filter", "F770W",
            "--weight", f"{start}-f770w_wht.fits.gz",
            "--highres", f"{start}-f444w_sci.fits.gz", "--highres-filter", "F444W",
            "--highres-weight", f"{start}-f444w_wht.fits.gz",
            "--highres-psf", f"{psfs}_psf.fits.gz[0,mean]",
            "--kernel", f"{psfs}_kernel_f770w.fits.gz[0,mean]",
        ]  # fmt: skip
    return jobs


def measure(checkout, command, *, cold):
    """Processor seconds of a job with a checkout, and largest memory of one of its processes in GB."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"PYTHONPATH": str(checkout), "MPLBACKEND": "agg"}
        if cold:
            environment["NUMBA_CACHE_DIR"] = folder + "/kernels"
        arguments = [one.replace("FOLDER", folder) for one in command]
        with open(f"{folder}/output", "w+") as output:
            process = subprocess.Popen(
                [sys.executable, *arguments], cwd=checkout, env=environment, stdout=output,
                stderr=subprocess.DEVNULL,
            )  # fmt: skip
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            output.seek(0)
            lines = output.read().split("\n")[-2:]
    if status:
        return float("nan"), float("nan")
    seconds = usage.ru_utime + usage.ru_stime
    # code that makes its input prints its own
    if command[0] == "-c":
        seconds = float(lines[0])
    return seconds, usage.ru_maxrss / 1e6


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("old", type=Path, help="checkout of the old version")
    parser.add_argument("new", type=Path, help="checkout of the new version")
    parser.add_argument("jobs", nargs="*", help="names of jobs (all)")
    parser.add_argument("--uds", type=Path, help="folder of real files, for the job 'photometry'")
    parser.add_argument(
        "--catalog", help="survey catalog, for the jobs 'fit', 'known', 'calibrate'"
    )
    parser.add_argument("--z-spec", default="z_spec", help="its column of redshifts")
    parser.add_argument("--rounds", type=int, default=3, help="how often each is measured")
    options = parser.parse_intermixed_args()
    jobs = commands(options)
    unknown = set(options.jobs) - jobs.keys()
    if unknown:
        parser.error(f"unknown jobs {sorted(unknown)}, or without their files; known: {[*jobs]}")
    print(f"{'job':12s} {'old':>8s} {'new':>8s} {'ratio':>6s}   {'memory (GB)':>12s}   CPU seconds")
    for name in options.jobs or jobs:
        cold = name in COLD
        found = {options.old.resolve(): [], options.new.resolve(): []}
        for turn in range(options.rounds + (not cold)):
            for checkout, values in found.items():
                value = measure(checkout, jobs[name], cold=cold)
                if cold or turn:
                    values.append(value)
        medians = [
            [statistics.median(column) for column in zip(*values, strict=True)]
            for values in found.values()
        ]
        (old, old_memory), (new, new_memory) = medians
        memory = f"{old_memory:.2f} {new_memory:.2f}"
        print(f"{name:12s} {old:8.2f} {new:8.2f} {new / old:6.2f}   {memory:>12s}", flush=True)


if __name__ == "__main__":
    main()
