"""Drives one run from a resolved configuration to the files of the run folder."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from droidw.errors import DroidwError, InputError, Interrupted, TrackingError
from droidw.eval.masks import score_folder
from droidw.eval.metrics import score
from droidw.eval.summary import told_what_moves
from droidw.events import Dispatcher, Progress, RunFailed, RunFinished, RunStarted
from droidw.geometry.rectify import Rectification, Rectifier
from droidw.io.files import write_json, write_text
from droidw.io.prefetch import prefetch
from droidw.io.tum import write_tum
from droidw.log import log_to_file
from droidw.plugin.component import BuildContext
from droidw.run.again import Again, Hidden, again, second_time
from droidw.run.cameras import choose_camera, inputs_of, open_masks, why_unmatched
from droidw.run.folder import RunFolder, listed, prepare
from droidw.run.machine import run_device, settle
from droidw.run.manifest import facts_of_setup, facts_of_time, facts_of_tracking, told
from droidw.run.parts import build_observers, build_parts
from droidw.run.signals import Stop
from droidw.run.sources import could_not_be_used, open_source
from droidw.slam.contract import frame_of
from droidw.slam.frame import RunResult
from droidw.slam.records import Outcome
from droidw.slam.system import SlamSystem
from droidw.slam.timing import Stopwatch

if TYPE_CHECKING:
    from droidw.config.resolve import ResolvedConfig
    from droidw.interfaces.datasets import FrameSource
    from droidw.io.masks import UserMasks
    from droidw.plugin.manager import Plugins
    from droidw.slam.frame import Frame, RawFrame
    from droidw.slam.optimise import Parts

__all__ = ["run"]

_log = logging.getLogger(__name__)


def run(
    resolved: ResolvedConfig,
    plugins: Plugins,
    run_dir: Path,
    *,
    overwrite: bool = False,
    note: str = "",
) -> RunResult:
    """Run on the source that the configuration names and write the run folder.

    Args:
        resolved: configuration whose parts have been found.
        plugins: where readers are looked up for `reader: auto`.
        run_dir: output folder, new or empty unless `overwrite`.
        note: a sentence for the log and the manifest, e.g. why a preset was chosen.
    Returns:
        What was written, as handed to the exporters.
    Raises:
        UsageError: the output folder cannot be used.
        InputError: the source or the calibration cannot be used.
        TrackingError: no frame could be matched with another.
        MissingRequirementError: the device is not there.
        Interrupted: stopped by a signal, after what was tracked had been written.
    """
    device = run_device(resolved)
    folder = prepare(run_dir, overwrite, inputs_of(resolved.config))
    with ExitStack() as stack:
        # What is refused before anything was tracked leaves no trace, and an earlier run as it was.
        stack.callback(folder.finish)
        stack.enter_context(log_to_file(folder.early("log.txt")))
        write_text(folder.early("config.yaml"), resolved.to_yaml())
        if note:
            _log.info(note)
        stop = stack.enter_context(Stop())
        return _Run(resolved, plugins, folder, device, stop, note).go()


class _Run:
    """State of one run between its stages."""

    def __init__(
        self,
        resolved: ResolvedConfig,
        plugins: Plugins,
        folder: RunFolder,
        device: torch.device,
        stop: Stop,
        note: str,
    ) -> None:
        self.resolved, self.plugins, self.folder = resolved, plugins, folder
        self.run_dir = folder.path
        self.config, self.device, self.stop, self.note = resolved.config, device, stop, note
        self.started = time.perf_counter()
        self.sweeps = self.kept = 1
        self.masks: UserMasks | None = None
        self.clock = Stopwatch()
        self.context = BuildContext(
            device=device,
            seed=self.config.seed,
            weights_dir=plugins.weights_dir,
            data_dir=plugins.data_dir,
            run_dir=folder.path,
            compat=frozenset(self.config.compat),
            disabled=plugins.disabled(),
        )
        settle(self.config.seed, self.config.threads)
        observers, failed = build_observers(resolved, self.context)
        self.events = Dispatcher(observers)
        for text in failed:
            self.events.warn(text)

    def go(self) -> RunResult:
        try:
            return self._go()
        except Exception as error:
            self.events.emit(RunFailed(str(error)))
            raise

    def _go(self) -> RunResult:
        source = open_source(self.resolved, self.plugins, self.context)
        pictures = iter(source.frames())
        first = next(pictures, None)
        if first is None:
            raise InputError(
                f"{self.config.input.source}: no picture could be read",
                "\n".join(source.problems[:5]) or "see: droidw run -h",
            )
        height, width = frame_of(first).image.shape[:2]
        camera, self.said, guessed = choose_camera(
            self.config.camera, source.camera, width, height, source.name
        )
        size = self.config.camera.size
        rectify = Rectifier(
            camera,
            long_side=None if size else self.config.camera.long_side,
            size=(size[0], size[1]) if size else None,
            edge=self.config.camera.edge,
        )
        if guessed:
            self.events.warn(f"camera: {self.said}")
        given, parts = self.config.input, (self.resolved, self.plugins, self.context)
        if given.masks:
            whole = open_source(*parts, whole=True) if given.max_frames else source
            self.masks = open_masks(given, whole)
        self.context = replace(self.context, camera=camera)
        able = self.resolved.parts["correspondence"][0].capabilities
        threads = "threads" in able or (self.device.type == "cuda" and "gpu-threads" in able)

        def build(hidden: Hidden | None) -> SlamSystem:
            return SlamSystem(
                self.config if hidden is None else second_time(self.config),
                self._build(),
                rectify.camera,
                self.device,
                self.events,
                threaded=threads,
                focal_known=not guessed,
                hidden=hidden,
                clock=self.clock,
                stopped=lambda: self.stop.signum > 0,
            )

        system = build(None)
        self.built = time.perf_counter()

        passes = chain([chain([first], pictures)], iter(source.frames, None))

        def frames() -> Generator[Frame, None, None]:
            return prefetch(self._prepared(next(passes), rectify), ahead=8)

        self.events.emit(
            RunStarted(self.config.input.source, self.run_dir, source.length, self._facts())
        )
        failure = self._track(system, frames)
        if failure is not None and not system.frames:
            raise failure
        if not system.frames:
            raise Interrupted("stopped by a signal before the first frame", self.stop.signum)
        outcome = system.finish(frames, brief=failure is not None or self.stop.signum > 0)
        once_more = None
        if failure is None and not self.stop.signum:
            once_more = again(system, outcome, self.config.frontend)
        self.setup = facts_of_setup(
            self.resolved, self.device, self.context.weights_dir, system.parts
        )
        # What it measured is not needed any more, and the second time needs the room.
        del system
        if once_more is not None:
            gc.collect()
            outcome = self._again(outcome, once_more, build, frames)
        if outcome.focal is not None and outcome.focal.factor != 1.0:
            self.said += (
                f"; focal length refined to {outcome.focal.factor:.3f} times that, "
                f"{camera.fx * outcome.focal.factor:.1f} px of the raw picture"
            )
        result = self._export(source, outcome, rectify.way)
        self._conclude(failure, result, outcome)
        return result

    def _prepared(self, pictures: Iterable[RawFrame], rectify: Rectifier) -> Iterator[Frame]:
        """Frames at working size; what decoding takes is counted in the thread that decodes."""
        pending, before = iter(pictures), None
        while True:
            with self.clock("decode"):
                raw = next(pending, None)
                if raw is not None:
                    before = frame_of(raw, before)
                frame = None if raw is None else self._rectified(raw, rectify)
                if frame is not None and self.device.type == "cuda":
                    frame = replace(frame, image=frame.image.pin_memory())
            if frame is None:
                return
            yield frame

    def _rectified(self, raw: RawFrame, rectify: Rectifier) -> Frame:
        masks = self.masks
        return rectify(raw) if masks is None else rectify(raw, masks.of(raw), working=masks.working)

    def _track(
        self, system: SlamSystem, frames: Callable[[], Generator[Frame, None, None]]
    ) -> Exception | None:
        """Track until the end, a signal or an error; an error is kept for after the export."""
        stream = frames()
        try:
            system.track(self.stop.until(stream))
        except Exception as error:  # noqa: BLE001 - raised again once all is written
            self.events.warn(f"tracking stopped after {system.frames} frames: {error}")
            return error
        finally:
            stream.close()
        return None

    def _again(
        self,
        outcome: Outcome,
        reason: Again,
        build: Callable[[Hidden | None], SlamSystem],
        frames: Callable[[], Generator[Frame, None, None]],
    ) -> Outcome:
        """Track once more; what was found stays if that fails."""
        _log.info(reason.why)
        self.sweeps = 2
        try:
            second = build(reason.hidden)
            stopped = self._track(second, frames) is not None or self.stop.signum > 0
            why = "it did not come to an end" if stopped else reason.unfounded(second)
            found = None if why else second.finish(frames)
            why = reason.rejection(outcome, found) if found else why
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the first is as good as it was
            found, why = None, str(error) or type(error).__name__
        if found is None or why:
            self.events.warn(f"tracked once more, but what was found first is kept: {why}")
            return outcome
        self.kept = 2
        return found

    def _conclude(self, failure: Exception | None, result: RunResult, outcome: Outcome) -> None:
        written = f"{len(result.trajectory)} poses were written to {self.run_dir}/trajectory.tum"
        if self.stop.signum:
            raise Interrupted(
                f"stopped by a signal after frame {int(result.manifest['last_frame'])}",
                self.stop.signum,
                written,
            )
        if failure is not None:
            raise failure
        if outcome.diagnosis.unmatched:
            why, advice = why_unmatched(self.masks)
            raise TrackingError(
                f"{self.config.input.source}: nothing could be matched between the "
                f"{outcome.diagnosis.frames} frames: {why}",
                f"{written}, all at the origin; {advice}",
            )

    # -- stages ----------------------------------------------------------------------------

    def _build(self) -> Parts:
        return build_parts(self.resolved, self.context)

    def _facts(self) -> dict[str, Any]:
        return {
            "camera": self.said,
            "device": str(self.device),
            "parts": {slot: part.name for slot, (part, _) in self.resolved.parts.items()},
        }

    def _export(self, source: FrameSource, outcome: Outcome, way: Rectification) -> RunResult:
        self.folder.begin()
        texts = [*outcome.diagnosis.warnings(), *(self.masks.problems() if self.masks else ())]
        texts += told(outcome.reports)
        texts += could_not_be_used(source)
        for text in texts:
            self.events.warn(text)
        truth = source.truth
        if truth is not None:
            write_tum(self.run_dir / "truth.tum", truth, digits=15)  # may be in map coordinates
        metrics = self._score(outcome, truth)
        result = RunResult(
            trajectory=outcome.trajectory,
            keyframes=outcome.keyframes,
            cloud=outcome.cloud,
            camera=outcome.camera,
            stride=outcome.grid.stride,
            offset=outcome.grid.offset,
            source=self.config.input.source,
            truth=truth,
            manifest=self._manifest(source, outcome),
            run_dir=self.run_dir,
            rectification=way,
        )
        total = len(self.resolved.exporters)
        with self.clock("export"):
            for done, (component, options) in enumerate(self.resolved.exporters):
                try:
                    component.factory(options, self.context).export(result, self.run_dir)
                except (Exception, SystemExit) as error:  # noqa: BLE001 - it must not cost others
                    _log.debug("exporter %s raised", component.name, exc_info=True)
                    kind = "" if isinstance(error, DroidwError) else f"{type(error).__name__}: "
                    self.events.warn(f"exporter '{component.name}' failed: {kind}{error}")
                self.events.emit(Progress("export", done + 1, total))
        metrics = self._score_masks(metrics)
        if metrics is not None:
            write_json(self.run_dir / "metrics.json", metrics)
        # Exporters take time and write files; all else holds.
        manifest = {**result.manifest, **self._facts_of_time(outcome), **self._files()}
        result = replace(result, manifest=manifest, warnings=tuple(self.events.warnings))
        write_json(self.run_dir / "manifest.json", {**manifest, "warnings": self.events.warnings})
        self.events.emit(RunFinished(result, self.run_dir, metrics))
        return result

    def _score(self, outcome: Outcome, truth: Any) -> dict[str, Any] | None:
        if truth is None or len(outcome.trajectory) < 3 or outcome.diagnosis.still:
            return None
        try:
            return score(outcome.trajectory, truth, names=("trajectory.tum", "truth")).to_dict()
        except DroidwError as error:
            self.events.warn(f"the trajectory was not scored: {error.message}")
            return None

    def _score_masks(self, metrics: dict[str, Any] | None) -> dict[str, Any] | None:
        """Add the score of the written uncertainty maps, where the source has motion masks."""
        masks, maps = Path(self.config.input.source) / "mask", self.run_dir / "uncertainty"
        if not masks.is_dir() or not maps.is_dir():
            return metrics
        try:
            found = score_folder(maps, masks, source=masks.parent).to_dict()
            if self.config.input.masks:
                found["notes"] += [told_what_moves(self.config.input.masks)]
            return {**(metrics or {}), "masks": found}
        except DroidwError as error:
            self.events.warn(f"the uncertainty was not scored: {error.message}")
            return metrics

    def _manifest(self, source: FrameSource, outcome: Outcome) -> dict[str, Any]:
        return {
            "source": self.config.input.source,
            **facts_of_tracking(source, outcome),
            "sweeps": self.sweeps,
            "kept_sweep": self.kept,
            **self._facts_of_time(outcome),
            "camera": self.said,
            **self.setup,
            "note": self.note,
            **self._files(),
        }

    def _facts_of_time(self, outcome: Outcome) -> dict[str, Any]:
        built, now = self.built - self.started, time.perf_counter() - self.started
        return facts_of_time(self.clock, len(outcome.trajectory), built, now)

    def _files(self) -> dict[str, Any]:
        """What lies in the run folder, and what each file means."""
        # written after the manifest has been put together
        later = {"manifest.json"}
        if any(part.name == "report" for part, _ in self.resolved.observers):
            later.add("report.html")
        return {"files": listed(self.run_dir, later)}
