"""Posteriors of parameters and derived quantities, and their priors."""
