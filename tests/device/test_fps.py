"""benchmarks/fps.py runs through and says what it measured."""

from __future__ import annotations

import importlib.util
from pathlib import Path

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "fps.py"


def test_a_tiny_run(monkeypatch, capsys):
    monkeypatch.setenv("DROIDW_WEIGHTS", "")  # put back afterwards
    spec = importlib.util.spec_from_file_location("fps", FILE)
    bench = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bench)
    record = bench.main(
        ["--preset", "droid-slam", "--size", "96x64", "--frames", "9", "--every", "3",
         "--repeats", "1", "threads=1", "ba=torch"]
    )  # fmt: skip
    assert (record["frames"], record["keyframes"], record["ba"]) == (9, 3, "torch")
    assert record["fps"] > 0 and record["stages"]["frontend"] > 0
    assert f"**{record['fps']:.2f} frames per second**" in capsys.readouterr().out
