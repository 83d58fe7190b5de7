"""Shapes of sources on the high-resolution image."""
