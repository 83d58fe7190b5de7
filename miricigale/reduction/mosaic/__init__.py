"""Mosaics of images, and rejection of outliers."""
