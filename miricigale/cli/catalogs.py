"""Commands that make catalogs: fit, photometry."""

import argparse
from pathlib import Path

from miricigale.cli.options import chosen, pair, quantity_in

_NOISE = ("error", "variance", "inverse-variance", "weight")


def add_fit(commands):
    """Declare ``fit``."""
    fit = commands.add_parser("fit", help="fit redshift and AGN fraction of a photometry table")
    fit.add_argument(
        "photometry",
        type=Path,
        metavar="CATALOG",
        help="FITS, ECSV, CSV, VOTable or text with id, <filter> and <filter>_err, or with --map",
    )
    fit.add_argument(
        "-o", "--output", type=Path, default=Path("fits"), help="folder of the results"
    )
    fit.add_argument(
        "--axes",
        choices=("fit", "quick", "survey"),
        default="fit",
        help="model grid: that of Yang et al. 2021, a thinner one, or that for real galaxies of a survey",
    )
    fit.add_argument("--redshift", metavar="COLUMN", help="column of known redshifts")
    fit.add_argument(
        "--z-spec",
        metavar="COLUMN",
        help="column of redshifts to compare with on the page (else z_spec, zspec or redshift)",
    )
    fit.add_argument(
        "--model-error",
        type=float,
        help="model error as a part of the flux, 0.1 (10 %%) by default; with --axes survey in place of its "
        "template error",
    )
    fit.add_argument(
        "--pairs",
        nargs="+",
        action="extend",
        type=pair,
        metavar="NAME:NAME",
        help="parameters whose joint posteriors are kept too, such as age:tau redshift:ebv",
    )
    fit.add_argument("--flux-unit", metavar="UNIT", help="unit of fluxes that have none (CSV)")
    fit.add_argument(
        "--map",
        dest="catalog_map",
        metavar="NAME|TOML",
        help="names and units of the columns: a survey (candels, 3dhst, jades, dja, cosmos2020, ceers, "
        "cigale), or a file with [columns], [units], survey, missing, factor, limits",
    )
    fit.add_argument(
        "--ebv",
        type=float,
        default=0.0,
        metavar="MAG",
        help="color excess E(B-V) of the Milky Way, if the fluxes are not corrected for it",
    )
    fit.add_argument(
        "--quasars",
        action="store_true",
        help="fit type-1 AGN too, and classify the objects by the evidence",
    )
    fit.add_argument(
        "--stars",
        type=Path,
        metavar="SPECTRA",
        help="fit stars too, with a file or folder of their spectra, such as the atlas of Pickles",
    )
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


def _fit(args):
    from miricigale.fitting.classes import fit_classes, write_table
    from miricigale.fitting.page import fit_page
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import thread_count, thread_pool

    hdu = int(args.hdu) if (args.hdu or "").isdigit() else args.hdu
    n_threads = thread_count(args.threads or None)
    try:
        with thread_pool(n_threads) as executor:
            found = fit_classes(
                args.photometry,
                args.output,
                **chosen(args, "quasars stars"),
                **chosen(args, "axes redshift model_error pairs flux_unit catalog_map ebv"),
                **chosen(args, "chunk_rows resume"),
                hdu=hdu,
                executor=executor if n_threads > 1 else None,
                progress_bar=not args.no_progress,
            )
        table = args.output / "table.fits"
        write_table(found, table, overwrite=True)
        page = fit_page(found, args.photometry, **chosen(args, "catalog_map z_spec"), hdu=hdu)
        page = page.write(args.output / "page.html")
    except OtherResultsError as err:
        # name the option of this command instead of the argument
        raise OtherResultsError(err.reason, "--no-resume to replace them") from err
    print(f"{found['galaxy']!r}; all in {table}; page: {page}")
    return 0


def _fit_stopped(args):
    n_parts = len(list(args.output.glob("part-*.fits")))
    how = "the same command, without --no-resume," if not args.resume else "the same command"
    return f"stopped; {n_parts} finished parts are in {args.output}/; {how} resumes here"


def add_photometry(commands):
    """Declare ``photometry``."""
    phot = commands.add_parser("photometry", help="forced photometry on a high-resolution prior")
    add = phot.add_argument
    add("positional", nargs="*", metavar="IMAGE HIGHRES", help="the two images, without options")
    add("--image", metavar="FITS", help="image to be measured; FILE[EXTENSION] names an extension")
    add("--highres", metavar="FITS", help="high-resolution image: the prior")
    add("--filter", help="filter of the image, such as miri.f770w, if its header does not state it")
    add("--highres-filter", metavar="FILTER", help="filter of the prior, likewise")
    add("--segmentation", metavar="FITS", help="segmentation map of the prior (else: detection)")
    add("--catalog", metavar="TABLE", help="FITS, ECSV, CSV or plain table with id, ra, dec")
    add("--kernel", metavar="FITS", help="kernel from prior to image; FILE[EXT,PLANE] of a cube")
    add("--psf", metavar="FITS", help="PSF of the image; FILE[EXT,PLANE] or FILE[EXT,mean]")
    add("--highres-psf", metavar="FITS", help="PSF of the prior, likewise")
    for prefix, what in (("", "image"), ("highres-", "prior")):
        add(
            f"--{prefix}psf-scale",
            type=quantity_in("arcsec"),
            metavar="ARCSEC",
            help=f"pixel of the PSF of the {what} (else: its header's, or the {what}'s)",
        )
        add(
            f"--{prefix}psf-angle",
            type=quantity_in("deg"),
            metavar="DEG",
            help=f"position angle of the PSF's y axis (else: its header's, or the {what}'s)",
        )
        add(
            f"--{prefix}pa-aper",
            type=quantity_in("deg"),
            metavar="DEG",
            help=f"position angle of the detector's y axis ({what}), if the header does not state it",
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
    add(
        "--max-shift",
        type=quantity_in("arcsec"),
        metavar="ARCSEC",
        help="fit a shift of the image up to this",
    )
    background = phot.add_mutually_exclusive_group().add_argument
    what = "order of the background, 0 for a constant"
    background("--background-order", type=int, default=0, help=what)
    none = {"dest": "background_order", "action": "store_const", "const": None}
    background("--no-background", **none, help="fit no constant with the sources")
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


def _photometry(args):
    from miricigale.photometry import MosaicFile
    from miricigale.photometry.from_files import measure_files

    paths = [path for path in (args.image, args.highres) if path is not None] + args.positional
    if len(paths) != 2 or (args.positional and len(args.positional) != 2):
        msg = "wanted are --image and --highres, or the two files without options"
        raise ValueError(msg)
    known = [*(kind.replace("-", "_") for kind in _NOISE), "filter", "unit", "zero_point"]
    known += ["background_box", "psf", "psf_scale", "psf_angle", "pa_aper"]
    images = [
        MosaicFile(path, **{n: getattr(args, prefix + n) for n in known})
        for path, prefix in zip(paths, ("", "highres_"), strict=True)
    ]
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
    print(f"{len(table)} sources in {args.output}; page: {page}")
    return 0
