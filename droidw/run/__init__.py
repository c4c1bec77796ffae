"""One run: folder, device, parts, frames in, files out."""

from droidw.run.drive import run

__all__ = ["run"]
