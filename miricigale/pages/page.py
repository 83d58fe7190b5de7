"""One self-contained HTML page: text, tables and figures, no outside file."""

import base64
import dataclasses
import html
import io
import string
from importlib import resources
from pathlib import Path

import numpy as np

from miricigale.utils.exceptions import argument_error
from miricigale.utils.store import replacing

__all__ = ["Missing", "Page", "number"]


@dataclasses.dataclass(frozen=True)
class Missing:
    """
    A value that there is not: a dash on the page, its reason beneath.

    Parameters
    ----------
    reason : str
        Why there is none.
    """

    reason: str

    def __str__(self):
        return "\N{EN DASH}"


def number(value, spec, reason, *, scale=1):
    """
    Text of a number, or `Missing` where there is none.

    Parameters
    ----------
    value : float or None
        The number; None or not finite is missing.
    spec : str
        Format, such as ``"+.2f"``, or one with braces and text around them (``"{:.1f} %"``).
    reason : str
        Why it is missing.
    scale : float, optional
        Factor before it is written.

    Returns
    -------
    text : str or `Missing`

    Examples
    --------
    >>> from miricigale.pages import number
    >>> number(0.0123, "{:+.1f} %", "no source", scale=100)
    '+1.2 %'
    >>> number(float("nan"), ".2f", "no source")
    Missing(reason='no source')
    """
    if value is None or not np.isfinite(value):
        return Missing(reason)
    return (spec if "{" in spec else f"{{:{spec}}}").format(scale * value)


