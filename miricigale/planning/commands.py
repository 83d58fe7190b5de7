"""What `miricigale plan` does: the table of the CEERS exposures, and a plan with its files."""

import dataclasses
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.utils.files import make_folder, replacing
from miricigale.utils.folder import check_folder
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.outputs import check_outputs
from miricigale.utils.table_files import write_table


def plan_table(*, quick=False):
    """
    Return the CEERS exposures: time, filling of the well by the sky, limits (5 sigma, AB).

    Parameters
    ----------
    quick : bool, optional
        Whether of the quick exposures.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each band. Three limits of point sources: ``limit_etc``, the exposure time calculator's
        scaled by the root of the time; ``limit``, of these exposures by `~miricigale.depth.sensitivity`, as
        surveys in flight reach; ``limit_proposal``, of the survey's proposal.

    Examples
    --------
    >>> from miricigale.planning import plan_table  # doctest: +SKIP
    >>> table = plan_table(quick=True)["filter", "groups", "dithers", "time", "limit"]  # doctest: +SKIP
    >>> print(table[:2])  # doctest: +SKIP
    """
    from astropy.coordinates import SkyCoord

    from miricigale.depth import proposal_limit
    from miricigale.instrument import background_level, ceers_exposures, psf_fwhm
    from miricigale.planning import BandPlan
    from miricigale.planning.config import NoiseSection

    exposures = ceers_exposures(SkyCoord(0 * u.deg, 0 * u.deg), 0 * u.deg, quick=quick)
    noise = NoiseSection()
    rows = []
    for name in dict.fromkeys(e.filter for e in exposures):
        mine = [e for e in exposures if e.filter == name]
        row = BandPlan(mine[0], len(mine), background_level(name), noise).numbers()
        row["limit_proposal"] = np.round(proposal_limit(name), 2)
        rows.append(row | {"fwhm": psf_fwhm(name)})
    order = ["filter", "groups", "integrations", "dithers", "time", "sky_in_well"]
    order += ["limit_etc", "limit", "limit_proposal", "fwhm"]
    return QTable(rows)[order]


@takes_other_keywords
def depth_table(config):
    """
    Return the exposures of all bands of a plan: time, filling of the well by the sky, limits and saturation.

    Parameters
    ----------
    config : `~miricigale.planning.PlanConfig`
        The plan.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each band, with the columns of `plan_table` but ``limit_proposal``; ``background``, the sky; and
        ``saturation``, the AB magnitude at which a point source saturates.

    Examples
    --------
    >>> from miricigale.planning import depth_table, load_plan
    >>> exposures = {"bands": ["miri.f770w"], "time": [3600.0], "dithers": [4]}
    >>> table = depth_table(load_plan(None, overrides={"exposures": exposures}))
    >>> table["time"][0].round()
    <Quantity 3596. s>
    """
    from miricigale.instrument import psf_fwhm
    from miricigale.planning.planner import Planner

    planner = Planner(config)
    bands = config.exposures.bands
    rows = []
    for name, plan in planner.band_plans(planner.share(bands), bands).items():
        row = plan.numbers()
        row["saturation"] = np.round(plan.saturation, 2)
        rows.append(row | {"fwhm": psf_fwhm(name)})
    return QTable(rows)


@takes_other_keywords
def write_plan(config, folder, *, executor=None, overwrite=False, progress_bar=False):
    """
    Work out a plan and write it.

    Parameters
    ----------
    config : `~miricigale.planning.PlanConfig`
        The plan.
    folder : path-like
        Gets ``plan.html``, ``plan.toml``, ``comparison.ecsv``, ``areas.ecsv`` (with ``[survey] areas``),
        and ``bands-<n>.ecsv`` and ``sources-<n>.ecsv`` of each set of bands, in the order of the
        configuration (0: the existing ones); and ``plan-sources.html``, the sources one by one, with a folder.
    executor : `concurrent.futures.Executor`, optional
        Threads to fit with; the answer is the same.
    overwrite : bool, optional
        Whether files of these names are replaced.
    progress_bar : bool, optional
        Whether a progress bar is shown.

    Returns
    -------
    comparison : `~astropy.table.QTable`
        See `~miricigale.planning.comparison_table`.

    Raises
    ------
    ValueError
        If ``folder`` has files of these names and ``overwrite`` is False, or cannot be written to.

    Examples
    --------
    >>> from miricigale.planning import load_plan, write_plan  # doctest: +SKIP
    >>> write_plan(load_plan("plan.toml"), "plan")["plan", "time", "merit"]  # doctest: +SKIP
    """
    from miricigale.planning import Planner, area_table, comparison_table, write_page
    from miricigale.planning.page import answer

    folder = Path(folder)
    check_folder(folder)
    # those of a plan with fewer sets, too
    paths = [folder / "plan.html", folder / "plan.toml"]
    paths += [folder / "comparison.ecsv", folder / "areas.ecsv"]
    for pattern in ("bands-[0-9]*.ecsv", "sources-[0-9]*.ecsv"):
        paths += sorted(folder.glob(pattern))
    paths.append(folder / "plan-sources.html")
    # refused before the fits, which take minutes
    check_outputs(paths, "folder", overwrite=overwrite)
    planner = Planner(config, executor=executor)
    plans = planner.compare(progress_bar=progress_bar)
    comparison = comparison_table(planner, plans)
    comparison.meta |= {"answer": answer(planner, plans, comparison)}
    comparison.meta |= {"noise": dataclasses.asdict(config.noise)}
    areas = None
    if config.survey.areas:
        areas = area_table(planner, planner.divide())
    make_folder(folder)
    with replacing(folder / "plan.toml", overwrite=overwrite) as partial:
        partial.write_text(config.to_toml(), encoding="utf-8")
    tables = {"comparison": comparison}
    if areas is not None:
        tables["areas"] = areas
    for k, plan in enumerate(plans):
        tables[f"sources-{k}"] = plan.sources
        if plan.bands:
            tables[f"bands-{k}"] = plan.band_table()
    for name, table in tables.items():
        write_table(table, folder / f"{name}.ecsv", overwrite=overwrite)
    write_page(folder / "plan.html", planner, plans, comparison, areas, overwrite=overwrite)
    return comparison
