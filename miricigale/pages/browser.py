"""The source browser: a page of many sources, whose details and pictures are in files beside it."""

import functools
import json
import zlib
from importlib import resources

import astropy.units as u
import numpy as np
from markupsafe import Markup

from miricigale.pages.rendering import render
from miricigale.utils.files import make_folder, replacing
from miricigale.utils.parallel import chunks

#: Sources whose details and pictures are in one file.
CHUNK = 32
#: Cells of the spectra.
N_WAVE = 240


def source_pages(save, folder, names, title, facts, order, shown, entry, sheet=None):
    """
    Write the page of sources, and the files that it loads.

    Parameters
    ----------
    save : callable
        Takes the name of a file and what writes it to a path.
    folder : str
        Folder of the page, for ``save``.
    names : (str, str)
        Of the page without its ending, and of the folder of its files within ``folder``.
    title : str
        Of the page.
    facts : dict
        What ``sources.js`` shows of all sources, plain values: ``table``, numbers and text by column in the order
        of the files; ``columns`` of the list, from `list_column`; ``shows``, by name a label and the column that
        is true of the sources (None for all); ``heading``, column, label and digits of what stands above the
        details; ``flags``, meanings by kind; ``flag_columns``, column, kind and what the flag is of; ``bands``,
        ``wave`` (um), ``sets`` of fits and ``notes``; and where there are any ``cutouts``, ``pdf_edges``,
        ``parameters``, ``truths``.
    order : int `~numpy.ndarray`, shape (n,)
        Numbers of the sources in the order of the files, those with pictures first.
    shown : bool `~numpy.ndarray`, shape (n,)
        Which have pictures.
    entry : callable
        Details of a source, plain values, by its number: ``flux`` and ``error`` by band, and where there are any
        ``true``, ``upper``, ``bits`` (flags by kind and measured band), ``fits`` and ``parameters``.
    sheet : callable, optional
        Pictures of some, by their numbers: an image with a strip for each (`PIL.Image.Image`), and where their
        stretches end.
    """
    for k, part in enumerate(chunks(len(order), CHUNK)):
        rows = order[part]
        stem = f"{folder}/{names[1]}/{k:03d}"
        tops = {}
        pictured = rows[shown[rows]]
        if pictured.size:
            picture, limits = sheet(pictured)
            tops = dict(zip(pictured, rounded(limits), strict=True))
            # shades of noise repeat in runs alone: smaller, in a fourth of the time of a search for others
            save(f"{stem}.png", functools.partial(picture.save, compress_type=zlib.Z_RLE))
        entries = [entry(row) | {"top": tops.get(row)} for row in rows]
        _save_text(save, f"{stem}.js", f"loaded({k}, {_json(entries)});\n")
    facts = facts | {"chunk": CHUNK, "folder": names[1], "pictured": int(shown.sum())}
    script = resources.files("miricigale.pages") / "templates" / "sources.js"
    page = render(
        "sources.html",
        title=title,
        report=facts.get("report", "index.html"),
        facts=Markup(_json(facts)),
        script=Markup(script.read_text("utf-8")),
    )
    _save_text(save, f"{folder}/{names[0]}.html", page)


def pages_beside(report, name, title, facts, order, shown, entry, sheet=None):
    """
    Write the page of sources beside another page, to which it links back, and the files that it loads.

    Parameters
    ----------
    report : `pathlib.Path`
        The other page.
    name : str
        Of the page without its ending, and of the folder of its files.
    title, facts, order, shown, entry, sheet
        As for `source_pages`.

    Returns
    -------
    name : str
        Of the file.
    """

    def save(file_name, write):
        place = report.parent / file_name
        make_folder(place.parent)
        with replacing(place) as partial:
            write(partial)

    facts = facts | {"report": report.name}
    source_pages(save, ".", (name, name), title, facts, order, shown, entry, sheet)
    return f"{name}.html"


