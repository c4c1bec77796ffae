"""Ctrl-C and SIGTERM: what was tracked is written, in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from droidw.io.tum import read_tum

SLOW = """
import time
import droidw
from droidw_plugins.datasets.synthetic import COMPONENT, SyntheticReader

class Slow(SyntheticReader):
    def __init__(self, options, flag):
        super().__init__(options)
        self.flag = flag
    def open(self, source, selection):
        opened = super().open(source, selection)
        pictures = opened.frames
        def frames():
            for frame in pictures():
                if {wait_first} or frame.index >= 20:
                    time.sleep(0.1)
                yield frame
        opened.frames = frames
        return opened

class Flag:
    def __init__(self, folder):
        self.folder = folder
    def on_event(self, event):
        if getattr(event, "done", 0) >= 12:
            (self.folder / "tracked").touch()

@droidw.hookimpl
def droidw_dataset_readers():
    yield droidw.Component("slow", "takes its time", lambda o, c: Slow(o, c.run_dir),
                           options=COMPONENT.options)

@droidw.hookimpl
def droidw_observers():
    yield droidw.Component("flag", "says when 12 frames are tracked", lambda o, c: Flag(c.run_dir))
"""


@pytest.mark.parametrize(
    ("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["ctrl-c", "sigterm"]
)
def test_a_signal_keeps_what_was_tracked(tmp_path, quick, signum, code):
    plugin, out = tmp_path / "slow.py", tmp_path / "out"
    plugin.write_text(SLOW.format(wait_first=False))
    process = subprocess.Popen(
        [sys.executable, "-m", "droidw", "run", "synthetic", "-o", str(out), *quick,
         "--plugin", str(plugin), "reader=slow", "reader.options.frames=600",
         "reader.options.width=160", "reader.options.height=120", "observers.flag={}",
         "observers.report={}"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    try:
        while not (out / "tracked").exists() and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(signum)
        _, wrong = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == code, wrong
    assert "Traceback" not in wrong
    assert "stopped by a signal after frame" in wrong and "poses were written" in wrong
    trajectory = read_tum(out / "trajectory.tum")
    assert 12 <= len(trajectory) < 600
    assert np.isfinite(trajectory.T_wc).all()
    assert np.allclose(np.diff(trajectory.times), 1 / 30, atol=1e-4)
    facts = json.loads((out / "manifest.json").read_text())
    assert facts["frames"] == len(trajectory)
    assert (out / "report.html").is_file() and (out / "points.ply").is_file()


def test_a_signal_before_the_first_frame(tmp_path, go, footage, monkeypatch):
    """In this process: the signal comes while parts are built."""
    from droidw.run import drive

    built = drive._Run._build

    def build(self):
        os.kill(os.getpid(), signal.SIGTERM)
        return built(self)

    monkeypatch.setattr(drive._Run, "_build", build)
    ran = go(footage(count=4).folder)
    assert ran.code == 143
    assert "Traceback" not in ran.err
    assert "before the first frame" in ran.err
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
