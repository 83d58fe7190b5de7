"""Comparison of plans: ranked for each hour, and depth against area."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.evaluation.estimates import weighted_share
from miricigale.planning.accuracy import sky_weights
from miricigale.utils.other_keywords import takes_other_keywords


def _row(planner, plan, numbers):
    """Return one row of both tables."""
    row = {"plan": plan.name, "time": plan.time.to(u.h), "area": plan.area}
    row["n"] = numbers["z_scatter"].n
    for name, number in numbers.items():
        row |= {name: number.value, f"{name}_err": number.error}
    # of all sources of the sample
    agn = np.asarray(plan.sources["frac_agn"]) >= planner.config.agn.limit
    detected = planner.common([plan])
    weight = sky_weights(plan.sources, planner.config.agn.limit)
    recovered = agn & detected & np.asarray(plan.sources["selected"], bool)
    scale = np.nan
    if plan.bands:
        scale = planner.density * plan.area.to_value(u.arcmin**2)
    for name, chosen in (("n_detected", detected), ("n_agn", recovered), ("n_agn_true", agn)):
        share = weighted_share(weight * chosen, weight)
        row |= {name: scale * share.value, f"{name}_err": scale * share.error}
    return row


def comparison_table(planner, plans):
    """
    Return the plans with MIRI, the best for each hour first, after the existing bands alone.

    All are compared on the same sources: those that one of them detects.

    Parameters
    ----------
    planner : `~miricigale.planning.Planner`
        That made them.
    plans : list of `~miricigale.planning.Plan`
        Of `Planner.compare`.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``plan``, ``time`` (h), ``area``, ``n`` (sources compared), the numbers of
        `~miricigale.planning.accuracy.accuracy` with their errors; expected in the area, with the binomial errors
        of the sample, ``n_detected`` (sources detected), ``n_agn`` (AGN detected and selected) and
        ``n_agn_true`` (all AGN); and ``merit``, by which the rows are ranked. Of ``[survey] rank = "agn"``
        that is ``n_agn`` times the purity for each hour; of ``"frac_agn"`` and ``"redshift"`` the inverse
        variance of the means that is gained over the existing bands, relative to these and for each hour:
        ((scatter without / scatter with)^2 - 1) / hours.

    Examples
    --------
    >>> from miricigale.planning import Planner, comparison_table  # doctest: +SKIP
    >>> planner = Planner()  # doctest: +SKIP
    >>> comparison_table(planner, planner.compare())["plan", "time", "merit"]  # doctest: +SKIP
    """
    chosen = planner.common(plans)
    rows = [_row(planner, plan, planner.accuracy(plan, chosen)) for plan in plans]
    rank = planner.config.survey.rank
    without = next((row for row, plan in zip(rows, plans, strict=True) if not plan.bands), None)
    for row in rows:
        hours = row["time"].to_value(u.h)
        row["merit"] = np.nan
        if hours > 0 and rank == "agn":
            row["merit"] = row["n_agn"] * row["purity"] / hours
        elif hours > 0 and without is not None:
            name = {"frac_agn": "frac_scatter", "redshift": "z_scatter"}[rank]
            row["merit"] = ((without[name] / row[name]) ** 2 - 1) / hours
    # those without a number last, the existing bands first
    order = sorted(
        range(len(rows)),
        key=lambda k: (bool(plans[k].bands), -np.nan_to_num(rows[k]["merit"], nan=-np.inf)),
    )
    table = QTable([rows[k] for k in order])
    table["merit"].info.description = f"for each hour, ranked by {rank}"
    return table


@takes_other_keywords
def area_table(planner, plans):
    """
    Return the depth against area.

    Parameters
    ----------
    planner : `~miricigale.planning.Planner`
        That made them.
    plans : list of `~miricigale.planning.Plan`
        Of `Planner.divide`.

    Returns
    -------
    table : `~astropy.table.QTable`
        As `comparison_table`, with ``pointings`` for the name and without a merit; the numbers are of the
        sources that each plan detects itself.

    Examples
    --------
    >>> from miricigale.planning import Planner, area_table, load_plan  # doctest: +SKIP
    >>> planner = Planner(load_plan(overrides={"survey": {"areas": [1, 4]}}))  # doctest: +SKIP
    >>> area_table(planner, planner.divide())["pointings", "area", "n_agn"]  # doctest: +SKIP
    """
    rows = []
    for plan in plans:
        row = _row(planner, plan, planner.accuracy(plan))
        rows.append({"pointings": int(row.pop("plan"))} | row)
    return QTable(rows)
