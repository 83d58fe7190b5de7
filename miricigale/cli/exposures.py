"""The command that reduces exposures."""

from miricigale.cli.options import chosen, filled

_FILES = "mask saturation bias reset linearity dark gain read_noise flat photom"


def reduce(args):
    """Reduce exposures."""
    from miricigale.reduction.commands.from_files import reduce_files
    from miricigale.utils.options import check_data

    for path in args.files:
        check_data(path.is_file(), "no file", path)
    table = reduce_files(
        args.files,
        args.output,
        reducer=reducer_of(args),
        integrations=args.rateints,
        **filled(args, reduce_files),
        progress_bar=not args.no_progress,
    )
    failed = table[table["status"] == "failed"]
    for row in failed:
        print(f"{row['file']}: {row['reason']}")
    print(
        f"{len(table) - len(failed)} of {len(table)} products; page: {args.output / 'index.html'}"
    )
    if len(failed):
        return 1
    return 0


def reducer_of(args):
    """Return the `~miricigale.reduction.Reducer` of the options."""
    from miricigale.reduction import (
        BackgroundSettings,
        MosaicSettings,
        RampSettings,
        Reducer,
    )

    # options go where they are parameters; the others are put in place here
    settings = filled(args, Reducer)
    settings["background"] = BackgroundSettings(args.background, **filled(args, BackgroundSettings))
    settings["ramps"] = RampSettings(**filled(args, RampSettings))
    settings["mosaics"] = MosaicSettings(**filled(args, MosaicSettings))
    settings["references"] = _references(args)
    settings["n_threads"] = args.threads
    settings["jump_threshold"] = args.jump_threshold or None
    return Reducer(**settings)


def _references(args):
    """Return references of the options: files, a cache of CRDS, or what ``--references`` names."""
    from miricigale.reduction import ReferenceCache, ReferenceFiles

    files = {}
    for name, value in chosen(args, _FILES).items():
        if value is not None:
            files[name] = _number(value)
    n_ways = bool(files) + (args.crds is not None) + (args.references is not None)
    if n_ways > 1 or (args.context and args.crds is None):
        msg = "wanted are files of references, --crds (with --context) or --references, only one of these"
        raise ValueError(msg)
    if args.crds is not None:
        return ReferenceCache(args.crds, args.context, incomplete=args.incomplete)
    if files:
        return ReferenceFiles(**files, incomplete=args.incomplete)
    return args.references


def _number(text):
    """Return a text as a number where it is one."""
    try:
        return float(text)
    except ValueError:
        return text
