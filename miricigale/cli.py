"""The command line: a thin layer over the workflow and the classes."""

import argparse
import dataclasses
import logging
import os
import shutil
import sys
import textwrap
import threading
import time
from pathlib import Path

__all__ = ["command", "main"]


def _parser():
    parser = argparse.ArgumentParser(
        prog="miricigale", description="Plan and analyze JWST/MIRI deep imaging."
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    parser.add_argument("-v", "--verbose", action="store_true", help="say what is done")
    parser.set_defaults(stopped=lambda _: "miricigale: stopped")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")

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
    run.set_defaults(call=_run, stopped=lambda _: _GOES_ON)

    fit = commands.add_parser("fit", help="fit redshift and AGN fraction of a photometry table")
    fit.add_argument(
        "photometry",
        type=Path,
        metavar="CATALOG",
        help="FITS or ECSV with id, <filter> and <filter>_err; CSV with --flux-unit",
    )
    fit.add_argument(
        "-o", "--output", type=Path, default=Path("fits"), help="folder of the results"
    )
    fit.add_argument("--axes", choices=("fit", "quick"), default="fit", help="model grid")
    fit.add_argument("--redshift", metavar="COLUMN", help="column of known redshifts")
    fit.add_argument(
        "--model-error",
        type=float,
        default=0.1,
        help="model error as a part of the flux (0.1 is 10 %%)",
    )
    fit.add_argument(
        "--pairs",
        nargs="+",
        action="extend",
        type=_pair,
        metavar="NAME:NAME",
        help="parameters whose joint posteriors are kept too, such as age:tau redshift:ebv",
    )
    fit.add_argument("--flux-unit", metavar="UNIT", help="unit of fluxes that have none (CSV)")
    fit.add_argument("--hdu", help="extension of a FITS file, if it has several tables")
    fit.add_argument("--chunk-rows", type=int, default=10000, help="rows in memory at a time")
    fit.add_argument(
        "--resume",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="go on with what is in the folder, or replace it",
    )
    fit.add_argument("--threads", type=int, default=1, help="threads (0 for all cores)")
    fit.add_argument("--no-progress", action="store_true", help="no progress bar")
    fit.set_defaults(call=_fit, stopped=_fit_stopped)

    _photometry_parser(commands)

    _plan_parser(commands)

    filters = commands.add_parser("filters", help="list the filters")
    filters.add_argument("pattern", nargs="?", default="", help="part of the name")
    filters.set_defaults(call=_filters)

    what = "compile all kernels now, once for each installation"
    compilation = commands.add_parser("compile", help=what)
    compilation.set_defaults(call=_compile, stopped=lambda _: _GOES_ON)

    data = commands.add_parser("data", help="reference data: list, check or add")
    actions = data.add_subparsers(dest="action", metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="what there is, where, its license, what to cite")
    listing.add_argument("pattern", nargs="?", default="", help="part of the name")
    listing.set_defaults(call=_data_list)
    check = actions.add_parser("check", help="whether each file is there and whole")
    check.set_defaults(call=_data_check)
    add = actions.add_parser("add", help="bring a file into the data folder; convert a library")
    add.add_argument("name", help="resource name, as 'miricigale data list' has it")
    add.add_argument("path", type=Path, help="file, folder or archive as distributed")
    add.set_defaults(call=_data_add, stopped=lambda _: "stopped; nothing was changed")
    return parser


def _plan_parser(commands):
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
    add("--background", metavar="LEVEL", help="zodiacal light: low, medium or high")
    add(
        "--position", nargs=2, type=float, metavar=("RA", "DEC"), help="degrees, for the background"
    )
    add("--date", metavar="DAY", help="such as 2027-03-01, for the background (needs zodipy)")
    add("--sources", type=int, metavar="N", help="sources of the sample")
    add("--rank", metavar="WHAT", help="ranked for each hour: agn, frac_agn or redshift")
    add("-o", "--output", type=Path, help="folder (default: the name of the plan)")
    add("--seed", type=int, help="seed of every random draw")
    add("--threads", type=int, help="threads (default: all cores)")
    add("--print-config", action="store_true", help="print the configuration and stop")
    plan.set_defaults(call=_plan)


def _photometry_parser(commands):
    phot = commands.add_parser("photometry", help="forced photometry on a high-resolution prior")
    add = phot.add_argument
    add("positional", nargs="*", metavar="IMAGE HIGHRES", help="the two images, without options")
    add("--image", metavar="FITS", help="image to be measured; FILE[EXTENSION] names an extension")
    add("--highres", metavar="FITS", help="high-resolution image: the prior")
    add("--filter", help="filter of the image, such as miri.f770w, if its header does not tell")
    add("--highres-filter", metavar="FILTER", help="filter of the prior, likewise")
    add("--segmentation", metavar="FITS", help="segmentation map of the prior (else: detection)")
    add("--catalog", metavar="TABLE", help="FITS, ECSV, CSV or plain table with id, ra, dec")
    add("--kernel", metavar="FITS", help="kernel from prior to image; FILE[EXT,PLANE] of a cube")
    add("--psf", metavar="FITS", help="PSF of the image; FILE[EXT,PLANE] or FILE[EXT,mean]")
    add("--highres-psf", metavar="FITS", help="PSF of the prior, likewise")
    for prefix, what in (("", "image"), ("highres-", "prior")):
        add(
            f"--{prefix}psf-scale",
            type=_in("arcsec"),
            metavar="ARCSEC",
            help=f"pixel of the PSF of the {what} (else: its header's, or the {what}'s)",
        )
        add(
            f"--{prefix}psf-angle",
            type=_in("deg"),
            metavar="DEG",
            help=f"position angle of the PSF's y axis (else: its header's, or the {what}'s)",
        )
        add(
            f"--{prefix}pa-aper",
            type=_in("deg"),
            metavar="DEG",
            help=f"position angle of the detector's y axis ({what}), if the header does not tell",
        )
        noise = phot.add_mutually_exclusive_group()
        for kind in _NOISE:
            noise.add_argument(
                f"--{prefix}{kind}", metavar="FITS", help=f"{kind.replace('-', ' ')} map ({what})"
            )
        add(f"--{prefix}unit", help=f"unit of the {what}, such as '10 nJy' (else: BUNIT)")
        add(f"--{prefix}zero-point", type=float, metavar="AB", help=f"of one count of the {what}")
        add(
            f"--{prefix}background-box",
            type=int,
            metavar="PIXELS",
            help=f"subtract a background measured in such boxes of the {what}",
        )
    what = "fit no constant with the sources"
    add("--no-background", dest="fit_background", action="store_false", help=what)
    add(
        "--max-shift",
        type=_in("arcsec"),
        metavar="ARCSEC",
        help="fit a shift of the image up to this",
    )
    add("--background-order", type=int, default=0, help="order of the background, 0 for a constant")
    add("--offset-order", type=int, help="order of a map of offsets in place of one shift")
    what = "fit what the prior lacks too; last rows of the table"
    add("--second-pass", action="store_true", help=what)
    add("--components", type=int, default=1, help="2: poor fits get a point on top of the template")
    add("-o", "--output", type=Path, default=Path("photometry.ecsv"), help="table, ECSV or FITS")
    add("--page", type=Path, help="HTML page (default: beside the table)")
    add("--model", type=Path, metavar="FITS", help="image of the fitted model")
    add("--residual", type=Path, metavar="FITS", help="image less model, with errors and mask")
    add("--overwrite", action="store_true", help="replace files that are there")
    add("--threads", type=int, help="threads (default: all cores)")
    add("--seed", type=int, default=1, help="seed of the empty positions of the page")
    add("--no-progress", action="store_true", help="no progress bar")
    phot.set_defaults(call=_photometry)


_NOISE = ("error", "variance", "inverse-variance", "weight")


_GOES_ON = "stopped; the same command goes on from here"


def _in(unit):
    """Type of an option that is a number in a unit."""

    def number(text):
        import astropy.units as u

        return float(text) * u.Unit(unit)

    return number


def _chosen(args, names):
    """Options by the names of the arguments that they become."""
    return {name: getattr(args, name) for name in names.split()}


def _pair(text):
    """Two names with a colon between them."""
    names = tuple(text.split(":"))
    if len(names) != 2 or not all(names):
        msg = f"{text!r} is no pair NAME:NAME"
        raise argparse.ArgumentTypeError(msg)
    return names


def _run(args):
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import process_pool, thread_count
    from miricigale.workflow import load_config, run_study
    from miricigale.workflow.cluster import cluster_executor
    from miricigale.workflow.options import read_setting

    options = _chosen(args, "threads seed") | {"keep_level1b": args.keep_level1b or None}
    given = {"run": {name: value for name, value in options.items() if value is not None}}
    for section, key, value in map(read_setting, args.settings):
        given.setdefault(section, {})[key] = value
    config = load_config(args.config, quick=args.quick, overrides=given)
    if args.print_config:
        print(config.to_toml(), end="")
        return 0
    folder = args.output or Path(config.run.name)
    begin = time.monotonic()
    options = _chosen(args, "redo until again") | {"progress_bar": not args.no_progress}
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


def _fit(args):
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import thread_count, thread_pool
    from miricigale.workflow.commands import fit_catalog

    n_threads = thread_count(args.threads or None)
    try:
        with thread_pool(n_threads) as executor:
            results = fit_catalog(
                args.photometry,
                args.output,
                **_chosen(args, "axes redshift model_error pairs flux_unit chunk_rows resume"),
                hdu=int(args.hdu) if (args.hdu or "").isdigit() else args.hdu,
                executor=executor if n_threads > 1 else None,
                progress_bar=not args.no_progress,
            )
        table = args.output / "table.fits"
        results.write_table(table, overwrite=True)
    except OtherResultsError as err:
        # name the option of this command instead of the argument
        raise OtherResultsError(err.reason, "--no-resume to replace them") from err
    print(f"{results!r}; all in {table}")
    return 0


def _fit_stopped(args):
    n_parts = len(list(args.output.glob("part-*.fits")))
    how = "the same command, without --no-resume," if not args.resume else "the same command"
    return f"stopped; {n_parts} finished parts are in {args.output}/; {how} goes on from here"


def _photometry(args):
    from miricigale.photometry import MosaicFile
    from miricigale.workflow.photometry import measure_files

    paths = [path for path in (args.image, args.highres) if path is not None] + args.positional
    if len(paths) != 2 or (args.positional and len(args.positional) != 2):
        msg = "wanted are --image and --highres, or the two files without options"
        raise ValueError(msg)
    known = [*(kind.replace("-", "_") for kind in _NOISE), "filter", "unit", "zero_point"]
    images = [
        MosaicFile(path, **{n: getattr(args, prefix + n) for n in (*known, "background_box")})
        for path, prefix in zip(paths, ("", "highres_"), strict=True)
    ]
    psfs = "psf psf_scale psf_angle pa_aper"
    page = args.page or args.output.with_suffix(".html")
    table = measure_files(
        *images,
        **_chosen(args, f"segmentation catalog kernel {psfs}"),
        **{f"highres_{name}": getattr(args, f"highres_{name}") for name in psfs.split()},
        **_chosen(args, "fit_background max_shift background_order offset_order second_pass"),
        **_chosen(args, "components output model residual overwrite seed"),
        page=page,
        n_threads=args.threads,
        progress_bar=not args.no_progress,
    )
    print(f"{len(table)} sources in {args.output}; page: {page}")
    return 0


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
    "seed": "plan.seed",
    "threads": "plan.threads",
}


