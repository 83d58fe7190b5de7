"""Rows of the tables of flags and columns, made from the code; without Sphinx, for the tests."""

import ast
import re

from miricigale.utils.tables import Flags

__all__ = ["column_rows", "flag_rows", "flags_of", "run_block"]

#: Meaning of columns that are the same in all tables of sources and carry no description.
STANDARD = {
    "id": "Identifier of the source",
    "sky": "Position (ICRS)",
    "x": "Pixel coordinate of the center, from 0",
    "y": "Pixel coordinate of the center, from 0",
    "redshift": "Redshift; NaN for stars",
    "star": "Whether the source is a star",
    "profile": "Shape: sersic, point or cutout",
    "half_light_radius": "Semi-major axis of the ellipse that holds half of the light",
    "sersic_index": "Sersic index",
    "axis_ratio": "Minor over major axis",
    "position_angle": "Position angle of the major axis, east of north",
    "galfit_flag": "Flag of the published profile fit",
    "mag_f160w": "Published magnitude in F160W",
    "first_id": "Identifier in the first catalog",
    "second_id": "Identifier in the second catalog",
    "measured_id": "Identifier of the matched detection, -1 for none",
    "separation": "Distance between source and detection",
    "matched": "Whether a detection was matched",
}
#: Meaning of columns that begin with the name of a band, by what follows it.
BANDS = {
    "": "Flux density in the band",
    "_err": "1-sigma error of the flux density in the band",
    "_true": "True flux density in the band",
    "_flags": "Flags of the measurement in the band",
}


def escape(text):
    """Text that reStructuredText shows as it is, markup characters included."""
    return re.sub(r"([\\*`|_])", r"\\\1", " ".join(str(text).split()))


def flag_rows(flags):
    """
    Rows of the table of a class of flags.

    Parameters
    ----------
    flags : type
        Subclass of `~miricigale.utils.tables.Flags`.

    Returns
    -------
    rows : list of tuple
        Value, name of the member, and its meaning: a sentence.
    """
    rows = []
    for value, (name, text) in flags.meanings().items():
        text = text or name
        text = text[0].upper() + text[1:]
        rows.append((value, name.replace(" ", "_").upper(), text.rstrip(".") + "."))
    return rows


def flags_of(text):
    """Name of the class of flags that a description is of, or None."""
    return next((one.__name__ for one in Flags.__subclasses__() if one.describe() == text), None)


def run_block(code, names):
    """Run Python code whose last statement is an expression; return the value of that."""
    *body, last = ast.parse(code).body
    exec(compile(ast.Module(body, []), "<column-table>", "exec"), names)
    return eval(compile(ast.Expression(last.value), "<column-table>", "eval"), names)


def column_rows(table):
    """
    Rows of the table of columns.

    Parameters
    ----------
    table : `~astropy.table.Table`

    Returns
    -------
    rows : list of tuple of str
        Name, unit and meaning (reStructuredText); of several bands the first stands for all, under ``<band>``.
    """
    bands = [name for name in table.colnames if _is_band(name)]
    rows = []
    for name in table.colnames:
        band = next((one for one in bands if name == one or name.startswith(f"{one}_")), None)
        if band and band != bands[0]:
            continue
        info = table[name].info
        unit = info.unit.to_string() if hasattr(info.unit, "to_string") else info.unit
        rest = name[len(band) :] if band else None
        text = info.description or (STANDARD.get(name) if band is None else BANDS.get(rest))
        shown = f"<band>{rest}" if band else name
        text = (text or "").replace(band, "the band") if band else text or ""
        unit = "deg" if name == "sky" else unit or ""
        of = flags_of(text)
        text = f"Flags: :ref:`{of} <{of.lower()}>`" if of else escape(text[:1].upper() + text[1:])
        rows.append((shown, unit, text))
    return rows


def _is_band(name):
    """Whether a column is the flux of a band, such as ``miri.f770w``."""
    instrument, dot, filter = name.partition(".")
    return bool(dot) and instrument.isalnum() and filter.isalnum()
