"""Forced photometry: the fit of templates to an image, its results, apertures."""
