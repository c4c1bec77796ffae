"""Ablations: rows of a table as configurations, run cell by cell, and made into a table."""
