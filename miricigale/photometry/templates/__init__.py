"""Templates of sources on the image's grid, and their normal equations."""
