"""Methods ``read`` and ``write`` of our classes by `astropy.io.registry`."""

import importlib
import os
from inspect import cleandoc

from astropy.io import registry
from astropy.io.registry import UnifiedReadWrite, UnifiedReadWriteMethod

from miricigale.utils.files import split_extension
from miricigale.utils.table_files import write_table

_SUFFIXES = {"fits": (".fits", ".fit", ".fits.gz"), "ascii.ecsv": (".ecsv",), "ds9": (".reg",)}


class _Method(UnifiedReadWrite):
    """What ``read`` and ``write`` share: the formats of a class are registered on first use."""

    method = None

    def __init__(self, instance, cls):
        super().__init__(instance, cls, self.method)
        # the method's own text, where it is looked up on an instance
        self.__doc__ = type(self).__doc__

    def _format(self, path, kwargs):
        importlib.import_module(self._cls.io_module)
        stated_format = kwargs.pop("format", None)
        if stated_format is not None:
            return stated_format
        path = split_extension(path)[0]
        formats_found = registry.identify_format(self.method, self._cls, path, None, [path], kwargs)
        if len(formats_found) == 1:
            return formats_found[0]
        formats = registry.get_formats(self._cls, self.method.capitalize())["Format"].tolist()
        suffixes = [suffix for name in formats for suffix in _SUFFIXES.get(name, ())]
        msg = f"{path} must end in one of {', '.join(suffixes)}, or 'format' be one of {formats}"
        raise registry.IORegistryError(msg)

    def __repr__(self):
        return f"<method {self._cls.__name__}.{self.method}>"


class _Read(_Method):
    """
    Read {what} from a file that `write` made.

    Parameters
    ----------
    path : path-like
        The file.
    {options}format : str, optional
        By default by the suffix of ``path``.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, something else or incomplete.
    """

    method = "read"

    def __call__(self, path, *args, **kwargs):
        file_format = self._format(path, kwargs)
        return self.registry.read(self._cls, path, *args, format=file_format, **kwargs)


class _Write(_Method):
    """
    Write {what} to a file, from which `read` gets it back.

    Parameters
    ----------
    path : path-like
        The file.
    format : str, optional
        By default by the suffix of ``path``.
    overwrite : bool, optional
        Whether a file that is there is replaced.

    Raises
    ------
    OSError
        If the file is there and ``overwrite`` is not set.
    """

    method = "write"

    def __call__(self, path, *args, **kwargs):
        importlib.import_module(self._cls.io_module)
        file_format = registry.identify_format(
            "write", self._cls, os.fspath(path), None, [path], kwargs
        )
        # other formats hold the table that people want, and cannot be read back as the whole
        if not file_format and "format" not in kwargs and hasattr(self._instance, "to_table"):
            return write_table(self._instance.to_table(), path, **kwargs)
        file_format = self._format(path, kwargs)
        return self.registry.write(self._instance, path, *args, format=file_format, **kwargs)


def read_write(what, options=""):
    """
    Class attributes ``read`` and ``write`` of a class.

    The methods are ``read(path, *, format=None, **options)`` and ``write(path, *, format=None, overwrite=False)``.
    The class has an attribute ``io_module``: the name of the module that registers its formats, imported when
    a file is first read or written.

    Parameters
    ----------
    what : str
        What a file holds, such as ``"a PSF"``.
    options : str, optional
        Further lines of the docstring of ``read``: its parameters, which `register` knows.

    Returns
    -------
    read, write
    """
    if options:
        # first lines stand at no indent, further ones at that of the class
        options = cleandoc(options) + "\n"
    docs = [cleandoc(base.__doc__).format(what=what, options=options) for base in (_Read, _Write)]
    return tuple(
        UnifiedReadWriteMethod(type(base.__name__, (base,), {"__doc__": doc}))
        for base, doc in zip((_Read, _Write), docs, strict=True)
    )


def register(cls, *, read=None, write=None, name="fits"):
    """
    Register a format of a class, known by its suffix.

    Parameters
    ----------
    cls : type
        The class.
    read : callable, optional
        ``read(path, **options)`` returns an instance.
    write : callable, optional
        ``write(instance, path, *, overwrite=False)``.
    name : {"fits", "ascii.ecsv", "ds9"}, optional
        Name of the format.
    """

    def matches(origin, path, fileobj, *args, **kwargs):
        return path is not None and str(path).lower().endswith(_SUFFIXES[name])

    if read is not None:
        registry.register_reader(name, cls, read)
    if write is not None:
        registry.register_writer(name, cls, write)
    registry.register_identifier(name, cls, matches)
