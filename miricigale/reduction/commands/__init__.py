"""Reduction from files to files."""
