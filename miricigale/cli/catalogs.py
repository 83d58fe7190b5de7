"""Commands that make catalogs: fit, photometry, errors."""

import contextlib
import sys

from miricigale.cli.options import chosen, read_input, workers
from miricigale.utils.exceptions import argument_error

#: Options of an image, as `~miricigale.photometry.MosaicFile` has them.
_OF_IMAGE = (
    "error", "variance", "inverse_variance", "weight", "filter", "unit", "zero_point", "background_box", "psf",
    "psf_scale", "psf_angle", "pa_aper",
)  # fmt: skip


def fit(args):
    """Fit a catalog."""
    from miricigale.fitting.catalogs.classes import fit_classes, write_table
    from miricigale.utils.exceptions import OtherResultsError

    hdu = args.hdu
    if hdu is not None and hdu.isdigit():
        hdu = int(hdu)
    if str(args.photometry) == "-":
        args.photometry = read_input(args.output)
    options = chosen(args, "classes quasars red_dots stars axes redshift model_error outliers")
    options |= chosen(args, "calibrate interpolate agn_error pairs nuclei nuclear_stars")
    options |= chosen(args, "flux_unit catalog_map ebv chunk_rows resume")
    if args.calibration is not None:
        options["calibration"] = args.calibration
    try:
        with _workers(args) as executor:
            results = fit_classes(
                args.photometry,
                args.output,
                **options,
                hdu=hdu,
                executor=executor,
                progress_bar=not args.no_progress,
            )
        # kernels are loaded after the files were checked
        from miricigale.fitting.catalogs.page import fit_page

        is_parquet = args.photometry.suffix.lower() == ".parquet"
        table = args.output / ("table.parquet" if is_parquet else "table.fits")
        write_table(results, table, overwrite=True)
        page = fit_page(results, args.photometry, **chosen(args, "catalog_map z_spec"), hdu=hdu)
        page = page.write(args.output / "page.html", overwrite=True)
        if args.plots:
            from miricigale.fitting.results.object_plots import write_plots

            if args.plots == ["all"]:
                ids = None
            else:
                ids = args.plots
            options = {"overwrite": True, "progress_bar": not args.no_progress}
            write_plots(results["galaxy"], args.output / "plots", ids, **options)
    except KeyboardInterrupt:
        n_parts = len(list(args.output.glob("part-*.fits")))
        if args.resume:
            command = "the same command"
        else:
            command = "the same command, without --no-resume,"
        args.stopped = (
            f"stopped; {n_parts} finished parts are in {args.output}/; {command} resumes here"
        )
        raise
    except OtherResultsError as err:
        # name the option of this command instead of the argument
        raise OtherResultsError(err.reason, "--no-resume to replace them") from err
    print(f"{_outcome(results['galaxy'])}; table: {table}; page: {page}")
    print(
        "mass: all stars formed; stellar_mass: living stars, as other codes quote it (0.2 to 0.3 dex less)"
    )
    return 0


def _outcome(results):
    """Say how many objects were fitted, and why others were not."""
    from collections import Counter

    from miricigale.fitting import FitFlags

    flags = results.to_table(["flags"])["flags"]
    unfitted = []
    for value in flags.tolist():
        if value & int(FitFlags.UNFITTED):
            unfitted.append(value & int(FitFlags.UNFITTED))
    n = len(flags)
    text = f"{n} object{'s' * (n != 1)}, {n - len(unfitted)} fitted"
    if not unfitted:
        return text
    counts = Counter(name for value in unfitted for name in FitFlags.names(value))
    reasons = [f"{name.replace('_', ' ')} {count}" for name, count in counts.most_common()]
    return f"{text} (not: {', '.join(reasons)})"


@contextlib.contextmanager
def _workers(args):
    """Return an executor of the threads of this machine, or of the workers of a scheduler."""
    from miricigale.utils.parallel import threads

    if args.scheduler is None:
        with threads(args.threads or None) as executor:
            yield executor
    else:
        from miricigale.workflow.engine.cluster import cluster_executor

        with cluster_executor(args.scheduler) as cluster:
            yield cluster._client.get_executor(pure=False)


