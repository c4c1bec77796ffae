"""A sound plugin: a feature extractor that runs anywhere, and parts that lack something."""

from dataclasses import dataclass, field

import droidw


@dataclass(frozen=True)
class Options:
    scale: float = field(default=1.0, metadata={"help": "factor on all features", "gt": 0})
    taps: tuple[int, ...] = (1, 2)


@droidw.hookimpl
def droidw_feature_extractors():
    yield droidw.Component(
        "acme",
        "features of the Acme network",
        lambda options, context: options,
        options=Options,
        capabilities=frozenset({"cpu", "cuda", "features"}),
    )
    yield droidw.Component("acme-cuda", "cuda only", print, capabilities=frozenset({"cuda"}))


@droidw.hookimpl
def droidw_depth_priors():
    yield droidw.Component(
        "acme-extra", "needs a package", print, requires=("acme_net",), extra="net"
    )
    yield droidw.Component("acme-package", "no extra", print, requires=("acme_net", "json"))
    yield droidw.Component("acme-weights", "needs weights", print, weights=("acme.pth",))
    yield droidw.Component("acme-gpu", "needs a GPU", print, available=lambda: "no GPU visible")
    yield droidw.Component("acme-odd", "its check raises", print, available=lambda: str(1 / 0))
