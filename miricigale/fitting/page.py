"""The page of a fitted catalog: redshifts, how well models fit, fractions, examples, what was left out."""

from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.evaluation import photoz_metrics
from miricigale.filters import Filter, FilterSet
from miricigale.filters.catalog_files import MappedRows
from miricigale.fitting import FitFlags
from miricigale.fitting.classes import classes_of, classes_section
from miricigale.fitting.from_files import open_catalog
from miricigale.fitting.likelihood import unused_bands
from miricigale.fitting.page_numbers import FitNumbers, known_redshifts
from miricigale.pages import Page, number
from miricigale.plotting.axes import WIDTH, new_figure
from miricigale.plotting.comparison import plot_redshifts

#: Examples on the page, and points in a drawing.
_EXAMPLES, _POINTS = 6, 5000
_COLOR, _SECOND = "#1d4ed8", "#c2410c"
#: Fluxes in a band for which a median is drawn.
_FEW = 5
#: Letters of a setting that are shown.
_LONG = 200
#: AGN fraction above which an object counts as one with an AGN.
_SOME_AGN = 0.2
#: What flags say where more than a tenth of the objects have them.
_WIDESPREAD = {
    FitFlags.HIGH_CHI2: "have no model that fits (reduced chi2 above the limit): errors that are too small, "
    "zero points, wrong columns or units, or models not theirs.",
    FitFlags.REDSHIFT_EDGE: "reach the first or last redshift of the grid.",
}
#: Columns on flux over model and on pulls, and their formats.
_RATIOS = {
    "flux / model": ".3f",
    "16 %": ".2f",
    "84 %": ".2f",
    "median pull": "+.2f",
    "beyond 3 sigma": "{:.1f} %",
}


def fit_page(results, path, *, catalog_map=None, hdu=None, z_spec=None):
    """
    Make the page of a fitted catalog.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResultsFiles` or dict of it
        What `~miricigale.fitting.fit_catalog` returned, or
        `~miricigale.fitting.classes.fit_classes`: then the page has a section on the classes.
    path : path-like
        The catalog that was fitted.
    catalog_map, hdu : optional
        As for the fit.
    z_spec : str, optional
        Column of known redshifts to compare with; by default the first of `KNOWN_REDSHIFTS` that is there.

    Returns
    -------
    page : `~miricigale.pages.Page`
        ``page.write(path)`` writes it, one HTML file.

    Raises
    ------
    ValueError
        If the catalog has no column ``z_spec``.
    """
    classes = results if isinstance(results, dict) else {"galaxy": results}
    results = classes["galaxy"]
    rows = open_catalog(path, results.job["chunk_rows"], hdu=hdu, catalog_map=catalog_map)
    found = every = FitNumbers(results)
    known = known_redshifts(rows, z_spec)
    columns = classes_of(classes) if len(classes) > 1 else None
    if columns is not None:
        # fits of stars and quasars with galaxies say nothing about the fit
        ours = np.isin(columns["class"], ["galaxy", ""])
        found, known = found.only(ours), (known[0], None if known[1] is None else known[1][ours])
    page = Page(
        f"Fits of {Path(path).name}",
        subtitle=f"{len(results)} objects, {len(found.filters)} bands",
        notices=_notices(found),
    )
    page.section("Summary")
    if columns is not None:
        others = " or ".join(list(classes)[1:])
        page.text(
            f"{found.chi2.size} of {len(results)} objects are no {others} by their evidence. All but the "
            "examples and what was left out is of these."
        )
    _summary(page, found)
    if columns is not None:
        classes_section(page, columns, list(classes), every.ids, every.chi2)
    _redshifts(page, found, known)
    _goodness(page, found)
    _physics(page, found)
    _examples(page, results, every)
    _left_out(page, rows, every)
    _settings(page, results)
    return page


