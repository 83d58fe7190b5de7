"""Catalogs sorted into galaxies, quasars and stars: fits of each class, their table and their part of a page."""

import warnings
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from miricigale.fitting.catalogs.class_names import chosen_classes
from miricigale.fitting.catalogs.classification import class_columns
from miricigale.fitting.catalogs.from_files import fit_catalog
from miricigale.fitting.catalogs.page_numbers import thinned
from miricigale.fitting.data.nuclei import WHOLE
from miricigale.fitting.results.pulls import without_warnings
from miricigale.pages import number
from miricigale.plotting.axes import WIDTH, new_figure
from miricigale.utils.arrays import finite_values
from miricigale.utils.row_files import write_rows
from miricigale.utils.tables import described_table

#: Objects of each class but the first that a page lists, those of the highest ratio.
_LISTED = 10
#: ln ratio beyond which a class is called sure (odds of 150 to 1).
_SURE = 5.0
#: Columns of a table that are the same of all classes.
_OF_ALL = ("id", "n_bands", "n_limits")
#: ln ratios that a drawing spans.
_SPAN = 60.0


def fit_classes(path, output, *, classes=(), quasars=False, red_dots=False, stars=None, **options):
    """
    Fit a catalog with galaxies and, where asked for, with quasars, little red dots and stars.

    Parameters
    ----------
    path, output, **options
        As for `~miricigale.fitting.fit_catalog`, which fits the galaxies. All classes have the same
        bands, errors of models, limits and known redshifts, but stars are at redshift 0, and in front of the Milky
        Way's dust. ``priors`` and ``pairs`` are of galaxies alone. With ``nuclei`` the fluxes of points are those
        of the AGN of galaxies and quasars, and all of the light of little red dots and stars.
    classes : iterable of str or str, optional
        Classes besides galaxies: ``"quasars"``, ``"red_dots"``, ``"stars"`` (with ``stars``), or ``"all"``; as
        text with commas between them. The arguments below ask for one each.
    quasars : bool, optional
        Whether type-1 AGN are fitted: `~miricigale.sed.SEDModel.survey` with `~miricigale.sed.quasar_axes`, into
        the folder ``quasar`` of ``output``.
    red_dots : bool, optional
        Whether `~miricigale.sed.red_dots` are fitted, at the redshifts of `~miricigale.sed.red_dot_axes`, 2 to 10,
        with the prior `~miricigale.fitting.red_dot_prior` and on the nodes alone, into the folder ``red_dot``.
    stars : path-like, optional
        Spectra of stars (`~miricigale.sed.read_spectra`), into the folder ``star``; those that end before the
        bands do are continued as `~miricigale.sed.template_grid` does with a warning.

    Returns
    -------
    fits : dict of str to `~miricigale.fitting.FitResultsFiles`
        ``galaxy``, ``quasar``, ``red_dot``, ``star``.

    Warns
    -----
    `~miricigale.utils.exceptions.FitWarning`
        What `~miricigale.fitting.fit_catalog` warns of, once for all classes.
    """
    names = chosen_classes(classes, quasars=quasars, red_dots=red_dots, stars=stars)
    spectra = None
    if "stars" in names:
        from miricigale.sed import read_spectra

        # a file that cannot be read is refused before hours of fitting
        spectra = read_spectra(stars)
    with _each_once():
        fits = {"galaxy": fit_catalog(path, output, **options)}
        options.pop("calibrate", None)
        # after the fit, which refuses what it cannot read before it loads the models
        from miricigale.fitting.catalogs.catalog_calibration import measured_calibration
        from miricigale.fitting.posterior.populations import red_dot_prior
        from miricigale.sed import SEDModel, quasar_axes, red_dot_axes, template_grid

        measured = measured_calibration(fits["galaxy"])
        if measured is not None:
            options["calibration"] = measured
        # of parameters of galaxies
        options.pop("pairs", None)
        options.pop("priors", None)

        def fit(name, models, **class_options):
            keywords = options | class_options
            fits[name] = fit_catalog(path, Path(output) / name, models=models, **keywords)

        # little red dots and stars are points
        of_points = {"nuclei": WHOLE if options.get("nuclei") else False}
        # sources of another class have large residuals
        with without_warnings():
            if "quasars" in names:
                fit("quasar", lambda _: (SEDModel.survey(), quasar_axes()))
            if "red_dots" in names:
                # lines that cross the bands are exact at the nodes, and these lie close
                priors = {"redshift": red_dot_prior(red_dot_axes()["redshift"])}
                models = partial(red_dot_grid, ebv=options.get("ebv", 0.0))
                fit("red_dot", models, interpolate=0, agn_error=0.0, priors=priors, **of_points)
            options.pop("redshift", None)
            if spectra is not None:

                def stars_in(bands):
                    return template_grid(spectra, bands, beyond="rayleigh-jeans"), None

                fit("star", stars_in, **of_points)
    return fits


def red_dot_grid(bands, *, ebv=0.0):
    """
    Make a grid of little red dots, for ``models`` of `~miricigale.fitting.fit_catalog`.

    Parameters
    ----------
    bands : list of str
        The bands.
    ebv : float, optional
        Color excess of the Milky Way in mag, whose dust dims each band as a constant F_nu.

    Returns
    -------
    grid : `~miricigale.sed.ModelGrid`
        `~miricigale.sed.red_dots` at the redshifts of `~miricigale.sed.red_dot_axes`.
    axes : None
    """
    from miricigale.sed import band_extinction, red_dot_axes, red_dots, template_grid

    grid = template_grid(red_dots(), bands, redshift=red_dot_axes()["redshift"])
    if ebv:
        extinction = band_extinction(bands, ebv, beyond="transparent")
        dimmed = [10.0 ** (-0.4 * extinction[band][0].value) for band in bands]
        grid = replace(grid, galaxy=grid.galaxy * np.array(dimmed))
    return grid, None