def _plan(args):
    given = {name for name in _PLAN_KEYS if getattr(args, name) is not None}
    options = ("config", "bands", "position", "output")
    given |= {name for name in options if getattr(args, name) is not None}
    if not given and not args.print_config:
        from miricigale.workflow.commands import plan_table

        plan_table(quick=args.quick).pprint_all()
        return 0
    if args.quick:
        msg = "--quick is of the table of the CEERS exposures, which has no other option"
        raise ValueError(msg)
    if args.time is not None and args.depth is not None:
        msg = "wanted are --time or --depth, not both"
        raise ValueError(msg)
    from miricigale.utils.parallel import thread_count, thread_pool
    from miricigale.workflow.commands import write_plan
    from miricigale.workflow.planning import load_plan

    config = load_plan(args.config, overrides=_plan_overrides(args))
    if args.print_config:
        print(config.to_toml(), end="")
        return 0
    folder = args.output or Path(config.plan.name)
    begin = time.monotonic()
    with thread_pool(thread_count(config.plan.threads or None)) as executor:
        comparison = write_plan(config, folder, executor=executor)
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


def _filters(args):
    from miricigale.workflow.commands import filter_table

    table = filter_table(args.pattern)
    if len(table) == 0:
        print(f"no filter has {args.pattern!r} in its name", file=sys.stderr)
        return 1
    table.pprint_all()
    return 0


