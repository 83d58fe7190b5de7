"""Subpackages whose names are loaded on first use, and say what is meant by a name that they do not have."""

import lazy_loader


class UnknownModuleAttributeError(AttributeError):
    """
    A name that a subpackage does not have, with what to write instead.

    The hint is looked up when the message is read: most of such errors only answer ``hasattr``.

    Parameters
    ----------
    module : str
        Name of the subpackage.
    name : str
        What was asked for.
    """

    def __init__(self, module, name):
        # not `obj`, by which Python would append a suggestion of its own
        super().__init__(f"module {module!r} has no attribute {name!r}", name=name)
        self._module = module

    def __str__(self):
        message = self.args[0]
        # loads numpy, which ``import miricigale`` does without
        from miricigale.utils.module_hints import module_hint

        hint = module_hint(self._module, self.name)
        if hint:
            return f"{message}; {hint}"
        return message

    def __reduce__(self):
        return type(self), (self._module, self.name)


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
