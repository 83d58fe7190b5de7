"""Errors of attributes whose messages say what to write instead."""


class HintedAttributeError(AttributeError):
    """
    An attribute that is not there, with what to write instead.

    The hint of a subclass is looked up when the message is read: most of such errors only answer ``hasattr``.

    Parameters
    ----------
    owner : object
        What was asked.
    name : str
        The attribute.
    label : str
        What the owner is called in the message.
    """

    def __init__(self, owner, name, label):
        # not `obj`, by which Python would append a suggestion of its own
        super().__init__(f"{label} has no attribute {name!r}", name=name)
        self._owner = owner

    def _hint(self):
        raise NotImplementedError

    def __str__(self):
        hint = self._hint()
        if hint:
            return f"{self.args[0]}; {hint}"
        return self.args[0]

    def __reduce__(self):
        return type(self), (self._owner, self.name)
