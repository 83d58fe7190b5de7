"""Values of the components of models."""


def values_of(component, **changes):
    """The defaults of a component's parameters, but for these."""
    return {name: par.default for name, par in component.parameters.items()} | changes
