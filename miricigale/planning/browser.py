"""The simulated sources of a plan one by one: true and mock fluxes, and what the sets of bands find."""

from pathlib import Path

import numpy as np

from miricigale.filters import Filter
from miricigale.filters.band_names import band_label
from miricigale.pages.browser import (
    band_entries,
    list_column,
    pages_beside,
    parameter_entries,
    rounded,
)
from miricigale.plotting.axes import MEASURED, SECOND
from miricigale.utils.missing_values import floats
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU

#: Largest number of sources of the page.
MAX_SOURCES = 5000
#: Parameters of the fits of a plan, what they are called, and their digits in the list.
_PARAMETERS = {"redshift": ("redshift", 3), "frac_agn": ("fracAGN", 2)}
_COLORS = ("#6b7280", SECOND, MEASURED)


def write_browser(path, title, planner, plans):
    """
    Write the page of the simulated sources of a plan.

    Parameters
    ----------
    path : path-like
        Page of the plan. This one is beside it, ``plan-sources.html`` of ``plan.html``, with a folder of files.
    title : str
        Of the page.
    planner : `~miricigale.planning.Planner`
        That made the plans.
    plans : list of `~miricigale.planning.Plan`
        Up to three to compare, the last with the mock fluxes that are shown.

    Returns
    -------
    name : str
        Of the file.
    """
    path = Path(path)
    name = f"{path.stem}-sources"
    sources = planner.sources[:MAX_SOURCES]
    photometry = planner.photometry(plans[-1].bands.values())[:MAX_SOURCES]
    fitted = [*planner.config.fit.bands, *plans[-1].bands]
    pivots = {band: float(Filter.from_name(band).pivot.value) for band in fitted}
    bands = sorted(fitted, key=pivots.get)
    true = np.transpose([sources[band].to_value(FNU) for band in bands])
    flux = np.transpose([photometry[band].to_value(FNU) for band in bands])
    error = np.transpose([photometry[error_column(band)].to_value(FNU) for band in bands])
    sets = []
    for plan, color in zip(plans, _COLORS, strict=False):
        sets.append({"name": plan.name, "label": plan.name, "color": color})
    waves = [pivots[band] for band in bands]
    facts = _list(planner, sources, plans) | {
        "heading": [["redshift", "true z", 3], ["frac_agn", "true fracAGN", 2]],
        "flags": {},
        "flag_columns": [],
        "bands": band_entries(bands, map(band_label, bands), waves, miri=plans[-1].bands),
        "sets": sets,
        "wave": rounded([0.7 * min(waves), 1.4 * max(waves)]),
        "parameters": parameter_entries(dict.fromkeys(_PARAMETERS, "")),
        "notes": {
            "spectrum": f"Mock fluxes are of the set {plans[-1].name}. Arrows: three times the error, where the "
            "flux is below its error."
        },
    }

    def details(row):
        fits = {}
        for plan in plans:
            values = plan.sources[row]
            moments = [[values[f"{key}_mean"], values[f"{key}_std"]] for key in _PARAMETERS]
            fits[plan.name] = {"moments": rounded(moments)}
        return {
            "true": rounded(true[row]),
            "flux": rounded(flux[row]),
            "error": rounded(error[row], 3),
            "fits": fits,
            "parameters": rounded([sources[key][row] for key in _PARAMETERS]),
        }

    order = np.arange(len(sources))
    no_pictures = np.zeros(len(sources), bool)
    return pages_beside(path, name, title, facts, order, no_pictures, details)


def _list(planner, sources, plans):
    """Return the list of sources: numbers by column, the columns, and what can be chosen."""
    table = {"id": np.asarray(sources["id"])}
    columns = [list_column("id", "id", "id of the sample")]
    shows = {"all": ["all sources", None]}
    for key, (group, digits) in _PARAMETERS.items():
        options = {"group": group, "digits": digits}
        table[key] = np.asarray(sources[key], float)
        columns.append(list_column(key, "true", "of the simulated source", **options))
        for k, plan in enumerate(plans):
            table[f"{key}_{k}"] = floats(plan.sources[f"{key}_mean"])[:MAX_SOURCES]
            columns.append(list_column(f"{key}_{k}", plan.name, "mean of the posterior", **options))
    title = f"posterior probability of a fracAGN of at least {planner.config.agn.limit:g}"
    is_agn = np.asarray(sources["frac_agn"]) >= planner.config.agn.limit
    for k, plan in enumerate(plans):
        rows = plan.sources[:MAX_SOURCES]
        table[f"agn_{k}"] = floats(rows["agn_probability"])
        columns.append(list_column(f"agn_{k}", plan.name, title, group="P(AGN)", digits=2))
        selected = np.asarray(rows["selected"], bool)
        table[f"found_{k}"] = is_agn & selected
        table[f"missed_{k}"] = is_agn & ~selected
        table[f"wrong_{k}"] = selected & ~is_agn
        shows[f"found_{k}"] = [f"AGN that {plan.name} select", f"found_{k}"]
        shows[f"missed_{k}"] = [f"AGN that {plan.name} miss", f"missed_{k}"]
        shows[f"wrong_{k}"] = [f"galaxies that {plan.name} select as AGN", f"wrong_{k}"]
    for k, plan in enumerate(plans):
        if plan.bands:
            table[f"n_{k}"] = np.asarray(plan.sources["n_detected"])[:MAX_SOURCES]
            title = "MIRI bands above 5 sigma"
            columns.append(list_column(f"n_{k}", plan.name, title, group="detected in"))
    table = {key: rounded(values) for key, values in table.items()}
    return {"table": table, "columns": columns, "shows": shows}
