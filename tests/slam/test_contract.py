"""What parts answer and readers deliver, held to their protocols."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.errors import PluginError
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.interfaces.correspondence import EdgeRequest, EdgeUpdate
from droidw.slam.contract import features_of, frame_of, movable_of, step_of, update_of
from droidw.slam.frame import RawFrame
from droidw.slam.stepping import stepped
from droidw.solve.problem import BAProblem, Report, Step
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT, E = 8, 12, 6, 3
FINE = Report("ok", 1.0)


@pytest.fixture
def problem(arc, waves):
    """Three frames that are to be located from three others, the last by a single cell."""
    T_cw, disps = arc(COUNT), waves(COUNT, H, W)
    pairs = [(i, j) for i in range(3) for j in range(3, COUNT)]
    ii, jj = torch.tensor(pairs).T.contiguous()
    intrinsics = torch.tensor([10.0, 10.0, 5.5, 3.5])
    target, _ = reproject(T_cw, disps, intrinsics, ii, jj)
    weight = torch.ones_like(target)
    weight[jj == COUNT - 1] = 0.0
    weight[(jj == COUNT - 1) & (ii == 0), 4, 5] = 1.0
    start = T_cw.clone()
    start[3:, :3] += 0.02
    return BAProblem(
        T_cw=start, disps=disps, intrinsics=intrinsics, ii=ii, jj=jj, target=target, weight=weight,
        fixed=torch.arange(COUNT) < 3, damping=torch.zeros_like(disps), motion_only=True,
        lm=1e-6, ep=1e-4,
    )  # fmt: skip


def test_one_frame_that_cannot_be_solved_does_not_cost_the_others(problem):
    ba = TorchBundleAdjuster()
    assert ba.step(problem).report.status == "singular"
    step = stepped(ba, problem)
    assert step.report.status == "ok"
    before, after = problem.T_cw[3:5], step.T_cw[3:5]
    exact = problem.T_cw[3:5].clone()
    exact[:, :3] -= 0.02
    assert ((after - exact)[:, :3].norm(dim=1) < 0.1 * (before - exact)[:, :3].norm(dim=1)).all()


def test_a_step_that_is_singular_all_the_same_is_told_of(problem):
    asked = []

    def step(given):
        asked.append((given.lm, given.ep))
        return Step(given.T_cw.clone(), given.disps.clone(), Report("singular", 1.0))

    ba = SimpleNamespace(step=step)
    assert stepped(ba, problem).report.status == "singular"
    assert asked == [(1e-6, 1e-4), (1e-4, 0.1)]
    asked.clear()
    stepped(ba, replace(problem, lm=1e-3, ep=1.0))
    assert asked == [(1e-3, 1.0)]


@pytest.mark.parametrize("field", ["T_cw", "disps"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_step_that_is_not_finite_is_left_out(problem, field, value):
    given = Step(problem.T_cw + 1, problem.disps + 1, FINE)
    getattr(given, field).view(-1)[7] = value
    step = step_of(given, problem)
    assert step.report.status == "nonfinite" and step.report.cost_before == 1.0
    assert torch.equal(step.T_cw, problem.T_cw) and torch.equal(step.disps, problem.disps)
    assert step.T_cw.data_ptr() != problem.T_cw.data_ptr()


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (lambda p: None, "NoneType, no Step"),
        (
            lambda p: Step(p.T_cw[:2], p.disps, FINE),
            r"poses that are a tensor \[2, 7\], not \[6, 7",
        ),
        (lambda p: Step(p.T_cw, p.disps[0], FINE), r"disparities that are a tensor \[8, 12\], not"),
    ],
)
def test_steps_that_are_none(problem, found, said):
    with pytest.raises(PluginError, match="bundle adjustment backend breaks.*" + said):
        step_of(found(problem), problem)


def zeros(*shape, dtype=torch.float32):
    return torch.zeros(*shape, dtype=dtype)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (None, "NoneType, no EdgeUpdate"),
        (
            EdgeUpdate(zeros(H, W, 2), zeros(E, H, W, 2)),
            r"a target that is a tensor \[8, 12, 2\], not float32 \[3, 8, 12, 2\]",
        ),
        (
            EdgeUpdate(zeros(E, H, W, 2), zeros(E, H, W, 3, dtype=torch.float64)),
            r"a confidence that is a torch.float64 tensor \[3, 8, 12, 3\], not float32",
        ),
        (EdgeUpdate(zeros(E, H, W, 2), zeros(E, H, W)), r"not float32 \[3, 8, 12, '2 or 3'\]"),
    ],
)
def test_answers_of_correspondence_that_are_none(found, said):
    request = EdgeRequest(
        [0, 1, 2], [0, 1, 2], [1, 2, 3], zeros(E, H, W, 2), zeros(E, H, W).bool(), payload=int
    )
    with pytest.raises(PluginError, match="correspondence operator breaks.*" + said):
        update_of(found, request)
    sound = EdgeUpdate(zeros(E, H, W, 2), zeros(E, H, W, 2))
    assert update_of(sound, request) is sound


GRID = Grid(H, W, 8, 3.5)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_features_that_are_not_finite_are_those_of_the_extractor(value):
    found = zeros(4, H, W)
    assert features_of(found, 4, GRID) is found
    found[1, 2, 3] = value
    with pytest.raises(PluginError, match=r"feature extractor breaks.*not finite"):
        features_of(found, 4, GRID)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (None, "NoneType"),
        (np.zeros((H, W), np.float32), "ndarray"),
        (zeros(W, H), r"a tensor \[12, 8\], not a tensor \[8, 12\]"),
        (zeros(H, W, dtype=torch.int64), "a torch.int64 tensor"),
        (zeros(H, W) + 200, r"values outside \[0, 1\]"),
        (zeros(H, W) + float("nan"), r"values outside \[0, 1\]"),
    ],
)
def test_what_can_move_is_a_share_of_each_cell(found, said):
    with pytest.raises(PluginError, match="feature extractor breaks.*`movable` returned " + said):
        movable_of(found, GRID)
    assert movable_of(zeros(H, W, dtype=torch.float64), GRID).dtype == torch.float32


def raw(index, time, image=None):
    picture = np.zeros((H, W, 3), np.uint8) if image is None else image
    return RawFrame(index, time, picture, str(index))


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (None, "NoneType, no RawFrame"),
        (raw(1, 1.0, np.zeros((H, W, 3), np.float32)), r"ndarray \[8, 12, 3\] float32, not uint8"),
        (raw(1, 1.0, np.zeros((H, W), np.uint8)), r"ndarray \[8, 12\] uint8, not uint8 \[H,W,3\]"),
        (raw(1, float("nan")), "the time nan"),
        (raw(1, 0.5), "picture 1 at 0.5 s after picture 0 at 0.5 s"),
        (raw(0, 1.0), "picture 0 at 1 s after picture 0 at 0.5 s"),
    ],
)
def test_pictures_of_a_reader_that_are_none(found, said):
    with pytest.raises(PluginError, match="reader breaks its contract: `frames` gave .*" + said):
        frame_of(found, raw(0, 0.5))
    sound = raw(1, 0.6)
    assert frame_of(sound, raw(0, 0.5)) is sound and frame_of(sound) is sound
