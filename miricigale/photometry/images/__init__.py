"""Images and mosaics that are measured: files, grids, noise, flags."""
