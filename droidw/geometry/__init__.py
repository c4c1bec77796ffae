"""Geometry: poses, cameras, projection, alignment; the lowest layer."""
