"""A small world for uncertainty models: a camera that stands still, and cells that change."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from droidw.interfaces.uncertainty import UncertaintyModel, UncertaintyView

N, C, H, W = 6, 8, 6, 7


def still_view(model: UncertaintyModel, channels: int = C, seed: int = 0) -> UncertaintyView:
    """Features are alike in all N frames, except in the three right columns, where they change in
    all channels but the first, which tells them apart. All pairs of frames are edges."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(1, channels, H, W, generator=generator).repeat(N, 1, 1, 1)
    features[:, 1:, :, 4:] = torch.randn(N, max(channels - 1, 0), H, 3, generator=generator)
    if channels:
        features[:, 0] = -2.0
        features[:, 0, :, 4:] = 2.0
    T_cw = torch.zeros(N, 7)
    T_cw[:, 6] = 1.0
    ii, jj = torch.meshgrid(torch.arange(N), torch.arange(N), indexing="ij")
    keep = (ii != jj).flatten()
    ii, jj = ii.flatten()[keep], jj.flatten()[keep]
    sizes = {"h": H, "w": W, "c": channels}
    fields = {
        f.name: torch.full(
            (N, *(sizes[s] if isinstance(s, str) else s for s in f.shape)),
            f.fill,
            dtype=getattr(torch, f.dtype),
        )
        for f in model.fields
    }
    return UncertaintyView(
        features=features,
        uncertainty=torch.zeros(N, H, W),
        fields=fields,
        T_cw=T_cw,
        disps=torch.ones(N, H, W),
        intrinsics=torch.tensor([8.0, 8.0, 3.0, 2.5]),
        ii=ii,
        jj=jj,
        target=torch.zeros(len(ii), H, W, 2),
        confidence=torch.ones(len(ii), H, W, 2),
        frames=torch.arange(N),
    )


@pytest.fixture
def view_of() -> Callable[..., UncertaintyView]:
    """`still_view`, before any keyframe was appended."""
    return still_view


@pytest.fixture
def started() -> Callable[..., UncertaintyView]:
    """`still_view` with all keyframes appended to the model."""

    def start(model: UncertaintyModel, seed: int = 0) -> UncertaintyView:
        view = still_view(model, seed=seed)
        for index in range(N):
            model.append(view, index)
        return view

    return start
