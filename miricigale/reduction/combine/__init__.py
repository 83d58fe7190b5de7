"""Alignment and combination of exposures."""
