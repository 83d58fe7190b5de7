"""Commands of studies: run, plan, compile."""

import dataclasses
import sys
import time
from pathlib import Path

from miricigale.cli.options import RESUMES, chosen


def add_run(commands):
    """Declare ``run``."""
    run = commands.add_parser("run", help="run a study: a preset (goodss) or a TOML file")
    run.add_argument("config", help="preset name or path of a TOML file")
    run.add_argument("--quick", action="store_true", help="fewer groups, dithers and sources")
    run.add_argument("-o", "--output", type=Path, help="folder (default: the name of the run)")
    run.add_argument("--keep-level1b", action="store_true", help="keep the level-1b files")
    run.add_argument("--threads", type=int, help="threads (default: all cores)")
    run.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work on the workers of this dask scheduler, such as tcp://host:8786, on a shared folder",
    )
    run.add_argument("--seed", type=int, help="seed of every random draw")
    run.add_argument(
        "--redo",
        action="store_true",
        help="do again what another configuration or seed made in the folder",
    )
    run.add_argument(
        "--set",
        action="append",
        default=[],
        dest="settings",
        metavar="SECTION.KEY=VALUE",
        help="another value of a key of the configuration, as in TOML; may be given several times",
    )
    what = "do this stage (or units, such as 'fits:agn20/*') and what it needs only"
    run.add_argument("--until", metavar="STAGE", help=what)
    run.add_argument("--from", dest="again", metavar="STAGE", help="do this stage or units again")
    run.add_argument("--print-config", action="store_true", help="print the configuration and stop")
    run.add_argument("--no-progress", action="store_true", help="no progress bars")
    run.set_defaults(call=_run, stopped=lambda _: RESUMES)


def _run(args):
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import process_pool, thread_count
    from miricigale.workflow import load_config, run_study
    from miricigale.workflow.engine.cluster import cluster_executor
    from miricigale.workflow.options import read_setting

    options = chosen(args, "threads seed") | {"keep_level1b": args.keep_level1b or None}
    given = {"run": {name: value for name, value in options.items() if value is not None}}
    for section, key, value in map(read_setting, args.settings):
        given.setdefault(section, {})[key] = value
    config = load_config(args.config, quick=args.quick, overrides=given)
    if args.print_config:
        print(config.to_toml(), end="")
        return 0
    folder = args.output or Path(config.run.name)
    begin = time.monotonic()
    options = chosen(args, "redo until again") | {"progress_bar": not args.no_progress}
    try:
        if args.scheduler is None:
            with process_pool(thread_count(config.run.threads or None)) as executor:
                report = run_study(config, folder, executor=executor, **options)
        else:
            with cluster_executor(args.scheduler) as (executor, n_threads, memory):
                limits = dataclasses.replace(
                    config.run,
                    threads=config.run.threads or n_threads,
                    memory=config.run.memory or 0.5 * memory,
                )
                config = dataclasses.replace(config, run=limits)
                report = run_study(config, folder, executor=executor, **options)
    except OtherResultsError as err:
        # name the option of this command instead of the argument
        raise OtherResultsError(err.reason, "--redo to replace it") from err
    made = f"report: {report}" if args.until is None else f"products: {folder}"
    print(f"done in {(time.monotonic() - begin) / 60:.1f} min; {made}")
    return 0


def add_plan(commands):
    """Declare ``plan``."""
    plan = commands.add_parser(
        "plan",
        help="what MIRI exposures would yield; without options, the CEERS exposures",
        description="Without options: saturation and depth of the CEERS exposures. With any of them "
        "but --quick: accuracy of redshift and AGN fraction, AGN selection and times, as a page.",
    )
    add = plan.add_argument
    add("--quick", action="store_true", help="the table of the quick exposures")
    add("--config", metavar="TOML", help="configuration; options replace its keys")
    add("--bands", nargs="+", metavar="BAND", help="MIRI bands, such as f770w f1500w")
    add("--time", nargs="+", type=float, metavar="S", help="time of each, all dithers; one for all")
    add(
        "--depth",
        nargs="+",
        type=float,
        metavar="AB",
        help="5-sigma depth of each in place of times",
    )
    add("--dithers", nargs="+", type=int, metavar="N", help="dithers of each (4); one for all")
    add("--readout", metavar="PATTERN", help="readout pattern (FASTR1)")
    add(
        "--sets",
        nargs="+",
        metavar="BAND,BAND",
        help="sets of the bands to compare; all: every band",
    )
    add("--areas", nargs="+", type=int, metavar="N", help="pointings that share the times")
    add("--pointings", type=int, metavar="N", help="pointings side by side, each with the times")
    add(
        "--background",
        nargs="+",
        metavar="LEVEL",
        help="zodiacal light (low, medium, high) or surface brightness ('12.5 MJy/sr'); one for all",
    )
    add(
        "--position", nargs=2, type=float, metavar=("RA", "DEC"), help="degrees, for the background"
    )
    add("--date", metavar="DAY", help="such as 2027-03-01, for the background (needs zodipy)")
    add("--sources", type=int, metavar="N", help="sources of the sample")
    add(
        "--images",
        action="store_true",
        default=None,
        help="image the exposures too, as a run does, and compare",
    )
    add("--rank", metavar="WHAT", help="ranked for each hour: agn, frac_agn or redshift")
    add("-o", "--output", type=Path, help="folder (default: the name of the plan)")
    add("--seed", type=int, help="seed of every random draw")
    add("--threads", type=int, help="threads (default: all cores)")
    add("--print-config", action="store_true", help="print the configuration and stop")
    plan.set_defaults(call=_plan)


