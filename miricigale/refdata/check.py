"""The state of every resource: there, whole, and what its record says."""

from typing import NamedTuple

from miricigale.refdata.lookup import file_sha256, find_place, stored_record
from miricigale.refdata.registry import resources
from miricigale.utils.exceptions import DataError


class ResourceState(NamedTuple):
    """
    State of one resource.

    Parameters
    ----------
    name : str
        The resource.
    state : str
        ``"ok"``; ``"absent"``; ``"wrong checksum"`` (another file than its record describes);
        ``"damaged"`` (cannot be opened as what it should be); ``"unchecked"`` (there, but
        nothing says what it should be); ``"from package"``.
    where : str
        Path, or source if absent.
    message : str
        What is wrong, or empty.

    Examples
    --------
    >>> from miricigale.refdata import check_resources
    >>> state = next(row for row in check_resources() if row.name == "ssp.bc03")
    >>> state.state
    'ok'
    """

    name: str
    state: str
    where: str
    message: str = ""

    @property
    def bad(self):
        """Whether results that use the resource cannot be trusted."""
        return self.state in ("wrong checksum", "damaged")


def check_resources():
    """
    State of every resource, from its whole content.

    Files are compared with the checksum of the record in ``resources.toml``, or with that of
    the record that was written beside them when they were added; libraries are read as a whole.

    Returns
    -------
    rows : list of `ResourceState`
        One for each record.

    Examples
    --------
    >>> from miricigale.refdata import check_resources
    >>> [row.name for row in check_resources() if row.bad]
    []
    """
    return list(map(_state, resources().values()))


def _state(record):
    from miricigale.refdata.libraries import READERS, verify_library

    name = record.name
    if not record.file:
        return ResourceState(name, "from package", record.source)
    path = find_place(record)[1]
    if path is None:
        return ResourceState(name, "absent", record.source)
    place = str(path)
    try:
        record_file = stored_record(path)
        if name in READERS:
            verify_library(path, name)
        wanted = record.sha256 or (record_file or {}).get("sha256", "")
        if not wanted:
            return ResourceState(name, "unchecked", place, "no record of its checksum")
        if file_sha256(path) != wanted:
            return ResourceState(name, "wrong checksum", place, "sha256 differs from its record")
    except OSError as err:
        message = str(err)
        if not isinstance(err, DataError):
            message = f"{path} cannot be read: {err}"
        return ResourceState(name, "damaged", place, message)
    return ResourceState(name, "ok", place)