class Page:
    """
    A report that is filled section by section and written once.

    Parameters
    ----------
    title : str
        Title of the page.
    subtitle : str, optional
        A line beneath it.
    notices : iterable of str, optional
        What a reader has to know before anything else, above the first section.
    dpi : int, optional
        Resolution of the figures.
    """

    def __init__(self, title, *, subtitle="", notices=(), dpi=110):
        self.title = title
        self.subtitle = subtitle
        self.notices = tuple(notices)
        self.dpi = dpi
        self._sections = []

    def section(self, title, text=""):
        """Begin a section with an optional paragraph."""
        self._sections.append((title, []))
        if text:
            self.text(text)

    def _add(self, block):
        if not self._sections:
            self.section("")
        self._sections[-1][1].append(block)

    def text(self, text):
        """Add a paragraph of plain text."""
        self._add(f"<p>{html.escape(text)}</p>")

    def links(self, text, pairs):
        """Add a sentence and links to what lies beside the page: (label, address) pairs of text."""
        links = ", ".join(
            f"<a href='{html.escape(address, quote=True)}'>{html.escape(label)}</a>"
            for label, address in pairs
        )
        self._add(f"<p>{html.escape(text)} {links}</p>")

    def bullets(self, entries):
        """Add a list of lines of plain text."""
        self._add(_bullets(entries))

    def items(self, pairs):
        """Add headline numbers: (label, value) pairs of text; a value may be `Missing`."""
        cells = ""
        for label, value in pairs:
            why = f" ({value.reason})" if isinstance(value, Missing) else ""
            cells += (
                f"<div class='item'><b>{html.escape(str(value))}</b>"
                f"<span>{html.escape(label + why)}</span></div>"
            )
        self._add(f"<div class='items'>{cells}</div>")

    def table(self, rows, *, header, caption="", empty="", text=1):
        """
        Add a table.

        Parameters
        ----------
        rows : iterable of sequence
            Cells of text or numbers; those that are `Missing` are dashes, and their reasons
            stand beneath the table.
        header : sequence of str
            Names of the columns.
        caption : str, optional
            What stands in it.
        empty : str, optional
            Sentence that takes the place of a table without rows.
        text : int or iterable of int, optional
            How many columns at the left are text, or which ones are; the others are numbers.

        Raises
        ------
        ValueError
            If a row has another number of cells than the header, or there are no rows and no
            ``empty``.
        """
        rows = [tuple(row) for row in rows]
        if any(len(row) != len(header) for row in rows):
            lengths = sorted({len(row) for row in rows})
            raise argument_error("rows", f"{len(header)} cells in each row", lengths)
        if not rows:
            if not empty:
                raise argument_error("rows", "at least one, or 'empty' for the sentence", "none")
            return self.text(empty)
        words = set(range(text)) if isinstance(text, int) else set(text)
        reasons = list(
            dict.fromkeys(cell.reason for row in rows for cell in row if isinstance(cell, Missing))
        )
        # a single reason is not numbered
        marks = {why: str(k) if len(reasons) > 1 else "" for k, why in enumerate(reasons, start=1)}

        def shown(cell):
            mark = marks[cell.reason] if isinstance(cell, Missing) else ""
            return f"{html.escape(str(cell))}{f'<sup>{mark}</sup>' if mark else ''}"

        def cells(row, tag):
            return "".join(
                f"<{tag}{'' if k in words else ' class=n'}>{shown(cell)}</{tag}>"
                for k, cell in enumerate(row)
            )

        body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
        caption = f"<caption>{html.escape(caption)}</caption>" if caption else ""
        notes = "; ".join(f"{shown(Missing(why))} {html.escape(why)}" for why in reasons)
        notes = f"<p class='note'>{notes}</p>" if notes else ""
        return self._add(
            f"<div class='table'><table>{caption}<thead><tr>{cells(header, 'th')}</tr></thead>"
            f"<tbody>{body}</tbody></table>{notes}</div>"
        )

    def figure(self, figure, caption="", *, name=None, folder=None):
        """
        Add a matplotlib figure as a PNG inside the page, and close it.

        Parameters
        ----------
        figure : `~matplotlib.figure.Figure`
            The figure.
        caption : str, optional
            What the reader sees in it.
        name : str, optional
            File name (without suffix) under which it is kept in ``folder`` too.
        folder : path-like, optional
            Folder for the separate PNG.
        """
        buffer = io.BytesIO()
        # with a layout engine all labels are within the figure already
        tight = None if figure.get_layout_engine() else "tight"
        # omit the version of matplotlib, so that the bytes do not depend on it
        meta = {"Software": None}
        figure.savefig(buffer, format="png", dpi=self.dpi, bbox_inches=tight, metadata=meta)
        figure.clear()
        if name and folder:
            Path(folder).mkdir(parents=True, exist_ok=True)
            (Path(folder) / f"{name}.png").write_bytes(buffer.getvalue())
        data = base64.b64encode(buffer.getvalue()).decode()
        self._add(
            f"<figure><img alt='{html.escape(caption, quote=True)}' src='data:image/png;base64,{data}'>"
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )

    def to_html(self):
        """The page as text."""
        template = string.Template(
            (resources.files("miricigale.pages") / "templates" / "report.html").read_text()
        )
        anchors = [f"s{k}" for k in range(len(self._sections))]
        contents = "".join(
            f"<a href='#{a}'>{html.escape(title)}</a>"
            for a, (title, _) in zip(anchors, self._sections, strict=True)
            if title
        )
        body = "".join(
            f"<section id='{a}'><h2>{html.escape(title)}</h2>{''.join(blocks)}</section>"
            for a, (title, blocks) in zip(anchors, self._sections, strict=True)
        )
        return template.substitute(
            title=html.escape(self.title),
            subtitle=html.escape(self.subtitle),
            notices=f"<aside>{_bullets(self.notices)}</aside>" if self.notices else "",
            contents=contents,
            body=body,
        )

    def write(self, path):
        """
        Write the page, whole or not at all.

        Returns
        -------
        path : `pathlib.Path`
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.write_text(self.to_html(), encoding="utf-8")
        return path


def _bullets(entries):
    return "<ul>" + "".join(f"<li>{html.escape(str(entry))}</li>" for entry in entries) + "</ul>"
