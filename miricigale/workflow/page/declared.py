"""What is declared of the study's page in `sections.toml`, filled with facts of a run."""

import functools
import tomllib
from importlib import resources

from markupsafe import Markup


@functools.cache
def _texts():
    text = (resources.files("miricigale.workflow.page") / "sections.toml").read_text("utf-8")
    return tomllib.loads(text)


def texts_of(section):
    """Return the sentences and tables of a section by name, as they stand in the file."""
    return _texts()[section]


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
