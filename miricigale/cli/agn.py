"""The command that counts AGN."""

from miricigale.cli.catalogs import fit_options, fit_workers
from miricigale.cli.options import filled

#: CPU-seconds of a fit of an object as a galaxy, and as each other class.
_SECONDS = 0.1


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
    if args.plan:
        print(_plan(args, survey))
        return 0
    with fit_workers(args) as executor:
        result = survey.run(**fit_options(args), executor=executor)
    for row in result.totals:
        interval = f"{row['n_low']:.1f} to {row['n_high']:.1f}"
        shipped = f"{row['n_shipped']:.1f} with the shipped prior"
        print(f"AGN with fracAGN >= {row['frac_agn']:g}: {row['n']:.1f} ({interval}); {shipped}")
    print(f"{result.totals['n_selected'][0]} selected objects; page: {args.output / 'page.html'}")
    return 0


def _plan(args, survey):
    """What a run would fit, and the processor time that it takes, as text."""
    from miricigale.fitting.catalogs.catalog_rows import open_catalog
    from miricigale.fitting.catalogs.class_names import chosen_classes

    rows = open_catalog(**filled(args, open_catalog))
    names = chosen_classes(**filled(args, chosen_classes))
    n_classes = 1 + len(names)
    n_fits = (rows.n_rows + survey.n_injections) * n_classes
    minutes = n_fits * _SECONDS / 60
    objects = f"{rows.n_rows} objects and {survey.n_injections} injected AGN"
    return f"{objects} in {n_classes} classes: {n_fits} fits, about {minutes:.0f} CPU-minutes"
