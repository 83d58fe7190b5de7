"""Errors of fluxes: models, curves, calibration, noise of images."""
