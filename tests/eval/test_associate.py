"""Matching by time stamp, and what is said when it cannot be."""

import numpy as np
import pytest

from droidw.errors import InputError, UsageError
from droidw.eval.associate import associate, uncrossed


def greedy(est: np.ndarray, ref: np.ndarray, max_diff: float) -> list[tuple[int, int]]:
    """All pairs in order of their difference, each stamp once: the slow way."""
    pairs = sorted(
        (abs(a - b), i, j)
        for i, a in enumerate(est)
        for j, b in enumerate(ref)
        if abs(a - b) <= max_diff
    )
    used_i, used_j, out = set(), set(), []
    for _, i, j in pairs:
        if i not in used_i and j not in used_j:
            used_i.add(i)
            used_j.add(j)
            out.append((i, j))
    return sorted(out, key=lambda pair: est[pair[0]])


@pytest.mark.parametrize("seed", range(8))
def test_same_pairs_as_taking_the_closest_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    est, ref = rng.uniform(0, 2, 60), rng.uniform(0, 2, 90)
    found = associate(est, ref, 0.02)
    assert list(zip(found.est.tolist(), found.ref.tolist(), strict=True)) == greedy(est, ref, 0.02)


def test_of_two_pairs_that_cross_the_closer_stays() -> None:
    times = np.array([0.0, 0.2, 0.1, 0.3, 0.35, 0.34])
    gaps = np.array([0.0, 0.1, -0.02, 0.0, 0.03, -0.01])
    assert uncrossed(times, gaps).tolist() == [True, False, True, True, False, True]
    assert uncrossed(np.array([0.0, 1.0, 1.0, 2.0]), gaps[:4]).all()


def test_each_stamp_is_used_once_and_the_closest_wins() -> None:
    found = associate(np.array([0.0, 0.009, 1.0]), np.array([0.01, 1.5]), 0.02)
    assert found.est.tolist() == [1]
    assert found.ref.tolist() == [0]
    assert found.diff == pytest.approx([-0.001])


def test_repeated_stamps_end_and_pair_up() -> None:
    found = associate(np.zeros(5), np.zeros(3), 0.0)
    assert len(found) == 3
    assert len(set(found.est.tolist())) == len(set(found.ref.tolist())) == 3


def test_offset_is_added_to_the_estimate() -> None:
    stamps = np.arange(10.0)
    assert len(associate(stamps, stamps + 100, 0.02, offset=100.0)) == 10


def test_report_says_how_many() -> None:
    text = str(associate(np.arange(4.0), np.arange(4.0) + 0.005, 0.02))
    assert text.startswith("4 of 4 stamps matched with 4 of the reference")
    assert "5.0 ms (allowed 20 ms)" in text


def test_frame_indices_are_recognised() -> None:
    ref = np.linspace(1311868163, 1311868250, 2401)
    with pytest.raises(InputError) as caught:
        associate(np.arange(812.0), ref)
    assert (
        "ref 2,401 stamps 1311868163-1311868250 s, est 812 stamps 0-811 s: "
        "these look like frame indices" in caught.value.message
    )
    assert "rgb.txt" in caught.value.hint


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nano"), (1e6, "micro"), (1e3, "milli")])
def test_other_units_are_recognised(factor: float, unit: str) -> None:
    seconds = np.linspace(1311868163.0, 1311868250.0, 100)
    with pytest.raises(InputError, match=f"the estimate looks like {unit}seconds"):
        associate(seconds * factor, seconds)
    with pytest.raises(InputError, match=f"the reference looks like {unit}seconds"):
        associate(seconds, seconds * factor)


@pytest.mark.parametrize("factor", [1e9, 1e6, 1e3])
def test_a_clock_of_another_unit_may_start_anywhere_and_last_less_long(factor: float) -> None:
    seconds = np.linspace(1311868163.0, 1311868250.0, 2400)
    part = np.round((seconds[200:900:4] - seconds[200]) * factor)
    unit = {1e9: "nano", 1e6: "micro", 1e3: "milli"}[factor]
    with pytest.raises(InputError, match=f"the estimate looks like {unit}seconds"):
        associate(part, seconds)
    with pytest.raises(InputError, match=f"the reference looks like {unit}seconds"):
        associate(seconds, part)


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nano"), (1e6, "micro")])
def test_a_short_part_does_not_hide_the_unit(factor: float, unit: str) -> None:
    seconds = np.arange(1000) / 30
    with pytest.raises(InputError, match=f"the reference looks like {unit}seconds"):
        associate(seconds[:80], np.round(seconds * factor), minimum=3)


