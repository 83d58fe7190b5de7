"""Files of exposures at any stage to mosaics of each filter, with a page of pictures."""

import dataclasses
import json
import logging
from pathlib import Path

import numpy as np
from astropy.table import Table

from miricigale.detector import Ramp
from miricigale.filters.band_names import band_label
from miricigale.instrument import ImageFacts
from miricigale.pages import Page, SectionWriter
from miricigale.plotting.axes import WIDTH, new_figure, plain_text
from miricigale.plotting.images import plot_image
from miricigale.reduction import Reducer, ReferenceFiles, read_images, write_image
from miricigale.reduction.commands.product_folder import ProductFolder
from miricigale.reduction.images.files import open_file, scaled_planes
from miricigale.reduction.images.repeats import ExposureRecord
from miricigale.reduction.sky.background import known_background
from miricigale.utils.content_hash import content_sha256, file_sha256
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import open_fits
from miricigale.utils.named_values import field_values, subset, without
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import declared
from miricigale.utils.progress import progress
from miricigale.utils.table_files import write_table
from miricigale.utils.units import RATE, SURFACE_BRIGHTNESS
from miricigale.utils.values import value_class

log = logging.getLogger(__name__)

#: Changes with what the products hold.
_VERSION = 8

#: Errors of a bad file; the other files are reduced all the same.
_ERRORS = (ArithmeticError, ImportError, KeyError, MemoryError, OSError, ValueError)


