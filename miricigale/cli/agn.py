"""The command that counts AGN."""

from miricigale.cli.catalogs import _workers
from miricigale.cli.options import chosen

#: CPU-seconds of a fit of an object as a galaxy, and as each other class.
_SECONDS = 0.15


def agn(args):
    """Count the AGN of a catalog, with a selection function."""
    import astropy.units as u

    from miricigale.agn import AGNSurvey
    from miricigale.utils.exceptions import OtherResultsError

    survey = AGNSurvey(
        args.area * u.arcmin**2,
        redshift=tuple(args.redshift_bins),
        log_luminosity=tuple(args.luminosity_bins),
        **chosen(args, "limit n_injections seed"),
    )
    if (args.hdu or "").isdigit():
        hdu = int(args.hdu)
    else:
        hdu = args.hdu
    if args.plan:
        print(_plan(args, hdu))
        return 0
    try:
        with _workers(args) as executor:
            result = survey.run(
                args.photometry,
                args.output,
                **chosen(args, "classes quasars red_dots stars axes redshift model_error outliers"),
                **chosen(args, "calibrate interpolate agn_error"),
                **({} if args.calibration is None else {"calibration": args.calibration}),
                **chosen(args, "flux_unit catalog_map ebv chunk_rows resume"),
                hdu=hdu,
                executor=executor,
                progress_bar=not args.no_progress,
            )
    except OtherResultsError as err:
        # name the option of this command instead of the argument
        raise OtherResultsError(err.reason, "--no-resume to replace them") from err
    for row in result.totals:
        interval = f"{row['n_low']:.1f} to {row['n_high']:.1f}"
        shipped = f"{row['n_shipped']:.1f} with the shipped prior"
        print(f"AGN with fracAGN >= {row['frac_agn']:g}: {row['n']:.1f} ({interval}); {shipped}")
    print(f"{result.totals['n_selected'][0]} selected objects; page: {args.output / 'page.html'}")
    return 0


def _plan(args, hdu):
    """What a run would fit, and the processor time that it takes, as text."""
    from miricigale.fitting.catalogs.catalog_rows import open_catalog
    from miricigale.fitting.catalogs.class_names import chosen_classes

    options = chosen(args, "catalog_map flux_unit")
    rows = open_catalog(args.photometry, args.chunk_rows, hdu=hdu, **options)
    names = chosen_classes(args.classes, **chosen(args, "quasars red_dots stars"))
    n_classes = 1 + len(names)
    n_fits = (rows.n_rows + args.n_injections) * n_classes
    minutes = n_fits * _SECONDS / 60
    objects = f"{rows.n_rows} objects and {args.n_injections} injected AGN"
    return f"{objects} in {n_classes} classes: {n_fits} fits, about {minutes:.0f} CPU-minutes"
