"""Plugins: what they declare, how they are found, and the registries they fill."""
