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
from miricigale.fitting.results.pulls import without_warnings
from miricigale.pages import number
from miricigale.plotting.axes import WIDTH, new_figure
from miricigale.utils.options import check_that
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
        Way's dust. ``priors`` and ``pairs`` are of galaxies alone.
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
    found : dict of str to `~miricigale.fitting.FitResultsFiles`
        ``galaxy``, ``quasar``, ``red_dot``, ``star``.

    Warns
    -----
    `~miricigale.utils.exceptions.FitWarning`
        What `~miricigale.fitting.fit_catalog` warns of, once for all classes.
    """
    names = chosen_classes(classes, quasars=quasars, red_dots=red_dots, stars=stars)
    # evidences of classes are compared for the same data
    has_nuclei = bool(options.get("nuclei")) and bool(names)
    check_that(not has_nuclei, "nuclei", "False with other classes than galaxies", "True")
    spectra = None
    if "stars" in names:
        from miricigale.sed import read_spectra

        # a file that cannot be read is refused before hours of fitting
        spectra = read_spectra(stars)
    with _each_once():
        found = {"galaxy": fit_catalog(path, output, **options)}
        options.pop("calibrate", None)
        # after the fit, which refuses what it cannot read before it loads the models
        from miricigale.fitting.catalogs.catalog_calibration import measured_calibration
        from miricigale.fitting.posterior.populations import red_dot_prior
        from miricigale.sed import SEDModel, quasar_axes, red_dot_axes, template_grid

        measured = measured_calibration(found["galaxy"])
        if measured is not None:
            options["calibration"] = measured
        # of parameters of galaxies
        options.pop("pairs", None)
        options.pop("priors", None)

        def fit(name, models, **more):
            own = options | more
            found[name] = fit_catalog(path, Path(output) / name, models=models, **own)

        # what is of another class has large residuals
        with without_warnings():
            if "quasars" in names:
                fit("quasar", lambda _: (SEDModel.survey(), quasar_axes()))
            if "red_dots" in names:
                # lines that cross the bands are exact at the nodes, and these lie close
                own = {"priors": {"redshift": red_dot_prior(red_dot_axes()["redshift"])}}
                models = partial(red_dot_grid, ebv=options.get("ebv", 0.0))
                fit("red_dot", models, interpolate=0, agn_error=0.0, **own)
            options.pop("redshift", None)
            if spectra is not None:

                def stars_in(bands):
                    return template_grid(spectra, bands, beyond="rayleigh-jeans"), None

                fit("star", stars_in)
    return found


def red_dot_grid(bands, *, ebv=0.0):
    """
    Grid of little red dots, for ``models`` of `~miricigale.fitting.fit_catalog`.

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
    show, shown = warnings.showwarning, set()

    def once(message, *args, **kwargs):
        if str(message) not in shown:
            shown.add(str(message))
            show(message, *args, **kwargs)

    warnings.showwarning = once
    try:
        yield
    finally:
        warnings.showwarning = show


def write_table(found, path, *, overwrite=False):
    """
    Write the table of all results, with the columns of the classes where there are several.

    Parameters
    ----------
    found : dict of str to `~miricigale.fitting.FitResultsFiles`
        As `fit_classes` returned it.
    path, overwrite
        As for `~miricigale.fitting.FitResultsFiles.write_table`.
    """
    # redshifts and how well a model fits are those of the class; all else of the table is of the fit as a galaxy
    first = found["galaxy"]
    if len(found) == 1:
        first.write_table(path, overwrite=overwrite)
        return
    width = max(part.ids.dtype.itemsize for part in first.parts())
    write_rows(path, _tables(found), len(first), id_width=width, overwrite=overwrite)


def _parts(found, step=1):
    """Iterate over the parts of the results, or every ``step``-th of their objects: `FitResults` by class."""
    thin = (thinned(results.parts(), step) for results in found.values())
    for parts in zip(*thin, strict=True):
        yield dict(zip(found, parts, strict=True))


def _tables(found):
    for some in _parts(found):
        table = some["galaxy"].to_table()
        columns = class_columns(some)
        for name in table.colnames:
            if name not in columns and name not in _OF_ALL:
                table[name].info.description += ", of the fit as a galaxy"
        table.update(described_table(columns))
        # the class stands with the id, and so with the redshift, which is its
        first = ["id", "class", "class_probability"]
        yield table[first + [name for name in table.colnames if name not in first]]


def classes_of(found, step=1):
    """Columns of `~miricigale.fitting.compare_classes` for every ``step``-th object: dict of name to array."""
    parts = [class_columns(some) for some in _parts(found, step)]
    return {name: np.concatenate([part[name][0] for part in parts]) for name in parts[0]}


def classes_section(page, columns, names, ids):
    """
    The part of a page on classes.

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
    label, others = columns["class"], names[1:]
    chi2, free = columns["reduced_chi2_galaxy"], "redshift_p50" in columns
    page.section("classes", others=" or ".join(others))
    rows = []
    for name in names:
        mine, own = label == name, columns[f"reduced_chi2_{name}"]
        sure = columns[f"probability_{name}"][mine] > 1.0 / (1.0 + np.exp(-_SURE))
        middle = number(np.median(own[mine]) if mine.any() else np.nan, ".2f", "no object")
        z = np.median(columns["redshift_p50"][mine]) if free and mine.any() else np.nan
        z = number(z, ".2f", "no object" if free else "given")
        rows.append({"class": name, "n": mine.sum(), "sure": sure.sum(), "chi2": middle, "z": z})
    lost = {"class": "not fitted with all classes", "n": np.sum(label == "")}
    page.table("counts", [*rows, lost | {"sure": "", "chi2": "", "z": ""}])
    figure, axes = new_figure(1, len(others), size=(WIDTH / 2, 3.2))
    for ax, name in zip(axes[0], others, strict=True):
        ratio = columns[f"log_ratio_{name}"]
        ratio = ratio[np.isfinite(ratio)]
        ax.hist(np.clip(ratio, -_SPAN, _SPAN), np.linspace(-_SPAN, _SPAN, 61), color="0.75")
        ax.axvline(0.0, color="0.3", lw=0.8)
        ax.set(xlabel=f"ln evidence, {name} over galaxy", ylabel="objects")
    page.figure("figure", figure)
    surest = []
    for name in others:
        ratio, own = columns[f"log_ratio_{name}"], columns[f"reduced_chi2_{name}"]
        mine = np.flatnonzero(label == name)
        for i in mine[np.argsort(-ratio[mine], kind="stable")][:_LISTED]:
            row = {"id": str(ids[i]), "class": name, "ratio": ratio[i]}
            row["z"] = columns["redshift_p50"][i] if free else np.nan
            row["z_galaxy"] = columns["redshift_p50_galaxy"][i] if free else np.nan
            surest.append(row | {"own": own[i], "galaxy": chi2[i]})
    if surest:
        page.table("surest", surest, n=_LISTED)
