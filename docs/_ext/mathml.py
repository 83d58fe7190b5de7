"""Equations as MathML, which browsers show without a script and without a network."""

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.errors import ExtensionError

__all__ = ["setup"]


def mathml(node, *, block):
    """The MathML of an equation in LaTeX."""
    try:
        return latex2mathml.tex2mathml(node.astext(), as_block=block)
    except Exception as err:
        msg = f"{node.source}:{node.line}: {err} in the equation {node.astext()!r}"
        raise ExtensionError(msg) from err


def visit_inline(self, node):
    """Write an equation within a line."""
    self.body.append(mathml(node, block=False))
    raise nodes.SkipNode


def visit_block(self, node):
    """Write an equation of its own line, with its number if it has one."""
    self.body.append(self.starttag(node, "div", CLASS="math"))
    if node["number"]:
        self.body.append(f'<span class="eqno">({node["number"]})</span>')
    self.body.append(mathml(node, block=True) + "</div>\n")
    raise nodes.SkipNode


def setup(app):
    """Add the renderer to Sphinx."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
