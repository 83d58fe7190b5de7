"""Whether files may be written: nothing that stands is replaced unless the caller asks for it."""

import tempfile
from pathlib import Path

from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import split_extension
from miricigale.utils.options import check_that

#: What names of files and folders may be that come from users, for messages.
FILE_NAME = (
    "printable text without / \\ and :, of at most 200 bytes, that does not begin with a dot, and neither begins "
    "nor ends with a space"
)
_LONGEST_NAME = 200


def is_file_name(text):
    """Whether text names a file or folder, and nothing outside of the folder that it is in."""
    return (
        text.isprintable()
        and text == text.strip()
        and 0 < len(text.encode("utf-8", "surrogatepass")) <= _LONGEST_NAME
        and not text.startswith(".")
        and not set(text) & set("/\\:")
    )


def check_output(path, argument, *, overwrite=False, inputs=(), kind="a file", endings=None):
    """
    Refuse a file that is not to be replaced or that could not be written, before the work is done.

    Parameters
    ----------
    path : path-like or None
        The file to be written; None is no file and always good.
    argument : str
        Name of the argument that the path came from, for the message.
    overwrite : bool, optional
        Whether a file that stands may be replaced.
    inputs : iterable of path-like, optional
        Files that are read, which are never replaced; with ``[EXTENSION]`` or without.
    kind : str, optional
        What the file is, for the message.
    endings : tuple of str, optional
        Endings of the name, in lower case, of which it must have one.

    Raises
    ------
    ValueError
        If the name has another ending, the path is a folder, an input or a file that stands, or its folder
        cannot be written to.
    """
    if path is None:
        return
    path = Path(path)
    if endings is not None and not path.name.lower().endswith(endings):
        raise argument_error(argument, f"{kind} ({', '.join(endings)})", path)
    check_that(not path.is_dir(), argument, "a file", f"the folder {path}")
    read = {Path(split_extension(name)[0]).resolve() for name in inputs}
    check_that(path.resolve() not in read, argument, "another file than those that are read", path)
    if path.exists() and not overwrite:
        raise argument_error(
            argument, "a new file (or 'overwrite' given)", f"{path}, which is there"
        )
    _check_writable(path, argument)


def check_outputs(paths, argument, *, overwrite=False, inputs=()):
    """
    Refuse files of which some are not to be replaced, with the names of all in one message.

    Parameters
    ----------
    paths : iterable of path-like
        The files to be written, and folders that get files of their own names.
    argument, overwrite, inputs
        As for `check_output`.

    Raises
    ------
    ValueError
        As `check_output`.
    """
    paths = [Path(path) for path in paths]
    standing = [path for path in paths if path.exists()]
    for path in standing:
        if not path.is_dir():
            check_output(path, argument, overwrite=True, inputs=inputs)
    if standing and not overwrite:
        names = ", ".join(path.name for path in standing)
        wanted = "a folder without files of the same names (or 'overwrite' given)"
        raise argument_error(argument, wanted, f"{standing[0].parent}, which has {names}")
    for folder in {path.parent for path in paths}:
        _check_writable(folder / "file", argument)


def _check_writable(path, argument):
    """Refuse a file whose folder, or the folder above that it would be made in, cannot be written to."""
    folder = path.parent
    while not folder.exists():
        folder = folder.parent
    try:
        # permission bits are not enough for a superuser or on a read-only disk
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as err:
        raise argument_error(argument, "in a folder that can be written to", path) from err
