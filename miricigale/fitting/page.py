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
from miricigale.fitting.page_numbers import fit_numbers, known_redshifts
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
    "beyond 3 sigma": ".1f %",
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
    job = results.job
    names = {"catalog_map": catalog_map, "flux_unit": job["catalogue"]["flux_unit"]}
    rows = open_catalog(path, job["chunk_rows"], hdu=hdu, **names)
    found = every = fit_numbers(results)
    found.meta["known"], found["z_known"] = known_redshifts(rows, z_spec)
    columns = classes_of(classes) if len(classes) > 1 else None
    if columns is not None:
        # fits of stars and quasars with galaxies say nothing about the fit
        found = found[np.isin(columns["class"], ["galaxy", ""])]
    page = Page(
        f"Fits of {Path(path).name}",
        subtitle=f"{len(results)} objects, {len(found.meta['filters'])} bands",
        notices=_notices(found),
    )
    page.section("Summary")
    if columns is not None:
        others = " or ".join(list(classes)[1:])
        page.text(
            f"{len(found)} of {len(results)} objects are no {others} by their evidence. All but the "
            "examples and what was left out is of these."
        )
    _summary(page, found)
    if columns is not None:
        classes_section(page, columns, list(classes), every["ids"], every["chi2"])
    _redshifts(page, found)
    _goodness(page, found)
    _physics(page, found)
    _examples(page, results, every)
    _left_out(page, rows, every)
    _settings(page, results)
    return page


def _bands(found):
    """Iterate over bands: name, and finite flux ratios and pulls of all objects."""
    columns = (found.meta["filters"], found["ratio"].T, found["pull"].T)
    for name, ratio, pull in zip(*columns, strict=True):
        yield name, ratio[np.isfinite(ratio)].astype(float), pull[np.isfinite(pull)]


def _notices(found):
    if len(found) and not found["good"].any():
        return ["No object was fitted; the flags below say why."]
    lines, flags = [], found["flags"][found["good"]]
    for flag, text in _WIDESPREAD.items():
        share = _mean(flags & int(flag) != 0)
        if share > 0.1:
            lines.append(f"{100 * share:.0f} % of the objects {text}")
    for name, ratio, _ in _bands(found):
        if ratio.size >= 30 and not 0.8 < np.median(ratio) < 1.25:
            lines.append(
                f"{name}: fluxes are {np.median(ratio):.2f} times those of the best models in the median of "
                f"{ratio.size} objects: look at its zero point and unit."
            )
    return lines


def _summary(page, found):
    good, none = found[found["good"]], "no object was fitted"
    numbers = [
        ("bands of an object, median", _median(good["n_bands"]), ".0f"),
        ("reduced chi2, median", _median(good["chi2"]), ".2f"),
    ]
    if not found.meta["fixed"]:
        low, z, high = good["z"].T
        width = _median((high - low) / 2 / (1 + z))
        numbers += [
            ("redshift, median", _median(z), ".2f"),
            ("half width of z over 1 + z, median", width, ".3f"),
        ]
    if np.isfinite(found["frac"]).any():
        label = f"with 84 % of the posterior above fracAGN {_SOME_AGN:g}"
        numbers.append((label, _mean(good["frac"][:, 0] > _SOME_AGN), ".0f %"))
    page.items(
        [
            ("objects", len(found)),
            ("fitted", len(good)),
            ("without any flag", int(np.count_nonzero(good["flags"] == 0))),
            *((label, number(value, spec, none)) for label, value, spec in numbers),
        ]
    )


def _median(values):
    values = values[np.isfinite(values)]
    return np.median(values) if len(values) else np.nan


def _mean(values):
    return np.mean(values) if len(values) else np.nan


def _draw_counts(ax, xlabel, bins, samples):
    """Draw histograms of samples by label, the first filled, the others as outlines."""
    for k, (label, values) in enumerate(samples.items()):
        style = {"histtype": "step", "color": _COLOR} if k else {"color": "0.75"}
        ax.hist(values, bins, label=label, **style)
    if len(samples) > 1:
        ax.legend(frameon=False, fontsize=8)
    ax.set(xlabel=xlabel, ylabel="objects")