def list_column(key, label, title, *, group="", **options):
    """
    Describe a column of the list of sources.

    Parameters
    ----------
    key : str
        Of the numbers or text in the table.
    label, title : str
        What stands above it, and what it says under the pointer.
    group : str, optional
        What stands above neighbors with the same group.
    **options
        ``digits`` behind the point; ``text=True``; ``limit`` and ``off``, keys of the columns that say which are
        limits and which are shown in red.

    Returns
    -------
    column : dict
    """
    return {"key": key, "label": label, "title": title, "group": group, **options}


def band_entries(names, labels, waves, *, miri):
    """Return what ``sources.js`` shows of bands with their wavelengths (um), those of ``miri`` marked."""
    entries = []
    for name, label, wave in zip(names, labels, rounded(waves), strict=True):
        entries.append({"name": name, "label": label, "wave": wave, "miri": name in miri})
    return entries


def shown_unit(unit):
    """Return the unit in which a parameter is shown: luminosities in that of the Sun."""
    unit = u.Unit(unit)
    if unit.is_equivalent(u.L_sun):
        return u.L_sun
    return unit


def parameter_entries(units):
    """Return what ``sources.js`` shows of parameters, from their units by name: list of dict."""
    entries = []
    for name, unit in units.items():
        text = str(unit).replace("solMass", "M☉").replace("solLum", "L☉")
        entries.append({"name": name, "unit": text})
    return entries


def moments_of(result, units):
    """Return mean and standard deviation of the parameters of a result in their units: list of pairs."""
    moments = []
    for name, unit in units.items():
        mean = rounded(result.mean(name).to_value(unit))
        moments.append([mean, rounded(result.std(name).to_value(unit))])
    return moments


def thousandths_of_log(values):
    """Return log10 of values in thousandths, None where they are not positive."""
    return [round(1000 * np.log10(x)) if x > 0 else None for x in values]


def spectrum_edges(pivots):
    """Return edges of `N_WAVE` cells about bands, evenly spaced in the logarithm of wavelength."""
    return np.geomspace(0.7 * min(pivots), 1.4 * max(pivots), N_WAVE + 1)


def cell_weights(pdf):
    """Return weights of a posterior in thousandths: index of the first cell that is not empty, and the weights."""
    weights = np.round(1000 * np.asarray(pdf)).astype(int)
    filled = np.flatnonzero(weights)
    if filled.size == 0:
        return [0, []]
    return [int(filled[0]), weights[filled[0] : filled[-1] + 1].tolist()]


def image_note(layout, about):
    """
    Say what the pictures of a source show.

    Parameters
    ----------
    layout : dict
        Of `~miricigale.plotting.cutouts.Cutouts.describe`.
    about : str
        How they lie, and what their circle is about.
    """
    return (
        f"{layout['box']} arcsec on a side, {about}; blue: other sources of the catalog; sand: no data. Mosaic, "
        f"model and residual of a band have one stretch: asinh of the value over {layout['softening']:g} times "
        f"the noise of a pixel (in residuals), between the limits beneath in {layout['unit']}, which are "
        f"{layout['lowest']:g} times the noise and the brightest pixel of the model, or 10 times the noise if "
        "that is more."
    )


def _save_text(save, name, text):
    save(name, lambda path: path.write_text(text, "utf-8"))


def rounded(values, digits=4):
    """Return plain numbers of so many significant digits, None for NaN; text, integers and flags as they are."""
    values = np.asarray(values)
    if values.ndim:
        return [rounded(value, digits) for value in values]
    if values.dtype.kind != "f":
        return values.item()
    if not np.isfinite(values):
        return None
    value = float(f"{float(values):.{digits}g}")
    if value.is_integer() and abs(value) < 1e9:
        return int(value)
    return value


def _json(values):
    """Return JSON that may stand in a script of a page."""
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    # no tag and no comment of HTML can begin in it
    return text.replace("<", "\\u003c")
