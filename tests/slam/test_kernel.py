"""What wrong matches cost bundle adjustment, with a kernel that gives them up, and its width."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import PhaseConfig, SolverConfig, WeightingConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import exp, inv, log, mul, rotation
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import neighbour_edges
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam.locate import locate
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.timing import Stopwatch
from droidw.solve.kernel import redescended
from droidw.solve.manhattan import rotation_term
from droidw.solve.problem import BAProblem
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT = 12, 16, 6
PHASE = PhaseConfig(updates=1, iterations=20, learn=False, weigh=False, depth_prior=False)


def robust(cauchy: float) -> SolverConfig:
    return SolverConfig(lm=1e-6, ep=1e-6, huber=0.2, cauchy=cauchy)


@pytest.fixture
def spoilt(arc, waves, stored):
    """True poses, and an optimiser some way off them, where half of each far edge is wrong.

    Wrong all alike, as by one tile of a wall, so that no sum over directions helps.
    """
    grid, intrinsics = Grid(H, W, 8, 3.5), torch.tensor([110.0, 110.0, 63.5, 47.5])
    T_cw, disps = arc(COUNT), waves(COUNT, H, W)
    off = exp(0.01 * torch.randn(COUNT, 6, generator=torch.Generator().manual_seed(1)))
    off[:2] = exp(torch.zeros(2, 6))  # both are held, and with them the scale
    store = stored(grid, intrinsics, mul(off, T_cw), disps)
    graph = FactorGraph(H, W, store.device)
    graph.add(neighbour_edges(COUNT, 3))
    ii, jj = graph.index(graph.select())
    graph.target[:], valid = reproject(T_cw, disps, grid.intrinsics(intrinsics), ii, jj)
    graph.confidence[:] = valid[..., None].float()
    far = torch.tensor(graph.ii) - torch.tensor(graph.jj)
    graph.target[far.abs() == 3, :, : W // 2] += torch.tensor([2.0, 1.0])
    parts = Parts(None, None, None, TorchBundleAdjuster(), None)
    return Optimiser(store, parts, WeightingConfig(), Stopwatch()), graph, T_cw


def apart(found: torch.Tensor, true: torch.Tensor) -> float:
    """Largest difference of poses, tangent norm."""
    return float(log(mul(found, inv(true))).norm(dim=-1).max())


def test_matches_that_are_wrong_alike_pull_a_huber_kernel_and_not_a_cauchy_kernel(spoilt):
    optimiser, graph, T_cw = spoilt
    store = optimiser.store
    start = store.T_cw.clone(), store.disps.clone()
    left = []
    for cauchy in (0.0, 0.2):
        store.write(*start)
        optimiser.adjust(graph, graph.select(), PHASE, robust(cauchy), first_free=2)
        left.append(apart(store.T_cw, T_cw))
    assert left[1] < 0.2 * left[0]
    assert torch.isfinite(store.disps).all()


@pytest.fixture
def located(spoilt):
    """`located(targets, solver)`: frames near the last keyframe, each by [h,w,2] in it.

    Each is measured from the keyframe three before that, `row` of the graph.
    """
    optimiser, graph, T_cw = spoilt
    last = COUNT - 1
    row = graph.pairs.index((last - 3, last))
    optimiser.store.write(T_cw, optimiser.store.disps)

    def call(targets, solver, known=None):
        count = len(targets)
        answer = EdgeUpdate(torch.stack(targets), graph.confidence[[row] * count])
        session = SimpleNamespace(update=lambda request: answer)
        operator = SimpleNamespace(session=lambda purpose: session)
        optimiser.parts = Parts(None, None, None, TorchBundleAdjuster(), operator)
        return locate(
            optimiser,
            [None] * count,
            mul(exp(torch.full((count, 6), 0.01)), T_cw[[last] * count]),
            [[last - 3]] * count,
            torch.ones(COUNT, H, W),
            updates=1,
            iterations=20,
            solver=solver,
            label="test",
            known=known,
        )

    call.target = graph.target[row]
    return call


def test_a_frame_is_located_in_spite_of_them(spoilt, located):
    _, _, T_cw = spoilt
    left = [apart(located([located.target], robust(c)), T_cw[-1:]) for c in (0.0, 0.2)]
    assert left[1] < 0.2 * left[0]


def test_a_frame_does_not_share_the_width_of_its_kernel_with_others(located):
    noise = torch.randn(H, W, 2, generator=torch.Generator().manual_seed(3))
    exact, rough = located.target + 0.01 * noise, located.target + 0.5 * noise
    solver = SolverConfig(lm=1e-6, ep=1e-6, cauchy=0.75, cauchy_tuning=0.5)
    together = located([exact, rough], solver)
    alone = torch.cat([located([one], solver) for one in (exact, rough)])
    assert torch.allclose(together, alone, atol=1e-5)


def test_what_is_known_of_a_frame_besides_counts(spoilt, located):
    _, _, T_cw = spoilt
    turned = mul(exp(torch.tensor([[0.0, 0, 0, 0.03, -0.02, 0.01]])), T_cw[-1:])
    usual = []

    def known(poses, square):
        usual.append(square)
        weight = 1e6 * torch.eye(3, dtype=torch.float64)[None]
        still = torch.eye(3, dtype=torch.float64)
        return rotation_term(poses, rotation(turned.double()), weight, still, 1.0)

    free = located([located.target], robust(0.2))
    held = located([located.target], robust(0.2), known)
    assert apart(rotated(held), rotated(turned)) < 1e-3
    assert apart(rotated(free), rotated(turned)) > 0.02
    # The rest of a pose is still what matches say, given that turn.
    assert apart(held, turned) > 0
    assert all(square > 0 for square in usual)


def rotated(T_cw):
    return torch.cat([torch.zeros_like(T_cw[:, :3]), T_cw[:, 3:]], dim=1)


@pytest.fixture
def problem(arc, waves) -> BAProblem:
    """Four frames on an arc, every match right but for a tenth that follows something else."""
    T_cw, disps = arc(4), waves(4, 9, 12)
    intrinsics = torch.tensor([14.0, 14.0, 5.5, 4.0])
    ii, jj = torch.tensor([0, 0, 1, 2]), torch.tensor([1, 2, 3, 3])
    target, valid = reproject(T_cw, disps, intrinsics, ii, jj)
    target += 0.01 * torch.randn(target.shape, generator=torch.Generator().manual_seed(0))
    target[:, :1] += 0.5
    return BAProblem(
        T_cw=T_cw,
        disps=disps,
        intrinsics=intrinsics,
        ii=ii,
        jj=jj,
        target=target,
        weight=valid[..., None].expand(*valid.shape, 2).float(),
        fixed=torch.tensor([True, True, False, False]),
        damping=torch.zeros_like(disps),
        pairs=list(zip(ii.tolist(), jj.tolist(), strict=True)),
    )


def kept(problem: BAProblem, solver: SolverConfig, **groups) -> tuple[float, float]:
    """Shares of their weight that wrong and right matches keep."""
    weight = redescended(problem, solver, **groups).weight / problem.weight.clamp_min(1e-9)
    known = problem.weight > 0
    return float(weight[:, :1][known[:, :1]].mean()), float(weight[:, 1:][known[:, 1:]].mean())


def test_a_kernel_that_follows_is_as_narrow_as_matches_are_exact(problem) -> None:
    wrong, right = kept(problem, SolverConfig(cauchy=0.75))
    assert wrong > 0.4 and right > 0.99
    wrong, right = kept(problem, SolverConfig(cauchy=0.75, cauchy_tuning=5.0))
    assert wrong < 0.02 and right > 0.9


def test_it_is_never_wider_than_the_other_and_as_wide_where_poses_are_far_off(problem) -> None:
    fixed, follows = SolverConfig(cauchy=0.05), SolverConfig(cauchy=0.05, cauchy_tuning=50.0)
    assert torch.allclose(redescended(problem, fixed).weight, redescended(problem, follows).weight)
    problem.T_cw[2:, :3] += 0.5
    fixed, follows = SolverConfig(cauchy=0.75), SolverConfig(cauchy=0.75, cauchy_tuning=5.0)
    assert torch.allclose(redescended(problem, fixed).weight, redescended(problem, follows).weight)


def test_matches_without_any_error_keep_their_weight(problem) -> None:
    problem.target[:] = reproject(
        problem.T_cw, problem.disps, problem.intrinsics, problem.ii, problem.jj
    )[0]
    solver = SolverConfig(cauchy=0.15, cauchy_tuning=0.5)
    assert torch.allclose(redescended(problem, solver).weight, problem.weight)


def test_edges_can_have_a_width_each(problem) -> None:
    problem.target[3, 1:] += 0.3 * torch.sign(problem.target[3, 1:] - problem.target[3, 1:].mean())
    solver = SolverConfig(cauchy=0.75, cauchy_tuning=2.0)
    one = redescended(problem, solver).weight[3, 1:].mean()
    each = redescended(problem, solver, group=problem.jj, groups=4).weight[3, 1:].mean()
    assert each > 2 * one


def test_no_kernel_leaves_the_problem_as_it_is(problem) -> None:
    assert redescended(problem, SolverConfig(cauchy=0.0, cauchy_tuning=5.0)) is problem
