"""The contract of every kind of part as a suite that anyone can run on a component.

A plugin author writes one test::

    from droidw.testing.conformance import check_feature_extractor
    from droidw_acme.plugin import COMPONENT

    def test_contract():
        check_feature_extractor(COMPONENT)

Each suite builds the component with its default options (or those given), as a run would, and
holds it against its interface. What is broken is raised as an AssertionError with a sentence that
names the component and the clause. Clauses that hold for all kinds:

- `component`, `name`, `summary`, `capabilities`, `extra`, `options`: the record is complete; the
  name is kebab, the summary one line, every option has a default and a help text.
- `light-import`: the module of the factory imports no torch, cv2, av, kornia, open3d or rerun.
- `protocol`: what the factory returns has all methods and attributes of the interface.
- `own-generator`: building leaves the global random generators alone.
- `errors`: valid input raises nothing; wrong input raises a `droidw.errors.DroidwError`.
- `shape`, `dtype`, `device`, `finite`, `no-grad`: of every tensor that is returned.
- `no-mutation`: inputs keep their values.
- `deterministic`: one seed, one answer, to the bit (on a CPU).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droidw.errors import UsageError
from droidw.plugin.registry import KINDS
from droidw.testing import (
    _check_bundle,
    _check_correspondence,
    _check_files,
    _check_maps,
    _check_uncertainty,
)
from droidw.testing._contract import Subject

if TYPE_CHECKING:
    import torch

    from droidw.plugin.component import Component

__all__ = [
    "check",
    "check_ba_backend",
    "check_bundle_adjuster",
    "check_component",
    "check_correspondence",
    "check_dataset_reader",
    "check_depth_prior",
    "check_exporter",
    "check_feature_extractor",
    "check_observer",
    "check_uncertainty_model",
]


def _run(
    kind: str,
    component: Component[Any],
    device: str | torch.device,
    options: Any,
    suite: Callable[[Subject], None] | None,
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        subject = Subject(kind, component, device, options, Path(folder))
        subject.record()
        if suite is not None:
            suite(subject)


def check_component(kind: str, component: Component[Any]) -> None:
    """The clauses of the record alone; the factory is not called.

    Args:
        kind: features, depth, uncertainty, ba, correspondence, reader, exporter or observer.
        component: what is tested.
    Raises:
        AssertionError: a clause does not hold.
    """
    _run(kind, component, "cpu", None, None)


def check_feature_extractor(
    component: Component[Any], device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold a feature extractor against `droidw.interfaces.features`.

    Clauses beside those of the module: `dim` is a number >= 0 and `capability` "features" is
    claimed if and only if it is above 0; `extract` gives [dim,h,w] float32 or float16 on the
    device of the image for even and odd sizes, for two grids, and for black and white pictures.

    Raises:
        AssertionError: a clause does not hold.
    """
    _run("features", component, device, options, _check_maps.feature_extractor)