def images_of(args, paths, prefix=""):
    """Return images with their options, each given as often as there are images, in their order; - for none."""
    from miricigale.photometry import MosaicFile

    options = [{} for _ in paths]
    for name in _OF_IMAGE:
        values = getattr(args, prefix + name)
        if not values:
            continue
        if len(values) != len(paths):
            wanted = f"given for each of {len(paths)} images, in their order (- for none)"
            raise argument_error(f"--{prefix}{name}".replace("_", "-"), wanted, len(values))
        for entries, value in zip(options, values, strict=True):
            if value != "-":
                entries[name] = value
    return [MosaicFile(path, **entries) for path, entries in zip(paths, options, strict=True)]


def photometry(args):
    """Measure images."""
    from miricigale.photometry.commands.from_files import measure_files

    paths, prior = _image_paths(args)
    images = images_of(args, paths)
    (highres,) = images_of(args, [prior], "highres_")
    options = chosen(args, "detection segmentation catalog confidence")
    options |= chosen(args, "max_shift background_order offset_order second_pass")
    options |= chosen(args, "components psf_stars overwrite seed")
    options["kernel"] = args.kernel
    if args.kernel:
        options["kernel"] = [None if name == "-" else name for name in args.kernel]
    if str(args.output) == "-":
        options["output"] = None
    else:
        options["output"] = args.output
    options["n_threads"] = args.threads
    options["progress_bar"] = not args.no_progress
    if args.patches is None:
        _refuse(args, ("patch_size", "overlap", "scheduler", "redo"), "left out without --patches")
        page = args.page
        if page is None and options["output"] is not None:
            page = args.output.with_suffix(".html")
        options |= chosen(args, "model residual")
        table = measure_files(images, highres, page=page, **options)
    else:
        _refuse(args, ("page", "model", "residual"), "left out with --patches")
        page = args.patches / "index.html"
        table = _in_patches(args, images, highres, options)
    if options["output"] is None:
        table.write(sys.stdout, format="ascii.ecsv")
    else:
        print(f"{len(table)} sources in {args.output}; page: {page}")
    return 0


def _image_paths(args):
    """Return the paths of the images and that of the prior, of options or of positional arguments."""
    if args.positional and not (args.image or args.highres):
        *paths, prior = args.positional
        if paths:
            return paths, prior
    elif args.image and args.highres and not args.positional and len(args.highres) == 1:
        return args.image, args.highres[0]
    msg = "wanted are --image and --highres, or the images and last the prior without options"
    raise ValueError(msg)


def _refuse(args, names, wanted):
    """Refuse options that mean nothing with others."""
    for name in names:
        value = getattr(args, name)
        if value is not None and value is not False:
            raise argument_error("--" + name.replace("_", "-"), wanted, value)


def _in_patches(args, images, prior, options):
    """Measure images in patches, on the processors of this machine or of others."""
    from miricigale.workflow import measure_patches

    for name, value in chosen(args, "patch_size overlap redo").items():
        if value is not None:
            options[name] = value
    args.stopped = f"stopped; the same command resumes what is in {args.patches}/"
    with workers(args.scheduler, args.threads) as executor:
        return measure_patches(images, prior, args.patches, executor=executor, **options)


def errors(args):
    """Measure the errors of an image."""
    import astropy.units as u

    from miricigale.photometry import MosaicFile, image_errors
    from miricigale.photometry.commands.kernel_files import image_psf
    from miricigale.photometry.commands.page import write_errors_page
    from miricigale.utils.outputs import check_output
    from miricigale.utils.table_files import write_table

    image_path, table_path, page_path = (
        args.output.with_suffix(suffix) for suffix in (".fits", ".ecsv", ".html")
    )
    for path in (image_path, table_path, page_path):
        check_output(path, "output", overwrite=args.overwrite, inputs=[args.image])
    file = MosaicFile(args.image, **{name: getattr(args, name) for name in _OF_IMAGE})
    psf = image_psf(file)
    options = {}
    if args.apertures:
        options["diameters"] = u.Quantity(args.apertures)
    result = image_errors(file.read(), psf=psf, n_sigma=args.sigma, seed=args.seed, **options)
    result.write(image_path, overwrite=args.overwrite)
    write_table(result.table, table_path, overwrite=args.overwrite)
    write_errors_page(page_path, result, overwrite=args.overwrite)
    print(f"limits in {image_path} and {table_path}; page: {page_path}")
    return 0
