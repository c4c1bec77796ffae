"""Sections of the report that list facts: time, camera, parts, files, configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from droidw.slam.frame import RunResult
from droidw_plugins.observers._html import bars, definitions, escape, section

__all__ = [
    "all_metrics",
    "camera_facts",
    "configuration",
    "files",
    "manifest_text",
    "number",
    "parts_used",
    "timings",
    "versions_used",
]

_KNOWN = {
    "config.yaml": "the resolved configuration; droidw run takes it again",
    "manifest.json": "versions, timings, weights, what was assumed",
    "log.txt": "what the run said",
    "trajectory.tum": "pose of every frame: t tx ty tz qx qy qz qw, camera to world",
    "keyframes.tum": "poses of the keyframes, in the same format",
    "points.ply": "static point cloud with colours",
    "uncertainty": "what moves, frame by frame",
    "depth": "depth maps of the keyframes",
    "metrics.json": "errors against the truth",
    "report.html": "this page",
}


def timings(manifest: Mapping[str, Any]) -> str:
    """Seconds by stage as bars; "" where none are known."""
    stages = manifest.get("stages")
    rows = [
        (str(name), seconds)
        for name, value in (stages.items() if isinstance(stages, Mapping) else ())
        if (seconds := number(value)) is not None and seconds >= 0
    ]
    if not rows:
        return ""
    total = sum(seconds for _, seconds in rows)
    whole = number(manifest.get("seconds"))
    if whole is None or whole <= 0:
        return section("Time", bars(rows, "s", total), f"{total:.2f} s in all stages together.")
    hint = f"{whole:.2f} s in all."
    if total > whole:
        hint += " Some of these lie within others, so they add up to more."
    return section("Time", bars(rows, "s", whole), hint)


def camera_facts(result: RunResult) -> str:
    """The working camera, and what was assumed about it."""
    camera = result.camera
    said = manifest_text(result.manifest.get("camera"))
    rows: list[tuple[str, object]] = [
        ("working size", f"{camera.width} x {camera.height} px"),
        ("focal length", f"{camera.fx:.2f}, {camera.fy:.2f} px"),
        ("principal point", f"{camera.cx:.2f}, {camera.cy:.2f} px"),
        ("grid", f"a cell every {result.stride} px"),
    ]
    return section("Camera", definitions(rows), said)


def manifest_text(value: object) -> str:
    """A manifest entry as one line of text, "" for what is not there."""
    if value is None:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {entry}" for key, entry in value.items())
    return str(value)


def all_metrics(metrics: Mapping[str, Any]) -> str:
    """Every figure of the evaluation, folded away."""
    rows: list[tuple[str, object]] = []

    def add(prefix: str, record: Mapping[str, Any]) -> None:
        for key, value in record.items():
            if isinstance(value, Mapping):
                add(f"{prefix}{key} ", value)
            elif isinstance(value, bool) or value is None or isinstance(value, (list, tuple)):
                continue
            elif isinstance(value, float):
                rows.append((f"{prefix}{key}", f"{value:.6g}"))
            else:
                rows.append((f"{prefix}{key}", value))

    add("", metrics)
    return (
        f"<section><details><summary>All figures of the evaluation</summary>"
        f'<div style="margin-top:12px">{definitions(rows)}</div></details></section>'
    )


def files(manifest: Mapping[str, Any], run_dir: Path) -> str:
    """The files of the run folder, with sizes and what each is."""
    named = manifest.get("files")
    meaning = (
        {str(key): str(value) for key, value in named.items()} if isinstance(named, Mapping) else {}
    )
    there = (
        {path.name for path in run_dir.iterdir() if not path.name.startswith(".")}
        if run_dir.is_dir()
        else set()
    )
    there.add("report.html")
    # An entry of the manifest may name a file inside a folder, such as depth/000000.png.
    names = sorted(there | {name for name in meaning if (run_dir / name).exists()})
    rows = []
    for name in names:
        path = run_dir / name
        about = meaning.get(name) or meaning.get(f"{name}/") or _KNOWN.get(name, "")
        link = quote(name) + ("/" if path.is_dir() else "")
        rows.append(
            f'<tr><td><a href="./{escape(link)}">{escape(name)}</a></td><td>{escape(about)}</td>'
            f"<td>{'' if name == 'report.html' else escape(_size(path))}</td></tr>"
        )
    return section("Files", f"<table>{''.join(rows)}</table>", str(run_dir))


def _size(path: Path) -> str:
    try:
        if path.is_dir():
            count = sum(1 for _ in path.iterdir())
            return f"{count} file" + ("" if count == 1 else "s")
        size = float(path.stat().st_size)
    except OSError:
        return ""
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


def configuration(manifest: Mapping[str, Any]) -> str:
    """The resolved configuration, folded away."""
    text = manifest.get("config_yaml")
    if not text:
        return ""
    return (
        "<section><details><summary>Configuration</summary>"
        f"<pre>{escape(text)}</pre></details></section>"
    )


def parts_used(manifest: Mapping[str, Any]) -> str:
    """The plugin in each slot, with its reference."""
    chosen = manifest.get("parts")
    if not isinstance(chosen, Mapping):
        return ""
    rows = []
    for slot, part in chosen.items():
        if isinstance(part, Mapping):
            cells = (slot, part.get("name", ""), part.get("reference", ""), part.get("from", ""))
            rows.append("".join(f"<td>{escape(cell)}</td>" for cell in cells))
    if not rows:
        return ""
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return section(
        "Parts",
        f'<div class="scroll"><table>{body}</table></div>',
        manifest_text(manifest.get("note")),
    )


def versions_used(manifest: Mapping[str, Any]) -> str:
    """Versions of what the numbers depend on."""
    versions = manifest.get("versions")
    if not isinstance(versions, Mapping) or not versions:
        return ""
    rows = [(str(key), manifest_text(value)) for key, value in versions.items()]
    return section("Versions", definitions(rows))


def number(value: object) -> float | None:
    """A finite number, or None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value) if math.isfinite(value) else None
