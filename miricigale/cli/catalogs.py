"""Commands that make catalogs: fit, photometry, errors."""

import contextlib
import inspect
import sys

import numpy as np

from miricigale.cli.options import filled, read_input, refuse, workers
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import attributes, without_none


def fit(args):
    """Fit a catalog."""
    from miricigale.fitting.catalogs.classes import fit_classes, write_table

    if str(args.path) == "-":
        args.path = read_input(args.output)
    try:
        with fit_workers(args) as executor:
            results = fit_classes(**fit_options(args), executor=executor)
        # kernels are loaded after the files were checked
        from miricigale.fitting.catalogs.page import fit_page

        is_parquet = args.path.suffix.lower() == ".parquet"
        table = args.output / ("table.parquet" if is_parquet else "table.fits")
        write_table(results, table, overwrite=True)
        page_path = args.output / "page.html"
        page = fit_page(results, **filled(args, fit_page), browser=page_path)
        page = page.write(page_path, overwrite=True)
        if args.plots is not None:
            from miricigale.fitting.results.object_plots import write_plots

            ids = None
            if args.plots and args.plots != ["all"]:
                ids = args.plots
            options = {"overwrite": True, "progress_bar": args.progress_bar}
            write_plots(results["galaxy"], args.output / "plots", ids, **options)
    except KeyboardInterrupt:
        n_parts = len(list(args.output.glob("part-*.fits")))
        command = "the same command, without --no-resume,"
        if args.resume:
            command = "the same command"
        args.stopped = (
            f"stopped; {n_parts} finished parts are in {args.output}/; {command} resumes here"
        )
        raise
    print(f"{_outcome(results['galaxy'])}; table: {table}; page: {page}")
    print(
        "mass: all stars formed; stellar_mass: living stars, as other codes quote it (0.2 to 0.3 dex less)"
    )
    return 0


def _outcome(results):
    """Say how many objects were fitted, and why others were not."""
    from collections import Counter

    from miricigale.fitting import FitFlags

    causes = results.to_table(["flags"])["flags"] & int(FitFlags.UNFITTED)
    unfitted = causes[causes != 0].tolist()
    n = len(causes)
    text = f"{n} object{'s' * (n != 1)}, {n - len(unfitted)} fitted"
    if not unfitted:
        return text
    counts = Counter(name for value in unfitted for name in FitFlags.names(value))
    reasons = [f"{count} with the flag {name.upper()}" for name, count in counts.most_common()]
    return f"{text} (not fitted: {', '.join(reasons)})"


#: Options of `~miricigale.fitting.fit_file`, whose module loads the kernels: a missing file is said without them.
_OF_FILE = ("redshift", "pairs", "flux_unit", "resume", "progress_bar")


def fit_options(args):
    """Return the options of fits of a catalog, as `~miricigale.fitting.catalogs.classes.fit_classes` has them."""
    from miricigale.fitting.catalogs.classes import fit_classes
    from miricigale.fitting.catalogs.from_files import fit_catalog

    options = filled(args, fit_classes, fit_catalog)
    for name in _OF_FILE:
        # not all are options of agn
        value = getattr(args, name, None)
        if value is not None:
            options[name] = value
    return options


@contextlib.contextmanager
def fit_workers(args):
    """Return an executor for fits of a catalog: threads of this machine, or workers of a scheduler."""
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import threads

    try:
        if args.scheduler is None:
            with threads(args.n_threads or None) as executor:
                yield executor
        else:
            from miricigale.workflow.engine.cluster import cluster_executor

            with cluster_executor(args.scheduler) as cluster:
                yield cluster._client.get_executor(pure=False)
    except OtherResultsError as err:
        # name the option of the command instead of the argument
        raise OtherResultsError(err.reason, "--no-resume to replace them") from err


def images_of(args, paths, prefix=""):
    """Return images with their options, each given as often as there are images, in their order; - for none."""
    from miricigale.photometry import MosaicFile

    options = [{} for _ in paths]
    for name in inspect.signature(MosaicFile).parameters:
        # a command may call something else 'path'
        if name == "path":
            continue
        values = getattr(args, prefix + name, None)
        if not values:
            continue
        if len(values) != len(paths):
            wanted = f"given for each of {len(paths)} images, in their order (- for none)"
            raise argument_error(prefix + name, wanted, len(values))
        for entries, value in zip(options, values, strict=True):
            if value != "-":
                entries[name] = value
    return [MosaicFile(path, **entries) for path, entries in zip(paths, options, strict=True)]


def photometer_options(args):
    """Return the options of the photometer; those of files count where none is given."""
    names = ("max_shift", "background_order", "offset_order", "second_pass", "components")
    options = without_none(attributes(args, names))
    if args.no_background:
        options["background_order"] = None
    return options


