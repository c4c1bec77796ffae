"""The report page: whole, self-contained, and right in the corner cases."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from droidw.events import Event, RunFinished, RunWarning
from droidw.interfaces.observers import Observer
from droidw.plugin.component import BuildContext
from droidw.slam.frame import CloudPoints, RunResult, Trajectory
from droidw_plugins.observers._cloud_view import splat
from droidw_plugins.observers._pictures import choose, keyframe_pictures
from droidw_plugins.observers._report_page import Report, build_page
from droidw_plugins.observers._svg import Line, nice_step, path_view
from droidw_plugins.observers._truth import make_paths
from droidw_plugins.observers.report import COMPONENT, ReportOptions

Make = Callable[..., RunResult]
VOID = {"meta", "img", "br", "path", "circle", "rect", "polyline", "polygon"}


class Page(HTMLParser):
    """Checks nesting, and gathers what a browser would load."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.links: list[str] = []
        self.images: list[str] = []
        self.count: dict[str, int] = {}
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        for name, value in attrs:
            if name in ("src", "href"):
                (self.images if tag == "img" else self.links).append(value or "")
            assert not name.startswith("on"), f"a handler in <{tag}>"
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        self.text += data


def checked(text: str) -> Page:
    """A page that parses, loads nothing, runs nothing and holds no number that is none."""
    page = Page(text)
    bare = re.sub(r"base64,[A-Za-z0-9+/=]*", "", text)
    assert not re.search(r"(https?:)?//[a-z]", bare, re.IGNORECASE), "an address outside"
    assert "url(" not in text and "@import" not in text
    assert "script" not in page.count and "link" not in page.count
    assert all(link.startswith("./") for link in page.links)
    assert all(image.startswith("data:image/") for image in page.images)
    for shape in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        assert "nan" not in shape and "inf" not in shape
    return page


@pytest.fixture(scope="module")
def full(make_result: Make, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return make_result(tmp_path_factory.mktemp("run"), frames=90, keyframes=10)


def test_the_whole_page(full: RunResult, tmp_path: Path) -> None:
    (tmp_path / "trajectory.tum").write_text("x" * 1500)
    (tmp_path / "depth").mkdir()
    observer = COMPONENT.factory(
        ReportOptions(keyframes=6), BuildContext(torch.device("cpu"), run_dir=tmp_path)
    )
    assert isinstance(observer, Observer)
    observer.on_event(RunWarning("the focal length is a guess"))
    metrics = {
        "ate_rmse": 0.0123,
        "unit": "m",
        "align": "sim3",
        "ate_percent": 0.047,
        "rpe_trans_rmse": None,
        "notes": [],
        "masks": {"auc": 0.943},
    }
    observer.on_event(RunFinished(full, tmp_path, metrics))
    page = checked((tmp_path / "report.html").read_text(encoding="utf-8"))
    for said in (
        "kitchen", "23.4", "0.0123", "0.943", "812", "Warnings (1)", "the focal length is a guess",
        "from camera.txt", "track", "8.40 s", "long_side: 320", "2.13.0", "1.5 kB",
        "6 of 10, evenly chosen", "EfficientNet", "no GPU was found", "13.40 s in all",
        "0.05 % of the path",
    ):  # fmt: skip
        assert said in page.text, said
    assert page.count["figure"] == 2 + 1 + 2 + 6
    assert len(page.images) == 2 + 2 * 6
    assert not list(tmp_path.glob("*.tmp"))
    for image in page.images:
        data = np.frombuffer(base64.b64decode(image.partition(",")[2]), np.uint8)
        assert cv2.imdecode(data, cv2.IMREAD_UNCHANGED) is not None


def test_other_events_write_nothing(tmp_path: Path) -> None:
    Report().on_event(Event())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("frames", "keyframes"), [(0, 0), (1, 0), (1, 1), (2, 1), (3, 2)])
@pytest.mark.parametrize("with_truth", [True, False])
def test_short_runs(
    make_result: Make, tmp_path: Path, frames: int, keyframes: int, with_truth: bool
) -> None:
    result = make_result(
        tmp_path, frames=frames, keyframes=keyframes, with_truth=with_truth, manifest={}
    )
    page = checked(build_page(result, tmp_path))
    assert f"{frames} with a pose" in page.text
    assert len(page.images) == 2 * keyframes + (2 if keyframes else 0)


def test_without_truth_the_scale_is_arbitrary(make_result: Make, tmp_path: Path) -> None:
    result = make_result(tmp_path, frames=30, keyframes=3, with_truth=False, manifest={})
    page = checked(build_page(result, tmp_path))
    assert "scale arbitrary" in page.text and "% of depth)" in page.text
    assert "ATE" not in page.text


