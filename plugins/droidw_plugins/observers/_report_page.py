"""The observer behind `report`, and the page that it writes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from droidw.events import Event, RunFinished, RunWarning
from droidw.io.files import atomic_write
from droidw.slam.frame import RunResult
from droidw_plugins.observers._cloud_view import cloud_views
from droidw_plugins.observers._html import escape, page, section, tile
from droidw_plugins.observers._pictures import colour_ramp, keyframe_pictures
from droidw_plugins.observers._report_facts import (
    all_metrics,
    camera_facts,
    configuration,
    files,
    number,
    parts_used,
    timings,
    versions_used,
)
from droidw_plugins.observers._svg import Line, error_chart, path_view
from droidw_plugins.observers._truth import Paths, make_paths

__all__ = ["Report", "build_page"]


class Report:
    """Writes `report.html` into the run folder when a run has finished.

    Args:
        keyframes: keyframes shown at most.
        cloud_points: points drawn in each view of the cloud at most.
    """

    def __init__(self, keyframes: int = 24, cloud_points: int = 400_000) -> None:
        self._keyframes = keyframes
        self._cloud_points = cloud_points
        self._warnings: list[str] = []

    def on_event(self, event: Event) -> None:
        """Collect warnings; write the page at the end."""
        if isinstance(event, RunWarning):
            self._warnings.append(event.text)
        elif isinstance(event, RunFinished):
            text = build_page(
                event.result,
                event.run_dir,
                event.metrics,
                warnings=tuple(self._warnings),
                keyframes=self._keyframes,
                cloud_points=self._cloud_points,
            )
            with atomic_write(event.run_dir / "report.html") as stream:
                stream.write(text.encode("utf-8"))


def build_page(
    result: RunResult,
    run_dir: Path,
    metrics: Mapping[str, Any] | None = None,
    *,
    warnings: tuple[str, ...] = (),
    keyframes: int = 24,
    cloud_points: int = 400_000,
) -> str:
    """The page as text: no scripts, nothing loaded from anywhere.

    Args:
        result: the finished run.
        run_dir: its folder, for the list of files.
        metrics: figures of `droidw eval`, or None where truth is unknown.
        warnings: sentences heard during the run, beside those of the result.
        keyframes: keyframes shown at most.
        cloud_points: points drawn in each view of the cloud at most.
    """
    paths = make_paths(result)
    name = Path(result.source).name or result.source or "run"
    told = list(dict.fromkeys((*result.warnings, *warnings)))
    parts = [
        f'<header><p class="brand">droidw run report</p><h1>{escape(name)}</h1>'
        f"<p>{escape(_subtitle(result, run_dir))}</p></header>",
        _tiles(result, paths, metrics or {}),
    ]
    if told:
        items = "".join(f"<li>{escape(text)}</li>" for text in told)
        parts.append(section(f"Warnings ({len(told)})", f"<ul>{items}</ul>", css="warn"))
    parts.append(_trajectory(paths))
    parts.append(_cloud(result, cloud_points))
    parts.append(_keyframes(result, keyframes))
    parts.append(timings(result.manifest))
    parts.append(camera_facts(result))
    if metrics:
        parts.append(all_metrics(metrics))
    parts.append(files(result.manifest, run_dir))
    parts.append(configuration(result.manifest))
    parts.append(parts_used(result.manifest))
    parts.append(versions_used(result.manifest))
    parts.append("<footer>This page needs no network: everything on it is inside it.</footer>")
    return page(f"{name} · droidw", "\n".join(part for part in parts if part))


def _subtitle(result: RunResult, run_dir: Path) -> str:
    parts = [result.source]
    for key, word in (("preset", "preset "), ("device", "on "), ("started", "")):
        value = result.manifest.get(key)
        if isinstance(value, str) and value:
            parts.append(word + value)
    return " · ".join(part for part in (*parts, str(run_dir)) if part)


def _tiles(result: RunResult, paths: Paths, metrics: Mapping[str, Any]) -> str:
    manifest = result.manifest
    poses = len(paths.times)
    frames = number(manifest.get("frames"))
    read = int(frames) if frames else len(result.trajectory)
    keys = len(result.keyframes)
    tiles = [
        tile(f"{read:,}", "", "frame" if read == 1 else "frames", f"{poses:,} with a pose"),
        tile(f"{keys:,}", "", "keyframe" if keys == 1 else "keyframes"),
    ]
    fps, memory = number(manifest.get("fps")), number(manifest.get("peak_memory_mb"))
    if fps is not None:
        tiles.append(tile(f"{fps:.1f}", "frames/s", "whole run"))
    if memory is not None:
        tiles.append(tile(f"{memory:,.0f}", "MB", "peak memory"))
    if paths.unit or paths.depth is None:
        tiles.append(tile(f"{paths.length:.3g}", paths.unit or "units", "path length"))
    else:
        tiles.append(
            tile(
                f"{paths.length / paths.depth:.3g}",
                "x depth",
                "path length",
                "in median scene depths",
            )
        )
    agreement = number(manifest.get("agreement"))
    if agreement is not None:
        told = ["tracked twice"] if manifest.get("sweeps") == 2 else []
        share = number(manifest.get("backwards")) or 0.0
        if share > 0:
            told.append(f"{share:.0%} of it backwards" if share < 1 else "backwards in the end")
        tiles.append(tile(f"{100 * agreement:.0f}", "%", "of matches agree", ", ".join(told)))
    ate = number(metrics.get("ate_rmse"))
    unit = str(metrics.get("unit", paths.unit or "m"))
    if ate is None and len(paths.errors):
        ate = float(np.sqrt(np.mean(paths.errors**2)))
    if ate is not None:
        percent = number(metrics.get("ate_percent"))
        how = str(metrics.get("align", "sim3"))
        more = f"after {how}" + (f", {percent:.2f} % of the path" if percent is not None else "")
        tiles.append(tile(f"{ate:.3g}", unit, "ATE RMSE", more))
    masks = metrics.get("masks")
    if isinstance(masks, Mapping) and number(masks.get("auc")) is not None:
        known = any("was told what moves" in str(note) for note in masks.get("notes", ()))
        more = "told by input.masks" if known else ""
        tiles.append(tile(f"{masks['auc']:.3f}", "", "motion mask AUC", more))
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _trajectory(paths: Paths) -> str:
    if not len(paths.centres):
        return section("Trajectory", '<p class="hint">There is no pose to show.</p>')
    least = 0.02 * paths.depth if paths.depth else 0.0
    views = []
    for title, axes, up, names in (
        ("from above", (0, 2), 1.0, ("right", "forward")),
        ("from the side", (2, 1), -1.0, ("forward", "up")),
    ):
        flip = np.array([1.0, up])
        lines = []
        if paths.truth is not None:
            lines.append(Line(paths.truth[:, axes] * flip, "truth"))
        lines.append(Line(paths.centres[:, axes] * flip, "est"))
        drawn = path_view(
            f"trajectory {title}",
            names,
            lines,
            paths.keyframes[:, axes] * flip,
            paths.bar,
            least_span=least,
        )
        views.append(
            f"<figure>{drawn}<figcaption>{escape(title.capitalize())}</figcaption></figure>"
        )
    legend = [
        _sample('<path class="est" d="M1 6H25"/>', "estimate"),
        _sample('<circle class="key" cx="13" cy="6" r="3"/>', "keyframe"),
        _sample('<circle class="start" cx="13" cy="6" r="5"/>', "start"),
        _sample('<rect class="end" x="8.5" y="1.5" width="9" height="9"/>', "end"),
    ]
    if paths.truth is not None:
        legend.insert(1, _sample('<path class="truth" d="M2 6H25"/>', "truth"))
    body = f'<div class="legend">{"".join(legend)}</div><div class="pair">{"".join(views)}</div>'
    if len(paths.errors) > 1:
        rmse = float(np.sqrt(np.mean(paths.errors**2)))
        chart = error_chart(paths.error_times, paths.errors, rmse, paths.keyframe_times, paths.unit)
        body += (
            f'<figure class="chart"><div>{chart}</div><figcaption>Position error over time, '
            "in seconds from the first frame; ticks mark keyframes</figcaption></figure>"
        )
    hint = "Seen in the frame of the first camera, both axes to one scale."
    if paths.truth is not None:
        hint += " The truth is laid on the estimate by the best similarity (Sim(3))."
    elif paths.note:
        hint += f" {paths.note[0].upper()}{paths.note[1:]}."
    elif paths.unit:
        hint += " No truth is known; the scale is that of the depth prior."
    else:
        hint += " No truth is known: the scale of a single camera is arbitrary, so the bar is also "
        hint += "given as a share of the median depth of the scene."
    return section("Trajectory", body, hint)


def _sample(shape: str, label: str) -> str:
    return f'<span><svg viewBox="0 0 26 12">{shape}</svg>{escape(label)}</span>'


def _cloud(result: RunResult, most: int) -> str:
    views = cloud_views(result, most)
    if not views:
        return section("Static point cloud", '<p class="hint">The cloud is empty.</p>')
    figures = "".join(
        f'<figure><img src="{uri}" width="{width}" height="{height}" '
        f'alt="point cloud {escape(name)}"><figcaption>{escape(name.capitalize())}</figcaption>'
        "</figure>"
        for name, uri, width, height in views
    )
    return section(
        "Static point cloud",
        f'<div class="pair cloud">{figures}</div>',
        f"{len(result.cloud.xyz):,} points that several keyframes agree on and that did not move; "
        "the line is the path of the camera.",
    )


def _keyframes(result: RunResult, most: int) -> str:
    total = len(result.keyframes)
    start = float(result.trajectory.times[0]) if len(result.trajectory) else 0.0
    pictures = keyframe_pictures(result.keyframes, result.stride, result.offset, most)
    if not pictures:
        return section("Keyframes", '<p class="hint">There is no keyframe to show.</p>')
    cards = []
    for shown in pictures:
        record = shown.record
        size = f'width="{shown.width}" height="{shown.height}"'
        cards.append(
            f'<figure><div><img src="{shown.overlay}" {size} alt="keyframe {shown.number} with '
            f'uncertainty"><img src="{shown.depth}" {size} alt="depth of keyframe '
            f'{shown.number}"></div><figcaption>#{shown.number} · frame {record.index} · '
            f"{record.time - start:.2f} s<br>{100 * shown.moving:.0f} % down-weighted · "
            f"{100 * shown.depth_share:.0f} % with depth</figcaption></figure>"
        )
    legend = (
        '<div class="legend"><span>uncertain <i class="ramp" style="background:'
        f'{colour_ramp("uncertainty")}"></i> more</span><span>far <i class="ramp" '
        f'style="background:{colour_ramp("depth")}"></i> near</span>'
        "<span>grey: depth not confirmed by other keyframes</span></div>"
    )
    some = f"{len(pictures)} of {total}, evenly chosen. " if len(pictures) < total else ""
    return section(
        "Keyframes",
        f'{legend}<div class="keys">{"".join(cards)}</div>',
        f"{some}Left the picture, tinted where uncertainty took its weight away (it moves, or it "
        "does not fit); right the inverse depth. Colours mean the same in all of them; times are "
        "from the first frame.",
    )
