"""What is imported when: help and listings must not wait for torch."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("torch", "cv2", "numpy", "kornia", "av", "omegaconf", "open3d")

PROBE = """
import sys
{code}
loaded = [name for name in {heavy!r} if name in sys.modules]
sys.stderr.write("HEAVY:" + ",".join(loaded))
"""


def _loaded_by(code):
    done = subprocess.run(
        [sys.executable, "-c", PROBE.format(code=code, heavy=HEAVY)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [name for name in done.stderr.rpartition("HEAVY:")[2].split(",") if name]


def test_import_of_droidw_is_light():
    assert _loaded_by("import droidw") == []


@pytest.mark.parametrize(
    "arguments", [["-h"], ["--version"], ["run", "-h"], ["list-plugins", "-h"]]
)
def test_help_is_light(arguments):
    code = (
        "from droidw.cli.main import main\n"
        "try:\n"
        f"    code = main({arguments!r})\n"
        "except SystemExit as end:\n"
        "    code = end.code\n"
        "assert not code, code"
    )
    assert _loaded_by(code) == []


def test_loading_plugins_is_light():
    """numpy is allowed here: records are made of its types, and it is quick to load."""
    loaded = _loaded_by("from droidw import load_plugins; load_plugins()")
    assert [name for name in loaded if name != "numpy"] == []
