"""What the tests of several rooms share: light in closed form, scenes, mosaics, grids, results."""
