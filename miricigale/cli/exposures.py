"""The command that reduces exposures."""

from pathlib import Path

from miricigale.cli.options import RESUMES, quantity_in

_FILES = "mask saturation bias reset linearity dark gain read_noise flat photom"


def add_reduce(commands):
    """Declare ``reduce``."""
    reduce = commands.add_parser(
        "reduce",
        help="reduce files of exposures to a mosaic of each filter",
        description="Files of the MIRI imager at any stage (uncal, ramp, rate, rateints, cal, i2d) to "
        "calibrated images and mosaics, with a page of pictures. What the package did not simulate "
        "needs references: --crds, files, or --references none for slopes in DN/s.",
    )
    add = reduce.add_argument
    add("files", nargs="+", type=Path, metavar="FILE", help="files of exposures")
    add("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the products")
    add("--crds", type=Path, metavar="DIR", help="local CRDS cache; its files by each header")
    add("--context", metavar="PMAP", help="context of the cache, such as jwst_1364.pmap (the last)")
    add("--references", choices=("none", "simulated"), help="do without; or own constants")
    for name in _FILES.split():
        kind = "number or file" if name in ("saturation", "bias") else "file"
        kind = "file, number or 'measured'" if name in ("gain", "read_noise") else kind
        add(f"--{name.replace('_', '-')}", metavar="REF", help=f"{name.replace('_', ' ')} ({kind})")
    add("--incomplete", action="store_true", help="do without references that are missing")
    add("--backend", choices=("native", "jwst"), default="native", help="who fits the ramps")
    add("--skip-first", type=int, metavar="N", help="groups left out at the start of integrations")
    add("--skip-last", type=int, metavar="N", help="groups left out at their end")
    add(
        "--pixel-scale",
        type=quantity_in("arcsec"),
        default="0.11",
        metavar="ARCSEC",
        help="of the mosaics (0.11)",
    )
    add("--rateints", action="store_true", help="slopes of each integration too")
    add("--no-resume", dest="resume", action="store_false", help="make everything again")
    add("--threads", type=int, help="threads (default: all cores)")
    add("--no-progress", action="store_true", help="no progress bar")
    reduce.set_defaults(call=_reduce, stopped=lambda _: RESUMES)


def _reduce(args):
    from miricigale.reduction import Reducer
    from miricigale.reduction.from_files import reduce_files

    reducer = Reducer(
        backend=args.backend,
        references=_references(args),
        skip_first=args.skip_first,
        skip_last=args.skip_last,
        n_threads=args.threads,
    )
    table = reduce_files(
        args.files,
        args.output,
        reducer=reducer,
        pixel_scale=args.pixel_scale,
        integrations=args.rateints,
        resume=args.resume,
        progress_bar=not args.no_progress,
    )
    failed = table[table["status"] == "failed"]
    for row in failed:
        print(f"{row['file']}: {row['reason']}")
    print(
        f"{len(table) - len(failed)} of {len(table)} products; page: {args.output / 'index.html'}"
    )
    return 1 if len(failed) else 0


def _references(args):
    """What the options say of references."""
    from miricigale.reduction import ReferenceCache, ReferenceFiles

    given = {name: getattr(args, name) for name in _FILES.split()}
    given = {name: _number(value) for name, value in given.items() if value is not None}
    ways = [bool(given), args.crds is not None, args.references is not None]
    if sum(ways) > 1:
        msg = "wanted are files of references, --crds or --references, only one of these"
        raise ValueError(msg)
    if args.crds is not None:
        return ReferenceCache(args.crds, args.context)
    return ReferenceFiles(**given, incomplete=args.incomplete) if given else args.references


def _number(text):
    try:
        return float(text)
    except ValueError:
        return text
