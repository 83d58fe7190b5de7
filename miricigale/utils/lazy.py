"""Names of a package that are imported on first use (PEP 562)."""

import importlib
import sys


def lazy_names(package, names):
    """
    Let a package import its modules when one of their names is first asked for.

    Parameters
    ----------
    package : str
        Name of the package, ``__name__``.
    names : dict of str to tuple of str
        The public names of each module of the package; none for a module that is public itself.

    Returns
    -------
    getter, lister, names : callable, callable, list of str
        The package's ``__getattr__``, ``__dir__`` and ``__all__``.

    Examples
    --------
    In an ``__init__.py``::

        __getattr__, __dir__, __all__ = lazy_names(__name__, {"filter": ("Filter",)})
    """
    home = {name: module for module, own in names.items() for name in own or (module,)}

    def getter(name):
        if name not in home:
            msg = f"module {package!r} has no attribute {name!r}"
            # with these Python tells the nearest name
            raise AttributeError(msg, name=name, obj=sys.modules[package])
        module = importlib.import_module(f"{package}.{home[name]}")
        value = module if name == home[name] and not names[name] else getattr(module, name)
        # next time the name is there
        setattr(sys.modules[package], name, value)
        return value

    def lister():
        return sorted(home)

    return getter, lister, sorted(home)
