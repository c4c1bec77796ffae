"""`droidw doctor`: one report on this machine, made to be pasted into an issue."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from droidw.config.schema import DroidwConfig, SlotConfig
from droidw.errors import DroidwError
from droidw.io.dataset_tables import data_root
from droidw.plugin.cache import user_cache
from droidw.plugin.manager import Plugins, load_plugins
from droidw.plugin.registry import KINDS, SLOTS

__all__ = ["HELP", "Diagnosis", "add_arguments", "diagnose", "main"]

HELP = "report versions, hardware, plugins and weights, and say what is missing"

_REQUIRED = {
    "torch": "torch",
    "numpy": "numpy",
    "opencv": "cv2",
    "kornia": "kornia",
    "av": "av",
    "omegaconf": "omegaconf",
    "pluggy": "pluggy",
}
"""What droidw cannot do without: label and import name."""

_EXTRAS = ("open3d-cpu", "open3d", "rerun-sdk", "ray", "evo")
_READY = "ready"
_EXIT_MISSING = 5


@dataclass
class Diagnosis:
    """What was found.

    Attributes:
        facts: section -> name -> value, in the order of printing; values are plain text.
        plugins: kind -> name -> status, "ready" or why not.
        failures: plugins that did not load, each as one line.
        problems: why preset `cpu` cannot run here; empty if it can.
        notes: what may surprise, but stops nothing.
    """

    facts: dict[str, dict[str, str]] = field(default_factory=dict)
    plugins: dict[str, dict[str, str]] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0 when the default preset can run, 5 otherwise."""
        return _EXIT_MISSING if self.problems else 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw doctor`."""
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def main(args: argparse.Namespace) -> int:
    """Print the report; 0 when the default preset can run, 5 otherwise."""
    diagnosis = diagnose(load_plugins())
    print(_as_json(diagnosis) if args.json else _as_text(diagnosis))
    return diagnosis.exit_code


def diagnose(plugins: Plugins) -> Diagnosis:
    """Look at the machine, the installation and the plugins; changes nothing."""
    found = Diagnosis()
    modules = _software(found)
    _machine(found, modules.get("torch"))
    _folders(found, plugins)
    _plugin_status(found, plugins)
    _default_preset(found, plugins)
    _lietorch(found)
    return found


def _software(found: Diagnosis) -> dict[str, Any]:
    """Import what is required; a package that is there but does not import is a problem."""
    facts = {"droidw": _version("droidw") or "running from a source tree, not installed"}
    facts["python"] = f"{platform.python_version()} ({sys.executable})"
    modules: dict[str, Any] = {}
    for label, name in _REQUIRED.items():
        try:
            module = importlib.import_module(name)
        except (ImportError, OSError) as error:  # OSError: a shared library of it is broken
            facts[label] = f"does not import: {error}"
            found.problems.append(
                f"the Python package {label} does not import ({error}); "
                "install it: pip install droidw"
            )
            continue
        modules[label] = module
        facts[label] = str(getattr(module, "__version__", "installed"))
    facts.update({name: version for name in _EXTRAS if (version := _version(name))})
    found.facts["software"] = facts
    return modules


def _machine(found: Diagnosis, torch: Any) -> None:
    facts = {"system": platform.platform(), "cpu": f"{_cores()} cores usable, {_processor()}"}
    memory = _memory_bytes()
    facts["memory"] = f"{memory / 2**30:.1f} GiB" if memory else "unknown"
    facts["gpu"] = _gpu(torch)
    facts["nvcc"] = _first_line_of("nvcc", "--version", containing="release") or "not found"
    compiler = os.environ.get("CXX", "").split()
    names = [compiler[0]] if compiler else ["c++", "g++", "clang++"]
    facts["compiler"] = next(
        (line for name in names if (line := _first_line_of(name, "--version"))), "not found"
    )
    found.facts["machine"] = facts


def _folders(found: Diagnosis, plugins: Plugins) -> None:
    weights = plugins.weights_dir
    files = sorted(p.name for p in weights.iterdir() if p.is_file()) if weights.is_dir() else []
    data = data_root()
    cache = Path(os.environ.get("DROIDW_CACHE") or user_cache(os.environ)).expanduser()
    known = ", ".join(files) or "empty" if weights.is_dir() else "not there"
    found.facts["folders"] = {
        "weights": f"{weights} ({known})",
        "data": f"{data} ({'there' if data.is_dir() else 'not there'})",
        "cache": f"{cache} ({'writable' if _writable(cache) else 'not writable'})",
        "here": f"{Path.cwd()} ({'writable' if _writable(Path.cwd()) else 'not writable'})",
    }
    for folder, what, variable in (
        (cache, "compiled kernels", "DROIDW_CACHE"),
        (weights.parent, "weights", "DROIDW_WEIGHTS"),
    ):
        if not _writable(folder):
            found.notes.append(
                f"{folder} cannot be written: {what} cannot be kept there; "
                f"name another folder: export {variable}=FOLDER"
            )


def _plugin_status(found: Diagnosis, plugins: Plugins) -> None:
    for kind in KINDS:
        registry = plugins.registry(kind)
        found.plugins[kind] = {name: registry.status(name) for name in registry.names()}
    found.failures = [f"{f.name} ({f.origin}): {f.error}" for f in plugins.failures]


def _default_preset(found: Diagnosis, plugins: Plugins) -> None:
    """Ask for every part that a run with the default configuration would ask for."""
    config = DroidwConfig()
    wanted = []
    for kind in SLOTS:
        slot = getattr(config, kind)
        if isinstance(slot, SlotConfig) and slot.name != "auto":
            wanted.append((kind, slot.name))
    wanted += [("exporter", name) for name in config.exporters]
    wanted += [("observer", name) for name in config.observers]
    for kind, name in wanted:
        try:
            plugins.registry(kind).require(name)
        except DroidwError as error:
            found.problems.append(f"{kind}: {error.message}")


def _lietorch(found: Diagnosis) -> None:
    """Name the unrelated project that owns the name `lietorch` on PyPI."""
    try:
        text = str(metadata.metadata("lietorch")).lower()
    except metadata.PackageNotFoundError:
        return
    if any(sign in text for sign in ("bsmets", "bellaard", "pde-g-cnn", "equivariant")):
        found.notes.append(
            "the installed 'lietorch' is the one from PyPI, another project (PDE-G-CNN), not the "
            "Lie groups that SLAM code means; droidw uses neither, but other code here may fail"
        )


def _as_json(found: Diagnosis) -> str:
    return json.dumps(
        {
            **found.facts,
            "plugins": found.plugins,
            "failures": found.failures,
            "notes": found.notes,
            "problems": found.problems,
            "can_run": not found.problems,
        },
        indent=2,
    )


def _as_text(found: Diagnosis) -> str:
    lines: list[str] = []
    for section, facts in found.facts.items():
        lines.append(section)
        lines += [f"  {name:<10} {value}" for name, value in facts.items()]
    lines.append("plugins")
    for kind, parts in found.plugins.items():
        ready = [name for name, status in parts.items() if status == _READY]
        lines.append(f"  {kind:<14} {', '.join(ready) or 'none is ready'}")
        lines += [f"    {n}: {status}" for n, status in parts.items() if status != _READY]
    for title, items in (("failed to load", found.failures), ("notes", found.notes)):
        if items:
            lines += [title, *(f"  {item}" for item in items)]
    lines.append("")
    if found.problems:
        lines.append("The default preset cannot run here:")
        lines += [f"  {problem}" for problem in found.problems]
    else:
        lines.append("The default preset can run here.")
    return "\n".join(lines)


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory_bytes() -> int:
    """Physical memory, or less where a container is limited; 0 if the system does not say."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 0
    limit = Path("/sys/fs/cgroup/memory.max")
    text = limit.read_text().strip() if limit.is_file() else ""
    return min(total, int(text)) if text.isdigit() else total


def _gpu(torch: Any) -> str:
    if torch is None:
        return "unknown: torch does not import"
    if not torch.cuda.is_available():
        built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built for CPU"
        driver = "a driver is installed" if shutil.which("nvidia-smi") else "no driver found"
        return f"none visible to torch ({built}; {driver})"
    found = []
    for i in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(i)
        found.append(
            f"cuda:{i} {device.name}, {device.total_memory / 2**30:.0f} GiB, "
            f"sm_{device.major}{device.minor}"
        )
    return "; ".join(found) + f" (torch built for CUDA {torch.version.cuda})"


def _first_line_of(program: str, argument: str, containing: str = "") -> str:
    """The first line that a program prints (with a given word in it), or "" if it is not there."""
    path = shutil.which(program)
    if path is None:
        return ""
    try:
        done = subprocess.run(
            [path, argument], capture_output=True, text=True, timeout=20, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{path} does not answer: {error}"
    lines = [line.strip() for line in done.stdout.splitlines() if containing in line]
    return f"{lines[0]} ({path})" if lines else ""


def _writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or the folder itself can be made."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)
