"""Commands that make catalogs: fit, photometry."""

import contextlib
import sys

from miricigale.cli.options import chosen, read_input, workers
from miricigale.utils.exceptions import argument_error

#: Options of an image, as `~miricigale.photometry.MosaicFile` has them.
_KNOWN = (
    "error", "variance", "inverse_variance", "weight", "filter", "unit", "zero_point", "background_box", "psf",
    "psf_scale", "psf_angle", "pa_aper",
)  # fmt: skip


def fit(args):
    """Fit a catalog."""
    from miricigale.fitting.catalogs.classes import fit_classes, write_table
    from miricigale.utils.exceptions import OtherResultsError

    hdu = int(args.hdu) if (args.hdu or "").isdigit() else args.hdu
    if str(args.photometry) == "-":
        args.photometry = read_input(args.output)
    try:
        with _workers(args) as executor:
            found = fit_classes(
                args.photometry,
                args.output,
                **chosen(args, "classes quasars red_dots stars axes redshift model_error outliers"),
                **chosen(args, "calibrate interpolate agn_error pairs nuclei nuclear_stars"),
                **({} if args.calibration is None else {"calibration": args.calibration}),
                **chosen(args, "flux_unit catalog_map ebv chunk_rows resume"),
                hdu=hdu,
                executor=executor,
                progress_bar=not args.no_progress,
            )
        # kernels are loaded after the files were checked
        from miricigale.fitting.catalogs.page import fit_page

        kind = ".parquet" if args.photometry.suffix.lower() == ".parquet" else ".fits"
        table = args.output / f"table{kind}"
        write_table(found, table, overwrite=True)
        page = fit_page(found, args.photometry, **chosen(args, "catalog_map z_spec"), hdu=hdu)
        page = page.write(args.output / "page.html", overwrite=True)
        if args.plots:
            from miricigale.fitting.results.object_plots import write_plots

            ids = None if args.plots == ["all"] else args.plots
            options = {"overwrite": True, "progress_bar": not args.no_progress}
            write_plots(found["galaxy"], args.output / "plots", ids, **options)
    except KeyboardInterrupt:
        n_parts = len(list(args.output.glob("part-*.fits")))
        how = "the same command" + ("" if args.resume else ", without --no-resume,")
        args.stopped = (
            f"stopped; {n_parts} finished parts are in {args.output}/; {how} resumes here"
        )
        raise
    except OtherResultsError as err:
        # name the option of this command instead of the argument
        raise OtherResultsError(err.reason, "--no-resume to replace them") from err
    print(f"{_outcome(found['galaxy'])}; table: {table}; page: {page}")
    print(
        "mass: all stars formed; stellar_mass: living stars, as other codes quote it (0.2 to 0.3 dex less)"
    )
    return 0


def _outcome(results):
    """Say how many objects were fitted, and why others were not."""
    from collections import Counter

    from miricigale.fitting import FitFlags

    flags = results.to_table(["flags"])["flags"]
    unfitted = [value for value in flags.tolist() if value & int(FitFlags.UNFITTED)]
    n = len(flags)
    text = f"{n} object{'s' * (n != 1)}, {n - len(unfitted)} fitted"
    if not unfitted:
        return text
    reasons = Counter(
        name for value in unfitted for name in FitFlags.names(value & int(FitFlags.UNFITTED))
    )
    said = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in reasons.most_common())
    return f"{text} (not: {said})"


@contextlib.contextmanager
def _workers(args):
    """Executor of the threads of this machine, or of the workers of a scheduler."""
    from miricigale.utils.parallel import threads

    if args.scheduler is None:
        with threads(args.threads or None) as executor:
            yield executor
    else:
        from miricigale.workflow.engine.cluster import cluster_executor

        with cluster_executor(args.scheduler) as cluster:
            yield cluster._client.get_executor(pure=False)


def images_of(args, paths, prefix=""):
    """Images with their options, each given as often as there are images, in their order; - for none."""
    from miricigale.photometry import MosaicFile

    given = {name: getattr(args, prefix + name) or ["-"] * len(paths) for name in _KNOWN}
    for name, values in given.items():
        if len(values) != len(paths):
            wanted = f"given for each of {len(paths)} images, in their order (- for none)"
            raise argument_error(f"--{prefix}{name}".replace("_", "-"), wanted, len(values))
    options = [dict(zip(given, one, strict=True)) for one in zip(*given.values(), strict=True)]
    return [
        MosaicFile(path, **{name: one for name, one in own.items() if one != "-"})
        for path, own in zip(paths, options, strict=True)
    ]


def photometry(args):
    """Measure images."""
    from miricigale.photometry.commands.from_files import measure_files

    *paths, prior = [*(args.image or ()), *args.positional, *(args.highres or ())] or [None]
    ways = bool(args.image) == bool(args.highres) != bool(args.positional)
    if not paths or not ways or len(args.highres or ()) > 1:
        msg = "wanted are --image and --highres, or the images and last the prior without options"
        raise ValueError(msg)
    images, prior = images_of(args, paths), images_of(args, [prior], "highres_")[0]
    options = {
        "kernel": args.kernel and [None if one == "-" else one for one in args.kernel],
        **chosen(args, "detection segmentation catalog confidence"),
        **chosen(args, "max_shift background_order offset_order second_pass"),
        **chosen(args, "components psf_stars overwrite seed"),
        "output": None if str(args.output) == "-" else args.output,
        "n_threads": args.threads,
        "progress_bar": not args.no_progress,
    }
    page, whole = args.page, args.patches is None
    for name in (
        ("patch_size", "overlap", "scheduler", "redo") if whole else ("page", "model", "residual")
    ):
        value = getattr(args, name)
        if value is not None and value is not False:
            wanted = f"left out with{'out' * whole} --patches"
            raise argument_error("--" + name.replace("_", "-"), wanted, value)
    if not whole:
        table, page = _in_patches(args, images, prior, options), args.patches / "index.html"
    else:
        if page is None and options["output"] is not None:
            page = args.output.with_suffix(".html")
        table = measure_files(images, prior, page=page, **chosen(args, "model residual"), **options)
    if options["output"] is None:
        table.write(sys.stdout, format="ascii.ecsv")
    else:
        print(f"{len(table)} sources in {args.output}; page: {page}")
    return 0


def _in_patches(args, images, prior, options):
    """Measure images in patches, on the processors of this machine or of others."""
    from miricigale.workflow import measure_patches

    given = chosen(args, "patch_size overlap redo")
    options |= {name: value for name, value in given.items() if value is not None}
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

    paths = [args.output.with_suffix(one) for one in (".fits", ".ecsv", ".html")]
    for path in paths:
        check_output(path, "output", overwrite=args.overwrite, inputs=[args.image])
    file = MosaicFile(args.image, **{name: getattr(args, name) for name in _KNOWN})
    psf, image = image_psf(file), file.read()
    options = {"diameters": u.Quantity(args.apertures)} if args.apertures else {}
    found = image_errors(image, psf=psf, n_sigma=args.sigma, seed=args.seed, **options)
    found.write(paths[0], overwrite=args.overwrite)
    write_table(found.table, paths[1], overwrite=args.overwrite)
    write_errors_page(paths[2], found, overwrite=args.overwrite)
    print(f"limits in {paths[0]} and {paths[1]}; page: {paths[2]}")
    return 0
