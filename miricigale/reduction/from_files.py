"""Files of exposures at any stage to mosaics of each filter, with a page of pictures."""

import dataclasses
import json
import logging
import os
from pathlib import Path

import numpy as np
from astropy.table import Table

from miricigale.detector import Ramp
from miricigale.instrument import ImageFacts
from miricigale.pages import Page, SectionWriter
from miricigale.plotting.axes import WIDTH, new_figure
from miricigale.plotting.images import plot_image
from miricigale.reduction import Reducer, ReferenceFiles, read_images, write_image
from miricigale.reduction.background import known_background
from miricigale.reduction.files import open_file, scaled_planes
from miricigale.utils.content import content_sha256, file_sha256
from miricigale.utils.declared import declared
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.options import check_that
from miricigale.utils.progress import progress
from miricigale.utils.units import ANGLE, RATE, SURFACE_BRIGHTNESS, to_array

log = logging.getLogger(__name__)

#: Changes with what the products hold.
_VERSION = 7

#: Errors of a bad file; the other files are reduced all the same.
_ERRORS = (ArithmeticError, ImportError, KeyError, MemoryError, OSError, ValueError)


def reduce_files(
    paths,
    folder,
    *,
    reducer=None,
    pixel_scale=0.11 * ANGLE,
    integrations=False,
    align=None,
    resume=True,
    progress_bar=False,
):
    """
    Reduce files of exposures to a mosaic of each filter.

    Parameters
    ----------
    paths : iterable of path-like
        Files of the MIRI imager at any stage: ``_uncal``, ``_ramp``, ``_rate``, ``_rateints``, ``_cal``,
        ``_i2d``.
    folder : path-like
        Gets ``<name>_rate.fits`` (with VAR_POISSON and VAR_RNOISE) and ``<name>_cal.fits`` of each
        exposure (background subtracted, it is in the extension BKG), ``mosaic_<filter>.fits`` (SCI,
        ERR, DQ, WHT, CON, BKG), ``files.ecsv`` and ``index.html``.
    reducer : `~miricigale.reduction.Reducer`, optional
        Settings, references among them.
    pixel_scale : `~astropy.units.Quantity`, optional
        Of the mosaics.
    integrations : bool, optional
        Whether ramps of several integrations give a ``<name>_rateints.fits`` too, with the
        slopes of each.
    align : optional
        As of `~miricigale.reduction.Reducer.run`.
    resume : bool, optional
        Whether products of the same files and settings that are there are kept.
    progress_bar : bool, optional
        Whether a progress bar is shown.

    Returns
    -------
    files : `~astropy.table.Table`
        A row for each file: ``file``, ``filter``, ``status`` (reduced, rate, kept or failed) and
        ``reason``, why a file failed or has no brightness. A file that fails never loses the
        others, and a filter whose mosaic fails is a row too.

    Raises
    ------
    ValueError
        If there are no paths, or two files have one name.

    Examples
    --------
    >>> from pathlib import Path
    >>> from miricigale.reduction import ReferenceCache, Reducer, reduce_files
    >>> reducer = Reducer(references=ReferenceCache("/data/crds"))  # doctest: +SKIP
    >>> files = sorted(Path().glob("*_uncal.fits"))
    >>> table = reduce_files(files, "reduced", reducer=reducer)  # doctest: +SKIP
    """
    paths = [Path(path) for path in paths]
    reducer = Reducer() if reducer is None else reducer
    to_array(pixel_scale, ANGLE, "pixel_scale", ndim=0, finite=True)
    check_that(paths, "paths", "at least one file", "none")
    stems = [_stem(path) for path in paths]
    twice = sorted({stem for stem in stems if stems.count(stem) > 1})
    check_that(not twice, "paths", "files of different names", f"two of {', '.join(twice)}")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    settings = _settings(reducer)
    rows, done = [], {}
    for path, stem in zip(progress(paths, show=progress_bar, desc="reduce"), stems, strict=True):
        row = {"file": str(path), "filter": "", "status": "failed", "reason": ""}
        rows.append(row)
        try:
            key = content_sha256([_VERSION, file_sha256(path), settings, integrations])
            cal, status, reason = _exposure(reducer, path, folder / stem, key, resume, integrations)
            row |= {"status": status, "reason": reason}
            if cal is not None:
                row["filter"] = ImageFacts.of(read_images(cal)[0].image).filter or ""
                done.setdefault(row["filter"], []).append((cal, key))
        except _ERRORS as err:
            row["reason"] = _reason(err)
            log.warning("%s is left out: %s", path, row["reason"])
    page = SectionWriter(
        Page("Reduction", subtitle=f"{len(paths)} files"), declared("miricigale.reduction")
    )
    for name, members in sorted(done.items()):
        row = {"file": f"mosaic_{name.rpartition('.')[2]}.fits", "filter": name}
        rows.append(row | {"status": "failed", "reason": ""})
        try:
            scale = pixel_scale.to_value(ANGLE)
            options = {"pixel_scale": scale * ANGLE, "align": align}
            path = folder / row["file"]
            status, notes = _mosaic(reducer, members, path, options, settings, resume)
            rows[-1] |= {"status": status, "reason": "; ".join(notes)}
            _show(page, path, members, notes)
        except _ERRORS as err:
            rows[-1]["reason"] = _reason(err)
            log.warning("no mosaic of %s: %s", name, rows[-1]["reason"])
    table = Table(rows=[list(row.values()) for row in rows], names=list(rows[0]))
    table.write(folder / "files.ecsv", overwrite=True)
    _list(page, table)
    page.report.write(folder / "index.html")
    return table


