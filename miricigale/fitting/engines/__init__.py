"""Ways to find a posterior; the grid engine is the one that every installation has."""
