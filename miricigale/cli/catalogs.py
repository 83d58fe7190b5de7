"""Commands that make catalogs: fit, photometry."""

import sys

from miricigale.cli.options import chosen, read_input

_NOISE = ("error", "variance", "inverse_variance", "weight")


def fit(args):
    """Fit a catalog."""
    from miricigale.fitting.classes import fit_classes, write_table
    from miricigale.fitting.page import fit_page
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import threads

    hdu = int(args.hdu) if (args.hdu or "").isdigit() else args.hdu
    if str(args.photometry) == "-":
        args.photometry = read_input(args.output)
    try:
        with threads(args.threads or None) as executor:
            found = fit_classes(
                args.photometry,
                args.output,
                **chosen(args, "quasars red_dots stars"),
                **chosen(args, "axes redshift model_error outliers calibration calibrate"),
                **chosen(
                    args, "interpolate agn_error pairs flux_unit catalog_map ebv chunk_rows resume"
                ),
                hdu=hdu,
                executor=executor,
                progress_bar=not args.no_progress,
            )
        table = args.output / "table.fits"
        write_table(found, table, overwrite=True)
        page = fit_page(found, args.photometry, **chosen(args, "catalog_map z_spec"), hdu=hdu)
        page = page.write(args.output / "page.html")
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
    print(f"{found['galaxy']!r}; all in {table}; page: {page}")
    return 0


def photometry(args):
    """Measure an image."""
    from miricigale.photometry import MosaicFile
    from miricigale.photometry.from_files import measure_files

    paths = [path for path in (args.image, args.highres) if path is not None] + args.positional
    if len(paths) != 2 or (args.positional and len(args.positional) != 2):
        msg = "wanted are --image and --highres, or the two files without options"
        raise ValueError(msg)
    known = [*_NOISE, "filter", "unit", "zero_point"]
    known += ["background_box", "psf", "psf_scale", "psf_angle", "pa_aper"]
    images = [
        MosaicFile(path, **{n: getattr(args, prefix + n) for n in known})
        for path, prefix in zip(paths, ("", "highres_"), strict=True)
    ]
    if str(args.output) == "-":
        args.output, page = None, args.page
    else:
        page = args.page or args.output.with_suffix(".html")
    table = measure_files(
        *images,
        **chosen(args, "segmentation catalog kernel"),
        **chosen(args, "max_shift background_order offset_order second_pass"),
        **chosen(args, "components output model residual overwrite seed"),
        page=page,
        n_threads=args.threads,
        progress_bar=not args.no_progress,
    )
    if args.output is None:
        table.write(sys.stdout, format="ascii.ecsv")
    else:
        print(f"{len(table)} sources in {args.output}; page: {page}")
    return 0
