"""The command that reduces exposures."""

from miricigale.cli.options import filled


def reduce(args):
    """Reduce exposures."""
    from miricigale.reduction.commands.from_files import reduce_files
    from miricigale.utils.options import check_is_file

    for path in args.paths:
        check_is_file(path)
    table = reduce_files(**filled(args, reduce_files), reducer=reducer_of(args))
    failed = table[table["status"] == "failed"]
    for row in failed:
        print(f"{row['file']}: {row['reason']}")
    n_good = len(table) - len(failed)
    print(f"{n_good} of {len(table)} products; page: {args.folder / 'index.html'}")
    return int(bool(len(failed)))


def reducer_of(args):
    """Return the `~miricigale.reduction.Reducer` of the options."""
    from miricigale.reduction import (
        BackgroundSettings,
        MosaicSettings,
        RampSettings,
        Reducer,
    )

    settings = filled(args, Reducer)
    settings["background"] = BackgroundSettings(**filled(args, BackgroundSettings))
    settings["ramps"] = RampSettings(**filled(args, RampSettings))
    settings["mosaics"] = MosaicSettings(**filled(args, MosaicSettings))
    settings["references"] = _references(args)
    if args.jump_threshold == 0:
        settings["jump_threshold"] = None
    return Reducer(**settings)


def _references(args):
    """Return references of the options: files, a cache of CRDS, or what ``--references`` names."""
    from miricigale.reduction import ReferenceCache, ReferenceFiles

    files = filled(args, ReferenceFiles)
    incomplete = files.pop("incomplete")
    n_ways = bool(files) + (args.crds is not None) + (args.references is not None)
    if n_ways > 1 or (args.context and args.crds is None):
        msg = "wanted are files of references, --crds (with --context) or --references, only one of these"
        raise ValueError(msg)
    if args.crds is not None:
        return ReferenceCache(args.crds, args.context, incomplete=incomplete)
    if files:
        return ReferenceFiles(**files, incomplete=incomplete)
    return args.references
