"""One self-contained HTML page: text, tables and figures, no outside file."""

import base64
import html
import io
import os
import string
from importlib import resources
from pathlib import Path

from miricigale.utils.files import writing

__all__ = ["Report"]


class Report:
    """
    A report that is filled section by section and written once.

    Parameters
    ----------
    title : str
        Title of the page.
    subtitle : str, optional
        A line beneath it.
    dpi : int, optional
        Resolution of the figures.
    """

    def __init__(self, title, *, subtitle="", dpi=110):
        self.title = title
        self.subtitle = subtitle
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

    def items(self, pairs):
        """Add headline numbers: (label, value) pairs of text."""
        cells = "".join(
            f"<div class='item'><b>{html.escape(str(value))}</b><span>{html.escape(str(label))}</span></div>"
            for label, value in pairs
        )
        self._add(f"<div class='items'>{cells}</div>")

    def table(self, rows, *, header, caption=""):
        """Add a table: rows of text or numbers under a header."""
        head = "".join(f"<th>{html.escape(str(name))}</th>" for name in header)
        body = "".join(
            "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>"
            for row in rows
        )
        caption = f"<caption>{html.escape(caption)}</caption>" if caption else ""
        self._add(f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")

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
        figure.savefig(buffer, format="png", dpi=self.dpi, bbox_inches="tight")
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
            (resources.files("miricigale.evaluation") / "templates" / "report.html").read_text()
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
            contents=contents,
            body=body,
        )

    def write(self, path):
        """
        Write the page under a temporary name, then rename it.

        Returns
        -------
        path : `pathlib.Path`
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        with writing(path):
            partial.write_text(self.to_html(), encoding="utf-8")
        os.replace(partial, path)
        return path
