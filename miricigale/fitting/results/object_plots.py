"""Pictures of single objects: photometry with the best model, residuals, and the posterior of the redshift."""

from pathlib import Path
from urllib.parse import quote

from miricigale.fitting.results.drawing import fitted_curves
from miricigale.plotting.axes import WIDTH, plain_text
from miricigale.utils.files import make_folder, replacing
from miricigale.utils.progress import progress

#: Inches of the picture of one object.
_HEIGHT = 3.2


def draw_objects(objects, filters, titles):
    """
    Draw objects below one another: fluxes with the best model and residuals, and the posterior of the redshift.

    Parameters
    ----------
    objects : sequence of `~miricigale.fitting.FitResults`
        Single objects that were fitted.
    filters : `~miricigale.filters.FilterSet`
        Bands of the results, for their wavelengths.
    titles : sequence of str or None
        Titles; id, redshift and chi2 by default.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    from matplotlib.figure import Figure

    n = len(objects)
    figure = Figure(figsize=(WIDTH, _HEIGHT * n), layout="constrained")
    rows = figure.subfigures(n, 1, squeeze=False)[:, 0]
    for k, (row, result) in enumerate(zip(rows, objects, strict=True)):
        fixed = result.redshift_fixed
        mosaic = [["fluxes"], ["residuals"]]
        ratios = {"height_ratios": [3, 1]}
        if not fixed:
            mosaic = [["fluxes", "redshift"], ["residuals", "redshift"]]
            ratios["width_ratios"] = [3, 1.2]
        axes = row.subplot_mosaic(mosaic, **ratios)
        axes["residuals"].sharex(axes["fluxes"])
        options = {}
        if titles is not None:
            options = {"title": titles[k]}
        result.plot_sed((axes["fluxes"], axes["residuals"]), filters=filters, **options)
        axes["fluxes"].title.set_fontsize("small")
        if not fixed:
            result.plot_pdf("redshift", axes["redshift"])
    return figure


def write_plots(results, folder, ids=None, *, overwrite=False, progress_bar=False):
    """
    Write a picture of each object.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults` or `~miricigale.fitting.FitResultsFiles`
        The fits.
    folder : path-like
        Gets ``<id>.png`` of each object that was fitted; what is no letter, number or ``_.-~`` of an id is quoted
        as in addresses.
    ids : iterable, optional
        Ids of the objects; all by default.
    overwrite : bool, optional
        Whether existing files are replaced.
    progress_bar : bool, optional
        Whether a progress bar is shown.

    Returns
    -------
    paths : list of `pathlib.Path`
        The files.

    Raises
    ------
    KeyError
        If there is no object of an id.
    OSError
        If a file exists and ``overwrite`` is False.
    """
    folder = Path(folder)
    missing_ids = None
    if ids is not None:
        missing_ids = set(map(str, ids))
    filters = None
    paths = []
    with progress(show=progress_bar, total=len(results), desc="plots", unit="objects") as bar:
        for result in results:
            bar.update()
            key = str(result.ids)
            if missing_ids is not None:
                if key not in missing_ids:
                    continue
                missing_ids.remove(key)
            if not result.fitted:
                continue
            if filters is None:
                filters = fitted_curves(result)
            make_folder(folder)
            path = folder / f"{quote(key, safe='')}.png"
            title = f"{plain_text(key)}: reduced chi2 {result.reduced_chi2:.2f}"
            with replacing(path, overwrite=overwrite) as partial:
                draw_objects([result], filters, [title]).savefig(partial, format="png", dpi=110)
            paths.append(path)
    if missing_ids:
        msg = f"no object with the id {min(missing_ids)!r}"
        raise KeyError(msg)
    return paths
