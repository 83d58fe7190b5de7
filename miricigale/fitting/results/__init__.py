"""Results of fits: tables, samples, figures, files."""
