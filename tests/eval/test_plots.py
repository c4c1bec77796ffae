"""Charts: well-formed, and what they show is where it belongs."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from droidw.eval.metrics import Delta, score
from droidw.eval.plots import write_plots
from droidw.eval.summary import Evaluation
from droidw.eval.svg import Bars, Line, bar_chart, colour, line_chart, path_panels
from droidw.slam.frame import Trajectory

SVG = "{http://www.w3.org/2000/svg}"


def drawn(text: str) -> list[tuple[str, np.ndarray]]:
    """Stroke colour and points of every polyline with more than an axis's commands."""
    found = []
    for path in ElementTree.fromstring(text).iter(f"{SVG}path"):
        numbers = re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)", path.attrib["d"])
        if len(numbers) > 1:
            found.append((path.attrib["stroke"], np.array(numbers, dtype=float)))
    return found


def test_a_line_is_where_its_numbers_are() -> None:
    x = np.array([0.0, 1.0, 2.0, 3.0])
    text = line_chart(
        "a < b", [Line("y", x, np.array([0.0, 1.0, np.nan, 3.0]), "#123456")], "x", ""
    )
    ((stroke, points),) = drawn(text)
    assert stroke == "#123456" and len(points) == 3
    # Evenly along x, where the third has no value; upwards is less in y.
    assert points[2, 0] - points[0, 0] == pytest.approx(3 * (points[1, 0] - points[0, 0]), abs=0.3)
    assert points[0, 1] - points[2, 1] == pytest.approx(3 * (points[0, 1] - points[1, 1]), abs=0.3)
    assert "a &lt; b" in text


def test_paths_keep_their_shape() -> None:
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [2, 1, 3.0]])
    text = path_panels("t", [("p", points, "#123456", False)], "m")
    xy, xz, yz = (p for _, p in drawn(text))
    one = np.linalg.norm(xy[1] - xy[0]) / 2
    for panel, axes in ((xy, (0, 1)), (xz, (0, 2)), (yz, (1, 2))):
        steps = np.diff(panel, axis=0) / one * [1, -1]
        np.testing.assert_allclose(steps, np.diff(points[:, axes], axis=0), atol=0.02)


def test_bars() -> None:
    bars = [Bars("a", [1.0, None], [0.2, None], [[0.9, 1.1], []]), Bars("b", [2.0, 4.0])]
    root = ElementTree.fromstring(bar_chart("t", ["one", "two"], bars, "error"))
    rects = [r for r in root.iter(f"{SVG}rect") if r.find(f"{SVG}title") is not None]
    heights = [float(r.attrib["height"]) for r in rects]
    np.testing.assert_allclose(np.array(heights) / heights[0], [1, 2, 4], atol=0.02)
    assert [r.find(f"{SVG}title").text for r in rects] == ["a: 1 ± 0.2", "b: 2", "b: 4"]
    assert len(list(root.iter(f"{SVG}circle"))) == 2


def test_bars_of_what_is_lost_leave_the_others_to_be_seen() -> None:
    bars = [Bars("a", [0.5, 0.4]), Bars("b", [50.0, 0.6])]
    root = ElementTree.fromstring(bar_chart("t", ["one", "two"], bars, "error"))
    heights = [float(r.attrib["height"]) for r in root.iter(f"{SVG}rect") if len(r)]
    decade = (heights[1] - heights[0]) / 2  # from 0.5 to 50
    assert heights[0] > 10
    assert heights[3] - heights[2] == pytest.approx(decade * np.log10(0.6 / 0.4), abs=0.2)
    numbers = {text.text for text in root.iter(f"{SVG}text")}
    assert {"0.2", "0.5", "1", "10", "50"} <= numbers


def test_lines_of_what_is_lost_leave_the_others_to_be_seen() -> None:
    x = np.arange(3.0)
    lines = [Line("a", x, np.array([0.0, 1.0, 2.0]), "#111111"), Line("b", x, 100 * x, "#222222")]
    (_, a), (_, b) = drawn(line_chart("t", lines, "x", "y"))
    assert a[1, 1] - b[1, 1] == pytest.approx(a[2, 1] - b[2, 1], abs=0.2)  # both a hundred times
    assert a[0, 1] == b[0, 1] == a[:, 1].max()  # none at all stands at the lower end


@pytest.mark.parametrize("values", [[0.0, 0.0], [np.nan, np.nan], [5.0, 5.0], []])
def test_nothing_to_show_is_shown(values: list[float]) -> None:
    y = np.array(values)
    ElementTree.fromstring(line_chart("t", [Line("y", y, y)], "x", "y"))
    ElementTree.fromstring(bar_chart("t", ["g"], [Bars("a", [None])], "y"))
    ElementTree.fromstring(path_panels("t", [("p", np.zeros((1, 3)), "#111111", False)], "m"))


def evaluation(count: int = 50) -> Evaluation:
    s = np.linspace(0, 5, count)
    T_wc = np.zeros((count, 7))
    T_wc[:, 0], T_wc[:, 2], T_wc[:, 6] = np.cos(s), s, 1.0
    truth = Trajectory(100 + s, T_wc)
    T_wc = T_wc.copy()
    T_wc[:, 1] += 0.01 * np.sin(40 * s)
    est = Trajectory(100 + s, T_wc)
    keys = Trajectory(est.times[::5], est.T_wc[::5])
    return Evaluation(score(est, truth), score(keys, truth))


def test_files_are_drawn_from_the_evaluation(tmp_path: Path) -> None:
    found = evaluation()
    written = write_plots(found, tmp_path)
    assert [p.name for p in written] == ["trajectory.svg", "ate.svg", "rpe.svg"]
    text = (tmp_path / "ate.svg").read_text()
    assert f"rmse {found.frames.ate.rmse:.4g} m" in text
    lines = drawn(text)
    errors = found.frames.errors
    height = lines[0][1][:, 1]
    # The chart and the figures agree on where the largest error is.
    assert int(np.argmin(height)) == int(np.argmax(errors))
    root = ElementTree.fromstring(text)
    assert len(list(root.iter(f"{SVG}circle"))) == len(found.keyframes.errors)
    before = [p.read_bytes() for p in written]
    assert [p.read_bytes() for p in write_plots(found, tmp_path)] == before


def test_without_pairs_there_is_no_rpe_to_draw(tmp_path: Path) -> None:
    found = evaluation().frames

    def still(centres: np.ndarray) -> Trajectory:
        turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(centres), 1))
        return Trajectory(found.times, np.concatenate([centres, turns], axis=1))

    far = score(still(found.aligned), still(found.truth), delta=Delta(900.0, "seconds"))
    names = [path.name for path in write_plots(Evaluation(far), tmp_path)]
    assert names == ["trajectory.svg", "ate.svg"]


def test_no_two_of_many_rows_have_one_colour() -> None:
    found = [colour(number) for number in range(24)]
    assert len(set(found)) == 24
    assert all(re.fullmatch("#[0-9a-f]{6}", one) for one in found)
