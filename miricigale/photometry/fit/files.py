"""What photometry keeps in files: results and templates."""

import dataclasses

import astropy.units as u
import numpy as np
import scipy.sparse
from astropy.coordinates import SkyCoord
from astropy.nddata import StdDevUncertainty
from astropy.table import QTable, Table

from miricigale.instrument.image import Image
from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.errors.error_files import write_ecsv
from miricigale.photometry.fit.exposure_result import ExposureResults
from miricigale.photometry.fit.offsets import OffsetMap
from miricigale.photometry.fit.results import ForcedPhotometryResult
from miricigale.photometry.images.fields import SmoothField
from miricigale.photometry.images.fits_images import grid_text, text_grid
from miricigale.photometry.shapes.shapes import FITTED, not_fitted
from miricigale.photometry.templates.sources import SourceTemplates
from miricigale.utils.file_formats import register
from miricigale.utils.named_values import attributes, without_none
from miricigale.utils.positions import sky_as_angles
from miricigale.utils.store import native, open_parts, write_parts
from miricigale.utils.tables import ascii_ids
from miricigale.utils.units import SURFACE_BRIGHTNESS


def _sky_columns(sky):
    icrs = sky.icrs
    return {"ra": icrs.ra.deg, "dec": icrs.dec.deg}


def _existing(owner, names):
    """Return those attributes of an object, by name, that are not None."""
    return without_none(attributes(owner, names))


def _columns(table):
    """Return columns of a table that was read, without masks: what is not finite stays so."""
    return {name: native(np.asarray(table[name])) for name in table.colnames}


def _sky(columns):
    return SkyCoord(columns.pop("ra"), columns.pop("dec"), unit="deg")


#: A layer of a template, as files have it.
_LAYER = np.dtype(
    [
        ("row", int),
        ("whole", bool),
        ("corner", int, (2,)),
        ("shape", int, (2,)),
        ("noise", float),
        ("convolved", bool),
    ]
)


def _write_templates(templates, path, *, overwrite=False):
    names = ("sersic", "flags", "snr", "flux", "components")
    table = {"id": ascii_ids(templates.id, "id")}
    table |= _sky_columns(templates.sky) | _existing(templates, names)
    for name in FITTED.names:
        table[f"fitted_{name}"] = templates.fitted[name]
    # rows of the table of layers: source, whether the layer is one of the whole galaxy, and its pixels
    layers = []
    for row, light in enumerate(templates.light):
        if light is None:
            continue
        layers += [(row, False, layer) for layer in light.layers]
        if light.galaxy is not None:
            layers += [(row, True, layer) for layer in light.galaxy.layers]
    records = np.zeros(len(layers), _LAYER)
    pixels = []
    for record, (row, is_galaxy, layer) in zip(records, layers, strict=True):
        record["row"] = row
        record["whole"] = is_galaxy
        record["corner"] = layer.origin
        record["shape"] = layer.data.shape
        record["noise"] = layer.noise
        record["convolved"] = layer.convolved
        pixels.append(layer.data.ravel())
    rows = {name: records[name].copy() for name in _LAYER.names}
    arrays = {"pixels": np.concatenate(pixels) if pixels else np.empty(0)}
    if templates.psf is not None:
        arrays["psf"] = templates.psf
    grid = None
    if templates.wcs is not None:
        grid = grid_text(templates.wcs)
    write_parts(
        path, "source-templates-3", text={"meta": templates.meta, "grid": grid}, arrays=arrays,
        tables={"sources": Table(table), "layers": Table(rows)}, overwrite=overwrite,
    )  # fmt: skip


def _read_templates(path):
    with open_parts(path, ("source-templates-3",), wanted="templates of sources") as parts:
        text = parts.text
        columns = _columns(parts.table("sources"))
        rows = _columns(parts.table("layers"))
        pixels = np.empty(0)
        if "pixels" in parts:
            pixels = parts.array("pixels")
        # templates from their layers
        light = [None] * len(columns["id"])
        wholes = list(light)
        ends = np.cumsum(np.prod(rows["shape"], axis=1, dtype=int))
        # the last layer of a source first: each is what is added to the one before
        for k in range(len(ends) - 1, -1, -1):
            h, w = rows["shape"][k].tolist()
            row = int(rows["row"][k])
            origin = tuple(rows["corner"][k].tolist())
            data = pixels[ends[k] - h * w : ends[k]].reshape(h, w)
            form = {
                "noise": float(rows["noise"][k]),
                "convolved": bool(rows["convolved"][k]),
            }
            if rows["whole"][k]:
                wholes[row] = Cutout(data, origin, correction=wholes[row], **form)
            else:
                light[row] = Cutout(data, origin, correction=light[row], galaxy=wholes[row], **form)
        fitted = not_fitted(len(light))
        for name in FITTED.names:
            fitted[name] = columns.pop(f"fitted_{name}")
        wcs = None
        if text["grid"] is not None:
            wcs = text_grid(text["grid"])
        psf = None
        if "psf" in parts:
            psf = parts.array("psf")
        return SourceTemplates(
            sky=_sky(columns),
            **columns,
            light=light,
            fitted=fitted,
            wcs=wcs,
            psf=psf,
            meta=text["meta"],
        )


