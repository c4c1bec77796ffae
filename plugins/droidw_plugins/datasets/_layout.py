"""Telling folders of footage apart by what lies in them; imports nothing heavy."""

from __future__ import annotations

from pathlib import Path

__all__ = ["VIDEO_SUFFIXES", "looks_like_tum"]

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".gif", ".mpg", ".mpeg", ".ts", ".wmv"}
    | {".3gp", ".flv", ".mts", ".ogv"}
)


def looks_like_tum(folder: Path) -> bool:
    """Whether this is a sequence of the TUM RGB-D benchmark as it is downloaded.

    It has `rgb.txt` and no `camera.txt`, and either files of the depth camera and the
    accelerometer or "freiburg" in its name.
    """
    if not (folder / "rgb.txt").is_file() or (folder / "camera.txt").exists():
        return False
    others = ("depth.txt", "accelerometer.txt")
    return any((folder / name).is_file() for name in others) or "freiburg" in folder.name
