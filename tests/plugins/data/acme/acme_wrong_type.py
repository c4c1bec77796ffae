"""Yields a dict where a Component is expected."""

import droidw


@droidw.hookimpl
def droidw_exporters():
    yield {"name": "acme-csv"}