def _redshifts(page, found):
    if found.meta["fixed"]:
        page.section("Redshifts", "Redshifts were given; they were not fitted.")
        return
    page.section("Redshifts")
    samples, text = {"fitted": found["z"][found["good"], 1]}, "Fitted redshifts (posterior medians)"
    some, name = found["good"] & np.isfinite(found["z_known"]), found.meta["known"]
    figure, axes = new_figure(1, 1 + some.any(), size=(WIDTH / 2, 4.2))
    if some.any():
        z, (low, middle, high) = found["z_known"][some], found["z"][some].T
        metrics = photoz_metrics(z, middle)
        inside = np.mean((low <= z) & (z <= high))
        page.items(
            [
                (f"objects with {name}", len(z)),
                ("bias, median of dz / (1 + z)", f"{metrics.bias:+.3f}"),
                ("sigma_MAD of dz / (1 + z)", f"{metrics.sigma_mad:.3f}"),
                ("outliers, above 0.15", f"{100 * metrics.outlier_fraction:.1f} %"),
                ("in their 16-84 % interval (68 % wanted)", f"{100 * inside:.0f} %"),
            ]
        )
        step = _step(len(z))
        plot_redshifts(z[::step], middle[::step], ax=axes[0, 0])
        axes[0, 0].set(xlabel=name, ylabel="fitted redshift (median)")
        samples[name] = z
        text += f" against {name}; dashed lines are |dz| = 0.15 (1 + z)"
    bins = np.histogram_bin_edges(np.concatenate(list(samples.values())), 40)
    _draw_counts(axes[0, -1], "redshift", bins, samples)
    page.figure(figure, f"{text}.")


