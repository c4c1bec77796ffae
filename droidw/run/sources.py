"""Opening the source that a configuration names."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING

from droidw.errors import InputError, did_you_mean
from droidw.interfaces.datasets import Selection
from droidw.io.dataset_tables import split_source, table_names

if TYPE_CHECKING:
    from droidw.config.resolve import ResolvedConfig
    from droidw.interfaces.datasets import DatasetReader, FrameSource
    from droidw.plugin.component import BuildContext
    from droidw.plugin.manager import Plugins

__all__ = ["could_not_be_used", "open_source"]

# As `droidw.io.notes` says it: rows of a truth are skipped, too.
_LEFT_OUT = re.compile(r", skipped$|^\d+ more (pictures|bad lines) .*skipped$")
_log = logging.getLogger("droidw.run.drive")


def open_source(
    resolved: ResolvedConfig, plugins: Plugins, context: BuildContext, *, whole: bool = False
) -> FrameSource:
    """The footage of a run, by the reader that is named, or by the first that recognises it.

    Args:
        whole: whatever `input.max_frames` says, to its end.
    Raises:
        InputError: no source is given, nothing recognises it, or it cannot be used.
    """
    given = resolved.config.input
    if not given.source:
        raise InputError("no source is given", "type: droidw run SOURCE")
    selection = Selection(given.stride, given.skip, 0 if whole else given.max_frames)
    if "reader" in resolved.parts:
        component, options = resolved.parts["reader"]
        chosen: DatasetReader = component.factory(options, context)
        return chosen.open(given.source, selection)
    registry, left_out = plugins.registry("reader"), []
    for name in registry.names():
        status = registry.status(name)
        if status != "ready":
            left_out += [f"'{name}' ({status})"] if "clash" in status else []
            continue
        entry = registry.entry(name)
        try:
            reader: DatasetReader = entry.component.factory(entry.component.options(), context)
            known = bool(reader.recognises(given.source))
        except Exception as error:  # noqa: BLE001 - nobody chose it
            why = f"{entry.origin}: {type(error).__name__}: {error}"
            left_out.append(f"'{name}' ({why})")
            _log.warning("reader '%s' was left out: %s", name, why)
            continue
        if known:
            _log.info(f"reader: {name}")
            return reader.open(given.source, selection)
    raise _unknown(given.source, registry.names(), left_out)


def _unknown(source: str, readers: list[str], left_out: list[str]) -> InputError:
    """What to say of a source that nobody recognises."""
    choose = f"readers: {', '.join(readers)}   (choose one with reader=NAME)"
    if left_out:
        choose += f"\nleft out: {', '.join(left_out)}"
    parted = split_source(source)
    if parted is not None:
        names = sorted({*table_names(), *readers})
        return InputError(
            f"{source}: no dataset is called '{parted[0]}'",
            did_you_mean(parted[0], names, after=f":{parted[1]}")
            + f"datasets: {', '.join(table_names())}   (sequences: droidw data list)\n{choose}",
        )
    found = (
        "no reader recognises it" if Path(source).exists() else "there is no such file or folder"
    )
    return InputError(
        f"{source}: {found}",
        f"a source is a folder of pictures, a video file, or reader:sequence\n{choose}",
    )


def could_not_be_used(source: FrameSource) -> list[str]:
    """Sentences about pictures of the source that were left out, and what else is to be known."""
    if not source.skipped:
        return source.problems[:5]
    left_out = [text for text in source.problems if _LEFT_OUT.search(text)]
    others = [text for text in source.problems if text not in left_out][:5]
    what = "picture" if source.skipped == 1 else "pictures"
    why = f": {'; '.join(left_out[:3])}" if left_out else ""
    return [f"{source.skipped} {what} could not be used{why}", *others]
