"""Reader `synthetic`: footage that is rendered while it is read, with exact truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from droidw.errors import InputError, UsageError
from droidw.interfaces.datasets import DatasetReader, Selection
from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.geometry.camera import Camera
    from droidw.slam.frame import RawFrame, Trajectory
    from droidw.testing.scenes import Scene

__all__ = ["COMPONENT", "SyntheticOptions", "SyntheticReader", "SyntheticSource"]

_PREFIX = "synthetic"


@dataclass(frozen=True)
class SyntheticOptions:
    """Options of reader `synthetic`; the scene itself is named in the source."""

    frames: int = field(default=60, metadata={"help": "pictures in the sequence", "ge": 1})
    width: int = field(default=320, metadata={"help": "width in pixels", "ge": 32})
    height: int = field(default=240, metadata={"help": "height in pixels", "ge": 32})
    fps: float = field(default=30.0, metadata={"help": "pictures per second", "gt": 0})
    seed: int = field(default=0, metadata={"help": "seed of room, paths and noise", "ge": 0})
    noise: float = field(
        default=1.5, metadata={"help": "sensor noise, standard deviation in grey levels", "ge": 0}
    )


class SyntheticSource:
    """A synthetic sequence as footage; attributes as in `FrameSource`.

    Args:
        name: of the scene. scene: what is rendered. selection: which pictures are taken.
    """

    def __init__(self, name: str, scene: Scene, selection: Selection) -> None:
        self.name = f"{_PREFIX}-{name}"
        self.scene = scene
        self.camera: Camera | None = scene.camera
        self.truth: Trajectory | None = scene.trajectory
        self.problems: list[str] = []
        self.skipped = 0
        chosen = range(selection.skip, len(scene), selection.stride)
        self._indices = chosen[: selection.max_frames] if selection.max_frames else chosen
        self.length: int | None = len(self._indices)

    def frames(self) -> Iterator[RawFrame]:
        """A fresh pass from the start; frames are rendered as they are asked for."""
        from droidw.slam.frame import RawFrame

        for index in self._indices:
            frame = self.scene.render(index)
            yield RawFrame(index, frame.time, frame.image, f"{index:06d}")


class SyntheticReader:
    """Opens `synthetic` (a hand-held camera) and `synthetic:NAME`.

    Args:
        options: size, length and seed.
    """

    def __init__(self, options: SyntheticOptions) -> None:
        self._options = options

    def recognises(self, source: str) -> bool:
        """Whether `source` is `synthetic` or begins with `synthetic:`."""
        return source == _PREFIX or source.startswith(_PREFIX + ":")

    def open(self, source: str, selection: Selection) -> SyntheticSource:
        """Open a scene of `droidw.testing.scenes.SCENES`.

        Raises:
            InputError: there is no such scene, or the selection leaves no picture.
        """
        from droidw.testing.scenes import SCENES, Scene, named_spec

        name = source.partition(":")[2] or "handheld"
        if not self.recognises(source) or name not in SCENES:
            raise InputError(
                f"{source}: there is no such synthetic scene",
                "available: synthetic:" + ", synthetic:".join(SCENES),
            )
        o = self._options
        try:
            spec = named_spec(
                name,
                width=o.width,
                height=o.height,
                frames=o.frames,
                fps=o.fps,
                seed=o.seed,
                noise=o.noise,
            )
        except UsageError as error:
            raise InputError(f"{source}: {error.message}", error.hint) from error
        if selection.skip >= o.frames:
            raise InputError(
                f"{source}: nothing is left of {o.frames} pictures after skipping {selection.skip}",
                "give a smaller input.skip, or more pictures: reader.options.frames",
            )
        return SyntheticSource(name, Scene(spec), selection)


def _build(options: Any, context: BuildContext) -> DatasetReader:
    return SyntheticReader(options)


COMPONENT: Component[DatasetReader] = Component(
    name="synthetic",
    summary="rendered footage with exact truth: synthetic, synthetic:orbit, synthetic:static, ...",
    factory=_build,
    options=SyntheticOptions,
    requires=("cv2",),
    capabilities=frozenset({"cpu", "cuda"}),
)
