"""The source browser: a page of many sources, whose details and pictures are in files beside it."""

import json
from importlib import resources

import numpy as np
from markupsafe import Markup

from miricigale.pages.rendering import render
from miricigale.utils.parallel import chunks

#: Sources whose details and pictures are in one file.
CHUNK = 32


def source_pages(save, folder, names, title, facts, order, shown, entry, sheet):
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
        What ``sources.js`` shows of all sources, plain values: ``table``, the columns of its table in the order of
        the files, ``bands``, ``flags`` and so on.
    order : int `~numpy.ndarray`, shape (n,)
        Numbers of the sources in the order of the files, those with pictures first.
    shown : bool `~numpy.ndarray`, shape (n,)
        Which have pictures.
    entry, sheet : callable
        Details of a source, plain values, by its number; pictures of some, by their numbers: an image with a
        strip for each (`PIL.Image.Image`), and where their stretches end.
    """
    for k, part in enumerate(chunks(len(order), CHUNK)):
        rows = order[part]
        stem = f"{folder}/{names[1]}/{k:03d}"
        tops = {}
        pictured = rows[shown[rows]]
        if pictured.size:
            picture, limits = sheet(pictured)
            tops = dict(zip(pictured, rounded(limits), strict=True))
            save(f"{stem}.png", picture.save)
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
