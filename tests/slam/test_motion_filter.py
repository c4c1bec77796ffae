"""The motion filter ahead of the window: what it waits for, and what it does not."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest
import torch

from droidw.config.schema import MotionFilterConfig
from droidw.interfaces.correspondence import Motion
from droidw.io.prefetch import prefetch
from droidw.slam.frame import Frame
from droidw.slam.motion_filter import Encoded, MotionFilter, spans

COUNT = 60
MOVED = {k for k in range(COUNT) if k % 7 in (3, 4)}


class Table:
    """Correspondence that moves at some frames."""

    def motion(self, reference, current):
        return Motion(9.0 if current in MOVED else 0.0, 1.0)


def judged(judge, stride=1):
    """Judges every frame there is of a source of which every `stride`-th is read."""
    blank = torch.zeros(0)
    for k in range(COUNT):
        encoded = Encoded(Frame(stride * k, stride * k / 30, blank, blank), k)
        yield k, judge.judge(encoded)


def verdicts(ahead, drops, stride=1):
    """(frame, forced) of all candidates; the window drops those in `drops` that it may."""
    judge = MotionFilter(Table(), MotionFilterConfig(force_every=5), ahead)
    found = []
    for k, verdict in prefetch(judged(judge, stride), 32 if ahead else 0, judge.close):
        if verdict.keep:
            found.append((k, verdict.forced))
            judge.settled(stride * k, verdict.forced or k not in drops)
    return found


def threads_ahead():
    return [
        thread.name for thread in threading.enumerate() if thread.name.startswith("droidw-prefetch")
    ]


@pytest.mark.parametrize("drops", [set(), MOVED, {3, 10, 17, 31}])
def test_what_runs_ahead_says_the_same(drops):
    expected = verdicts(False, drops)
    assert any(forced for _, forced in expected) and not all(forced for _, forced in expected)
    for _ in range(5):
        assert verdicts(True, drops) == expected


@pytest.mark.parametrize("ahead", [False, True])
def test_frames_are_counted_that_are_tracked(ahead):
    """Not those between them that `--stride` leaves out."""
    drops = {3, 10, 17, 31}
    assert verdicts(ahead, drops, stride=4) == verdicts(ahead, drops)


def test_it_goes_on_until_the_window_matters():
    """A candidate of frame 3 that may be dropped matters from frame 5 on, and not before."""
    judge = MotionFilter(Table(), MotionFilterConfig(force_every=5), ahead=True)

    items = judged(judge)
    assert [next(items)[0] for _ in range(5)] == [0, 1, 2, 3, 4]
    done = threading.Event()
    thread = threading.Thread(target=lambda: (next(items), done.set()))
    thread.start()
    assert not done.wait(0.2), "frame 5 was judged without knowing of frame 4"
    judge.settled(3, kept=False)
    judge.settled(4, kept=True)
    thread.join()
    assert done.is_set()


def test_stopping_early_leaves_nobody_waiting():
    judge = MotionFilter(Table(), MotionFilterConfig(force_every=5), ahead=True)
    ahead = prefetch(judged(judge), 32, judge.close)
    assert [next(ahead)[0] for _ in range(4)] == [0, 1, 2, 3]
    assert threads_ahead()
    ahead.close()  # hangs if the thread waits for what the window says of frame 3
    assert not threads_ahead()


class Counting(Table):
    """Correspondence that is asked from which payload it measures."""

    def __init__(self):
        self.asked = []

    def aside(self, payload, cells):
        return (payload, cells)

    def motion(self, reference, current):
        self.asked.append(reference)
        return Motion(9.0 if current == 2 else 0.0, 1.0)


def test_what_is_set_aside_of_a_keyframe_holds_until_the_next():
    table, blank = Counting(), torch.zeros(0)
    judge = MotionFilter(table, MotionFilterConfig())
    frames = [Encoded(Frame(k, k / 30, blank, blank), k) for k in range(4)]
    assert judge.judge(frames[0]).keep
    cells = torch.zeros(2, 2, dtype=torch.bool)
    judge.set_aside(frames[0], cells)
    assert [judge.judge(frame).keep for frame in frames[1:]] == [False, True, False]
    assert table.asked == [(0, cells), (0, cells), 2]


class Moving(Counting):
    """Every picture moves by so much."""

    def __init__(self, flow):
        super().__init__()
        self.flow = flow

    def motion(self, reference, current):
        return Motion(self.flow, 1.0)


@pytest.mark.parametrize(
    ("aside", "near"), [(0, 1.0), (2, 1.0), (3, 0.9625), (4, 0.9), (6, 0.7), (10, 0.5), (20, 0.5)]
)
def test_a_few_cells_bring_no_keyframe_nearer(aside, near):
    """Of twenty: up to a tenth, which a classifier may see where nothing moves."""
    movable = (torch.arange(20).view(1, 4, 5) < aside) * 0.2
    options = MotionFilterConfig(movable_nearer=1.0)
    whole = torch.ones(1, 4, 5)
    assert spans(movable, whole, options) == pytest.approx([near])
    halved, none = replace(options, movable_nearer=0.5), replace(options, movable_nearer=0.0)
    assert spans(movable, whole, halved) == pytest.approx([(1 + near) / 2])
    assert spans(movable, whole, none) == [1.0]
    for above in (0.0, 0.2):  # a mask counts all the same
        some = replace(options, movable_above=above)
        assert spans(movable, whole, some) == [1.0]
        assert spans(movable, 1.0 - 5.0 * movable, some) == pytest.approx([near])
    rest = torch.flip(whole - 5.0 * movable, (1, 2))
    if aside >= 6:  # as many others are masked
        assert spans(movable, rest, options) == pytest.approx([max(2 * near - 1, 0.5)])


@pytest.mark.parametrize(
    ("aside", "nearer", "limit"),
    [(0, 1.0, 1.25), (1, 1.0, 1.015625), (1, 0.5, 1.1328125), (1, 0.0, 1.25), (3, 1.0, 0.625)],
)
@pytest.mark.parametrize("how", ["set aside", "masked", "both"])
def test_keyframes_come_nearer_where_something_is_hidden(aside, nearer, limit, how):
    """By the share of four cells, in full from 0.3, half at most, until the next one is taken."""
    cells, blank = torch.arange(4).view(2, 2) < aside, torch.zeros(0)
    frames = [Encoded(Frame(k, k / 30, blank, blank), k) for k in range(4)]
    gone = {
        "set aside": (cells,),
        "masked": (None, cells),
        "both": (torch.zeros_like(cells), cells),
    }[how]
    for flow, keeps in ((limit - 0.01, False), (limit + 0.01, True)):
        judge = MotionFilter(Moving(flow), MotionFilterConfig(movable_nearer=nearer))
        judge.judge(frames[0])
        judge.set_aside(frames[0], *gone)
        assert judge.judge(frames[1]).keep == keeps

    moving = Moving(1.3)
    judge = MotionFilter(moving, MotionFilterConfig(movable_nearer=nearer))
    judge.judge(frames[0])
    judge.set_aside(frames[0], *gone)
    assert judge.judge(frames[1]).keep
    moving.flow = 1.2
    assert not judge.judge(frames[2]).keep


class Flows:
    """Correspondence that says what it is asked to."""

    def motion(self, reference, current):
        return current


@pytest.mark.parametrize(
    ("flow", "matched", "above", "kept", "expected"),
    [
        (0.5, 1.0, 0.25, True, True),
        (0.3, 1.0, 0.25, True, False),  # the picture hardly moved since
        (0.3, 1.0, 0.0, True, True),
        (0.5, 0.01, 0.25, True, False),  # nothing of it is known again
        (0.3, 1.0, 0.25, False, True),  # since a keyframe that was dropped; it had moved itself
        (1.2, 1.0, 1.0, True, False),  # as any other
        (0.3, 1.0, 1.0, False, False),
    ],
)
def test_whether_the_last_frame_becomes_a_keyframe(flow, matched, above, kept, expected):
    judge = MotionFilter(Flows(), MotionFilterConfig(last_above=above))
    blank = torch.zeros(0)
    pictures = [None, Motion(2.0, 1.0), Motion(flow, matched)]
    first, second, last = (
        judge.judge(Encoded(Frame(k, k / 30, blank, blank), picture))
        for k, picture in enumerate(pictures)
    )
    assert first.keep and second.keep and not last.keep
    assert judge.ends(last, 1 if kept else 0) is expected
    assert not judge.ends(first, 0)
