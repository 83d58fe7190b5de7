"""Utilities that every subpackage uses: units, validation, tables, randomness, parallel maps."""
