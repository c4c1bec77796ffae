"""A hook with a typing error."""

import droidw


@droidw.hookimpl
def droidw_uncertanty_models():
    return []