def test_a_metric_depth_prior_gives_metres(make_result: Make, tmp_path: Path) -> None:
    manifest = {"scale": "metric, from the depth prior"}
    result = make_result(tmp_path, frames=30, keyframes=3, with_truth=False, manifest=manifest)
    page = checked(build_page(result, tmp_path))
    assert "arbitrary" not in page.text and "that of the depth prior" in page.text


def test_a_still_camera_looks_still(make_result: Make, tmp_path: Path) -> None:
    result = make_result(tmp_path, frames=40, keyframes=3, with_truth=False, still=True)
    text = build_page(result, tmp_path)
    checked(text)
    path = re.search(r'<polyline class="est" points="([^"]*)"', text)
    assert path is not None
    points = np.array([[float(v) for v in p.split(",")] for p in path[1].split()])
    assert np.ptp(points, axis=0).max() < 12


def test_text_is_escaped(make_result: Make, tmp_path: Path) -> None:
    evil = '<script>alert("x")</script>&'
    (tmp_path / 'a"b<i>.txt').write_text("x")
    manifest = {
        "camera": evil, "versions": {evil: evil}, "config_yaml": evil, "stages": {evil: 1.0},
        "files": {'a"b<i>.txt': evil}, "preset": evil,
    }  # fmt: skip
    result = make_result(
        tmp_path, frames=5, keyframes=1, manifest=manifest, warnings=(evil,), source=evil
    )
    page = checked(build_page(result, tmp_path, {"align": evil, "ate_rmse": 1.0, evil: evil}))
    assert page.text.count(evil) >= 9
    assert "i" not in page.links


def test_the_page_says_how_much_agrees_and_that_it_was_tracked_twice(
    make_result: Make, tmp_path: Path
) -> None:
    said = []
    for facts in ({"agreement": 0.664, "sweeps": 2}, {"agreement": 0.874, "sweeps": 1}, {}):
        result = make_result(tmp_path, frames=5, keyframes=1, manifest=facts)
        said.append(checked(build_page(result, tmp_path, {})).text)
    assert "66%" in said[0].replace(" ", "") and "tracked twice" in said[0]
    assert "87%" in said[1].replace(" ", "") and "tracked twice" not in said[1]
    assert "of matches agree" not in said[2]


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.0, ""), (0.691, "69% of it backwards"), (1.0, "backwards in the end"), ("all", "")],
)
def test_the_page_says_how_much_was_tracked_backwards(
    make_result: Make, tmp_path: Path, share: object, words: str
) -> None:
    facts = {"agreement": 0.7, "backwards": share}
    result = make_result(tmp_path, frames=5, keyframes=1, manifest=facts)
    text = checked(build_page(result, tmp_path, {})).text
    assert words in text
    assert ("backwards" in text) == bool(words)


def test_a_strange_manifest_is_left_out(make_result: Make, tmp_path: Path) -> None:
    manifest = {
        "stages": {"track": float("nan"), "fill": "long", "global": -1}, "fps": float("inf"),
        "versions": [1, 2], "parts": {"ba": "torch"}, "files": "none",
        "config_yaml": None, "peak_memory_mb": True,
        "agreement": "most", "sweeps": 3,
    }  # fmt: skip
    result = make_result(tmp_path, frames=5, keyframes=1, manifest=manifest)
    text = checked(build_page(result, tmp_path, {"ate_rmse": None})).text
    assert "Time" not in text and "peak memory" not in text and "frames/s" not in text


def test_values_that_are_not_finite(full: RunResult, tmp_path: Path) -> None:
    first = full.keyframes[0]
    bad = replace(
        first,
        T_wc=np.full(7, np.nan),
        disp=np.full_like(first.disp, np.nan),
        uncertainty=np.full_like(first.uncertainty, np.inf),
        weight=np.full_like(first.weight, np.nan),
    )
    poses = full.trajectory.T_wc.copy()
    poses[3] = np.nan
    xyz = full.cloud.xyz.copy()
    xyz[::2] = np.nan
    result = replace(
        full,
        keyframes=(bad,),
        trajectory=Trajectory(full.trajectory.times, poses),
        cloud=CloudPoints(xyz, full.cloud.rgb),
    )
    assert "89 with a pose" in checked(build_page(result, tmp_path)).text