def _step(n):
    """Every so many of n points are drawn."""
    return max(1, n // _POINTS)


def _goodness(page, found):
    page.section(
        "How well models fit",
        "Reduced chi2 is that of the best model over bands less one, with the model error in the errors. "
        "A median ratio far from 1 in one band indicates a wrong zero point, unit or curve.",
    )
    figure, ((ax, of_bands),) = new_figure(1, 2, size=(WIDTH / 2, 3.6))
    chi2, bins = found["chi2"][found["good"]], np.geomspace(1e-2, 1e3, 51)
    label = "reduced chi2 (those beyond in the outermost bins)"
    _draw_counts(ax, label, bins, {"": np.clip(chi2, 1e-2, 1e3)})
    ax.set(xscale="log")
    if len(chi2):
        ax.axvline(np.median(chi2), color=_COLOR, lw=1, label="median")
        ax.legend(frameon=False)
    rows, none = [], "no flux was fitted"
    bands = sorted(_bands(found), key=lambda band: _pivot(band[0]))
    for k, (name, ratio, pull) in enumerate(bands):
        low, mid, high = np.percentile(ratio, [16, 50, 84]) if ratio.size else [np.nan] * 3
        if ratio.size >= _FEW:
            limits = [[mid - low], [high - mid]]
            of_bands.errorbar(k, mid, limits, fmt="o", color=_COLOR, ms=4, lw=1)
        values = (mid, low, high, _median(pull), _mean(np.abs(pull) > 3))
        texts = [number(v, spec, none) for v, spec in zip(values, _RATIOS.values(), strict=True)]
        rows.append((name, f"{_pivot(name):.3g}", ratio.size, *texts))
    of_bands.axhline(1.0, color="0.6", lw=0.8)
    of_bands.set_xticks(range(len(bands)), [name for name, *_ in bands], rotation=90, fontsize=7)
    of_bands.set(ylabel="flux over that of the best model", ylim=(0.4, 1.8))
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
    found = found[found["good"] & (found["mass"][:, 1] > 0)]
    with_agn = np.isfinite(found["frac"]).any()
    if not len(found):
        return
    page.section("Masses and AGN" if with_agn else "Masses")
    figure, axes = new_figure(1, 1 + with_agn, size=(WIDTH / 2, 3.6))
    drawn, ax = found[:: _step(len(found))], axes[0, 0]
    mass, strong = np.log10(drawn["mass"][:, 1]), drawn["frac"][:, 0] > _SOME_AGN
    groups = {"others": (~strong, "0.6" if with_agn else _COLOR)}
    groups |= {f"84 % above fracAGN {_SOME_AGN:g}": (strong, _SECOND)} if with_agn else {}
    for label, (rows, color) in groups.items():
        ax.plot(drawn["z"][rows, 1], mass[rows], ".", ms=4, color=color, label=label)
    low, high = np.percentile(mass, [0.5, 99.5])
    ax.set(xlabel="redshift", ylabel="log stellar mass (Msun)", ylim=(low - 0.5, high + 0.5))
    text = "Stellar masses (posterior medians)"
    if with_agn:
        ax.legend(frameon=False, fontsize=8)
        samples = {"posterior median": found["frac"][:, 1], "16th percentile": found["frac"][:, 0]}
        _draw_counts(axes[0, 1], "fracAGN", np.linspace(0, 1, 26), samples)
        axes[0, 1].set(yscale="log")
        text += " and AGN fractions"
    page.figure(figure, f"{text}.")
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
        z = "" if found.meta["fixed"] else f"z = {one.best['redshift'].value:.2f}, "
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
    rows = np.flatnonzero(found["good"])
    if not rows.size:
        return []
    some = found[rows]
    order = rows[np.argsort(some["chi2"], kind="stable")]
    places = {0.1: "a good fit", 0.5: "median chi2", 0.9: "worst tenth", 1.0: "the worst fit"}
    chosen = {}
    for place, what in places.items():
        chosen.setdefault(int(order[int(place * (order.size - 1))]), what)
    fraction = np.nan_to_num(some["frac"][:, 0], nan=-1.0)
    if fraction.max() > _SOME_AGN:
        chosen.setdefault(int(rows[np.argmax(fraction)]), "surest AGN")
    high = np.where(some["flags"] == 0, some["z"][:, 0], -1.0)
    if high.max() > 0 and not found.meta["fixed"]:
        chosen.setdefault(int(rows[np.argmax(high)]), "highest redshift without a flag")
    return list(chosen.items())[:_EXAMPLES]


def _left_out(page, rows, found):
    page.section(
        "What was left out",
        "Each row of the catalog is a row of the results, flagged if not fitted.",
    )
    filters, bad = found.meta["filters"], found["unusable"].sum(axis=0)
    counts = [f"{name} {n}" for name, n in zip(filters, bad, strict=True) if n]
    lines = {
        "bands that were not fitted, for want of a filter or of errors: {}": unused_bands(
            rows.chunk(0), list(filters)
        ),
        "bands without a flux in any object: {}": [
            name for name, ratio, _ in _bands(found) if not ratio.size
        ],
        "fluxes with an error that is no error (0, negative or infinite): {}; where negative errors "
        "mark upper limits, 'limits = true' in the map of --map says so": counts,
    }
    entries = list(rows.messages()) if isinstance(rows, MappedRows) else []
    entries += [line.format(", ".join(names)) for line, names in lines.items() if names]
    page.bullets(entries or ["No column and no number of the catalog."])
    counts = [("none", "", int(np.count_nonzero(found["flags"] == 0)))]
    for value, (name, meaning) in FitFlags.meanings().items():
        n = int(np.count_nonzero(found["flags"] & value))
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
    rows = {name: _plain(value) for name, value in settings.items()}
    for name, axis in first.axes.items():
        ends = f"from {axis.values[0]:g} to {axis.values[-1]:g} {u.Unit(axis.unit)}"
        rows[f"axis {name}"] = f"{axis.values.size} {ends}".strip()
    shorten = {name: f"{text[:_LONG]} ..." for name, text in rows.items() if len(text) >= _LONG}
    page.table((rows | shorten).items(), header=("", ""), text=2)


def _plain(value):
    if isinstance(value, dict):
        different = set(map(str, value.values()))
        if len(different) == 1:
            return f"{different.pop()} in all bands"
        return ", ".join(f"{name} {v}" for name, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(map(str, value)) or "none"
    return str(value)
