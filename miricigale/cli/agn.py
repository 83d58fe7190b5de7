"""The command that counts AGN."""

from miricigale.cli.catalogs import fit_options, fit_workers, images_of, photometer_options
from miricigale.cli.options import declarations, destination, filled, refuse
from miricigale.utils.named_values import attributes, without_none

#: CPU-seconds of a fit of an object as a galaxy, and as each other class, without and with fluxes of nuclei.
_SECONDS = {False: 0.06, True: 0.12}
#: The same of an injected AGN, whose narrower posterior takes more models, with the default number of these, and
#: with as many as the catalog.
_INJECTED_SECONDS = {False: 0.06, True: 0.18}
_INJECTED_SECONDS_IN_FULL = {False: 0.11, True: 0.35}
#: Options of the prior and its sources.
_OF_PRIOR = ("segmentation", "catalog", "psf_stars")


def agn(args):
    """Count the AGN of a catalog, with a selection function."""
    import astropy.units as u

    from miricigale.agn import AGNSurvey

    settings = filled(args, AGNSurvey)
    settings["area"] = args.area * u.arcmin**2
    # --redshift names a column of the catalog
    settings.pop("redshift", None)
    if args.redshift_bins is not None:
        settings["redshift"] = args.redshift_bins
    survey = AGNSurvey(**settings)
    images = _images(args)
    if args.plan:
        print(_plan(args, survey))
        return 0
    with fit_workers(args) as executor:
        result = survey.run(images=images, **fit_options(args), executor=executor)
    for row in result.totals:
        interval = f"{row['n_low']:.1f} to {row['n_high']:.1f}"
        shipped = f"{row['n_shipped']:.1f} with the shipped prior"
        print(f"AGN with fracAGN >= {row['frac_agn']:g}: {row['n']:.1f} ({interval}); {shipped}")
    print(f"{result.totals['n_selected'][0]} selected objects; page: {args.output / 'page.html'}")
    return 0


def _images(args):
    """Make the `~miricigale.agn.AGNImages` of the options of images; None without any."""
    if args.images is None:
        names = []
        for flag in declarations()["agn"]["as_in"]["photometry"]:
            option = declarations()["photometry"]["options"][flag]
            if "{prefix}" in flag:
                for prefix in ("", "highres-"):
                    names.append(destination(flag.replace("{prefix}", prefix), option))
            else:
                names.append(destination(flag, option))
        refuse(args, names, "given with --images")
        return None
    from miricigale.agn import AGNImages

    if len(args.images) < 2:
        msg = f"--images must be one image at least and the prior, got {args.images}"
        raise ValueError(msg)
    paths = args.images[:-1]
    options = photometer_options(args) | without_none(attributes(args, _OF_PRIOR))
    if args.kernel:
        options["kernel"] = [None if name == "-" else name for name in args.kernel]
    (highres,) = images_of(args, args.images[-1:], "highres_")
    return AGNImages(images_of(args, paths), highres, n_threads=args.n_threads, **options)


def _plan(args, survey):
    """What a run would fit, and the processor time that it takes, as text."""
    from miricigale.agn.injections import most_injections
    from miricigale.fitting import GridSettings
    from miricigale.fitting.catalogs.catalog_rows import open_catalog
    from miricigale.fitting.catalogs.class_names import chosen_classes

    rows = open_catalog(**filled(args, open_catalog))
    survey.warn_of_density(rows.n_rows)
    names = chosen_classes(**filled(args, chosen_classes))
    n_classes = 1 + len(names)
    n_most = most_injections(survey.n_injections, rows.n_rows)
    n_fits = (rows.n_rows + n_most) * n_classes
    n_models = GridSettings.interpolate
    if args.interpolate is not None:
        n_models = args.interpolate
    nuclei = bool(args.nuclei)
    seconds = _INJECTED_SECONDS_IN_FULL[nuclei]
    if survey.injected_models < n_models:
        seconds = _INJECTED_SECONDS[nuclei]
    alone = rows.n_rows * n_classes * _SECONDS[nuclei] / 60
    minutes = alone + n_most * n_classes * seconds / 60
    objects = f"{rows.n_rows} objects and at most {n_most} injected AGN in {n_classes} classes"
    return f"{objects}: {n_fits} fits, about {minutes:.0f} CPU-minutes, {alone:.0f} without AGN"