def _data_list(args):
    from miricigale.refdata import find_resource, resources

    records = {name: record for name, record in resources().items() if args.pattern in name}
    if not records:
        print(f"no resource has {args.pattern!r} in its name", file=sys.stderr)
        return 1
    width = min(shutil.get_terminal_size((100, 24)).columns, 120)
    for name, record in records.items():
        path = find_resource(name) if record.file else None
        if path is not None:
            state = str(path)
        elif not record.file:
            state = f"read from {record.source}"
        else:
            state = f"absent; miricigale data add {name} PATH"
        print(f"{name} ({record.kind}): {state}")
        lines = [record.title, f"license: {record.licence}", f"cite: {record.citation}"]
        if record.file and path is None:
            lines.append(f"source: {record.source}")
        for line in lines:
            # do not break URLs
            wrapped = textwrap.wrap(line, width - 4, break_long_words=False, break_on_hyphens=False)
            print(textwrap.indent("\n  ".join(wrapped), "    "))
    return 0


def _data_check(args):
    from miricigale.refdata import check_resources

    rows = check_resources()
    length = max(len(row.name) for row in rows)
    for row in rows:
        print(f"{row.name:{length}s}  {row.state:14s}  {row.where}")
        if row.message:
            print(f"{'':{length}s}  {row.message}")
    bad = [row.name for row in rows if row.bad]
    if bad:
        print(f"miricigale: not as they should be: {', '.join(bad)}", file=sys.stderr)
    return int(bool(bad))