@takes_other_keywords
def reduce_files(
    paths,
    folder,
    *,
    reducer=None,
    pixel_scale=None,
    integrations=False,
    align=None,
    resume=True,
    overwrite=False,
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
        ERR, DQ, WHT, CON, BKG), ``files.ecsv``, ``index.html`` and ``reduce.json``, the checksums of these. One
        reduction at a time uses a folder.
    reducer : `~miricigale.reduction.Reducer`, optional
        Settings, references among them.
    pixel_scale : `~astropy.units.Quantity`, optional
        Of the mosaics; that of the reducer by default.
    integrations : bool, optional
        Whether ramps of several integrations give a ``<name>_rateints.fits`` too, with the
        slopes of each.
    align : optional
        As of `~miricigale.reduction.Reducer.run`.
    resume : bool, optional
        Whether products of the same files and settings that are there are kept, if their content is that which
        was written. Others that a reduction wrote here are made again.
    overwrite : bool, optional
        Whether files are replaced that no reduction wrote here, or that were edited since.
    progress_bar : bool, optional
        Whether a progress bar is shown.

    Returns
    -------
    files : `~astropy.table.Table`
        A row for each file: ``file``, ``filter``, ``status`` (reduced, rate, kept or failed) and
        ``reason``, why a file failed or has no brightness. A file that fails never loses the
        others, and a filter whose mosaic fails is a row too. An exposure that is there twice (a copy, or a ramp
        and its slopes) is left out the second time.

    Raises
    ------
    ValueError
        If there are no paths, two files have one name, or ``folder`` has files of others, or edited ones, that
        would be replaced and ``overwrite`` is False.
    `~miricigale.utils.exceptions.DataError`
        If another reduction uses the folder.

    Examples
    --------
    >>> from pathlib import Path
    >>> from miricigale.reduction import ReferenceCache, Reducer, reduce_files
    >>> reducer = Reducer(references=ReferenceCache("/data/crds"))  # doctest: +SKIP
    >>> files = sorted(Path().glob("*_uncal.fits"))
    >>> table = reduce_files(files, "reduced", reducer=reducer)  # doctest: +SKIP
    """
    paths = [Path(path) for path in paths]
    if reducer is None:
        reducer = Reducer()
    pixel_scale = reducer.mosaic_scale(pixel_scale)
    check_that(paths, "paths", "at least one file", "none")
    stems = [_stem(path) for path in paths]
    twice = sorted({stem for stem in stems if stems.count(stem) > 1})
    check_that(not twice, "paths", "files of different names", f"two of {', '.join(twice)}")
    with ProductFolder(folder, overwrite=overwrite) as products:
        names = [name for path in paths for name in _product_names(path, integrations)]
        inputs = {path.resolve() for path in paths}
        if any((products.folder / name).resolve() in inputs for name in names):
            raise argument_error("folder", "another one than that of the files", folder)
        products.check_replaceable(list(names) + [_TABLE, _PAGE])
        reduction = _Reduction(reducer, products, _settings(reducer), resume, integrations)
        rows = []
        members = {}
        record = ExposureRecord()
        for path in progress(paths, show=progress_bar, desc="reduce"):
            duplicate = record.add_file(path)
            if duplicate is not None:
                reason = f"the same exposure as {duplicate}"
                log.warning("%s is left out: %s", path, reason)
                rows.append(_failed(path, reason=reason))
                continue
            row, cal, key = reduction.reduce(path)
            rows.append(row)
            if cal is not None:
                members.setdefault(row["filter"], []).append((cal, key))
        page = SectionWriter(
            Page("Reduction", subtitle=f"{len(paths)} files"), declared("miricigale.reduction")
        )
        options = {"pixel_scale": pixel_scale, "align": align}
        for name in sorted(members):
            rows.append(reduction.combine(name, members[name], options, page))
        table = Table(rows=rows)
        products.write(_TABLE, "", lambda path: write_table(table, path, overwrite=True))
        _list(page, table)
        products.write(_PAGE, "", lambda path: page.report.write(path, overwrite=True))
    return table


#: Names of the table of the files, and of the page.
_TABLE = "files.ecsv"
_PAGE = "index.html"
#: Stages of files that are calibrated.
_CALIBRATED = ("cal", "calints", "i2d", "crf")
_STAGES = ("uncal", "ramp", "rate", "rateints") + _CALIBRATED


def _name_parts(path):
    """Name of a file without its suffix of the stage, and the stage; an empty one if the name has none."""
    stem = path.name.removesuffix(".gz").removesuffix(".fits")
    head, _, stage = stem.rpartition("_")
    if head and stage in _STAGES:
        return (head, stage)
    return (stem, "")


def _stem(path):
    """Name of a file without its suffix of the stage."""
    return _name_parts(path)[0]


def _product_names(path, integrations):
    """Return the names of the products of a file, as far as its name and its header tell."""
    stem, stage = _name_parts(path)
    kinds = ["cal"]
    if stage not in _CALIBRATED:
        # also of a rate, whose copy has our keywords
        kinds.append("rate")
        kinds += ["rateints"] * integrations
    names = [f"{stem}_{kind}.fits" for kind in kinds]
    try:
        with open_fits(path, wanted="an exposure") as hdus:
            band = hdus[0].header.get("FILTER")
    except OSError:
        # what is wrong is said when the file is reduced
        return names
    if band is None:
        return names
    return list(names) + [_mosaic_name(str(band))]


def _mosaic_name(band):
    return f"mosaic_{band.strip().lower().rpartition('.')[2]}.fits"


def _reason(err):
    if isinstance(err, KeyError) and err.args:
        text = str(err.args[0])
    else:
        text = str(err)
    return " ".join(text.split()) or type(err).__name__


def _failed(file, band="", *, reason=""):
    """Return the row of a file in the table, for one that failed or as it is before it is reduced."""
    return {"file": str(file), "filter": band, "status": "failed", "reason": reason}


def _settings(reducer):
    """Return what the products depend on: settings, and the content of reference files."""
    values = {}
    for name, value in without(field_values(reducer), ["n_threads"]).items():
        values[name] = repr(value)
    if isinstance(reducer.references, ReferenceFiles):
        for name in reducer.references.names():
            if isinstance(path := getattr(reducer.references, name), Path):
                values[f"reference {name}"] = file_sha256(path)
    return values


@value_class
class _Reduction:
    """Reduction of files into a folder of products, of which those that stand are kept."""

    reducer: Reducer
    products: ProductFolder
    settings: dict
    resume: bool
    integrations: bool

    def reduce(self, path):
        """Reduce one file: its row, its calibrated product (None without one), and the key of that."""
        row = _failed(path)
        cal = key = None
        try:
            key = content_sha256([_VERSION, file_sha256(path), self.settings, self.integrations])
            cal, row["status"], row["reason"] = self._exposure(path, key)
            if cal is not None:
                row["filter"] = ImageFacts.of(read_images(cal)[0].image).filter or ""
        except _ERRORS as err:
            cal = None
            row |= {"status": "failed", "reason": _reason(err)}
            log.warning("%s is left out: %s", path, row["reason"])
        return row, cal, key

    def _is_kept(self, name, key):
        return self.products.is_kept(name, key, resume=self.resume)

    def _exposure(self, path, key):
        """Reduce one file: its calibrated product (None without), what was done, and why not more."""
        stem = _stem(path)
        cal = f"{stem}_cal.fits"
        rate = f"{stem}_rate.fits"
        if self._is_kept(cal, key):
            return self.products.path(cal), "kept", ""
        slopes_only = "no photometry without references"
        if self.reducer.references == "none" and self._is_kept(rate, key):
            return None, "kept", slopes_only
        exposure = open_file(path)
        if isinstance(exposure, Ramp):
            if self.integrations and exposure.shape[0] > 1:
                parts = self.reducer.fit_integrations(exposure, planes=True)
                self._write(f"{stem}_rateints.fits", key, parts)
            exposure = self.reducer.fit_ramp(exposure, planes=True)
        image = exposure.image
        planes = exposure.planes
        if self.reducer.references == "none" and not image.unit.is_equivalent(SURFACE_BRIGHTNESS):
            self._write(rate, key, image, **planes)
            return None, "rate", slopes_only
        if image.unit.is_equivalent(RATE):
            # there to stay where the brightness cannot be had
            self._write(rate, key, image, **planes)
        _, reduced, background = self.reducer.reduce(image)
        planes = scaled_planes(planes, image, reduced)
        path = self._write(cal, key, reduced, **planes, BKG=background.level)
        return path, "reduced", ""

    def _write(self, name, key, image, **planes):
        def writer(path):
            write_image(image, path, planes=planes, overwrite=True)

        return self.products.write(name, key, writer)

    def combine(self, band, members, options, page):
        """Combine the exposures of a filter, and put the mosaic on the page: its row."""
        name = _mosaic_name(band)
        row = _failed(name, band)
        try:
            path, row["status"], notes = self._mosaic(name, members, options)
            row["reason"] = "; ".join(notes)
            _show(page, path, members, notes)
        except _ERRORS as err:
            row |= {"status": "failed", "reason": _reason(err)}
            log.warning("no mosaic of %s: %s", band, row["reason"])
        return row

    def _mosaic(self, name, members, options):
        """Make the mosaic of a filter: its path, what was done, and what could not be."""
        keys = [key for _, key in members]
        key = content_sha256([_VERSION, keys, repr(options), self.settings])
        if self._is_kept(name, key):
            path = self.products.path(name)
            meta = json.loads(read_images(path)[0].header["META"])
            return path, "kept", meta.get("notes", [])
        files = [read_images(cal)[0] for cal, _ in members]
        images = [file.image for file in files]
        mesh = subset(self.reducer.background.mesh, ("box", "filter_size"))
        levels = [known_background(file.planes["BKG"]) for file in files]
        backgrounds = [dataclasses.replace(level, **mesh) for level in levels]
        planes = [file.planes for file in files]
        result = self.reducer.combine(images, backgrounds, planes=planes, **options)
        path = self.products.write(name, key, lambda path: result.write(path, overwrite=True))
        return path, "reduced", list(result.notes)


def _show(page, path, members, notes):
    """Put the mosaic and its exposures on the page."""
    file = read_images(path)[0]
    image = file.image
    meta = file.image.meta
    band = band_label(meta["filter"])
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
    plot_image(
        data, ax=axes[0, 0], pixel_scale=scale, colorbar="MJy/sr", title=plain_text(path.name)
    )
    options = {"stretch": "linear", "limits": (0, len(members)), "colorbar": "exposures"}
    count = np.squeeze(file.planes["CON"]).astype(float)
    title = "exposures of each pixel"
    plot_image(count, ax=axes[0, 1], pixel_scale=scale, title=title, **options)
    page.figure("figure", axes[0, 0].figure, file=path.name)


def _levels(members):
    metas = [read_images(cal)[0].image.meta for cal, _ in members]
    levels = []
    for meta in metas:
        if "background" in meta:
            levels.append(
                f"{meta['background']:.4g} ± {meta.get('background_error', np.nan):.1g} "
                + " ".join(meta.get("background_flags", []))
            )
    if levels:
        return ", ".join(map(str.strip, levels)) + " MJy/sr"
    return "not known"


def _references(meta):
    """Return the references that all exposures share."""
    names = {}
    for key, text in meta.items():
        if key.startswith("reference_"):
            names[key.removeprefix("reference_")] = text
    return "; ".join(f"{name}: {text}" for name, text in names.items()) or "differ, or not known"


def _list(page, table):
    """Put the table of the files on the page."""
    page.section("files")
    failed = np.count_nonzero(table["status"] == "failed")
    rows = [dict(zip(row.colnames, map(str, row.values()), strict=True)) for row in table]
    page.table("table", rows, failed=f"{failed} failed." if failed else "")
