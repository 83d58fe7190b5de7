"""Percentiles of samples by their columns."""

#: Levels of percentiles.
LEVELS = (0.16, 0.5, 0.84)


def suffix(level):
    """Name of the percentile of a level, in columns."""
    return f"p{100 * level:g}"
