"""
Directives of the lookup pages, whose tables are made from the code.

``.. flag-table:: PATH`` shows every bit of a class of flags: value, name and meaning.
``.. column-table::`` runs its content, which ends with an expression for a table, and shows the
names, units and descriptions of the columns. Blocks of a page share their variables.
"""

import importlib

from docutils.statemachine import StringList
from lookup import column_rows, escape, flag_rows, run_block
from sphinx.util.docutils import SphinxDirective

__all__ = ["ColumnTable", "FlagTable", "setup"]


def table_lines(head, widths, rows):
    """Lines of a list-table; cells are reStructuredText."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for row in (head, *rows):
        marks = ["   * - ", *["     - "] * (len(row) - 1)]
        lines += [mark + cell for mark, cell in zip(marks, row, strict=True)]
    return [*lines, ""]


class FlagTable(SphinxDirective):
    """Show the bits of a class of flags."""

    required_arguments = 1
    has_content = False

    def run(self):
        """Nodes of the table."""
        module, _, name = self.arguments[0].rpartition(".")
        try:
            flags = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as err:
            raise self.error(f"no class of flags {self.arguments[0]!r}: {err}") from err
        rows = [(f"{value}", f"``{word}``", escape(text)) for value, word, text in flag_rows(flags)]
        lines = table_lines(("value", "name", "meaning"), "14 24 62", rows)
        return self.parse_text_to_nodes(StringList(lines, f"flag-table {self.arguments[0]}"))


class ColumnTable(SphinxDirective):
    """Show the columns of a table."""

    has_content = True

    def run(self):
        """Nodes of the table."""
        names = self.env.temp_data.setdefault("column-table", {})
        try:
            rows = column_rows(run_block("\n".join(self.content), names))
        except Exception as err:
            raise self.error(f"the block of the table fails: {err!r}") from err
        rows = [(f"``{name}``", escape(unit) or "–", text or "–") for name, unit, text in rows]
        lines = table_lines(("column", "unit", "meaning"), "30 12 58", rows)
        return self.parse_text_to_nodes(StringList(lines, "column-table"))


def setup(app):
    """Add the directives to Sphinx."""
    app.add_directive("flag-table", FlagTable)
    app.add_directive("column-table", ColumnTable)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