def photometry(args):
    """Measure images."""
    from miricigale.photometry import measure_files

    paths, prior = _image_paths(args)
    images = images_of(args, paths)
    highres = _prior_of(args, prior)
    if args.kernel:
        args.kernel = [None if name == "-" else name for name in args.kernel]
    to_screen = str(args.output) == "-"
    if to_screen:
        args.output = None
    if args.patches is None:
        refuse(args, ("patch_size", "overlap", "scheduler", "redo"), "left out without --patches")
        if args.page is None and not to_screen:
            args.page = args.output.with_suffix(".html")
        page = args.page
        options = filled(args, measure_files) | photometer_options(args)
        options |= {"image": images, "highres": highres}
        table = measure_files(**options)
    else:
        from miricigale.workflow import measure_patches

        refuse(args, ("page", "model", "residual"), "left out with --patches")
        page = args.patches / "index.html"
        options = filled(args, measure_files, measure_patches) | photometer_options(args)
        options |= {"image": images, "highres": highres, "folder": args.patches}
        args.stopped = f"stopped; the same command resumes what is in {args.patches}/"
        with workers(args.scheduler, args.n_threads) as executor:
            table = measure_patches(**options, executor=executor)
    if to_screen:
        table.write(sys.stdout, format="ascii.ecsv")
    else:
        text = f"{len(table)} sources in {args.output}"
        n_new = _count_new(table)
        if n_new:
            text += f", {n_new} of them found on the residual (flag NOT_IN_CATALOG)"
        print(f"{text}; page: {page}")
    return 0


def _count_new(table):
    """Count the sources of a table of photometry that the prior does not have."""
    from miricigale.photometry import ForcedFlags

    is_new = np.zeros(len(table), bool)
    for name in table.colnames:
        if name.endswith("_flags"):
            is_new |= (np.ma.filled(table[name], 0) & int(ForcedFlags.NOT_IN_CATALOG)) != 0
    return int(is_new.sum())


def _prior_of(args, path):
    """Return the prior with its options, or None where sources are points."""
    if path is not None:
        (highres,) = images_of(args, [path], "highres_")
        return highres
    names = [name for name in vars(args) if name.startswith("highres_")]
    refuse(args, names, "left out without a high-resolution image")
    refuse(args, ("patches",), "left out without a high-resolution image")
    return None


def _image_paths(args):
    """
    Return the paths of the images and that of the prior, of options or of positional arguments.

    The prior is None where a catalog is given with a single image, or with images by option.
    """
    if args.positional and args.highres and not args.image:
        # images without an option, the prior with its own
        args.image = args.positional
        args.positional = []
    if args.positional and not args.image:
        from miricigale.photometry.detection.prior_catalog import is_catalog

        *paths, prior = args.positional
        if paths and args.catalog is None and is_catalog(prior):
            # a table in the place of the prior
            args.catalog = prior
            return paths, None
        if paths:
            return paths, prior
        if args.catalog is not None:
            return [prior], None
    elif args.image and not args.positional and args.catalog is not None and not args.highres:
        return args.image, None
    elif args.image and args.highres and not args.positional and len(args.highres) == 1:
        return args.image, args.highres[0]
    msg = (
        "give the images and, last, the high-resolution image (the prior): miricigale photometry "
        "f770w.fits f444w.fits; or both by option, --image and --highres; or an image and --catalog "
        "for points at its positions"
    )
    raise ValueError(msg)


def errors(args):
    """Measure the errors of an image."""
    import astropy.units as u

    from miricigale.photometry import MosaicFile, image_errors
    from miricigale.photometry.commands.kernel_files import image_psf
    from miricigale.photometry.commands.page import write_errors_page
    from miricigale.utils.outputs import check_output
    from miricigale.utils.table_files import write_table

    image_path = args.output.with_suffix(".fits")
    table_path = args.output.with_suffix(".ecsv")
    page_path = args.output.with_suffix(".html")
    for path in (image_path, table_path, page_path):
        check_output(path, "output", overwrite=args.overwrite, inputs=[args.image])
    file = MosaicFile(args.image, **filled(args, MosaicFile))
    options = filled(args, image_errors)
    if args.diameters is not None:
        options["diameters"] = u.Quantity(args.diameters)
    options |= {"image": file.read(), "psf": image_psf(file)}
    result = image_errors(**options)
    result.write(image_path, overwrite=args.overwrite)
    write_table(result.table, table_path, overwrite=args.overwrite)
    write_errors_page(page_path, result, overwrite=args.overwrite)
    print(f"limits in {image_path} and {table_path}; page: {page_path}")
    return 0