def _stem(path):
    """Name of a file without its suffix of the stage."""
    stem = path.name.removesuffix(".gz").removesuffix(".fits")
    head, _, stage = stem.rpartition("_")
    known = ("uncal", "ramp", "rate", "rateints", "cal", "calints", "i2d", "crf")
    return head if head and stage in known else stem


def _reason(err):
    text = str(err.args[0]) if isinstance(err, KeyError) and err.args else str(err)
    return " ".join(text.split()) or type(err).__name__


def _settings(reducer):
    """What the products depend on: settings, and which state the reference files have."""
    values = {
        field.name: repr(getattr(reducer, field.name))
        for field in dataclasses.fields(reducer)
        if field.name != "n_threads"
    }
    if isinstance(reducer.references, ReferenceFiles):
        for name in reducer.references.names():
            if isinstance(path := getattr(reducer.references, name), Path):
                state = os.stat(path)
                values[f"reference {name}"] = [state.st_size, state.st_mtime_ns]
    return values


def _kept(path, key, resume):
    """Whether a product of this key is there."""
    if not (resume and path.is_file()):
        return False
    try:
        return read_images(path)[0].image.meta.get("key") == key
    except DataError:
        return False


def _exposure(reducer, path, stem, key, resume, integrations):
    """Reduce one file: its calibrated product (None without), what was done, and why not more."""
    cal, rate = (stem.with_name(f"{stem.name}_{kind}.fits") for kind in ("cal", "rate"))
    if cal.resolve() == path.resolve() or rate.resolve() == path.resolve():
        raise argument_error("folder", "another one than that of the files", stem.parent)
    if _kept(cal, key, resume):
        return cal, "kept", ""
    slopes_only = "no photometry without references"
    if reducer.references == "none" and _kept(rate, key, resume):
        return None, "kept", slopes_only
    exposure = open_file(path)
    if isinstance(exposure, Ramp):
        if integrations and exposure.shape[0] > 1:
            parts = reducer.fit_integrations(exposure, planes=True)
            write_image(parts, stem.with_name(f"{stem.name}_rateints.fits"), overwrite=True)
        exposure = reducer.fit_ramp(exposure, planes=True)
    exposure, planes = exposure.image, exposure.planes
    if reducer.references == "none" and not exposure.unit.is_equivalent(SURFACE_BRIGHTNESS):
        _write(exposure, rate, key, **planes)
        return None, "rate", slopes_only
    if exposure.unit.is_equivalent(RATE):
        # there to stay where the brightness cannot be had
        _write(exposure, rate, key, **planes)
    _, image, background = reducer.reduce(exposure)
    planes = scaled_planes(planes, exposure, image)
    _write(image, cal, key, **planes, BKG=background.level)
    return cal, "reduced", ""


