"""Conformance of what looks at pictures: feature extractors and depth priors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from droidw.geometry.camera import Grid
from droidw.interfaces.depth import DepthMap, DepthPrior
from droidw.interfaces.features import FeatureExtractor, KnowsMovable
from droidw.slam.frame import Frame
from droidw.testing._contract import Subject, same, snapshot
from droidw.testing.scenes import Scene, SceneSpec

__all__ = ["depth_prior", "feature_extractor"]

_SIZES = ((160, 120), (131, 97))


def _pictures(subject: Subject) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Name, image and intrinsics: rendered at an even and an odd size, and without texture."""
    scene = Scene(SceneSpec(width=160, height=120, frames=1))
    picture = torch.from_numpy(scene.render(0).image).permute(2, 0, 1).float().div(255)
    intrinsics = torch.from_numpy(scene.intrinsics).float()
    for width, height in _SIZES:
        image = picture[:, :height, :width].contiguous()
        yield (
            f"a picture of {width}x{height}",
            image.to(subject.device),
            intrinsics.to(subject.device),
        )
    black = torch.zeros(3, 72, 96, device=subject.device)
    yield "a black picture", black, torch.tensor([80.0, 80, 47.5, 35.5], device=subject.device)
    yield (
        "a white picture",
        torch.ones_like(black),
        torch.tensor([80.0, 80, 47.5, 35.5], device=subject.device),
    )


def feature_extractor(subject: Subject) -> None:
    """See `droidw.testing.conformance.check_feature_extractor`."""
    part, twin = subject.build(seed=3), subject.build(seed=3)
    subject.follows(part, FeatureExtractor)
    dim = part.dim
    subject.expect("dim", isinstance(dim, int) and dim >= 0, f"dim is {dim!r}")
    claims = "features" in subject.component.capabilities
    subject.expect(
        "capability",
        claims == (dim > 0),
        f"dim is {dim}, but the capability 'features' is "
        + ("claimed" if claims else "not claimed"),
    )
    for what, image, _ in _pictures(subject):
        for stride, offset in ((8, 3.5), (4, 1.5)):
            grid = Grid.of(image.shape[-2], image.shape[-1], stride, offset)
            before = snapshot(image)
            with subject.calling(f"extract on {what}, stride {stride},"):
                features = part.extract(image, grid)
                again, other = part.extract(image, grid), twin.extract(image, grid)
            label = f"the result of extract on {what}, stride {stride},"
            subject.tensor(
                label, features, (dim, grid.height, grid.width), (torch.float32, torch.float16)
            )
            subject.unchanged(f"the image given to extract ({what})", before, image)
            subject.expect(
                "deterministic",
                same(features, again),
                f"extract gives different features for {what} when asked again",
            )
            subject.expect(
                "deterministic",
                same(features, other),
                f"two extractors of one seed give different features for {what}",
            )
            if isinstance(part, KnowsMovable):
                _movable(subject, part, image, grid, f"{what}, stride {stride},")


def _movable(subject: Subject, part: Any, image: Tensor, grid: Grid, what: str) -> None:
    before = snapshot(image)
    with subject.calling(f"movable on {what}"):
        found, again = part.movable(image, grid), part.movable(image, grid)
    subject.tensor(f"the result of movable on {what}", found, (grid.height, grid.width))
    subject.unchanged(f"the image given to movable ({what})", before, image)
    subject.expect(
        "range",
        bool(((found >= 0) & (found <= 1)).all()),
        f"movable is not from 0 to 1 somewhere on {what}",
    )
    subject.expect(
        "deterministic",
        same(found, again),
        f"movable says something else of {what} when asked again",
    )


def depth_prior(subject: Subject) -> None:
    """See `droidw.testing.conformance.check_depth_prior`."""
    part, twin = subject.build(seed=3), subject.build(seed=3)
    subject.follows(part, DepthPrior)
    subject.expect("metric", isinstance(part.metric, bool), f"metric is {part.metric!r}")
    for what, image, intrinsics in _pictures(subject):
        frame = Frame(0, 0.0, image, intrinsics, "000000")
        before = snapshot(frame)
        with subject.calling(f"predict on {what}"):
            depth, again, other = part.predict(frame), part.predict(frame), twin.predict(frame)
        subject.unchanged(f"the frame given to predict ({what})", before, frame)
        subject.expect(
            "deterministic",
            same(depth, again) and same(depth, other),
            f"predict gives different depth for {what} when asked again",
        )
        if depth is None:
            continue
        subject.expect(
            "capability",
            "depth" in subject.component.capabilities,
            "it gives depth, but does not claim the capability 'depth'",
        )
        subject.expect(
            "shape",
            isinstance(depth, DepthMap),
            f"predict returned a {type(depth).__name__}, not a DepthMap or None",
        )
        subject.tensor(f"the depth of {what}", depth.depth, tuple(image.shape[-2:]))
        subject.expect(
            "range",
            bool((depth.depth >= 0).all()),
            f"the depth of {what} is negative somewhere; 0 means unknown",
        )