#: Sections and keys of a plan by the options of the command that replace them.
_PLAN_KEYS = {
    "time": "exposures.time",
    "depth": "exposures.depth",
    "dithers": "exposures.dithers",
    "readout": "exposures.readout",
    "sets": "exposures.sets",
    "pointings": "exposures.pointings",
    "areas": "survey.areas",
    "rank": "survey.rank",
    "background": "background.level",
    "date": "background.date",
    "sources": "sample.n_sources",
    "images": "images.enabled",
    "seed": "plan.seed",
    "threads": "plan.threads",
}


def _plan(args):
    given = {name for name in _PLAN_KEYS if getattr(args, name) is not None}
    options = ("config", "bands", "position", "output")
    given |= {name for name in options if getattr(args, name) is not None}
    if not given and not args.print_config:
        from miricigale.planning import plan_table

        plan_table(quick=args.quick).pprint_all()
        return 0
    if args.quick:
        msg = "--quick is of the table of the CEERS exposures, which has no other option"
        raise ValueError(msg)
    if args.time is not None and args.depth is not None:
        msg = "wanted are --time or --depth, not both"
        raise ValueError(msg)
    from miricigale.planning import load_plan, write_plan
    from miricigale.utils.parallel import thread_count, thread_pool

    config = load_plan(args.config, overrides=_plan_overrides(args))
    if args.print_config:
        print(config.to_toml(), end="")
        return 0
    folder = args.output or Path(config.plan.name)
    begin = time.monotonic()
    with thread_pool(thread_count(config.plan.threads or None)) as executor:
        comparison = write_plan(config, folder, executor=executor, progress_bar=True)
    wanted = ["plan", "time", "z_scatter", "z_outliers", "frac_scatter", "completeness", "purity"]
    table = comparison[[*wanted, "n_agn", "merit"]]
    for name in table.colnames[1:]:
        table[name].info.format = ".3g"
    table.pprint_all()
    print(f"done in {time.monotonic() - begin:.0f} s; page: {folder / 'plan.html'}")
    return 0


def _plan_overrides(args):
    """Sections and keys that the options of the command replace."""
    values = {}
    for name, key in _PLAN_KEYS.items():
        value = getattr(args, name)
        if value is not None:
            section, _, key = key.partition(".")
            values.setdefault(section, {})[key] = value
    if args.time is not None and args.depth is None:
        # depths of the file would count in place of times
        values["exposures"]["depth"] = []
    if args.bands is not None:
        exposures = values.setdefault("exposures", {})
        exposures["bands"] = [f"miri.{name.removeprefix('miri.')}" for name in args.bands]
        exposures.setdefault("dithers", [4])
    if args.position is not None:
        ra, dec = args.position
        values.setdefault("background", {}).update(ra=ra, dec=dec)
    return values


def add_compile(commands):
    """Declare ``compile``."""
    what = "compile all kernels now, once for each installation"
    compilation = commands.add_parser("compile", help=what)
    compilation.set_defaults(call=_compile, stopped=lambda _: RESUMES)


def _compile(args):
    from miricigale.utils.parallel import thread_count, thread_pool
    from miricigale.workflow.warmup import JOBS, compile_apart, describe_job, is_compiled

    names = [name for name in JOBS if not is_compiled(name)]
    with thread_pool(thread_count()) as executor:
        jobs = [executor.submit(compile_apart, name) for name in names]
        for name in names:
            print(describe_job(name), flush=True)
        kept = [job.result() for job in jobs]
    if not all(kept):
        print("miricigale: compiled code cannot be kept; set NUMBA_CACHE_DIR", file=sys.stderr)
        return 1
    print("all kernels are compiled")
    return 0
