"""What the tests of several folders share: light in closed form, scenes, mosaics, grids, results."""
