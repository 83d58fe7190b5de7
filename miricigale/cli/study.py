"""Commands of studies: run, plan, compile."""

import sys
import time
from pathlib import Path

from miricigale.cli.options import declarations, destination, filled, workers
from miricigale.utils.options import check_that


def _key_values(args, command):
    """Return values of the keys of the configuration for which options stand, where they are given."""
    values = {}
    if getattr(args, "seed", None) is not None:
        values[f"{command}.seed"] = args.seed
    if getattr(args, "n_threads", None) is not None:
        values[f"{command}.threads"] = args.n_threads
    for flags, option in declarations()[command]["options"].items():
        value = getattr(args, destination(flags, option), None)
        if "key" in option and value is not None and value is not False:
            values[option["key"]] = value
    return values


def _settings(args, values):
    """Return values by section and key, with those of ``--set``."""
    from miricigale.workflow.options import read_setting

    sections = {}
    for name, value in values.items():
        section, _, key = name.partition(".")
        sections.setdefault(section, {})[key] = value
    for section, key, value in map(read_setting, args.settings):
        sections.setdefault(section, {})[key] = value
    return sections


def run(args):
    """Run a study."""
    from miricigale.workflow import StudyRunner, load_config, run_study

    overrides = _settings(args, _key_values(args, "run"))
    config = load_config(args.config, quick=args.quick, overrides=overrides)
    if args.print_config:
        print(config.to_toml(), end="")
        return 0
    folder = args.output or Path(config.run.name)
    if args.plan:
        return _show_cost(config, folder, args.until, args.again)
    begin = time.monotonic()
    with workers(args.scheduler, config.run.threads, config.run.memory) as executor:
        options = filled(args, StudyRunner) | {"config": config, "folder": folder}
        report = run_study(**options, executor=executor)
    if args.until is None:
        products = f"report: {report}"
    else:
        products = f"products: {folder}"
    print(f"done in {(time.monotonic() - begin) / 60:.1f} min; {products}")
    return 0


def _show_cost(config, folder, until, again):
    """Print what a run takes, and do nothing."""
    from miricigale.workflow import StudyRunner, check_study, study_cost
    from miricigale.workflow.stage_list import study_stages

    check_study(config)
    # names of stages and units are checked as in a run
    runner = StudyRunner(config, folder, study_stages, until=until, again=again)
    cost = study_cost(config)
    if until is not None:
        stages = {key.partition(":")[0] for key in runner.keys}
        cost = cost[[name in stages for name in cost["stage"]]]
        print(f"stages that {until!r} needs, with all of their units:")
    cost.pprint_all()
    hours = cost["cpu"].sum().to_value("h")
    disk = cost["disk"].sum().to_value("GB")
    print(f"all: {cost['units'].sum()} units, {hours:.1f} hours of a core, {disk:.1f} GB")
    return 0


#: Columns of a comparison of plans that are printed.
_COMPARED = [
    "plan", "time", "z_scatter", "z_outliers", "frac_scatter", "completeness", "purity", "n_agn", "merit",
]  # fmt: skip


def depth(args):
    """Tabulate the depth and saturation of exposures."""
    from miricigale.planning import depth_table, load_plan, plan_table

    _take_bands(args)
    _refuse_with_depth(args, "--time", args.time)
    # a plan of these exposures alone
    args.config = None
    args.sets = None
    args.settings = []
    values = _key_values(args, "plan")
    if not values and args.bands is None and args.position is None:
        plan_table().pprint_all()
        return 0
    values = _plan_values(args, values)
    depth_table(load_plan(None, overrides=_settings(args, values))).pprint_all()
    return 0


def _take_bands(args):
    """Take bands without an option as those of ``--bands``."""
    for name in args.positional:
        wanted = f"names of filters (a time is --time {name}, a magnitude --depth {name})"
        check_that(not name[0].isdigit(), "BANDS", wanted, name)
    if args.positional:
        check_that(args.bands is None, "bands", "left out beside bands without it", args.bands)
        args.bands = args.positional


