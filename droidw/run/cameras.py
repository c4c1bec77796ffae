"""Which camera a run assumes, and why; and the masks that go with its pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from droidw.errors import InputError
from droidw.geometry.camera import Camera
from droidw.io.calib import read_calibration
from droidw.io.masks import UserMasks

if TYPE_CHECKING:
    from droidw.config.schema import CameraConfig, DroidwConfig, InputConfig
    from droidw.interfaces.datasets import FrameSource

__all__ = ["GUESSED_FOV", "choose_camera", "inputs_of", "open_masks", "why_unmatched"]

GUESSED_FOV = 60.0
"""Horizontal field of view in degrees where nothing is known: between phones and webcams."""


def choose_camera(
    config: CameraConfig, known: Camera | None, width: int, height: int, source: str
) -> tuple[Camera, str, bool]:
    """The camera of the raw pictures.

    What the user said comes before what the source says, and a guess comes last.

    Args:
        config: what the user said; at most one of a file, a focal length, a field of view.
        known: what the source says.
        width, height: of the raw pictures.
        source: name of the source, for messages.
    Returns:
        The camera; a sentence that says where it is from; and whether it was guessed.
    Raises:
        InputError: a calibration cannot be used, or does not fit the pictures.
    """
    if config.calib is not None:
        camera, note = read_calibration(Path(config.calib), width, height)
        return camera, f"from {config.calib}{': ' + note if note else ''}", False
    if config.focal is not None:
        camera = Camera(
            width, height, config.focal, config.focal, (width - 1) / 2, (height - 1) / 2
        )
        camera = camera.validated("--focal")
        return camera, f"focal length {config.focal:g} px as given, axis in the middle", False
    if config.fov is not None:
        camera = Camera.guess(width, height, config.fov)
        return camera, f"field of view {config.fov:g} degrees as given", False
    if known is not None:
        if (known.width, known.height) != (width, height):
            known = _scaled(known, width, height, source)
            return known, f"from {source}, scaled to {width}x{height}", False
        return known.validated(source), f"from {source}", False
    camera = Camera.guess(width, height, GUESSED_FOV)
    said = (
        f"unknown; a field of view of {GUESSED_FOV:g} degrees (focal length {camera.fx:.0f} px "
        "of the raw picture) was assumed; say better with --calib FILE, --focal PIXELS or "
        "--fov DEGREES"
    )
    return camera, said, True


def _scaled(camera: Camera, width: int, height: int, source: str) -> Camera:
    """A calibration made at another size of the same shape."""
    across, down = width / camera.width, height / camera.height
    if abs(across / down - 1.0) > 0.01:
        raise InputError(
            f"{source}: the calibration is for {camera.width}x{camera.height} px, but the "
            f"pictures have {width}x{height} px, which is another shape",
            f"calibrate at {width}x{height}, or give --focal PIXELS or --fov DEGREES",
        )
    return camera.resized(width, height).validated(source)


def open_masks(config: InputConfig, source: FrameSource) -> UserMasks | None:
    """The masks that the configuration names, or None.

    Args:
        source: with all its pictures, whatever `max_frames` says.
    Raises:
        InputError: the folder is not there or holds no masks.
    """
    if not config.masks:
        return None
    if source.length is None:
        return UserMasks(Path(config.masks), 0, None)
    # A stride hides how many pictures there are, but for a range.
    least = config.skip + (source.length - 1) * config.stride + 1
    return UserMasks(Path(config.masks), least, least + config.stride - 1)


def inputs_of(config: DroidwConfig) -> dict[str, str]:
    """What a run reads, by the key that names it."""
    given = {
        "input.source": config.input.source,
        "input.masks": config.input.masks,
        "camera.calib": config.camera.calib,
        "depth.options.path": config.depth.options.get("path"),
    }
    return {key: path for key, path in given.items() if path and isinstance(path, str)}


def why_unmatched(masks: UserMasks | None) -> tuple[str, str]:
    """Why nothing could be matched between pictures, as far as one knows, and what to do."""
    if masks is not None and masks.hide_all():
        return (
            f"the masks in {masks.folder} hide all of them",
            "what is not black in a mask is ignored: are they the other way about?",
        )
    return (
        "they are blank, unrelated or without texture",
        "look at the footage, or try a larger camera.long_side",
    )
