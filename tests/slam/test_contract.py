"""What bundle adjustment and correspondence answer, held to their protocols."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.errors import PluginError
from droidw.geometry.projective import reproject
from droidw.interfaces.correspondence import EdgeRequest, EdgeUpdate
from droidw.slam.contract import step_of, update_of
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