def plan(args):
    """Tabulate exposures, or compare plans."""
    _take_bands(args)
    values = _key_values(args, "plan")
    has_files = args.config is not None or args.output is not None
    has_options = args.bands is not None or args.position is not None or args.settings
    if not (values or has_files or has_options or args.print_config):
        from miricigale.planning import plan_table

        plan_table(quick=args.quick).pprint_all()
        return 0
    _check_plan_options(args)
    from miricigale.planning import Planner, load_plan, write_plan
    from miricigale.utils.outputs import check_output
    from miricigale.utils.parallel import threads

    values = _plan_values(args, values)
    config = load_plan(args.config, overrides=_settings(args, values))
    if args.print_config:
        print(config.to_toml(), end="")
        return 0
    folder = args.output or Path(config.plan.name)
    if args.config is not None:
        # never replaced, not even with --overwrite
        path = folder / "plan.toml"
        check_output(path, "output", overwrite=True, inputs=[args.config])
    # known at once, where fits take minutes
    Planner(config).exposure_table().pprint_all()
    n_fits = len(config.exposures.sets) + 1
    print(
        f"what they yield follows from {n_fits} fits of a mock survey, some minutes; table and page: {folder}",
        flush=True,
    )
    begin = time.monotonic()
    with threads(config.plan.threads or None) as executor:
        comparison = write_plan(
            config,
            folder,
            executor=executor,
            overwrite=args.overwrite,
            progress_bar=args.progress_bar,
        )
    table = comparison[_COMPARED]
    for name in table.colnames[1:]:
        table[name].info.format = ".3g"
    table.pprint_all()
    print(comparison.meta["answer"])
    print(f"done in {time.monotonic() - begin:.0f} s; page: {folder / 'plan.html'}")
    return 0


def _plan_values(args, values):
    """Return keys of a plan: those given by name, and those of the options of bands, times and position."""
    values = dict(values)
    if args.time is not None:
        # depths of the file would count in place of times
        values["exposures.depth"] = []
    bands = args.bands
    if bands is None and args.config is None:
        bands = _bands_of_sets(args.sets)
    if bands is not None:
        values |= _keys_of_bands(args, bands, values)
    if args.position is not None:
        values["background.ra"], values["background.dec"] = args.position
    return values


def _check_plan_options(args):
    """Refuse options of `plan` that contradict each other."""
    if args.quick:
        msg = (
            "--quick stands alone, for the table of the quick CEERS exposures; leave it out, or tell the "
            "depths of bands with 'miricigale depth F770W F1500W --time 3600'"
        )
        raise ValueError(msg)
    _refuse_with_depth(args, "--time", args.time)
    _refuse_with_depth(args, "--hours", args.hours)


def _refuse_with_depth(args, option, value):
    """Refuse the value of an option beside ``--depth``."""
    if value is not None and args.depth is not None:
        msg = f"wanted are {option} or --depth, not both"
        raise ValueError(msg)


def _bands_of_sets(sets):
    """List the bands that stand in sets of them; None without sets, or where one is ``all``."""
    if not sets or "all" in sets:
        return None
    return _labels(sets)


def _labels(texts):
    """List the labels that stand in texts, separated by commas."""
    labels = [label.strip() for label in ",".join(texts).split(",")]
    return list(filter(None, labels))


def _keys_of_bands(args, bands, values):
    """Return keys of the bands that were asked for: those that nothing else gives as in the CEERS exposures."""
    from miricigale.instrument.published_tables import imager_filter
    from miricigale.planning.config import ExposureSection

    # separated by spaces or commas
    names = list(dict.fromkeys(imager_filter(label) for label in _labels(bands)))
    keys = {"exposures.bands": names}
    if args.config is None and not {"exposures.time", "exposures.depth"} & set(values):
        times = ExposureSection(bands=tuple(names)).by_band("time")
        keys["exposures.time"] = times
        if "exposures.hours" not in values:
            text = ", ".join(f"{time:g} s" for time in times)
            print(f"exposed as in CEERS: {text}", file=sys.stderr)
    keys["exposures.dithers"] = values.get("exposures.dithers", [4])
    return keys


def compile_all(args):
    """Compile all kernels."""
    from miricigale.utils.parallel import thread_count
    from miricigale.workflow.warmup import compile_missing

    if not compile_missing(thread_count()):
        print("miricigale: compiled code cannot be kept; set NUMBA_CACHE_DIR", file=sys.stderr)
        return 1
    print("all kernels are compiled")
    return 0