def _write(image, path, key, **planes):
    image.meta["key"] = key
    write_image(image, path, planes=planes, overwrite=True)


def _mosaic(reducer, members, path, options, settings, resume):
    """Make the mosaic of a filter: what was done, and what could not be."""
    key = content_sha256([_VERSION, [key for _, key in members], repr(options), settings])
    if _kept(path, key, resume):
        return "kept", json.loads(read_images(path)[0].header["META"]).get("notes", [])
    files = [read_images(cal)[0] for cal, _ in members]
    images = [file.image for file in files]
    mesh = {name: reducer.background.mesh[name] for name in ("box", "filter_size")}
    levels = [known_background(file.planes["BKG"]) for file in files]
    backgrounds = [dataclasses.replace(level, **mesh) for level in levels]
    planes = [file.planes for file in files]
    result = reducer.combine(images, backgrounds, planes=planes, **options)
    result.mosaic.meta["key"] = key
    result.write(path, overwrite=True)
    return "reduced", list(result.notes)


def _show(page, path, members, notes):
    """Put the mosaic and its exposures on the page."""
    file = read_images(path)[0]
    image, meta = file.image, file.image.meta
    band = meta["filter"].rpartition(".")[2].upper()
    page.section("mosaic", band=band, notes=" ".join(f"{note}." for note in notes))
    good = ~image.mask
    values = {
        "n": len(members),
        "exposure_time": meta.get("exposure_time"),
        "error": np.median(image.uncertainty.array[good]) if good.any() else np.nan,
        "background": _levels(members),
    }
    page.items(values)
    page.text("references", references=_references(meta))
    ny, nx = image.shape
    _, axes = new_figure(1, 2, size=(WIDTH / 2, max(2.5, min(6.0, WIDTH / 2 * ny / nx))))
    scale = meta["pixel_scale"]
    data = np.where(image.mask, np.nan, image.data)
    plot_image(data, ax=axes[0, 0], pixel_scale=scale, colorbar="MJy/sr", title=path.name)
    options = {"stretch": "linear", "limits": (0, len(members)), "colorbar": "exposures"}
    count = np.squeeze(file.planes["CON"]).astype(float)
    title = "exposures of each pixel"
    plot_image(count, ax=axes[0, 1], pixel_scale=scale, title=title, **options)
    page.figure("figure", axes[0, 0].figure, file=path.name)


def _levels(members):
    metas = [read_images(cal)[0].image.meta for cal, _ in members]
    known = [
        f"{meta['background']:.4g} ± {meta.get('background_error', np.nan):.1g} "
        + " ".join(meta.get("background_flags", []))
        for meta in metas
        if "background" in meta
    ]
    return ", ".join(map(str.strip, known)) + " MJy/sr" if known else "not known"


def _references(meta):
    """The references that all exposures share."""
    found = {
        key.removeprefix("reference_"): text
        for key, text in meta.items()
        if key.startswith("reference_")
    }
    return "; ".join(f"{name}: {text}" for name, text in found.items()) or "differ, or not known"


def _list(page, table):
    """Put the table of the files on the page."""
    page.section("files")
    failed = np.count_nonzero(table["status"] == "failed")
    rows = [dict(zip(row.colnames, map(str, row.values()), strict=True)) for row in table]
    page.table("table", rows, failed=f"{failed} failed." if failed else "")
