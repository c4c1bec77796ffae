"""What the conformance suites share: the component under test, and the common clauses."""

from __future__ import annotations

import copy
import dataclasses
import os
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from droidw.errors import DroidwError
from droidw.plugin.component import BuildContext, Component
from droidw.plugin.registry import KINDS

__all__ = ["HEAVY", "Subject", "snapshot"]

HEAVY = ("torch", "cv2", "av", "kornia", "open3d", "rerun")
"""Packages that the module of a component must not import; its factory may."""

_NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")


class Subject:
    """A component under test.

    Args:
        kind: key of `droidw.plugin.registry.KINDS`.
        component: what is tested. device: where. options: instead of the defaults.
        folder: the run folder that the component is built for.
    """

    def __init__(
        self,
        kind: str,
        component: Component[Any],
        device: str | torch.device,
        options: Any,
        folder: Path,
    ) -> None:
        self.noun = KINDS[kind].noun
        self.component = component
        self.device = torch.device(device)
        self.folder = folder
        self._options = options

    def expect(self, clause: str, condition: bool, sentence: str) -> None:
        """Fail with a sentence that names component and clause unless `condition` holds."""
        if not condition:
            name = getattr(self.component, "name", "?")
            raise AssertionError(f"{self.noun} '{name}' breaks clause '{clause}': {sentence}")

    @contextmanager
    def calling(self, what: str) -> Iterator[None]:
        """Turn whatever a valid call raises into a failure of clause `errors`."""
        try:
            yield
        except AssertionError:
            raise
        except DroidwError as error:
            self._raised(f"{what} refused valid input: {error.message}", error)
        except Exception as error:  # noqa: BLE001 - strangers' code
            self._raised(f"{what} raised {type(error).__name__}: {error}", error)

    def _raised(self, sentence: str, error: Exception) -> None:
        try:
            self.expect("errors", False, sentence)
        except AssertionError as failure:
            raise failure from error

    def build(self, seed: int = 0) -> Any:
        """A fresh part, as a run would build it."""
        options = self.component.options() if self._options is None else self._options
        context = BuildContext(self.device, seed=seed, run_dir=self.folder)
        before = _random_states()
        with self.calling("the factory"):
            part = self.component.factory(options, context)
        self.expect(
            "own-generator",
            before == _random_states(),
            "building it draws from or seeds the global random generators; make a "
            "generator from `context.seed` instead",
        )
        return part

    def follows(self, part: Any, protocol: type) -> None:
        """Clause `protocol`: all methods and attributes of the interface are there."""
        self.expect(
            "protocol",
            isinstance(part, protocol),
            f"what the factory returned ({type(part).__name__}) lacks a method or "
            f"attribute of {protocol.__module__}.{protocol.__qualname__}",
        )

    def unchanged(self, what: str, before: Any, after: Any) -> None:
        """Clause `no-mutation`: an input has the value it had."""
        self.expect("no-mutation", same(before, after), f"{what} was changed")

    def tensor(
        self,
        what: str,
        value: Any,
        shape: tuple[int, ...],
        dtypes: tuple[torch.dtype, ...] = (torch.float32,),
    ) -> None:
        """Clauses `shape`, `dtype`, `device`, `finite` and `no-grad` of a returned tensor."""
        self.expect(
            "shape",
            isinstance(value, torch.Tensor),
            f"{what} is a {type(value).__name__}, not a tensor",
        )
        self.expect(
            "shape",
            tuple(value.shape) == shape,
            f"{what} has shape {list(value.shape)} where {list(shape)} is due",
        )
        names = " or ".join(str(dtype) for dtype in dtypes)
        self.expect("dtype", value.dtype in dtypes, f"{what} is {value.dtype}, not {names}")
        self.expect(
            "device",
            value.device.type == self.device.type,
            f"{what} is on {value.device}, not on {self.device}",
        )
        self.expect("finite", bool(torch.isfinite(value).all()), f"{what} has NaN or inf")
        self.expect("no-grad", not value.requires_grad, f"{what} requires gradients")

    def record(self) -> None:
        """The clauses of `droidw.testing.conformance.check_component`."""
        c = self.component
        self.expect("component", isinstance(c, Component), f"it is a {type(c).__name__}")
        self.expect("name", bool(_NAME.fullmatch(c.name)), "the name is not lower-case kebab")
        self.expect(
            "summary",
            bool(c.summary.strip()) and "\n" not in c.summary and len(c.summary) <= 120,
            "the summary must be one line of at most 120 characters",
        )
        self.expect(
            "capabilities",
            bool({"cpu", "cuda"} & set(c.capabilities)),
            "capabilities must name a device: 'cpu', 'cuda' or both",
        )
        self.expect(
            "extra",
            not c.extra or bool(c.requires),
            "an extra is named, but `requires` does not say what it installs",
        )
        self._record_options()
        self._record_import()

    def _record_options(self) -> None:
        c = self.component
        self.expect(
            "options",
            isinstance(c.options, type) and dataclasses.is_dataclass(c.options),
            "`options` is not a dataclass",
        )
        for entry in dataclasses.fields(c.options):
            has_default = (
                entry.default is not dataclasses.MISSING
                or entry.default_factory is not dataclasses.MISSING
            )
            self.expect("options", has_default, f"option '{entry.name}' has no default")
            self.expect(
                "options",
                bool(str(entry.metadata.get("help", "")).strip()),
                f"option '{entry.name}' has no help text (metadata={{'help': ...}})",
            )
        with self.calling("making the default options"):
            self.expect("options", c.options() == c.options(), "two sets of default options differ")

    def _record_import(self) -> None:
        """In a fresh interpreter, since everything may be loaded already in this one."""
        module = getattr(self.component.factory, "__module__", None)
        if not module:
            return
        code = (
            "import importlib, importlib.util, sys\n"
            f"name, heavy = {module!r}, {HEAVY!r}\n"
            "try:\n"
            "    found = importlib.util.find_spec(name) is not None\n"
            "except ModuleNotFoundError:\n"
            "    found = False\n"
            "if found:\n"
            "    importlib.import_module(name)\n"
            "    print(*[package for package in heavy if package in sys.modules])\n"
        )
        # Not from the current folder: a test module is no plugin and may import what it likes.
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                [sys.executable, "-c", code],
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
                env=dict(os.environ),
            )
        self.expect(
            "light-import",
            done.returncode == 0,
            f"module {module} cannot be imported: {done.stderr.strip()[-400:]}",
        )
        self.expect(
            "light-import",
            not done.stdout.strip(),
            f"module {module} imports {done.stdout.strip()} at its top; import that in the factory",
        )


