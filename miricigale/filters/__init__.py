"""Passbands: curves, synthetic photometry, and weights for fast band averages."""

from miricigale.filters.filter import Filter
from miricigale.filters.filter_set import FilterSet

__all__ = ["Filter", "FilterSet"]
