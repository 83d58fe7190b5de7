"""Shelves that every room uses: units, validation, tables, randomness, parallel maps."""
