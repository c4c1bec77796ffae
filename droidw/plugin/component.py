"""`Component`: the description by which a plugin offers one part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    Generic,
    Literal,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from droidw.plugin.weights import WeightsFile

if TYPE_CHECKING:
    import torch

    from droidw.geometry.camera import Camera

T = TypeVar("T")

__all__ = ["BuildContext", "Component", "NoOptions"]


@dataclass(frozen=True)
class NoOptions:
    """Options of a component that has none."""


@dataclass(frozen=True)
class BuildContext:
    """What a factory may know of the run that it builds for.

    Attributes:
        device: where tensors of the run live.
        seed: seed of the run; a component that draws numbers makes its own generator from it.
        weights_dir: folder of downloaded weights, or None where none was set up.
        data_dir: folder of datasets that readers know by name (`bonn:balloon`), or None for the
            usual one (`droidw.io.dataset_tables.data_root`).
        run_dir: the run folder, or None in tests; the only place where a component may write.
        compat: names of published behaviours asked for, such as "droid-w".
        camera: of the raw pictures, or None where it is not known (frames carry their own
            intrinsics, at working size).
        disabled: parts switched off by `DROIDW_DISABLE_PLUGINS`, as "kind/name": a part that
            chooses among others leaves them out.
    """

    device: torch.device
    seed: int = 0
    weights_dir: Path | None = None
    data_dir: Path | None = None
    run_dir: Path | None = None
    compat: frozenset[str] = frozenset()
    camera: Camera | None = None
    disabled: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Component(Generic[T]):
    """A named part that a plugin offers; frozen, and cheap to make.

    Making one must not import anything heavy: the factory does that when the part is chosen.

    Attributes:
        name: lower-case kebab, unique within its kind, e.g. "affine-softplus".
        summary: one line for `droidw list-plugins`.
        factory: called as `factory(options, context)`; `options` is an instance of `options`.
        options: dataclass in which every field has a default; unknown keys are refused. The
            text for `list-plugins --options` comes from `field(metadata={"help": ...})`.
        requires: import names that must be importable, checked without importing them.
        extra: the extra that installs what `requires` names, e.g. "open3d".
        weights: files that must be on disk (`droidw weights list`): records, or bare names of
            what another part describes; or, where it depends on the options, a function of them
            that returns such a tuple (`weights_for` asks).
        capabilities: facts that the host checks before a run: "cpu", "cuda" (devices whose tensors
            it takes and gives), "host" (it computes on the processor on either, so that
            `device: auto` has no reason for a GPU), "threads" and "gpu-threads" (see
            `Correspondence.motion`),
            "features" (an uncertainty model that needs features, an extractor that gives them),
            "depth" (a depth prior that gives depth).
        reference: paper, equation or table row, and the licence of code and weights.
        available: None, or a check that returns "" when the part can run here and a short
            reason such as "no GPU visible" when not; it may be slow and is called lazily.
    """

    name: str
    summary: str
    factory: Callable[[Any, BuildContext], T]
    options: type = NoOptions
    requires: tuple[str, ...] = ()
    extra: str | None = None
    weights: tuple[str | WeightsFile, ...] | Callable[[Any], Sequence[str | WeightsFile]] = ()
    capabilities: frozenset[str] = frozenset({"cpu"})
    reference: str = ""
    available: Callable[[], str] | None = field(default=None, compare=False)

    def weights_for(self, options: Any = None) -> tuple[str | WeightsFile, ...]:
        """The weights that the part needs with these options (an instance; None: the defaults)."""
        if not callable(self.weights):
            return tuple(self.weights)
        return tuple(self.weights(self.options() if options is None else options))

    def all_weights(self) -> tuple[str | WeightsFile, ...]:
        """The weights that the part may need: with its defaults, and with each choice of options.

        Choices are options of type `Literal` and switches, changed one at a time.
        """
        found = dict.fromkeys(self.weights_for())
        if callable(self.weights):
            hints = get_type_hints(self.options)
            for option in fields(self.options):
                kind = hints[option.name]
                values = get_args(kind) if get_origin(kind) is Literal else ()
                for value in (False, True) if kind is bool else values:
                    changed = replace(self.options(), **{option.name: value})
                    found.update(dict.fromkeys(self.weights_for(changed)))
        return tuple(found)
