"""Import of optional packages, with the pip command in the error if one is missing."""

import importlib


def require(module, *, extra):
    """
    Import an optional package or say how to install it.

    Parameters
    ----------
    module : str
        Name of the module to import.
    extra : str
        The extra of this package that installs it.

    Returns
    -------
    module : module

    Raises
    ------
    ImportError
        If the package is not installed; the message holds the pip command.
    """
    try:
        return importlib.import_module(module)
    except ImportError as err:
        msg = f"{module!r} is needed for this: pip install 'miricigale[{extra}]'"
        raise ImportError(msg) from err