def test_frame_indices_of_more_frames_than_were_tracked() -> None:
    """Three of 80 frames are a whole second into the clip: that is no match of clocks."""
    with pytest.raises(InputError, match=r"by chance alone: .* frame indices"):
        associate(np.arange(80) / 30, np.arange(1000.0), minimum=3)


def test_a_short_clip_beside_truth_once_a_second() -> None:
    """Few pairs, but truth does not last a hundred times as long."""
    assert len(associate(np.arange(150) / 30, np.arange(61.0), minimum=3).est) == 5


@pytest.mark.parametrize("est", [[0.0, 0.1], [0.1, 0.1, 0.1, 0.1]])
def test_too_few_poses_are_no_matter_of_clocks(est: list[float]) -> None:
    with pytest.raises(InputError, match="the estimate has fewer") as caught:
        associate(np.array(est), np.arange(30) / 10, minimum=3)
    assert "--t-max-diff" not in caught.value.hint


@pytest.mark.parametrize(
    ("est", "ref"),
    [
        (np.arange(600.0), 1.3e9 + np.arange(2000) / 100),  # TUM: truth at 100 Hz
        (np.arange(600.0), 1.4e9 + np.arange(6000) / 200),  # EuRoC: at 200 Hz
        (np.arange(0.0, 99.0, 7), 1.3e9 + np.arange(800) / 30),  # keyframes of a part
    ],
)
def test_frame_indices_are_no_clock_of_another_unit(est, ref) -> None:
    with pytest.raises(InputError, match="frame indices"):
        associate(est, ref)
    with pytest.raises(InputError, match="frame indices"):
        associate(ref, est)


def test_keyframes_beside_a_fast_truth_are_of_another_clock_and_no_other_unit() -> None:
    with pytest.raises(InputError, match="s apart") as caught:
        associate(np.arange(0.0, 30.0, 0.3), 1.4e9 + np.arange(6000) / 200)
    assert "--t-offset 1400000000" in caught.value.hint


@pytest.mark.parametrize(("last", "rate"), [(300, 100), (300, 200), (100, 30), (96, 10)])
def test_indices_of_an_estimate_are_none_where_they_would_last_too_long(last, rate) -> None:
    """Whatever the rate of a truth of ten seconds, and how many frames were tracked."""
    with pytest.raises(InputError, match="frame indices"):
        associate(np.arange(float(last)), np.arange(10 * rate) / rate)


@pytest.mark.parametrize("step", [1, 7])
def test_frame_indices_are_no_seconds_where_some_of_them_are_as_large(step: int) -> None:
    """Frames 0, 1, ... 9 are as many seconds into 300 frames of ten seconds."""
    seconds, indices = np.arange(300) / 30, np.arange(0.0, 300.0, step)
    for est, ref, word in ((indices, seconds, "estimate"), (seconds, indices, "reference")):
        with pytest.raises(InputError, match=r"by chance alone: .* frame indices") as caught:
            associate(est, ref)
        assert f"write the {word} with the seconds" in caught.value.hint


def test_a_clock_that_ticks_once_a_second_is_one() -> None:
    """Truth once a second beside frames of as many seconds, or of the first of them."""
    for seconds in (300, 20):
        found = associate(np.arange(30 * seconds) / 30, np.arange(300.0))
        assert len(found) == seconds


def test_another_time_and_a_coarse_clock_are_told_apart() -> None:
    with pytest.raises(InputError, match=r"they lie 41 s apart") as caught:
        associate(np.linspace(50.5, 60.25, 30), np.linspace(0.25, 9.5, 30))
    assert "--t-offset -50.25" in caught.value.hint
    with pytest.raises(InputError, match=r"the nearest two are 0\.25 s apart") as caught:
        associate(np.arange(10) * 0.6, np.arange(10) * 0.6 + 0.25)
    assert "--t-max-diff" in caught.value.hint


def test_nonsense_is_refused() -> None:
    with pytest.raises(UsageError, match="from 0"):
        associate(np.arange(3.0), np.arange(3.0), -1.0)
    with pytest.raises(UsageError, match="finite"):
        associate(np.arange(3.0), np.arange(3.0), 0.1, offset=float("nan"))
    with pytest.raises(InputError, match="not a finite number"):
        associate(np.array([0.0, np.nan]), np.arange(3.0))
    with pytest.raises(InputError, match="est no stamps"):
        associate(np.zeros(0), np.arange(3.0))