def _notices(found):
    good = found.good
    if good.size and not good.any():
        return ["No object was fitted; the flags below say why."]
    lines = []
    for flag, text in _WIDESPREAD.items():
        share = _mean(found.flags[good] & int(flag) != 0)
        if share > 0.1:
            lines.append(f"{100 * share:.0f} % of the objects {text}")
    for name, ratio, _ in found.bands():
        if ratio.size >= 30 and not 0.8 < np.median(ratio) < 1.25:
            lines.append(
                f"{name}: fluxes are {np.median(ratio):.2f} times those of the best models in the median of "
                f"{ratio.size} objects: look at its zero point and unit."
            )
    return lines


def _summary(page, found):
    good, none = found.good, "no object was fitted"
    items = [
        ("objects", len(good)),
        ("fitted", int(good.sum())),
        ("without any flag", int(np.count_nonzero(good & (found.flags == 0)))),
    ]
    numbers = [
        ("bands of an object, median", _median(found.n_bands[good]), ".0f"),
        ("reduced chi2, median", _median(found.chi2), ".2f"),
    ]
    if not found.fixed:
        low, z, high = found.z.T
        numbers += [
            ("redshift, median", _median(z[good]), ".2f"),
            ("half width of z over 1 + z, median", _median((high - low) / 2 / (1 + z)), ".3f"),
        ]
    if np.isfinite(found.frac).any():
        share = 100 * _mean(found.frac[good, 0] > _SOME_AGN)
        numbers.append(
            (f"with 84 % of the posterior above fracAGN {_SOME_AGN:g}", share, "{:.0f} %")
        )
    page.items(items + [(label, number(value, spec, none)) for label, value, spec in numbers])


def _median(values):
    values = values[np.isfinite(values)]
    return np.median(values) if values.size else np.nan


def _mean(values):
    return np.mean(values) if values.size else np.nan


