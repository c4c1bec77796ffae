"""Conformance of uncertainty models."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from droidw.geometry import se3
from droidw.geometry.camera import Grid
from droidw.graph.store import KeyframeStore
from droidw.interfaces.uncertainty import (
    Begins,
    Renews,
    StoreField,
    UncertaintyModel,
    UncertaintyReport,
    UncertaintyView,
)
from droidw.testing._contract import Subject, same, snapshot

__all__ = ["uncertainty_model"]

_N, _H, _W = 4, 9, 11
_OWN = ("uncertainty", "fields")


def uncertainty_model(subject: Subject) -> None:
    """See `droidw.testing.conformance.check_uncertainty_model`."""
    part = subject.build(seed=3)
    subject.follows(part, UncertaintyModel)
    _fields(subject, part)
    needs = "features" in subject.component.capabilities
    for channels, dtype in ((24, torch.float32), (24, torch.float16), (0, torch.float32)):
        if channels == 0 and needs:
            continue
        label = f"with {channels} channels of {dtype}"
        maps = [_run(subject, subject.build(seed=3), channels, dtype, label) for _ in range(2)]
        subject.expect(
            "deterministic",
            same(maps[0], maps[1]),
            f"two models of one seed give different maps {label}",
        )
    for name, offered, method in (
        ("begins", Begins, "begin(view, movable)"),
        ("renews", Renews, "renew(view, index, movable)"),
    ):
        subject.expect(
            name,
            isinstance(part, offered) or not getattr(part, name, False),
            f"{name} is true, but there is no method {method}",
        )
    if isinstance(part, Begins) and part.begins:
        _begin(subject)
    if isinstance(part, Renews) and part.renews:
        _renew(subject)
    _state(subject)
    _between(subject)


def _begin(subject: Subject) -> None:
    """A model that begins with what can move writes the maps that it is asked for."""
    part = subject.build(seed=3)
    view = _view(subject, part, 24, torch.float32)
    for index in range(_N):
        part.append(_without_edges(view), index)
    movable = torch.linspace(0, 1, _W, device=subject.device).expand(_N, _H, _W).contiguous()
    before, given = snapshot(view), snapshot(movable)
    with subject.calling("begin"):
        part.begin(_without_edges(view), movable)
    _inputs_kept(subject, before, view, "begin")
    subject.unchanged("what can move, given to begin", given, movable)
    _maps(subject, view, "after begin")
    subject.expect(
        "only-asked",
        same(before.uncertainty[3], view.uncertainty[3]),
        "begin changed the map of a keyframe that is not in `frames`",
    )
    began = view.uncertainty.clone()
    with subject.calling("update after begin"):
        part.update(view)
    _maps(subject, view, "after begin and an update")
    with subject.calling("begin once more"):
        part.begin(_without_edges(view), movable)
    subject.expect(
        "begins-anew",
        same(began, view.uncertainty),
        "begin, called once more, kept something of what was learned in between",
    )


def _renew(subject: Subject) -> None:
    """A model that is told of later keyframes, too, goes on and keeps what it was told."""
    first, second = subject.build(seed=3), subject.build(seed=4)
    view = _view(subject, first, 24, torch.float32)
    movable = torch.linspace(0, 1, _W, device=subject.device).expand(_N, _H, _W).contiguous()
    for index in range(_N - 1):
        first.append(_without_edges(view), index)
    first.begin(_without_edges(view), movable)
    before, given = snapshot(view), snapshot(movable)
    with subject.calling("renew"):
        first.renew(_without_edges(view), _N - 1, movable[_N - 1])
    _inputs_kept(subject, before, view, "renew")
    subject.unchanged("what can move, given to renew", given, movable)
    subject.expect("only-asked", same(before.uncertainty, view.uncertainty), "renew changed a map")
    copied = dataclasses.replace(
        view,
        uncertainty=view.uncertainty.clone(),
        fields={name: value.clone() for name, value in view.fields.items()},
    )
    with subject.calling("load_state_dict, append and renew after renew"):
        second.load_state_dict(snapshot(first.state_dict()))
        for model, seen in ((first, view), (second, copied)):
            model.renew(_without_edges(seen), _N - 1, movable[0])
            model.append(_without_edges(seen), _N - 1)
    _maps(subject, view, "after renew and append")
    subject.expect(
        "state",
        same(view.uncertainty, copied.uncertainty),
        "a model restored from state_dict() is not renewed as the original",
    )


def _fields(subject: Subject, part: Any) -> None:
    names = []
    for entry in part.fields:
        subject.expect(
            "fields",
            isinstance(entry, StoreField),
            f"fields holds a {type(entry).__name__}, not a StoreField",
        )
        known = all(isinstance(n, int) or n in ("h", "w", "c") for n in entry.shape)
        subject.expect(
            "fields",
            known,
            f"field '{entry.name}' has shape {entry.shape}; valid are numbers, 'h', 'w' and 'c'",
        )
        subject.expect(
            "fields",
            isinstance(getattr(torch, entry.dtype, None), torch.dtype),
            f"field '{entry.name}' has the unknown dtype '{entry.dtype}'",
        )
        names.append(entry.name)
    subject.expect("fields", len(set(names)) == len(names), "two fields have the same name")
    taken = KeyframeStore(Grid(_H, _W, 8, 3.5), torch.ones(4)).names & set(names)
    subject.expect(
        "fields", not taken, f"the store has fields of these names already: {', '.join(taken)}"
    )


def _run(subject: Subject, part: Any, channels: int, dtype: torch.dtype, label: str) -> Tensor:
    view = _view(subject, part, channels, dtype)
    for index in range(_N):
        before = snapshot(view)
        with subject.calling(f"append {label}"):
            part.append(_without_edges(view), index)
        _inputs_kept(subject, before, view, "append")
        _maps(subject, view, f"after append {label}")
        others = [n for n in range(_N) if n != index]
        subject.expect(
            "only-asked",
            same(before.uncertainty[others], view.uncertainty[others]),
            f"append of keyframe {index} changed the map of another one",
        )
    for iteration in range(2):
        before = snapshot(view)
        with subject.calling(f"update {label}"):
            report = part.update(dataclasses.replace(view, iteration=iteration))
        _inputs_kept(subject, before, view, "update")
        _maps(subject, view, f"after update {label}")
        subject.expect(
            "only-asked",
            same(before.uncertainty[3], view.uncertainty[3]),
            "update changed the map of a keyframe that is not in `frames`",
        )
        subject.expect(
            "report",
            isinstance(report, UncertaintyReport),
            f"update returned a {type(report).__name__}, not an UncertaintyReport",
        )
        subject.expect(
            "report",
            math.isfinite(report.energy) and all(math.isfinite(v) for v in report.facts.values()),
            "a number in the report of update is not finite",
        )
    calibrated = dataclasses.replace(view, calibrate=True, iteration=2)
    with subject.calling("update with calibrated similarities"):
        part.update(calibrated)
    _maps(subject, view, "after an update with calibrated similarities")
    half = 0.5 * view.confidence.prod(-1, keepdim=True).sqrt()
    full = dataclasses.replace(view, confidence=torch.cat([view.confidence, half], dim=-1))
    with subject.calling("update with an off-diagonal in the confidence"):
        part.update(full)
    _maps(subject, view, "after an update with an off-diagonal in the confidence")
    blind = dataclasses.replace(view, confidence=torch.zeros_like(view.confidence), iteration=2)
    with subject.calling("update without any confidence"):
        part.update(blind)
    _maps(subject, view, "after an update without any confidence")
    with subject.calling("update without edges"):
        part.update(dataclasses.replace(_without_edges(view), iteration=3))
    _maps(subject, view, "after an update without edges")
    return view.uncertainty


def _inputs_kept(
    subject: Subject, before: UncertaintyView, view: UncertaintyView, call: str
) -> None:
    for entry in dataclasses.fields(UncertaintyView):
        if entry.name not in _OWN:
            subject.unchanged(
                f"view.{entry.name} given to {call}",
                getattr(before, entry.name),
                getattr(view, entry.name),
            )


def _maps(subject: Subject, view: UncertaintyView, when: str) -> None:
    subject.tensor(f"view.uncertainty {when}", view.uncertainty, (_N, _H, _W))
    subject.expect(
        "range",
        bool((view.uncertainty >= 0).all()),
        f"the uncertainty is negative somewhere {when}",
    )
    for name, value in view.fields.items():
        if value.is_floating_point():
            subject.expect(
                "finite", bool(torch.isfinite(value).all()), f"field '{name}' has NaN or inf {when}"
            )


def _state(subject: Subject) -> None:
    """A model restored in the middle goes on as the one it was taken from."""
    first, second = subject.build(seed=3), subject.build(seed=4)
    view = _view(subject, first, 24, torch.float32)
    with subject.calling("append, update, state_dict and load_state_dict"):
        for index in range(_N):
            first.append(_without_edges(view), index)
        first.update(dataclasses.replace(view, calibrate=True))
        copied = dataclasses.replace(
            view,
            uncertainty=view.uncertainty.clone(),
            fields={name: value.clone() for name, value in view.fields.items()},
        )
        second.load_state_dict(snapshot(first.state_dict()))
        # Other edges than before: what was learned of those counts now.
        some = [4, 5, 8, 9]
        view, copied = (_of(one, list(range(_N)), edges=some) for one in (view, copied))
        first.update(dataclasses.replace(view, calibrate=True, iteration=1))
        second.update(dataclasses.replace(copied, calibrate=True, iteration=1))
    subject.expect(
        "state",
        same(view.uncertainty, copied.uncertainty),
        "a model restored from state_dict() does not continue as the original",
    )


def _between(subject: Subject) -> None:
    """A keyframe that comes in between others is not taken for the one whose number it has now."""
    first, second = subject.build(seed=3), subject.build(seed=4)
    view = _view(subject, first, 24, torch.float32)
    near = [0, 1, 2, 3, 6, 7]  # edges among the first three
    with subject.calling("append and update"):
        three = _of(view, [0, 1, 3], edges=near)
        for index in range(3):
            first.append(_without_edges(three), index)
        first.update(three)
    view.uncertainty[[0, 1, 3]] = three.uncertainty
    for name, value in view.fields.items():
        value[[0, 1, 3]] = three.fields[name]
    with subject.calling("append between others, update and load_state_dict"):
        first.append(_without_edges(view), 2)
        view = _of(view, list(range(_N)), edges=near)  # by their numbers, the same as before
        first.update(view)
        copied = _of(view, list(range(_N)), edges=list(range(len(near))))
        second.load_state_dict(snapshot(first.state_dict()))
        first.update(dataclasses.replace(view, iteration=2))
        second.update(dataclasses.replace(copied, iteration=2))
    _maps(subject, view, "after a keyframe came in between others")
    subject.expect(
        "between",
        same(view.uncertainty, copied.uncertainty),
        "a keyframe came in between others, and what was kept of the one with its number counted",
    )


def _of(view: UncertaintyView, nodes: list[int], edges: list[int]) -> UncertaintyView:
    """A copy of a view with these keyframes and edges; numbers in `ii` and `jj` stay."""
    return dataclasses.replace(
        view,
        features=view.features[nodes],
        uncertainty=view.uncertainty[nodes],
        fields={name: value[nodes] for name, value in view.fields.items()},
        T_cw=view.T_cw[nodes],
        disps=view.disps[nodes],
        **{name: getattr(view, name)[edges] for name in ("ii", "jj", "target", "confidence")},
    )


def _view(subject: Subject, part: Any, channels: int, dtype: torch.dtype) -> UncertaintyView:
    """Four keyframes that look at a plane while the camera moves sideways."""
    draw = torch.Generator().manual_seed(11)
    device = subject.device
    sizes = {"h": _H, "w": _W, "c": channels}
    fields = {
        f.name: torch.full(
            (_N, *(n if isinstance(n, int) else sizes[n] for n in f.shape)),
            f.fill,
            dtype=getattr(torch, f.dtype),
            device=device,
        )
        for f in part.fields
    }
    T_cw = se3.identity(_N).float()
    T_cw[:, 0] = torch.arange(_N) * 0.05
    # Neighbours first; models may learn from frames alone that lie farther apart.
    ii = torch.tensor([0, 1, 1, 2, 2, 3, 0, 2, 1, 3, 0, 3])
    jj = torch.tensor([1, 0, 2, 1, 3, 2, 2, 0, 3, 1, 3, 0])
    edges = len(ii)
    y, x = torch.meshgrid(torch.arange(float(_H)), torch.arange(float(_W)), indexing="ij")
    shift = (jj - ii).float() * 0.5
    target = torch.stack([x + shift[:, None, None], y.expand(edges, _H, _W)], dim=-1)
    # Alike in all frames, as those of a scene are, or else there would be nothing to compare.
    alike = torch.randn(channels, _H, _W, generator=draw)
    features = (alike + 0.3 * torch.randn(_N, channels, _H, _W, generator=draw)).to(dtype)
    return UncertaintyView(
        features.to(device),
        torch.zeros(_N, _H, _W, device=device),
        fields,
        T_cw.to(device),
        torch.full((_N, _H, _W), 1.0, device=device),
        torch.tensor([10.0, 10.0, 5.0, 4.0], device=device),
        ii.to(device),
        jj.to(device),
        target.to(device),
        torch.ones(edges, _H, _W, 2, device=device),
        torch.tensor([0, 1, 2], device=device),
    )


def _without_edges(view: UncertaintyView) -> UncertaintyView:
    return dataclasses.replace(
        view, ii=view.ii[:0], jj=view.jj[:0], target=view.target[:0], confidence=view.confidence[:0]
    )
