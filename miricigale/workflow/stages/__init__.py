"""The stages of the study, each declared beside its function."""
