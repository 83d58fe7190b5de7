"""Records of the reference data, and registries of named things that cite."""

import dataclasses

from miricigale.utils.caching import cached
from miricigale.utils.options import check_names
from miricigale.utils.package_tables import declared


@dataclasses.dataclass(frozen=True)
class Resource:
    """
    One record of ``resources.toml``.

    Parameters
    ----------
    name : str
        Such as ``"ssp.bc03"``.
    kind : str
        ``"bundled"`` (a file of this package), ``"package"`` (made from an installed
        package such as astro-sedpy) or ``"user"`` (brought by the user).
    title : str
        One line that says what it is.
    licence : str
        License of the numbers' authors and of the package they came in.
    citation : str
        What to cite.
    source : str
        Where the numbers come from.
    file : str, optional
        Path below ``refdata/files`` for bundled resources; below the data folder else.
    sha256 : str, optional
        Checksum of the file.
    script : str, optional
        The script in ``tools/`` that made it.
    retrieved : str, optional
        ISO date.
    notes : str, optional
        Accuracy, caveats.

    Examples
    --------
    >>> from miricigale.refdata import resource
    >>> one = resource("torus.skirtor2016")
    >>> one.kind, one.citation
    ('user', 'Stalevski et al. 2012, MNRAS 420, 2756; Stalevski et al. 2016, MNRAS 458, 2288')
    """

    name: str
    kind: str
    title: str
    licence: str
    citation: str
    source: str
    file: str = ""
    sha256: str = ""
    script: str = ""
    retrieved: str = ""
    notes: str = ""


@cached
def resources():
    """
    Return all records of ``resources.toml``.

    Returns
    -------
    records : dict of str to `Resource`

    Examples
    --------
    >>> from miricigale.refdata import resources
    >>> sorted(resources())[:3]
    ['catalog.goodss', 'dust.dale2014', 'dust.dl07']
    """
    entries = declared("miricigale.refdata", "resources.toml").items()
    records = {}
    for name, entry in entries:
        records[name] = Resource(name=name, **entry)
    return records


def resource(name):
    """
    Return the record of one resource.

    Raises
    ------
    KeyError
        If there is no such resource; the message lists the known ones.

    Examples
    --------
    >>> from miricigale.refdata import resource
    >>> resource("ssp.bc03").kind
    'bundled'
    """
    check_names([name], "resource", resources())
    return resources()[name]


def citations(*names):
    """
    Return what to cite for the named resources, as a sorted list without repeats.

    Examples
    --------
    >>> from miricigale.refdata import citations
    >>> citations("igm.inoue2014")
    ['Inoue et al. 2014, MNRAS 442, 1805']
    """
    texts = set()
    for name in names:
        texts.add(resource(name).citation)
    return sorted(texts)


class Registry:
    """
    Named things made on first use.

    Parameters
    ----------
    kind : str
        What is registered, for messages ("filter").

    Examples
    --------
    >>> from miricigale.refdata import Registry
    >>> registry = Registry("color")
    >>> registry.register("red", lambda name: (1, 0, 0), citation="none")
    >>> registry.names(), registry.get("red")
    (['red'], (1, 0, 0))
    """

    def __init__(self, kind):
        self.kind = kind
        self._loaders = {}

    def __repr__(self):
        return f"<Registry of {len(self._loaders)} names, each a {self.kind}>"

    def register(self, name, loader, *, replace=False, **metadata):
        """Register ``loader(name)``; a name that is there is an error unless ``replace``."""
        if name in self._loaders and not replace:
            msg = f"{self.kind} {name!r} is registered already"
            raise ValueError(msg)
        self._loaders[name] = (loader, metadata)

    def names(self):
        """Return all names, sorted."""
        return sorted(self._loaders)

    def metadata(self, name):
        """Return the metadata given at registration; nothing is loaded."""
        return dict(self._entry(name)[1])

    def get(self, name):
        """Make the named thing (no cache: values are the loader's business)."""
        return self._entry(name)[0](name)

    def _entry(self, name):
        check_names([name], self.kind, self._loaders)
        return self._loaders[name]

    def __contains__(self, name):
        return name in self._loaders