def _redshifts(page, found, known):
    name, z = known
    good = found.good
    if found.fixed:
        page.section("Redshifts", "Redshifts were given; they were not fitted.")
        return
    page.section("Redshifts")
    some = good & np.isfinite(z) if z is not None else np.zeros(good.size, bool)
    figure, axes = new_figure(1, 2 if some.any() else 1, size=(WIDTH / 2, 4.2))
    if some.any():
        metrics = photoz_metrics(z[some], found.z[some, 1])
        inside = (found.z[some, 0] <= z[some]) & (z[some] <= found.z[some, 2])
        page.items(
            [
                (f"objects with {name}", int(some.sum())),
                ("bias, median of dz / (1 + z)", f"{metrics.bias:+.3f}"),
                ("sigma_MAD of dz / (1 + z)", f"{metrics.sigma_mad:.3f}"),
                ("outliers, above 0.15", f"{100 * metrics.outlier_fraction:.1f} %"),
                ("in their 16-84 % interval (68 % wanted)", f"{100 * np.mean(inside):.0f} %"),
            ]
        )
        rows = np.flatnonzero(some)[:: max(1, int(some.sum()) // _POINTS)]
        plot_redshifts(z[rows], found.z[rows, 1], ax=axes[0, 0])
        axes[0, 0].set(xlabel=name, ylabel="fitted redshift (median)")
    ax = axes[0, -1]
    if good.any():
        both = np.append(found.z[good, 1], z[some] if some.any() else [])
        bins = np.histogram_bin_edges(both, 40)
        ax.hist(found.z[good, 1], bins, color="0.75", label="fitted")
        if some.any():
            ax.hist(z[some], bins, histtype="step", color=_COLOR, label=name)
            ax.legend(frameon=False)
    ax.set(xlabel="redshift", ylabel="objects")
    text = "Fitted redshifts (posterior medians)"
    if some.any():
        text += f" against {name}; dashed lines are |dz| = 0.15 (1 + z)"
    page.figure(figure, f"{text}.")


def _goodness(page, found):
    page.section(
        "How well models fit",
        "Reduced chi2 is that of the best model over bands less one, with the model error in the errors. "
        "A median ratio far from 1 in one band indicates a wrong zero point, unit or curve.",
    )
    figure, axes = new_figure(1, 2, size=(WIDTH / 2, 3.6))
    ax = axes[0, 0]
    chi2 = found.chi2[found.good]
    if chi2.size:
        ax.hist(np.clip(chi2, 1e-2, 1e3), np.geomspace(1e-2, 1e3, 51), color="0.75")
        ax.axvline(np.median(chi2), color=_COLOR, lw=1, label="median")
        ax.legend(frameon=False)
    ax.set(
        xscale="log", xlabel="reduced chi2 (those beyond in the outermost bins)", ylabel="objects"
    )
    ax = axes[0, 1]
    rows, none = [], "no flux was fitted"
    bands = sorted(found.bands(), key=lambda band: _pivot(band[0]))
    for k, (name, ratio, pull) in enumerate(bands):
        low, mid, high = np.percentile(ratio, [16, 50, 84]) if ratio.size else [np.nan] * 3
        if ratio.size >= _FEW:
            ax.errorbar(k, mid, [[mid - low], [high - mid]], fmt="o", color=_COLOR, ms=4, lw=1)
        values = (mid, low, high, _median(pull), 100 * _mean(np.abs(pull) > 3))
        texts = [number(v, spec, none) for v, spec in zip(values, _RATIOS.values(), strict=True)]
        rows.append((name, f"{_pivot(name):.3g}", ratio.size, *texts))
    ax.axhline(1.0, color="0.6", lw=0.8)
    ax.set_xticks(range(len(bands)), [name for name, *_ in bands], rotation=90, fontsize=7)
    ax.set(ylabel="flux over that of the best model", ylim=(0.4, 1.8))
    page.figure(
        figure,
        f"Reduced chi2, and measured over model flux in bands of {_FEW} or more fluxes: median, 16-84 % (in full "
        "in the table).",
    )
    page.table(rows, header=("band", "um", "fluxes", *_RATIOS))


def _pivot(name):
    """Pivot wavelength of a filter of the library in um."""
    return float(Filter.from_name(name).pivot.value)


def _physics(page, found):
    good = found.good & np.isfinite(found.mass[:, 1]) & (found.mass[:, 1] > 0)
    with_agn = np.isfinite(found.frac).any()
    if not good.any():
        return
    page.section("Masses and AGN" if with_agn else "Masses")
    figure, axes = new_figure(1, 2 if with_agn else 1, size=(WIDTH / 2, 3.6))
    rows = np.flatnonzero(good)[:: max(1, int(good.sum()) // _POINTS)]
    ax = axes[0, 0]
    z, mass = found.z[rows, 1], np.log10(found.mass[rows, 1])
    strong = found.frac[rows, 0] > _SOME_AGN
    ax.plot(
        z[~strong], mass[~strong], ".", ms=3, color="0.6" if with_agn else _COLOR, label="others"
    )
    if with_agn:
        label = f"84 % above fracAGN {_SOME_AGN:g}"
        ax.plot(z[strong], mass[strong], ".", ms=4, color=_SECOND, label=label)
        bins = np.linspace(0, 1, 26)
        axes[0, 1].hist(found.frac[good, 1], bins, color="0.75", label="posterior median")
        axes[0, 1].hist(
            found.frac[good, 0], bins, histtype="step", color=_COLOR, label="16th percentile"
        )
        axes[0, 1].set(xlabel="fracAGN", ylabel="objects", yscale="log")
        for one in axes[0]:
            one.legend(frameon=False, fontsize=8)
    low, high = np.percentile(mass, [0.5, 99.5])
    ax.set(xlabel="redshift", ylabel="log stellar mass (Msun)", ylim=(low - 0.5, high + 0.5))
    page.figure(
        figure, "Stellar masses (posterior medians)" + (" and AGN fractions." if with_agn else ".")
    )
    if with_agn:
        page.text(
            "A fraction above 0 is no detection of an AGN: see the guide, Is my AGN real? Without data beyond "
            "3 um at rest the fraction is what the prior makes it."
        )


def _examples(page, results, found):
    chosen = _choose(found)
    if not chosen:
        return
    page.section("Examples")
    filters = FilterSet(next(iter(results.parts())).filters)
    figure, axes = new_figure(-(-len(chosen) // 2), 2, size=(WIDTH / 2, 3.3))
    picked = results[np.array([row for row, _ in chosen])]
    for ax, (_, what), one in zip(axes.ravel(), chosen, picked, strict=False):
        one.plot_sed(ax, filters=filters)
        z = "" if found.fixed else f"z = {one.best['redshift'].value:.2f}, "
        title = f"{np.asarray(one.ids).item()}: {z}reduced chi2 {one.reduced_chi2:.2f} ({what})"
        ax.set_title(title, fontsize="small")
    for ax in axes.ravel()[len(chosen) :]:
        ax.remove()
    page.figure(
        figure,
        "Measured fluxes (points; open where they were not fitted), best model (line) and its fluxes (squares).",
    )


def _choose(found):
    """Rows to be shown, and why: spread over chi2, and the strongest AGN."""
    rows = np.flatnonzero(np.isfinite(found.chi2))
    if not rows.size:
        return []
    order = rows[np.argsort(found.chi2[rows], kind="stable")]
    places = {0.1: "a good fit", 0.5: "median chi2", 0.9: "worst tenth", 1.0: "the worst fit"}
    chosen = {}
    for place, what in places.items():
        chosen.setdefault(int(order[int(place * (order.size - 1))]), what)
    fraction = np.where(np.isfinite(found.frac[rows, 0]), found.frac[rows, 0], -1.0)
    if fraction.max() > _SOME_AGN:
        chosen.setdefault(int(rows[np.argmax(fraction)]), "surest AGN")
    if not found.fixed:
        high = np.where(found.flags[rows] == 0, found.z[rows, 0], -1.0)
        if high.max() > 0:
            chosen.setdefault(int(rows[np.argmax(high)]), "highest redshift without a flag")
    return list(chosen.items())[:_EXAMPLES]


def _left_out(page, rows, found):
    page.section(
        "What was left out",
        "Each row of the catalog is a row of the results, flagged if not fitted.",
    )
    lines = list(rows.told()) if isinstance(rows, MappedRows) else []
    unused = unused_bands(rows.chunk(0), list(found.filters))
    if unused:
        lines.append(
            f"bands that were not fitted, for want of a filter or of errors: {', '.join(unused)}"
        )
    empty = [name for name, ratio, _ in found.bands() if not ratio.size]
    if empty:
        lines.append(f"bands without a flux in any object: {', '.join(empty)}")
    bad = found.unusable.sum(axis=0)
    if bad.any():
        counts = ", ".join(f"{name} {n}" for name, n in zip(found.filters, bad, strict=True) if n)
        lines.append(
            f"fluxes with an error that is no error (0, negative or infinite): {counts}; where negative errors "
            "mark upper limits, 'limits = true' in the map of --map says so"
        )
    page.bullets(lines or ["No column and no number of the catalog."])
    counts = [("none", "", int(np.count_nonzero(found.flags == 0)))]
    for value, (name, meaning) in FitFlags.meanings().items():
        n = int(np.count_nonzero(found.flags & value))
        if n:
            fitted = "" if not value & int(FitFlags.UNFITTED) else " Not fitted."
            counts.append((f"{value} {name}", f"{meaning}{fitted}", n))
    page.table(counts, header=("flag", "meaning", "objects"), text=2)


def _settings(page, results):
    page.section("What was fitted")
    first = next(iter(results.parts()))
    settings = {name: v for name, v in first.meta.get("fit", {}).items() if name != "filters"}
    if results.model is not None:
        settings |= results.model.recipe
    rows = [(name, _plain(value)) for name, value in settings.items()]
    for name, axis in first.axes.items():
        values = np.asarray(axis.values)
        text = f"{values.size} from {values[0]:g} to {values[-1]:g} {u.Unit(axis.unit)}"
        rows.append((f"axis {name}", text.strip()))
    rows = [(name, text if len(text) < _LONG else f"{text[:_LONG]} ...") for name, text in rows]
    page.table(rows, header=("", ""), text=2)


def _plain(value):
    if isinstance(value, dict):
        different = set(map(str, value.values()))
        if len(different) == 1:
            return f"{different.pop()} in all bands"
        return ", ".join(f"{name} {v}" for name, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(map(str, value)) or "none"
    return str(value)
