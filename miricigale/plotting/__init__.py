"""Figures from arrays and tables; nothing here knows a class of the package."""
