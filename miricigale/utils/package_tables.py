"""What the package declares in TOML files beside its modules: texts, names, presets."""

import tomllib
from importlib import resources

from miricigale.utils.caching import cached


@cached
def declared(package, file="page.toml"):
    """
    Read a TOML file of the package, once.

    Parameters
    ----------
    package : str
        Package that has the file, such as ``"miricigale.fitting"``.
    file : str, optional
        Its name.

    Returns
    -------
    tables : dict
        As they stand in the file; not to be changed.
    """
    return tomllib.loads((resources.files(package) / file).read_text("utf-8"))


def column_texts(package, table):
    """
    Read what the columns of a table are, for their descriptions.

    Parameters
    ----------
    package : str
        Package whose ``columns.toml`` has them.
    table : str
        Name of the table there.

    Returns
    -------
    texts : dict of str to str
        By column; not to be changed.
    """
    return declared(package, "columns.toml")[table]


def hint_sentences(table):
    """
    Resolve hints that stand for one another.

    Parameters
    ----------
    table : dict of str to str
        Sentences by name; one that is another name of the table stands for the sentence of that.

    Returns
    -------
    sentences : dict of str to str

    Examples
    --------
    >>> from miricigale.utils.package_tables import hint_sentences
    >>> hint_sentences({"band": "a filter is meant", "filt": "band"})
    {'band': 'a filter is meant', 'filt': 'a filter is meant'}
    """
    return {name: table.get(sentence, sentence) for name, sentence in table.items()}
