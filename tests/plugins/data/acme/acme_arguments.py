"""Wants an argument that the hook does not have."""

import droidw


@droidw.hookimpl
def droidw_exporters(folder):
    return []
