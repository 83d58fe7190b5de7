"""Fits on grids of models, and between their nodes."""
