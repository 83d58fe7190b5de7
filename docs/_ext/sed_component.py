"""
Directives that show what the code declares, so that no page repeats it by hand.

``.. sed-component:: NAME`` shows a component of a model: class, role, reference, the data that
it reads, options, parameters and a figure; a name that is not registered is an error of the build.
``.. sed-derived::`` shows the table of derived quantities.
"""

import re

from component_figure import panels_of
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

from miricigale import sed
from miricigale.refdata import resource
from miricigale.sed import COMPONENTS, DERIVED, components

__all__ = [
    "SEDComponent",
    "SEDDerived",
    "component_lines",
    "derived_lines",
    "figure_lines",
    "setup",
]

_KINDS = {
    "bundled": "comes with the package",
    "package": "read from an installed package",
    "user": "to be brought by you",
}


def escape(text):
    """Text that reStructuredText shows as it is, markup characters included."""
    return re.sub(r"([\\*`|_])", r"\\\1", " ".join(str(text).split()))


def component_lines(name):
    """
    What a component declares, as lines of reStructuredText.

    Parameters
    ----------
    name : str
        The component's ``name``.

    Returns
    -------
    lines : list of str

    Raises
    ------
    KeyError
        If no such component is registered.
    """
    cls = COMPONENTS.get(name)
    # where the reference has it
    home = components if cls.__module__.startswith(components.__name__) else sed
    where = home.__name__ if hasattr(home, cls.__name__) else cls.__module__
    fields = [
        ("Name", f"``{name}``, :class:`~{where}.{cls.__name__}`"),
        ("Role", f"``{cls.role}``"),
        ("Paper", escape(cls.reference) or "–"),
    ]
    if cls.resource:
        fields += _data_fields(resource(cls.resource))
    else:
        fields.append(("Data", "none"))
    lines = [f":{key}: {text}" for key, text in fields]
    options = cls.all_options()
    if options:
        rows = [
            (f"``{option}``", f"``{values[0]}``", ", ".join(f"``{v}``" for v in values[1:]) or "–")
            for option, values in options.items()
        ]
        lines += _table("Options", ("option", "default", "others"), rows)
    rows = [
        (
            f"``{par.name}``",
            escape(par.unit.to_string()) or "–",
            f"{par.default:g}",
            f"{par.bounds[0]:g} to {par.bounds[1]:g}",
            escape(par.doc),
        )
        for par in cls.declared().values()
    ]
    if rows:
        head = ("parameter", "unit", "default", "bounds", "meaning")
        lines += _table("Parameters", head, rows)
    else:
        lines += ["", "It has no parameters."]
    return [*lines, ""]


def figure_lines(name):
    """
    Figure of a component, as lines of reStructuredText.

    Components whose data users bring have a sentence in its place.

    Parameters
    ----------
    name : str
        The component's ``name``.

    Returns
    -------
    lines : list of str
    """
    if not panels_of(name):
        return ["No figure here: the component needs data of yours.", ""]
    return [
        ".. plot::",
        f"   :alt: {name} for some values of its parameters",
        f"   :caption: ``{name}`` for some values of its parameters, the others at their defaults.",
        "",
        "   from component_figure import draw",
        f"   draw({name!r})",
        "",
    ]


def derived_lines():
    """Derived quantities, as lines of reStructuredText."""
    rows = [
        (f"``{name}``", escape(entry.unit.to_string()) or "–", escape(entry.text))
        for name, entry in DERIVED.items()
    ]
    return [*_table("Derived quantities", ("name", "unit", "meaning"), rows), ""]


def _data_fields(record):
    kind = _KINDS[record.kind]
    fields = [("Data", f"``{record.name}``, {kind}: {escape(record.title)}")]
    if record.kind == "user":
        source = escape(record.source)
        fields += [
            ("Source", source),
            (
                "Register",
                f"``miricigale data add {record.name} PATH``; see :doc:`/method/data`",
            ),
        ]
    fields += [("License", escape(record.licence)), ("Cite", escape(record.citation))]
    return fields


def _table(title, head, rows):
    """Lines of a list-table."""
    lines = ["", f".. list-table:: {title}", "   :header-rows: 1", ""]
    for row in (head, *rows):
        marks = ["   * - ", *["     - "] * (len(row) - 1)]
        lines += [mark + cell for mark, cell in zip(marks, row, strict=True)]
    return lines


class SEDComponent(SphinxDirective):
    """Show what a component declares."""

    required_arguments = 1
    has_content = False

    def run(self):
        """Nodes of the fields and tables."""
        try:
            lines = component_lines(self.arguments[0]) + figure_lines(self.arguments[0])
        except KeyError as err:
            raise self.error(str(err.args[0])) from err
        source = f"sed-component {self.arguments[0]}"
        return self.parse_text_to_nodes(StringList(lines, source))


class SEDDerived(SphinxDirective):
    """Show the derived quantities."""

    has_content = False

    def run(self):
        """Nodes of the table."""
        return self.parse_text_to_nodes(StringList(derived_lines(), "sed-derived"))


def setup(app):
    """Add the directives to Sphinx."""
    app.setup_extension("matplotlib.sphinxext.plot_directive")
    app.add_directive("sed-component", SEDComponent)
    app.add_directive("sed-derived", SEDDerived)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
