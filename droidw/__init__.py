"""droidw: camera poses, depth and dynamic uncertainty from a monocular video.

Importing this package is cheap: torch, OpenCV and the parts themselves are loaded when they are
used. What a plugin author needs is here: `hookimpl`, `Component`, `NoOptions`, `BuildContext`,
`WeightsFile`; what a caller from Python needs as well: `load_plugins`, `register`.
"""

from __future__ import annotations

from droidw.log import quiet_library
from droidw.plugin.component import BuildContext, Component, NoOptions
from droidw.plugin.hookspecs import hookimpl, hookspec
from droidw.plugin.manager import Plugins, load_plugins, register
from droidw.plugin.weights import WeightsFile

__version__ = "0.1.0"

__all__ = [
    "BuildContext",
    "Component",
    "NoOptions",
    "Plugins",
    "WeightsFile",
    "__version__",
    "hookimpl",
    "hookspec",
    "load_plugins",
    "register",
]

quiet_library()
