"""Subpackages whose names are loaded on first use, and say what is meant by a name that they do not have."""

import lazy_loader

from miricigale.utils.hinted_errors import HintedAttributeError


class UnknownModuleAttributeError(HintedAttributeError):
    """
    A name that a subpackage does not have, with what to write instead.

    Parameters
    ----------
    module : str
        Name of the subpackage.
    name : str
        What was asked for.
    """

    def __init__(self, module, name):
        super().__init__(module, name, f"module {module!r}")

    def _hint(self):
        # loads numpy, which ``import miricigale`` does without
        from miricigale.utils.module_hints import module_hint

        return module_hint(self._owner, self.name)


def attach_stub(package_name, filename):
    """
    Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, from the stub file beside it.

    They are those of `lazy_loader.attach_stub`, but for the message of names that are not there.
    """
    load, list_names, names = lazy_loader.attach_stub(package_name, filename)
    available = frozenset(names)

    def load_name(name):
        if name in available:
            return load(name)
        raise UnknownModuleAttributeError(package_name, name)

    return load_name, list_names, names
