"""Raises when asked what it offers."""

import droidw


@droidw.hookimpl
def droidw_exporters():
    raise RuntimeError("no licence key")
