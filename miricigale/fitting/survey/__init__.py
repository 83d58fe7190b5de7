"""Calibration on survey data: zero points, errors of bands, templates and priors."""
