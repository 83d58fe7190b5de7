"""Calibrated images: flags, readers, writers, repeated exposures."""