def snapshot(value: Any) -> Any:
    """A deep copy, to compare with later."""
    return copy.deepcopy(value)


def same(first: Any, second: Any) -> bool:
    """Equal to the bit, through tensors, arrays, records, mappings and sequences; NaN is NaN."""
    if isinstance(first, torch.Tensor):
        return (
            isinstance(second, torch.Tensor)
            and first.dtype == second.dtype
            and first.shape == second.shape
            and same(first.detach().cpu().numpy(), second.detach().cpu().numpy())
        )
    if isinstance(first, np.ndarray):
        return (
            isinstance(second, np.ndarray)
            and first.dtype == second.dtype
            and first.shape == second.shape
            and first.tobytes() == second.tobytes()
        )
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        return type(first) is type(second) and all(
            same(getattr(first, f.name), getattr(second, f.name)) for f in dataclasses.fields(first)
        )
    if isinstance(first, dict):
        return (
            isinstance(second, dict)
            and first.keys() == second.keys()
            and all(same(first[key], second[key]) for key in first)
        )
    if isinstance(first, (list, tuple)):
        return (
            type(first) is type(second)
            and len(first) == len(second)
            and all(same(a, b) for a, b in zip(first, second, strict=True))
        )
    if isinstance(first, float) and isinstance(second, float) and first != first:
        return second != second
    return bool(first == second)


def _random_states() -> tuple[bytes, bytes, str]:
    state: Any = np.random.get_state(legacy=True)
    numbers = np.asarray(state[1]).tobytes() + str(state[2:]).encode()
    return torch.get_rng_state().numpy().tobytes(), numbers, repr(random.getstate())
