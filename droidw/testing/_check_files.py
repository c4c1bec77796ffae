"""Conformance of what reads, writes and listens: readers, exporters, observers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from droidw.errors import InputError
from droidw.events import (
    Event,
    FrameTracked,
    KeyframeAdded,
    KeyframeRemoved,
    Progress,
    RunFailed,
    RunFinished,
    RunStarted,
    RunWarning,
)
from droidw.interfaces.datasets import DatasetReader, FrameSource, Selection
from droidw.interfaces.exporters import Exporter
from droidw.interfaces.observers import Observer
from droidw.slam.frame import CloudPoints, KeyframeRecord, RawFrame, RunResult, Trajectory
from droidw.testing._contract import Subject, same, snapshot
from droidw.testing.scenes import Scene, SceneSpec

__all__ = ["dataset_reader", "exporter", "observer", "sample_result"]

_FEW = 6


def dataset_reader(subject: Subject, source: str) -> None:
    """See `droidw.testing.conformance.check_dataset_reader`."""
    part = subject.build(seed=3)
    subject.follows(part, DatasetReader)
    with subject.calling("recognises"):
        subject.expect(
            "recognises", part.recognises(source) is True, f"it does not recognise {source}"
        )
        for junk in ("", "no/such/place", "no-such-reader:clip"):
            subject.expect(
                "recognises", part.recognises(junk) is False, f"it takes {junk!r} for its own"
            )
    try:
        part.open("no/such/place", Selection())
    except InputError:
        pass
    except Exception as error:  # noqa: BLE001 - strangers' code
        subject.expect(
            "errors",
            False,
            f"open of a source that is not there raised {type(error).__name__}, not an InputError",
        )
    else:
        subject.expect("errors", False, "open of a source that is not there raised nothing")
    opened, frames = _open(subject, part, source, Selection(max_frames=_FEW))
    subject.expect("frames", bool(frames), f"{source} yields no frame")
    if opened.length is not None and opened.skipped == 0:
        subject.expect(
            "length",
            opened.length == len(frames),
            f"length is {opened.length}, but a pass yields {len(frames)} frames",
        )
    _sequence(subject, frames)
    problems, skipped = list(opened.problems), opened.skipped
    with subject.calling("a second pass"):
        again = list(opened.frames())
    subject.expect("repeatable", same(frames, again), "a second pass yields other frames")
    subject.expect(
        "problems",
        problems == opened.problems and skipped == opened.skipped,
        "problems or skipped grow after the first pass",
    )
    _, some = _open(subject, part, source, Selection(stride=2, skip=1, max_frames=2))
    if skipped == 0:
        expected = frames[1::2][:2]
        subject.expect(
            "selection",
            [f.index for f in some] == [f.index for f in expected]
            and [f.time for f in some] == [f.time for f in expected],
            "stride=2, skip=1, max_frames=2 does not select the second and the fourth "
            "picture with their own index and time",
        )
    _calibration(subject, opened, frames[0])


def _open(
    subject: Subject, part: Any, source: str, selection: Selection
) -> tuple[FrameSource, list[RawFrame]]:
    with subject.calling(f"open of {source}"):
        opened = part.open(source, selection)
    subject.follows(opened, FrameSource)
    with subject.calling(f"reading {source}"):
        frames = list(islice(opened.frames(), selection.max_frames + 1))
    subject.expect(
        "selection",
        len(frames) <= selection.max_frames,
        f"max_frames={selection.max_frames} yields more frames than that",
    )
    return opened, frames


def _sequence(subject: Subject, frames: list[RawFrame]) -> None:
    shape = frames[0].image.shape
    for frame in frames:
        image = frame.image
        subject.expect("frames", isinstance(frame, RawFrame), "frames yields no RawFrame")
        subject.expect(
            "shape",
            image.ndim == 3 and image.shape[2] == 3 and image.shape == shape,
            f"an image has shape {image.shape}; [H,W,3] is due, the same for all",
        )
        subject.expect("dtype", image.dtype == np.uint8, f"an image is {image.dtype}, not uint8")
    for earlier, later in zip(frames, frames[1:], strict=False):
        subject.expect(
            "time",
            np.isfinite(later.time) and later.time > earlier.time,
            f"times do not strictly rise: {earlier.time}, {later.time}",
        )
        subject.expect(
            "index",
            later.index > earlier.index,
            f"indices do not rise: {earlier.index}, {later.index}",
        )


def _calibration(subject: Subject, opened: FrameSource, frame: RawFrame) -> None:
    subject.expect(
        "name",
        bool(opened.name) and "/" not in opened.name,
        f"the name '{opened.name}' cannot name a run folder",
    )
    camera, truth = opened.camera, opened.truth
    if camera is not None:
        size = frame.image.shape[1], frame.image.shape[0]
        subject.expect(
            "camera",
            (camera.width, camera.height) == size,
            f"the camera is for {camera.width}x{camera.height}, the pictures are "
            f"{size[0]}x{size[1]}",
        )
    if truth is not None:
        subject.expect(
            "truth",
            truth.T_wc.shape == (len(truth.times), 7) and bool(np.isfinite(truth.T_wc).all()),
            f"truth has poses of shape {truth.T_wc.shape} or numbers that are not finite",
        )
        norms = np.linalg.norm(truth.T_wc[:, 3:], axis=1)
        subject.expect(
            "truth",
            bool((np.abs(norms - 1) < 1e-3).all()) and bool((np.diff(truth.times) > 0).all()),
            "truth has quaternions that are not of unit length, or times that do not rise",
        )


def sample_result(run_dir: Path | None = None) -> RunResult:
    """A small result with exact numbers, as a run over a synthetic scene would leave it.

    Six frames of 64x48, three of them keyframes on a grid of 8x6 cells, and 60 points.
    """
    scene = Scene(SceneSpec(width=64, height=48, frames=6, fps=10.0))
    y, x = np.mgrid[:6, :8].astype(np.float64)
    cells = np.stack([x, y], axis=-1) * 8 + 3.5
    rows, columns = np.mgrid[:48, :64].astype(np.float64)
    pixels = np.stack([columns, rows], axis=-1)
    records = []
    for index in (0, 2, 4):
        depth = scene.depth_at(index, cells)
        # Grey by distance: the textures of the scene take longer to paint than all the rest.
        grey = np.clip(scene.depth_at(index, pixels) * 45, 0, 255).astype(np.uint8)
        moving = scene.correspond(index, index, cells).moving
        records.append(
            KeyframeRecord(
                index,
                scene.time(index),
                f"{index:06d}",
                np.stack([grey] * 3, axis=-1),
                scene.T_wc(index),
                scene.intrinsics,
                (1 / depth).astype(np.float32),
                ~moving,
                np.where(moving, 2.0, 0.1).astype(np.float32),
                np.where(moving, 0.0, 1.0).astype(np.float32),
            )
        )
    truth = scene.trajectory
    rng = np.random.default_rng(1)
    cloud = CloudPoints(
        rng.uniform(-1, 1, (60, 3)).astype(np.float32),
        rng.integers(0, 256, (60, 3), dtype=np.uint8),
    )
    return RunResult(
        Trajectory(truth.times, truth.T_wc, np.arange(6) % 2 == 0),
        tuple(records),
        cloud,
        scene.camera,
        8,
        3.5,
        "synthetic",
        truth,
        {"seed": 0, "timings": {"track": 1.0}},
        ("a warning of the test",),
        run_dir,
    )


def _shortened(result: RunResult, keyframes: int) -> RunResult:
    """The result with fewer keyframes; with none, there are no points either."""
    kept = result.keyframes[:keyframes]
    is_keyframe = np.isin(result.trajectory.times, [k.time for k in kept])
    cloud = result.cloud if kept else CloudPoints(result.cloud.xyz[:0], result.cloud.rgb[:0])
    trajectory = replace(result.trajectory, is_keyframe=is_keyframe)
    return replace(result, keyframes=kept, trajectory=trajectory, cloud=cloud)


def exporter(subject: Subject) -> None:
    """See `droidw.testing.conformance.check_exporter`."""
    part = subject.build(seed=3)
    subject.follows(part, Exporter)
    full = sample_result(subject.folder)
    for keyframes, label in ((3, "a small run"), (1, "one keyframe"), (0, "no keyframes")):
        result = _shortened(full, keyframes)
        before = snapshot(result)
        folder = subject.folder / f"export-{keyframes}"
        folder.mkdir()
        outside = _listing(subject.folder)
        with subject.calling(f"export of {label}"):
            files = part.export(result, folder)
        subject.unchanged(f"the result ({label})", before, result)
        written = _listing(folder)
        subject.expect(
            "files",
            isinstance(files, list) and all(isinstance(path, Path) for path in files),
            "export must return a list of paths",
        )
        subject.expect(
            "files",
            {path.resolve() for path in files} == written,
            f"the files returned for {label} are not the files written",
        )
        subject.expect(
            "folder",
            _listing(subject.folder) - written == outside - written,
            f"files were written outside the given folder for {label}",
        )
        if keyframes == 3:
            subject.expect(
                "files",
                bool(files) and all(p.stat().st_size > 0 for p in files),
                "nothing, or an empty file, is written for a small run",
            )


def _listing(folder: Path) -> set[Path]:
    return {path.resolve() for path in folder.rglob("*") if path.is_file()}


@dataclass(frozen=True)
class _FutureEvent(Event):
    """An event that this version of droidw does not have yet."""


def observer(subject: Subject) -> None:
    """See `droidw.testing.conformance.check_observer`."""
    full = sample_result(subject.folder)
    for keyframes, length in ((3, 6), (0, None)):
        part = subject.build(seed=3)
        subject.follows(part, Observer)
        result = _shortened(full, keyframes)
        before = snapshot(result)
        events: list[Event] = [RunStarted("synthetic", subject.folder, length, {"device": "cpu"})]
        for index in range(6):
            events.append(FrameTracked(index, index / 10, index + 1, index // 2))
        events += [
            KeyframeAdded(0, 0),
            KeyframeAdded(1, 2),
            KeyframeRemoved(1, 2),
            Progress("global", 1, 2),
            Progress("global", 2, 2),
            Progress("fill", 1, 1),
            _FutureEvent(),
            RunWarning("a sentence"),
            RunFinished(result, subject.folder, {"ate_rmse": 0.01} if length else None),
        ]
        _hears(subject, part, events)
        subject.unchanged("the result in RunFinished", before, result)
    failed = subject.build(seed=3)
    _hears(
        subject,
        failed,
        [RunStarted("synthetic", subject.folder, None, {}), RunFailed("tracking stopped")],
    )
    _hears(subject, subject.build(seed=3), [RunFailed("nothing could be read")])


def _hears(subject: Subject, part: Any, events: list[Event]) -> None:
    for event in events:
        with subject.calling(f"on_event with {type(event).__name__}"):
            answer = part.on_event(event)
        subject.expect(
            "silent", answer is None, f"on_event returned {answer!r} for {type(event).__name__}"
        )
