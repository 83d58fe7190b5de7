"""Detection of sources, segments, prior catalogs, cutouts."""
