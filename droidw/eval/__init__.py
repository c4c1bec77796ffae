"""Evaluation: files in, numbers out; nothing here knows of a running system."""