@contextmanager
def _each_once():
    """Show each text of a warning once, for it holds for all classes."""
    show = warnings.showwarning
    shown = set()

    def show_once(message, *args, **kwargs):
        if str(message) not in shown:
            shown.add(str(message))
            show(message, *args, **kwargs)

    warnings.showwarning = show_once
    try:
        yield
    finally:
        warnings.showwarning = show


def write_table(fits, path, *, overwrite=False):
    """
    Write the table of all results, with the columns of the classes where there are several.

    Parameters
    ----------
    fits : dict of str to `~miricigale.fitting.FitResultsFiles`
        As `fit_classes` returned it.
    path, overwrite
        As for `~miricigale.fitting.FitResultsFiles.write_table`.
    """
    # redshifts and how well a model fits are those of the class; all else of the table is of the fit as a galaxy
    galaxies = fits["galaxy"]
    if len(fits) == 1:
        galaxies.write_table(path, overwrite=overwrite)
        return
    width = max(part.ids.dtype.itemsize for part in galaxies.parts())
    write_rows(path, _tables(fits), len(galaxies), id_width=width, overwrite=overwrite)


def _parts(fits, step=1):
    """Iterate over the parts of the results, or every ``step``-th of their objects: `FitResults` by class."""
    by_class = [thinned(results.parts(), step) for results in fits.values()]
    for parts in zip(*by_class, strict=True):
        yield dict(zip(fits, parts, strict=True))


def _tables(fits):
    for class_results in _parts(fits):
        table = class_results["galaxy"].to_table()
        columns = class_columns(class_results)
        for name in table.colnames:
            if name not in columns and name not in _OF_ALL:
                table[name].info.description += ", of the fit as a galaxy"
        table.update(described_table(columns))
        # the class stands with the id, and so with the redshift, which is its
        first = ["id", "class", "class_probability"]
        yield table[first + [name for name in table.colnames if name not in first]]


def classes_of(fits, step):
    """Compute the columns of `~miricigale.fitting.compare_classes` for every ``step``-th object, by name."""
    parts = [class_columns(class_results) for class_results in _parts(fits, step)]
    return {name: np.concatenate([part[name][0] for part in parts]) for name in parts[0]}


def classes_section(page, columns, names, ids):
    """
    Write the section of a page on classes.

    Parameters
    ----------
    page : `~miricigale.pages.SectionWriter`
        Gets the section.
    columns : dict of str to `~numpy.ndarray`, shape (n,)
        As `classes_of` returned them.
    names : list of str
        The classes, galaxies first.
    ids : `~numpy.ndarray`, shape (n,)
        Ids of the objects.
    """
    label = columns["class"]
    non_galaxies = names[1:]
    has_redshifts = "redshift_p50" in columns
    page.section("classes", others=" or ".join(non_galaxies))
    missing_redshift = "given"
    if has_redshifts:
        missing_redshift = "no object"
    # probability of odds exp(_SURE) to 1
    sure_probability = 1.0 / (1.0 + np.exp(-_SURE))
    rows = []
    for name in names:
        in_class = label == name
        sure = columns[f"probability_{name}"][in_class] > sure_probability
        median_chi2 = np.nan
        median_z = np.nan
        if in_class.any():
            median_chi2 = np.median(columns[f"reduced_chi2_{name}"][in_class])
            if has_redshifts:
                median_z = np.median(columns["redshift_p50"][in_class])
        row = {"class": name, "n": in_class.sum(), "sure": sure.sum()}
        row["chi2"] = number(median_chi2, ".2f", "no object")
        row["z"] = number(median_z, ".2f", missing_redshift)
        rows.append(row)
    unsorted = {"class": "not fitted with all classes", "n": np.sum(label == "")}
    rows.append(unsorted | {"sure": "", "chi2": "", "z": ""})
    page.table("counts", rows)
    figure, axes = new_figure(1, len(non_galaxies), size=(WIDTH / 2, 3.2))
    for ax, name in zip(axes[0], non_galaxies, strict=True):
        ratio = columns[f"log_ratio_{name}"]
        ratio = finite_values(ratio)
        ax.hist(np.clip(ratio, -_SPAN, _SPAN), np.linspace(-_SPAN, _SPAN, 61), color="0.75")
        ax.axvline(0.0, color="0.3", lw=0.8)
        ax.set(xlabel=f"ln evidence, {name} over galaxy", ylabel="objects")
    page.figure("figure", figure)
    surest = []
    for name in non_galaxies:
        ratio = columns[f"log_ratio_{name}"]
        in_class = np.flatnonzero(label == name)
        for i in in_class[np.argsort(-ratio[in_class], kind="stable")][:_LISTED]:
            row = {"id": str(ids[i]), "class": name, "ratio": ratio[i]}
            row["z"] = np.nan
            row["z_galaxy"] = np.nan
            if has_redshifts:
                row["z"] = columns["redshift_p50"][i]
                row["z_galaxy"] = columns["redshift_p50_galaxy"][i]
            row["own"] = columns[f"reduced_chi2_{name}"][i]
            row["galaxy"] = columns["reduced_chi2_galaxy"][i]
            surest.append(row)
    if surest:
        page.table("surest", surest, n=_LISTED)
