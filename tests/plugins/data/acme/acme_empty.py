"""Forgets the marker."""


def droidw_exporters():
    return []
