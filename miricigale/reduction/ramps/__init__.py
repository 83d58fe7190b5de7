"""Slopes of ramps: fits, settling, showers, reference pixels."""
