"""Fixtures for tests of plugins; pytest loads this by itself where droidw is installed.

Nothing heavy is imported until a fixture is used, since this module takes part in every pytest
session of an environment that has droidw.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import torch

    from droidw.plugin.component import Component
    from droidw.testing.scenes import Scene

__all__ = ["device", "droidw_build", "scene"]


@pytest.fixture
def device(request: pytest.FixtureRequest) -> torch.device:
    """The device named by `--device` where the project's `conftest.py` has that option, or CPU."""
    import torch

    return torch.device(request.config.getoption("--device", default="cpu"))


@pytest.fixture(scope="session")
def scene() -> Scene:
    """A small synthetic scene with exact truth: 6 frames of 96x72 with moving objects."""
    from droidw.testing.scenes import Scene, SceneSpec

    return Scene(SceneSpec(width=96, height=72, frames=6, fps=6.0))


@pytest.fixture
def droidw_build(device: torch.device, tmp_path: Path) -> Callable[..., Any]:
    """Build a component as a run would: `droidw_build(component, seed=0, **options)`.

    Options not given keep their defaults; `run_dir` is the test's own folder.
    """
    from droidw.plugin.component import BuildContext

    def build(component: Component[Any], seed: int = 0, **options: Any) -> Any:
        context = BuildContext(device, seed=seed, run_dir=tmp_path)
        return component.factory(component.options(**options), context)

    return build
