"""The eight hooks by which a plugin offers its parts; each docstring is a complete guide.

All hooks are plural and take no arguments: a plugin answers with any number of `Component`
records. They are called once, when plugins are loaded, so a plugin module must import nothing
heavy at its top; the factory of a component does that when the component is chosen.

A plugin is a module (or any object) with functions marked `@droidw.hookimpl`. droidw finds it
by an entry point of group `droidw` in an installed package::

    [project.entry-points.droidw]
    acme = "droidw_acme.plugin"

or by `droidw run ... --plugin path/to/file.py`, or from Python by
`plugins = droidw.register(module)`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.interfaces.correspondence import Correspondence
    from droidw.interfaces.datasets import DatasetReader
    from droidw.interfaces.depth import DepthPrior
    from droidw.interfaces.exporters import Exporter
    from droidw.interfaces.features import FeatureExtractor
    from droidw.interfaces.observers import Observer
    from droidw.interfaces.uncertainty import UncertaintyModel
    from droidw.plugin.component import Component

__all__ = ["PROJECT", "hookimpl", "hookspec"]

PROJECT = "droidw"

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def droidw_feature_extractors() -> Iterable[Component[FeatureExtractor]]:
    """Offer feature extractors, chosen by `features.name`.

    The factory returns a `droidw.interfaces.features.FeatureExtractor`: `dim` channels, and
    `extract(image, grid)` that gives `[dim,h,w]` at the cells of the grid. Say the capability
    "features" unless `dim` is 0. Check yours with
    `droidw.testing.conformance.check_feature_extractor(component)`. Example::

        from dataclasses import dataclass, field
        import droidw

        @dataclass(frozen=True)
        class Options:
            scale: float = field(default=1.0, metadata={"help": "factor on all features", "gt": 0})

        def build(options, context):
            from droidw_acme.network import AcmeFeatures  # torch is imported here, not above
            return AcmeFeatures(options.scale, context.device)

        @droidw.hookimpl
        def droidw_feature_extractors():
            yield droidw.Component(
                name="acme", summary="features of the Acme network", factory=build,
                options=Options, capabilities=frozenset({"cpu", "cuda", "features"}),
            )
    """
    raise NotImplementedError


@hookspec
def droidw_depth_priors() -> Iterable[Component[DepthPrior]]:
    """Offer depth priors, chosen by `depth.name`.

    The factory returns a `droidw.interfaces.depth.DepthPrior`: `metric`, and `predict(frame)`
    that gives depth at the size of `frame.image` or None. Say the capability "depth" unless it
    never gives any. Check with `droidw.testing.conformance.check_depth_prior`. Example::

        import droidw

        WEIGHTS = droidw.WeightsFile(
            name="acme-depth", urls=("https://acme.example/depth.pth",), size=90_000_000,
            licence="CC BY-NC 4.0", check="droidw_acme.depth:check",
        )

        def build(options, context):
            from droidw.io.weights import load_state
            from droidw_acme.depth import AcmeDepth
            return AcmeDepth(load_state(context.weights_dir, WEIGHTS), context.device)

        @droidw.hookimpl
        def droidw_depth_priors():
            yield droidw.Component(
                name="acme-depth", summary="metric depth of the Acme network", factory=build,
                requires=("acme_net",), extra="net", weights=(WEIGHTS,),
                capabilities=frozenset({"cpu", "cuda", "depth"}),
                reference="Acme 2025; code MIT, weights CC-BY-NC-4.0",
            )

    With `extra="net"`, a missing `acme_net` is answered with
    `pip install 'droidw-acme[net]'` of the distribution that registered it.
    """
    raise NotImplementedError


@hookspec
def droidw_uncertainty_models() -> Iterable[Component[UncertaintyModel]]:
    """Offer uncertainty models, chosen by `uncertainty.name`.

    The factory returns a `droidw.interfaces.uncertainty.UncertaintyModel`, which writes one
    value u >= 0 per cell. Say the capability "features" if it needs them: then it is refused
    together with an extractor that has none. Check with
    `droidw.testing.conformance.check_uncertainty_model`. Example::

        import droidw

        def build(options, context):
            from droidw_acme.uncertainty import AcmeUncertainty
            return AcmeUncertainty(seed=context.seed)

        @droidw.hookimpl
        def droidw_uncertainty_models():
            yield droidw.Component(
                name="acme", summary="one value per feature cluster", factory=build,
                capabilities=frozenset({"cpu", "cuda", "features"}),
            )
    """
    raise NotImplementedError


@hookspec
def droidw_ba_backends() -> Iterable[Component[BundleAdjuster]]:
    """Offer bundle adjustment backends, chosen by `ba.name`.

    The factory returns a `droidw.interfaces.bundle.BundleAdjuster` with one method,
    `step(problem) -> Step`. Use `available` to say why it cannot run here. Check with
    `droidw.testing.conformance.check_ba_backend`. Example::

        import droidw

        def reason():
            import torch
            return "" if torch.cuda.is_available() else "no GPU visible"

        def build(options, context):
            from droidw_acme.solver import AcmeSolver
            return AcmeSolver(context.device)

        @droidw.hookimpl
        def droidw_ba_backends():
            yield droidw.Component(
                name="acme", summary="bundle adjustment of the Acme library", factory=build,
                capabilities=frozenset({"cuda"}), available=reason,
            )
    """
    raise NotImplementedError


@hookspec
def droidw_correspondence_ops() -> Iterable[Component[Correspondence]]:
    """Offer correspondence operators, chosen by `correspondence.name`.

    The factory returns a `droidw.interfaces.correspondence.Correspondence`: it states its grid
    (`stride`, `offset`), encodes frames, and answers where cells of one keyframe lie in
    another. Check with `droidw.testing.conformance.check_correspondence`. Example::

        import droidw

        def build(options, context):
            from droidw_acme.matcher import AcmeMatcher
            return AcmeMatcher(options, context.device)

        @droidw.hookimpl
        def droidw_correspondence_ops():
            yield droidw.Component(
                name="acme", summary="dense matches of the Acme network", factory=build,
                capabilities=frozenset({"cpu", "cuda"}),
            )
    """
    raise NotImplementedError


@hookspec
def droidw_dataset_readers() -> Iterable[Component[DatasetReader]]:
    """Offer dataset readers, chosen by `reader.name`, or by themselves with `reader: auto`.

    The factory returns a `droidw.interfaces.datasets.DatasetReader`: `recognises(source)` says
    whether the footage is its own, `open(source, selection)` gives a `FrameSource`. Check with
    `droidw.testing.conformance.check_dataset_reader`. Example::

        import droidw

        def build(options, context):
            from droidw_acme.reader import AcmeReader
            return AcmeReader()

        @droidw.hookimpl
        def droidw_dataset_readers():
            yield droidw.Component(
                name="acme", summary="recordings of the Acme rig (*.acme)", factory=build,
            )
    """
    raise NotImplementedError


@hookspec
def droidw_exporters() -> Iterable[Component[Exporter]]:
    r"""Offer exporters, switched on by a key under `exporters`.

    The factory returns a `droidw.interfaces.exporters.Exporter`: `export(result, folder)`
    writes there and returns the files. Check with
    `droidw.testing.conformance.check_exporter`. Example::

        from pathlib import Path
        import droidw

        class CentresCsv:
            def export(self, result, folder):
                path = Path(folder) / "centres.csv"
                rows = (",".join(map(str, row)) for row in result.trajectory.centres)
                path.write_text("x,y,z\n" + "\n".join(rows) + "\n")
                return [path]

        @droidw.hookimpl
        def droidw_exporters():
            yield droidw.Component(
                name="centres-csv", summary="camera centres as a table",
                factory=lambda options, context: CentresCsv(),
            )

    `droidw run clip.mp4 --plugin centres.py exporters.centres-csv={}` runs it.
    """
    raise NotImplementedError


@hookspec
def droidw_observers() -> Iterable[Component[Observer]]:
    """Offer observers, switched on by a key under `observers`.

    The factory returns a `droidw.interfaces.observers.Observer`: `on_event(event)` hears the
    typed events of `droidw.events` and can stop nothing; one that raises is reported once and
    not called again. Check with `droidw.testing.conformance.check_observer`. Example::

        import droidw

        class Count:
            def __init__(self):
                self.keyframes = 0

            def on_event(self, event):
                if type(event).__name__ == "KeyframeAdded":
                    self.keyframes += 1

        @droidw.hookimpl
        def droidw_observers():
            yield droidw.Component(
                name="count", summary="counts keyframes",
                factory=lambda options, context: Count(),
            )
    """
    raise NotImplementedError