#: Columns of a result's table, its quantities that are few, and its sparse matrices.
_ROWS = [
    "flux", "flux_err", "flux_err_noise", "flux_err_template", "flux_err_psf", "flags", "coverage",
    "chi2", "residual_fraction", "template", "template_snr", "crowded", "x", "y", "flux_point",
    "flux_point_err",
]  # fmt: skip
_QUANTITIES = ("background", "background_err", "shift", "shift_err", "psf_fwhm")
_MATRICES = ("covariance", "joint_covariance")


def _write_result(result, path, *, overwrite=False):
    # images
    residual = result.residual_image
    arrays = {
        "model": result.model_image.data,
        "residual": residual.data,
        "sigma": residual.uncertainty.array,
        "mask": np.asarray(residual.mask),
        **_existing(result, ("noise_correlation",)),
    }
    for name, matrix in _existing(result, _MATRICES).items():
        arrays[f"{name}_data"] = matrix.data
        arrays[f"{name}_indices"] = matrix.indices
        arrays[f"{name}_indptr"] = matrix.indptr
    quantities = {}
    for name, value in _existing(result, _QUANTITIES).items():
        quantities[name] = value.value, value.unit.to_string()
    text = {
        "meta": result.meta,
        "image_meta": residual.meta,
        "wcs": grid_text(residual.wcs),
        "quantities": quantities,
    }
    table = {"id": ascii_ids(result.id, "id"), **_sky_columns(result.sky)}
    tables = {"sources": QTable({**table, **_existing(result, _ROWS)})}
    # smooth fields, and tables
    fields = {"background_field": result.background_field}
    if result.offset_map is not None:
        fields["offset_map"] = result.offset_map.field
        tables["offsets"] = sky_as_angles(result.offset_map.sources)
    if result.exposures is not None:
        tables["exposures"] = result.exposures.table
    if result.new_sources is not None:
        tables["new"] = sky_as_angles(result.new_sources)
    for name, field in fields.items():
        if field is not None:
            text[name] = {**dataclasses.asdict(field)}
    parts = {"shown": result.to_table(), "text": text, "arrays": arrays, "tables": tables}
    write_parts(path, "forced-photometry-1", **parts, overwrite=overwrite)


def _read_result(path):
    with open_parts(path, ("forced-photometry-1",), wanted="forced photometry") as parts:
        text = parts.text
        wcs = text_grid(text["wcs"])
        columns = _table(parts, "sources")
        # attributes of the result by name
        values = {name: columns[name] for name in ("id", *_ROWS) if name in columns.colnames}
        for name, (value, unit) in text["quantities"].items():
            values[name] = value * u.Unit(unit)
        n = len(columns)
        for name, size in zip(_MATRICES, (n, 2 * n), strict=True):
            if f"{name}_indptr" in parts:
                # arrays without an element are not in the file
                arrays = []
                for part, dtype in (("data", float), ("indices", np.int32), ("indptr", np.int32)):
                    key = f"{name}_{part}"
                    arrays.append(parts.array(key) if key in parts else np.empty(0, dtype))
                values[name] = scipy.sparse.csr_array(tuple(arrays), shape=(size, size))
        if "noise_correlation" in parts:
            values["noise_correlation"] = parts.array("noise_correlation")
        if "background_field" in text:
            values["background_field"] = _field(text["background_field"])
        if "offset_map" in text:
            field = _field(text["offset_map"])
            values["offset_map"] = OffsetMap(_table(parts, "offsets"), field, wcs)
        if "exposures" in parts:
            values["exposures"] = ExposureResults(QTable(parts.table("exposures")))
        if "new" in parts:
            values["new_sources"] = _table(parts, "new")
        options = {"unit": SURFACE_BRIGHTNESS, "wcs": wcs}
        return ForcedPhotometryResult(
            sky=columns["sky"],
            **values,
            model_image=Image(parts.array("model"), meta=dict(text["image_meta"]), **options),
            residual_image=Image(
                parts.array("residual"),
                mask=parts.array("mask").astype(bool),
                uncertainty=StdDevUncertainty(parts.array("sigma"), copy=False),
                meta=dict(text["image_meta"]),
                **options,
            ),
            meta=text["meta"],
        )


def _table(parts, name):
    """Read a table with positions."""
    read = parts.table(name)
    columns = _columns(read)
    sky = _sky(columns)
    table = QTable()
    for key, values in columns.items():
        unit = read[key].unit
        table[key] = values if unit is None else values * unit
    table.add_column(sky, name="sky", index=1)
    return table


def _field(state):
    coefficients = np.array(state["coefficients"])
    return SmoothField(coefficients, tuple(state["shape"]), state["order"])


register(SourceTemplates, read=_read_templates, write=_write_templates)
register(ForcedPhotometryResult, read=_read_result, write=_write_result)
register(ForcedPhotometryResult, write=write_ecsv, name="ascii.ecsv")
register(ForcedPhotometryResult, write=ForcedPhotometryResult.write_regions, name="ds9")