def check_depth_prior(
    component: Component[Any], device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold a depth prior against `droidw.interfaces.depth`.

    Clauses: `metric` is a bool; `predict` gives None or a `DepthMap` of [H,W] float32 for even
    and odd sizes and blank pictures; `range`: depth >= 0; `capability` "depth" is claimed if any
    depth is given.

    Raises:
        AssertionError: a clause does not hold.
    """
    _run("depth", component, device, options, _check_maps.depth_prior)


def check_uncertainty_model(
    component: Component[Any], device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold an uncertainty model against `droidw.interfaces.uncertainty`.

    Clauses: `fields` are `StoreField`s of distinct names; `append` and `update` write finite maps
    >= 0 (`range`) in place and touch `only-asked` keyframes; full and half precision features,
    none at all unless the capability "features" is claimed, confidence with an off-diagonal, no
    confidence and no edges are all taken; `report` is finite; `state`: a model restored from
    `state_dict()` continues as the original; so it does after a keyframe came in `between` others.

    Raises:
        AssertionError: a clause does not hold.
    """
    _run("uncertainty", component, device, options, _check_uncertainty.uncertainty_model)


def check_bundle_adjuster(
    component: Component[Any], device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold a bundle adjustment backend against `droidw.interfaces.bundle`.

    Clauses: `fresh` tensors; `fixed` poses and `isolated` ones do not move; `unit` quaternions;
    `status` is a known word, "empty" without edges, and everything but "ok" returns the input;
    `edge-order` does not matter; `motion-only` leaves disparities; `prior` draws them; `bounds`
    hold; `guard` never raises the energy; `information` may have an off-diagonal (three channels
    of weight); `bad-numbers` are dropped and counted; `converges`: 15 steps on exact measurements
    bring the error below a twentieth.

    Raises:
        AssertionError: a clause does not hold.
    """
    _run("ba", component, device, options, _check_bundle.bundle_adjuster)


check_ba_backend = check_bundle_adjuster
"""`check_bundle_adjuster` under the name of its hook."""


def check_correspondence(
    component: Component[Any], device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold a correspondence operator against `droidw.interfaces.correspondence`.

    Clauses: `grid` is possible; `range`: confidence >= 0 and, where it has an off-diagonal, a
    positive semidefinite matrix; answers in the `order` of the request,
    also for no edges, known and new ones, and for every purpose; `sources` fit damping and upmask;
    `forget` ignores unknown ids and frees known ones; `accuracy`: on rendered pictures 3 frames
    apart the median error of confident cells is below 2 pixels; `motion` of a frame against
    itself is nothing and grows with distance. Even picture sizes, and odd ones too unless these
    are refused with an `InputError`.

    Raises:
        AssertionError: a clause does not hold.
    """
    _run("correspondence", component, device, options, _check_correspondence.correspondence)


def check_dataset_reader(
    component: Component[Any], source: str, device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold a dataset reader against `droidw.interfaces.datasets`.

    Clauses: `recognises` its source and nothing else; `frames` are `RawFrame`s of uint8 [H,W,3],
    all of one size; `time` and `index` strictly rise; `length` is what a pass yields; a second
    pass is the same (`repeatable`) and adds no `problems`; `selection` is honoured; `name` can
    name a folder; `camera` fits the pictures; `truth` has rising times and unit quaternions; a
    missing source is an `InputError`.

    Args:
        component: what is tested.
        source: footage of the reader's kind with four pictures or more.
        device: passed to the factory.
        options: instead of the default options.
    Raises:
        AssertionError: a clause does not hold.
    """
    _run(
        "reader",
        component,
        device,
        options,
        lambda subject: _check_files.dataset_reader(subject, source),
    )


def check_exporter(
    component: Component[Any], device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold an exporter against `droidw.interfaces.exporters`.

    Clauses: `files`: the paths returned are exactly the files written; `folder`: nothing is
    written elsewhere in the run folder; the result is not changed; a run of three keyframes, of
    one, and of none.

    Raises:
        AssertionError: a clause does not hold.
    """
    _run("exporter", component, device, options, _check_files.exporter)


def check_observer(
    component: Component[Any], device: str | torch.device = "cpu", options: Any = None
) -> None:
    """Hold an observer against `droidw.interfaces.observers`.

    Clauses: it takes every event in the order of a run, of unknown length and without keyframes,
    events it does not know, and a run that fails at once; `silent`: it returns nothing; the
    result is not changed.

    Raises:
        AssertionError: a clause does not hold.
    """
    _run("observer", component, device, options, _check_files.observer)


def check(
    kind: str,
    component: Component[Any],
    device: str | torch.device = "cpu",
    options: Any = None,
    source: str | None = None,
) -> None:
    """Run the suite of a kind (a key of `droidw.plugin.registry.KINDS`).

    Args:
        kind: features, depth, uncertainty, ba, correspondence, reader, exporter or observer.
        component: what is tested.
        device: where tensors live.
        options: instead of the default options.
        source: footage, for kind "reader" alone.
    Raises:
        AssertionError: a clause does not hold.
        UsageError: there is no such kind, or a reader is given no source.
    """
    if kind == "reader":
        if source is None:
            raise UsageError(
                "a dataset reader cannot be checked without footage", "give source=PATH"
            )
        check_dataset_reader(component, source, device, options)
        return
    suites: dict[str, Callable[..., None]] = {
        "features": check_feature_extractor,
        "depth": check_depth_prior,
        "uncertainty": check_uncertainty_model,
        "ba": check_bundle_adjuster,
        "correspondence": check_correspondence,
        "exporter": check_exporter,
        "observer": check_observer,
    }
    if kind not in suites:
        raise UsageError(
            f"there is no kind of plugin called '{kind}'", "kinds: " + ", ".join(KINDS)
        )
    suites[kind](component, device, options)
