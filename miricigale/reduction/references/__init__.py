"""Detector constants and reference files, and calibration with them."""
