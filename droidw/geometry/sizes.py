"""At which size a picture is worked on."""

from __future__ import annotations

from droidw.errors import InputError

__all__ = ["SMALLEST", "plan_size", "working_size"]

SMALLEST = 32
"""Pixels that are needed on each side."""


def working_size(width: int, height: int, long_side: int, multiple: int = 8) -> tuple[int, int]:
    """The size (w, h) at which a picture is worked on.

    The picture is resized until its longer side is `long_side` (never enlarged), each side
    rounded to a whole pixel; then a centred crop takes off up to `multiple - 1` pixels in all
    per axis to reach multiples of `multiple`. Nothing is stretched to fit.

    Raises:
        InputError: less than 32 pixels would be left on a side.
    """
    return plan_size(width, height, long_side, 0, multiple)[1]


def plan_size(
    width: int, height: int, long_side: int, edge: int, multiple: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Size after resizing to `long_side`, and after cropping `edge` and the rest off each side.

    Raises:
        InputError: as `working_size`.
    """
    scale = min(1.0, long_side / max(width, height))
    resized = (max(1, round(width * scale)), max(1, round(height * scale)))
    w, h = ((side - 2 * edge) // multiple * multiple for side in resized)
    if min(w, h) < SMALLEST:
        raise InputError(
            f"pictures of {width}x{height} pixels leave {max(w, 0)}x{max(h, 0)} pixels to work on",
            f"at least {SMALLEST} are needed on each side: give a larger camera.long_side "
            f"(now {long_side}), a smaller camera.edge (now {edge}) or larger pictures",
        )
    return resized, (w, h)
