"""Templates of the pages, and figures as images within them."""

import base64
import io

import jinja2

from miricigale.utils.caching import cached

#: Points, line nodes and glyphs above which a figure is smaller as pixels than as vectors.
_MAX_MARKS = 1500


@cached
def _environment():
    return jinja2.Environment(
        loader=jinja2.PackageLoader("miricigale.pages"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


@cached
def macros():
    """Return the blocks that make up a page: functions that return markup."""
    return _environment().get_template("macros.html").module


def render(template, **values):
    """Return a page as text: a template of this package, filled with values that are escaped."""
    return _environment().get_template(template).render(**values)


def image_of(figure, dpi):
    """
    Draw a matplotlib figure.

    Parameters
    ----------
    figure : `~matplotlib.figure.Figure`
        The figure.
    dpi : float
        Pixels of the page per inch of the figure.

    Returns
    -------
    source : str
        Address that holds the image: vectors where the figure has few marks, otherwise pixels at
        twice the resolution of the page. The same figure gives the same bytes.
    width : int
        Width on the page in pixels.
    """
    from matplotlib import rc_context

    if figure.get_layout_engine() is None:
        figure.set_layout_engine("constrained")
    # dates and the version of matplotlib are omitted, and ids do not depend on chance
    if _count_marks(figure) <= _MAX_MARKS:
        kind = "svg+xml"
        options = {"format": "svg", "metadata": {"Date": None, "Creator": None}}
    else:
        kind = "png"
        options = {"format": "png", "metadata": {"Software": None}, "dpi": 2 * dpi}
        # faster than the default level, and smaller for pixels that are repeated
        options["pil_kwargs"] = {"compress_level": 2}
    buffer = io.BytesIO()
    # laid out here: savefig draws all of a figure once more for its layout
    figure.set_dpi(options.get("dpi", figure.dpi))
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine(None)
    with rc_context({"svg.hashsalt": "miricigale"}):
        figure.savefig(buffer, **options)
    width = round(dpi * figure.get_figwidth())
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}", width


def _count_marks(figure):
    """Return the number of points and line nodes of a figure; infinite if it has an image."""
    from matplotlib.collections import Collection
    from matplotlib.image import AxesImage
    from matplotlib.lines import Line2D

    # images are looked for first: walking through all artists makes the ticks of all axes
    for axes in figure.axes:
        if axes.images:
            return float("inf")
    marks = 0
    for artist in figure.findobj():
        if isinstance(artist, AxesImage):
            return float("inf")
        if isinstance(artist, Line2D):
            marks += len(artist.get_xdata(orig=False))
        elif isinstance(artist, Collection):
            marks += max(len(artist.get_offsets()), len(artist.get_paths()))
    return marks
