"""What each pass of global adjustment does: its kernel narrows from one to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from droidw.config.schema import BackendConfig

__all__ = ["Kernel", "Pass", "all_passes", "last_passes"]

Kernel = Literal["wide", "usual", "narrow", "narrowest"]
# By how much less steady motion counts from pass to pass.
_FADES = 3.0
# Passes for a path of which little has changed since it was adjusted, and their kernels.
_LAST: tuple[Kernel, ...] = ("usual", "narrow", "narrowest")


@dataclass(frozen=True)
class Pass:
    """One pass: edges are chosen anew, then adjusted.

    Attributes:
        updates: update steps.
        kernel: `wide` draws back what has broken off; `usual` is that of `global_solver`, whatever
            the residuals; `narrow` follows the median residual, if `global_solver` says so;
            `narrowest` goes by what fits best, once the path has come to rest by all matches.
        steady: share of the motion prior that counts. Measurements have the last word.
        learns: uncertainty may learn anew: the path is mended.
        refines: the focal length is looked for afterwards, if at all.
    """

    updates: int
    kernel: Kernel
    steady: float = 0.0
    learns: bool = True
    refines: bool = False


def all_passes(options: BackendConfig, wide: bool) -> tuple[Pass, ...]:
    """The passes of `backend.passes`.

    Where a path has broken, matches across the break are all that can mend it, and they are the
    very ones that a narrow kernel gives up: the first of several may be wide. The last is narrow.

    Args:
        wide: there is a kernel to be wider than, and the path may have broken.
    """
    updates = options.passes
    first = int(wide and options.wide_start > 1 and len(updates) > 1)
    begin: tuple[Kernel, ...] = ("wide", "usual", "narrow")
    kernels = begin[1 - first :]
    last = len(updates) - 1
    made = []
    for number, count in enumerate(updates):
        kernel = kernels[number] if number < len(kernels) else "narrowest"
        if number == last and kernel == "usual":
            kernel = "narrow"
        made.append(
            Pass(
                count,
                kernel,
                steady=0.0 if number == last else _FADES**-number,
                learns=number > 0 or number == last,
                refines=number == first,
            )
        )
    return tuple(made)


def last_passes(options: BackendConfig, wide: bool) -> tuple[Pass, ...]:
    """Passes for a path of which little has changed since all passes were made.

    They end as all of them do, so that what agrees in the end can be held against it.

    Args:
        wide: as of `all_passes`.
    """
    made = all_passes(options, wide)
    kernels = _LAST[: _LAST.index(made[-1].kernel) + 1] if made else ()
    last = zip(reversed(options.passes), reversed(kernels), strict=False)
    return tuple(Pass(count, kernel) for count, kernel in last)[::-1]