def test_truth_is_laid_on_the_estimate(full: RunResult) -> None:
    paths = make_paths(full)
    assert paths.truth is not None and len(paths.truth) == len(paths.centres)
    assert paths.unit == "m"
    assert paths.scale == pytest.approx(0.7, rel=0.03)
    assert np.allclose(paths.centres[0], 0)
    distance = np.linalg.norm(paths.truth - paths.centres, axis=1)
    assert distance == pytest.approx(paths.errors)
    assert paths.errors.max() < 0.04


def test_a_truth_that_does_not_fit_is_told(full: RunResult, tmp_path: Path) -> None:
    assert full.truth is not None
    later = replace(full, truth=Trajectory(full.truth.times + 1e4, full.truth.T_wc))
    assert "time stamps do not match" in checked(build_page(later, tmp_path)).text


def test_overlay_marks_what_lost_its_weight(full: RunResult) -> None:
    shown = keyframe_pictures(full.keyframes, full.stride, full.offset, 1)[0]
    data = np.frombuffer(base64.b64decode(shown.overlay.partition(",")[2]), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(float)
    record = full.keyframes[shown.number]
    box = np.argwhere(record.weight < 0.1)
    y, x = (box.mean(axis=0) * full.stride + full.offset).round().astype(int)
    assert np.abs(image[y, x] - record.image[y, x]).max() > 60
    assert np.abs(image[5:80, 5:315] - record.image[5:80, 5:315]).mean() < 40
    assert shown.moving == pytest.approx(float(np.mean(record.weight < 0.5)))


def test_choice_is_even() -> None:
    assert choose(5, 24) == [0, 1, 2, 3, 4]
    assert choose(0, 24) == []
    assert choose(100, 4) == [0, 33, 66, 99]
    assert choose(9, 1) == [4]
    assert choose(9, 0) == []


def test_a_scale_bar_fits_its_figure():
    """A path ten times as long as high is drawn larger from one side than from above."""
    points = np.stack([np.linspace(0, 0.02, 40), np.linspace(0, 0.6, 40)], axis=1)
    for shown in (points, points * 0.01, points[:, ::-1], points[:, :1].repeat(2, 1)):
        drawn = path_view("a", ("x", "y"), [Line(shown, "est")], shown[:0], lambda u: f"{u:g} m")
        bar = re.search(r'class="bar" d="M([\d.]+) [\d.]+v8M[\d.]+ [\d.]+h([\d.]+)m', drawn)
        assert 40 < float(bar[2]) <= 468 / 3 + 0.01
        assert re.search(r">[125]e?[-0-9.]* m<|>0\.0*[125] m<", drawn)


def test_steps_are_round() -> None:
    assert nice_step(10.0, 3) == 2.0
    assert nice_step(0.037, 3) == pytest.approx(0.01)
    assert nice_step(7e6, 1) == pytest.approx(5e6)
    assert nice_step(0.0, 3) == nice_step(float("nan"), 3) == 1.0


def test_nearer_points_hide_others() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, (4000, 2)), np.full(4000, 2.0)])
    far = wall * [2, 2, 2]
    points = np.concatenate([wall, far, [[0, 0, -1.0]]])
    rgb = np.repeat(np.array([[255, 0, 0], [0, 0, 255], [0, 255, 0]], np.uint8), [4000, 4000, 1], 0)
    picture = splat(points, rgb, (80, 60), (60.0, 40.0, 30.0))
    middle = picture[20:40, 20:60]
    assert (middle[..., 3] == 255).mean() > 0.97
    assert (middle[..., 2] > 0).mean() > 0.9, "red lies in front of blue"
    assert not splat(points[-1:], rgb[-1:], (80, 60), (60.0, 40.0, 30.0)).any()


def test_depth_pictures_bear_outliers(full: RunResult) -> None:
    """One cell in a hundred that is far off changes no colour of the others."""
    ramp = np.linspace(0.2, 1.0, 1200, dtype=np.float32).reshape(30, 40)
    off = ramp.copy()
    off[::10, ::10] = 500.0
    off[5, 20] = np.inf

    def shown(disp: np.ndarray, valid: bool) -> np.ndarray:
        record = replace(
            full.keyframes[0], disp=disp, disp_full=None, depth_valid=np.full((30, 40), valid)
        )
        uri = keyframe_pictures([record] * 2, full.stride, full.offset, 2)[1].depth
        data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=float)

    difference = np.abs(shown(ramp, True) - shown(off, True)).max(-1)
    assert np.median(difference) < 12
    grey = shown(ramp, False).mean(-1)
    assert grey[-20:].mean() > grey[110:130].mean() + 20 > grey[:20].mean() + 40
