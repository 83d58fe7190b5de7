"""Sections of a page as a TOML file declares them: titles, paragraphs, headline numbers, captions and columns."""

import contextlib

from markupsafe import Markup

from miricigale.pages.values import cell_of


def sentence(text, facts):
    """
    Return a sentence with facts in place of the names in braces.

    Parameters
    ----------
    text : str
        The sentence.
    facts : dict
        What stands in it, by name.

    Returns
    -------
    text : `~markupsafe.Markup`
        Links among the facts stay links, all else is escaped.
    """
    return Markup.escape(" ".join(text.split())).format_map(facts)


class SectionWriter:
    """
    Fills a page with declared sections.

    A section has a ``title``, sentences by name (``text`` is its paragraph), ``items`` (headline numbers: label,
    and how `~miricigale.pages.cell_of` takes the value), and tables by name: ``columns`` (header, and the same of
    the cells), ``caption``, ``empty`` and ``text`` as of `~miricigale.pages.Page.table`. Figures and tables with a
    line in ``folded`` stand behind it, and a section with ``closed`` as a whole. Words in braces are filled with
    facts.

    Parameters
    ----------
    report : `~miricigale.pages.Page`
        The page.
    texts : dict of str to dict
        Of `declared`.
    """

    #: What all sentences say: dict of str to values.
    facts = {}

    def __init__(self, report, texts):
        self.report = report
        self.texts = texts
        self._section = None

    def __repr__(self):
        return f"<{type(self).__name__} of {self.report!r}>"

    def sentence(self, name, /, **facts):
        """Return a sentence of the current section, filled with the facts of all and further ones."""
        return sentence(self.texts[self._section][name], self.facts | facts)

    def notice(self, name, /, **facts):
        """Add a sentence of ``[notices]`` to what stands above the first section."""
        self.report.notices.append(sentence(self.texts["notices"][name], self.facts | facts))

    def section(self, name, text="text", /, **facts):
        """Begin a section, with the paragraph ``text`` where it has that."""
        self._section = name
        texts = self.texts[name]
        paragraph = ""
        if text in texts:
            paragraph = self.sentence(text, **facts)
        title = sentence(texts.get("title", ""), self.facts | facts)
        closed = sentence(texts.get("closed", ""), self.facts | facts)
        self.report.section(title, paragraph, closed=closed)

    def folding(self, name, /, **facts):
        """Return a context whose figures and tables are folded, if the section folds what is called so."""
        title = self.texts[self._section].get("folded", {}).get(name)
        if title is None:
            return contextlib.nullcontext()
        return self.report.folded(sentence(title, self.facts | facts))

    def text(self, name, /, **facts):
        """Add a paragraph."""
        self.report.text(self.sentence(name, **facts))

    def items(self, values, /, **facts):
        """Add headline numbers: label, and how it is taken from values by name; unknown ones are left out."""
        pairs = []
        for label, *column in self.texts[self._section]["items"]:
            if column[0] in values:
                pairs.append((sentence(label, self.facts | facts), cell_of(values, column)))
        self.report.items(pairs)

    def figure(self, name, figure, /, **facts):
        """Add a figure with its caption, unless there is none."""
        if figure is not None:
            with self.folding(name, **facts):
                self.report.figure(figure, self.sentence(name, **facts))

    def table(self, name, rows, /, **facts):
        """Add a table as it is declared, from dictionaries; without columns it has all of their keys."""
        table = self.texts[self._section][name]
        rows = list(rows)
        facts = self.facts | facts
        keys = ()
        if rows:
            keys = list(rows[0])
        columns = {}
        for header, *column in table.get("columns", [(key, key) for key in keys]):
            if column[0] in keys:
                columns[sentence(header, facts)] = column
        cells = []
        for row in rows:
            cells.append([cell_of(row, column) for column in columns.values()])
        with self.folding(name, **facts):
            self.report.table(
                cells,
                header=tuple(columns),
                text=table.get("text", 1),
                caption=sentence(table.get("caption", ""), facts),
                empty=sentence(table.get("empty", ""), facts),
            )
