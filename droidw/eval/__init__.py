"""Evaluation: reads files only, and states how each number was made."""
