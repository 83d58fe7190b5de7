"""The study's page: its numbers, panels and sections, the comparison with the paper, and provenance."""
