"""What is fitted: photometry with its flags, likelihood, settings, errors of templates."""
