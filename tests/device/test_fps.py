"""benchmarks/fps.py runs through and says what it measured."""

from __future__ import annotations


def test_a_tiny_run(monkeypatch, capsys, load_benchmark):
    monkeypatch.setenv("DROIDW_WEIGHTS", "")  # put back afterwards
    record = load_benchmark("fps").main(
        ["--preset", "droid-slam", "--size", "96x64", "--frames", "9", "--every", "3",
         "--repeats", "1", "threads=1", "ba=torch"]
    )  # fmt: skip
    assert (record["frames"], record["keyframes"], record["ba"]) == (9, 3, "torch")
    assert record["fps"] > 0 and record["stages"]["frontend"] > 0
    assert f"**{record['fps']:.2f} frames per second**" in capsys.readouterr().out
