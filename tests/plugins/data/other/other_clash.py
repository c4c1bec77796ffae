"""Takes a name that the fixture `acme` has too."""

import droidw


@droidw.hookimpl
def droidw_feature_extractors():
    return [droidw.Component("acme", "another acme", print)]