def _data_add(args):
    from miricigale.refdata import add_resource
    from miricigale.refdata.libraries import READERS, add_library

    if args.name in READERS:
        print(add_library(args.name, args.path, progress_bar=sys.stderr.isatty()))
    else:
        print(add_resource(args.name, args.path))
    return 0


def main(argv=None):
    """
    Entry point of the ``miricigale`` command.

    Parameters
    ----------
    argv : list of str, optional
        Arguments; those of the process if not given.

    Returns
    -------
    status : int
        0 if all went well, 2 for input that cannot be used, 130 if interrupted.
    """
    parser = _parser()
    args = parser.parse_args(argv)
    handler = logging.StreamHandler()
    # astropy has a handler of its own
    handler.addFilter(lambda record: not record.name.startswith("astropy"))
    logging.basicConfig(
        level=logging.INFO if args.verbose else logging.WARNING,
        format="%(message)s",
        handlers=[handler],
    )
    # messages about compilation are shown at any verbosity
    logging.getLogger("miricigale.utils.compilation").setLevel(logging.INFO)
    if args.version:
        from miricigale import __version__

        print(__version__)
        return 0
    if args.command is None:
        parser.print_help()
        return 2
    try:
        return args.call(args)
    except KeyboardInterrupt:
        print(args.stopped(args), file=sys.stderr)
        return 130
    except Exception as err:
        from astropy.units import UnitsError

        # one clear sentence for input that cannot be used; the traceback is for --verbose
        expected = (ValueError, KeyError, OSError, ImportError, UnitsError)
        if args.verbose or not isinstance(err, expected):
            raise
        message = err.args[0] if isinstance(err, KeyError) and err.args else err
        # the message of a KeyError may be the key alone
        bare = isinstance(err, KeyError) and " " not in str(message)
        kind = f"{type(err).__name__} " if bare else ""
        where = "".join(f" ({note})" for note in getattr(err, "__notes__", ()))
        print(f"miricigale: {kind}{' '.join(str(message).split())}{where}", file=sys.stderr)
        return 2


def command():
    """Run `main` as the whole of a process; see there."""
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if status == 130 and not all(thread.daemon for thread in others):
        # threads in compiled code ignore interrupts, and the interpreter would wait for them
        os._exit(status)
    sys.exit(status)
