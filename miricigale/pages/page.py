"""One self-contained HTML page: text, tables and figures, no outside file."""

import contextlib
from pathlib import Path

from markupsafe import Markup

from miricigale.pages.rendering import image_of, macros, render
from miricigale.pages.values import Missing
from miricigale.utils.files import make_folder, replacing
from miricigale.utils.options import check_that


class Page:
    """
    A report that is filled section by section and written once.

    All text is escaped; a `~miricigale.pages.Link` may stand wherever text may.

    Parameters
    ----------
    title : str
        Title of the page.
    subtitle : str, optional
        A line beneath it.
    notices : iterable of str, optional
        What a reader has to know before anything else, above the first section.
    dpi : int, optional
        Pixels of the page per inch of a figure.
    """

    def __init__(self, title, *, subtitle="", notices=(), dpi=110):
        self.title = title
        self.subtitle = subtitle
        self.notices = list(notices)
        self.dpi = dpi
        self._sections = []

    def __repr__(self):
        n = len(self._sections)
        return f"<Page {self.title!r}, {n} section{'s' * (n != 1)}>"

    def section(self, title, text="", *, closed=""):
        """Begin a section with an optional paragraph; a ``closed`` one shows that line until it is opened."""
        self._sections.append((title, [], closed))
        if text:
            self.text(text)

    @contextlib.contextmanager
    def folded(self, title):
        """
        Fold what is added to the section within the block, until a reader opens it; printed pages have all of it.

        Parameters
        ----------
        title : str
            The line that stays: what it holds.

        Examples
        --------
        >>> from miricigale.pages import Page
        >>> page = Page("Limits")
        >>> with page.folded("How the limits were made"):
        ...     page.text("As the root of the time.")
        >>> page.to_html().count("<summary>How the limits were made</summary>")
        1
        """
        if not self._sections:
            self.section("")
        parts = self._sections[-1][1]
        first = len(parts)
        yield
        parts[first:] = [macros().folded(title, parts[first:])]

    def _add(self, macro, *values):
        if not self._sections:
            self.section("")
        self._sections[-1][1].append(getattr(macros(), macro)(*values))

    def text(self, text):
        """Add a paragraph of plain text."""
        self._add("text", text)

    def bullets(self, entries, *, box=False):
        """Add a list of lines of plain text, in a ``box`` where a reader has to know them."""
        self._add("notices" if box else "bullets", list(entries))

    def items(self, pairs):
        """Add headline numbers: (label, value) pairs of text; a value may be `Missing`."""
        entries = []
        for label, value in pairs:
            if isinstance(value, Missing):
                label = label + f" ({value.reason})"
            entries.append((label, value))
        self._add("items", entries)

    def table(self, rows, *, header, caption="", empty="", text=1):
        """
        Add a table.

        Parameters
        ----------
        rows : iterable of sequence
            Cells: text, numbers, or `~miricigale.pages.Link`; those that are `Missing` are dashes,
            and their reasons stand beneath the table.
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
        lengths = set(map(len, rows))
        check_that(lengths <= {len(header)}, "rows", f"{len(header)} cells in each row", lengths)
        if not rows:
            check_that(empty, "rows", "at least one, or 'empty' for the sentence", "none")
            return self.text(empty)
        marks = _marks_of_missing(rows)
        shown = []
        for row in rows:
            shown.append([marks[c.reason] if isinstance(c, Missing) else c for c in row])
        words = text
        if isinstance(text, int):
            words = range(text)
        return self._add("table", shown, header, set(words), caption, marks)

    def figure(self, figure, caption=""):
        """
        Add a matplotlib figure as an image inside the page, and clear it.

        Figures with few marks are vectors, others pixels at twice the resolution of the page.

        Parameters
        ----------
        figure : `~matplotlib.figure.Figure`
            The figure.
        caption : str, optional
            What the reader sees in it.
        """
        source, width = image_of(figure, self.dpi)
        self._add("figure", source, width, caption)

    def to_html(self):
        """Return the page as text."""
        return render(
            "page.html",
            sections=self._sections,
            title=self.title,
            subtitle=self.subtitle,
            notices=self.notices,
        )

    def write(self, path, *, overwrite=False):
        """
        Write the page, whole or not at all.

        Parameters
        ----------
        path : path-like
            The file; its folder is made.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Returns
        -------
        path : `pathlib.Path`

        Raises
        ------
        OSError
            If the file exists and ``overwrite`` is False.
        """
        path = Path(path)
        make_folder(path.parent)
        with replacing(path, overwrite=overwrite) as partial:
            partial.write_text(self.to_html(), encoding="utf-8")
        return path


def _marks_of_missing(rows):
    """Return the marks of missing cells by their reasons; a single reason is not numbered."""
    cells = {}
    for row in rows:
        for cell in row:
            if isinstance(cell, Missing):
                cells[cell.reason] = cell
    if len(cells) == 1:
        return cells
    marks = {}
    for k, (reason, cell) in enumerate(cells.items(), start=1):
        marks[reason] = Markup("{}<sup>{}</sup>").format(cell, k)
    return marks
