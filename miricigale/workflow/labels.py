"""What bands, sets of bands, truths and parameters are called on the page, and links to its sources."""

from urllib.parse import quote, urlencode

from miricigale.filters import Filter
from miricigale.filters.band_names import band_label
from miricigale.pages import Link
from miricigale.plotting.axes import MEASURED, SECOND, plain_text
from miricigale.utils.package_tables import declared
from miricigale.workflow.truths import CATALOG


def texts_of(section):
    """Return the sentences and tables of a section of the page by name, as they stand in its file."""
    return declared("miricigale.workflow.page", "sections.toml")[section]


_LABELS = texts_of("labels")
#: Sets of bands: what they are called, and their colors.
SET_LABELS = _LABELS["sets"]
SET_COLORS = {"all": MEASURED, "none": SECOND, "blue": "#0d9488", "red": "#a21caf"}


def band_title(name):
    """Return what a band is called in figures: `band_label`, shown as it is by matplotlib."""
    return plain_text(band_label(name))


def class_label(name):
    """Return what a class of `~miricigale.evaluation.classify` is called."""
    return _LABELS["classes"].get(name, str(name))


def parameter_label(name):
    """Return what a parameter of the fits is called."""
    return _LABELS["parameters"].get(name, name.replace("_", " "))


def truth_label(truth):
    """Return what a truth (`~miricigale.evaluation.TruthResults`) is called."""
    if truth.frac_agn is not None:
        return f"fracAGN {truth.frac_agn:g}"
    if truth.name.startswith(CATALOG):
        return "AGN of the catalog"
    return "realistic field"


def by_wavelength(names):
    """Return names of bands in the order of their pivot wavelengths."""
    return sorted(names, key=lambda name: Filter.from_name(name).pivot)


def end_bands(names):
    """Return the shortest and the longest of some bands, or the only one."""
    return by_wavelength(names)[:: max(1, len(names) - 1)]


def three_bands(names):
    """Return the shortest, the middle and the longest of some bands, or all of fewer than three."""
    bands = by_wavelength(names)
    if len(bands) < 3:
        return bands
    return [bands[0], bands[len(bands) // 2], bands[-1]]


def color_bands(names):
    """Return the bands of color images: the shortest and the longest three of six or more, or as `three_bands`."""
    if len(names) < 6:
        return three_bands(names)
    bands = by_wavelength(names)
    return bands[:3] + bands[-3:]


def browse(truth, text, source="", **filters):
    """
    Return a cell or words that link into the source browser of a truth.

    Parameters
    ----------
    truth : str
        Name of the truth.
    text : str or int
        What the reader sees; a number of 0 sources is no link.
    source : str or int, optional
        Id of the source that is opened.
    **filters
        What the browser lists: ``show``, ``flag`` and ``text`` of its controls, or a range by the
        name of a column.
    """
    if text == 0:
        return text
    page = f"sources-{quote(truth)}.html"
    anchor = quote(str(source), safe="")
    if filters:
        anchor += f"?{urlencode(filters)}"
    return Link(text, f"{page}#{anchor}" if anchor else page)
