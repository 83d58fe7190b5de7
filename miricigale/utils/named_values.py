"""Values by name: of the attributes of an object, or some of those in a dictionary."""

import dataclasses


def attributes(instance, names):
    """Return attributes of an object by name, in the order of ``names``."""
    return {name: getattr(instance, name) for name in names}


def field_values(instance):
    """Return the fields of a dataclass by name; the values are not copied, as `dataclasses.asdict` does."""
    return attributes(instance, field_names(instance))


def field_names(cls):
    """List the names of the fields of a dataclass, or of an instance of one."""
    return [field.name for field in dataclasses.fields(cls)]


def first_value(mapping):
    """Return the first value of a mapping, which has one at least."""
    return next(iter(mapping.values()))


def subset(mapping, names):
    """Return the values of some keys of a dictionary, or of some columns of a table, in the order of ``names``."""
    return {name: mapping[name] for name in names}


def without(mapping, names):
    """Return the items of a dictionary but those of some keys, which need not be there."""
    return {key: value for key, value in mapping.items() if key not in names}


def without_none(mapping):
    """Return the items of a dictionary whose value is not None."""
    return {key: value for key, value in mapping.items() if value is not None}


def places(names, sequence):
    """List the index of each name in a sequence of names, such as columns of bands in an array."""
    return [sequence.index(name) for name in names]


def convert_values(function, mapping):
    """Return a dictionary with the same keys, and what a function makes of each value."""
    return {key: function(value) for key, value in mapping.items()}


def rows_of(columns, rows):
    """Return some rows (an index, a slice or a mask) of columns by name."""
    return {name: column[rows] for name, column in columns.items()}
