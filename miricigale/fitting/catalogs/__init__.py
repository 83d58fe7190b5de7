"""Fits of catalogs in files: from file to file, classes of sources, pages, checks on mock catalogs."""
