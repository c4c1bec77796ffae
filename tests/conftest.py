"""Options of the test run, small and steady thread counts, and a guard over the checkout."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

# Before torch, numpy or OpenCV are imported: sums in one order, and no more cores than needed.
for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import pytest  # noqa: E402 - the variables above come first

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("droidw")
    group.addoption("--device", default="cpu", help="device of the tests: cpu (default) or cuda")
    group.addoption("--runslow", action="store_true", help="run the tests marked slow as well")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--device").startswith("cuda"):
        import torch

        if not torch.cuda.is_available():
            raise pytest.UsageError(
                "--device cuda: torch sees no GPU here, so the GPU tests would all be skipped"
            )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    slow = pytest.mark.skip(reason="slow: run with --runslow")
    gpu = pytest.mark.skip(reason="needs a GPU: run with --device cuda")
    for item in items:
        if "slow" in item.keywords and not config.getoption("--runslow"):
            item.add_marker(slow)
        if "gpu" in item.keywords and not config.getoption("--device").startswith("cuda"):
            item.add_marker(gpu)


@pytest.fixture(autouse=True, scope="session")
def _steady_threads() -> None:
    """Whatever was imported first (a plugin of pytest, say) obeys as well."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def _caches_stay_out_of_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What the code under test keeps between runs goes to a temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        # Kernels take a while to compile: once for all workers of this run.
        base = tmp_path_factory.getbasetemp()
        shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
        patch.setenv("DROIDW_CACHE", str(shared / "compiled"))
        yield


@pytest.fixture(autouse=True, scope="session")
def _checkout_stays_clean() -> Iterator[None]:
    """No test may write into the checkout; checked on CI, where nobody else writes there."""
    before = _strangers() if os.environ.get("CI") else None
    yield
    if before is not None:
        new = sorted(_strangers() - before)
        assert not new, f"tests wrote into the checkout instead of tmp_path: {', '.join(new)}"


@pytest.fixture(scope="session")
def load_benchmark() -> Callable[[str], ModuleType]:
    """`load_benchmark(name)`: the script benchmarks/NAME.py as a module."""

    def call(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return call


def _strangers() -> set[str]:
    """Files in the checkout that git does not hold, caches of tools aside."""
    done = subprocess.run(
        ["git", "status", "--porcelain", "--ignored", "--untracked-files=all"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    tools = ("__pycache__", ".pytest_cache", ".mypy_cache", ".ruff_cache", ".venv", ".egg-info")
    return {line for line in done.stdout.splitlines() if not any(tool in line for tool in tools)}
