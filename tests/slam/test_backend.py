"""Global bundle adjustment: how it begins, and what its graph holds."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import CameraConfig, DroidwConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import act, exp, inv, log, mul
from droidw.graph.factors import FactorGraph
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam import backend as module
from droidw.slam.backend import Backend
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.timing import Stopwatch
from droidw.solve.epipolar import PointMatches
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT, BROKEN = 8, 12, 9, 3
LIARS = 0.2  # share of the cells that agree with the break


@pytest.fixture
def broken(arc, waves, stored):
    """`broken(cauchy=, focal=, **backend)`: a backend whose first keyframes have broken off.

    And what tells its largest residual, cells. Measurements are exact, but that some of those
    across the break agree with it, as matches do that follow what moves.
    """
    grid, intrinsics = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])
    T_cw, disps = arc(COUNT), waves(COUNT, H, W)
    off = exp(torch.tensor([0.1, -0.05, 0.0, 0.05, 0.1, 0.05])).expand(BROKEN, -1)

    lies = torch.rand(H, W, generator=torch.Generator().manual_seed(0)) < LIARS
    start = torch.cat([mul(off, T_cw[:BROKEN]), T_cw[BROKEN:]])

    def measured(ii, jj, poses=T_cw):
        return reproject(poses, disps, grid.intrinsics(intrinsics), ii, jj)

    def answer(request):
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        target, valid = measured(ii, jj)
        wrong = ((ii < BROKEN) != (jj < BROKEN))[:, None, None] & lies
        target = torch.where(wrong[..., None], measured(ii, jj, start)[0], target)
        return EdgeUpdate(target, valid[..., None].float().expand_as(target).contiguous())

    def blind(request):
        # some noise, and nothing at all across the break
        found = answer(request)
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        noise = torch.randn(found.target.shape, generator=torch.Generator().manual_seed(1))
        seen = ((ii < BROKEN) == (jj < BROKEN))[:, None, None, None]
        return EdgeUpdate(found.target + 0.02 * noise, found.confidence * seen)

    def leaning(request):
        # some noise, and a third of the cells is off alike, by a few times as much
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        target, valid = measured(ii, jj)
        g = torch.Generator().manual_seed(2)
        noise = 0.01 * torch.randn(target.shape, generator=g)
        slipped = torch.rand(H, W, generator=g)[..., None] < 1 / 3
        alike = slipped * torch.tensor([0.0, -0.06]) * (jj - ii)[:, None, None, None]
        sure = valid[..., None].float().expand_as(target).contiguous()
        return EdgeUpdate(target + noise + alike, sure)

    def call(cauchy=0.75, focal=False, joined=True, leans=False, **backend):
        config = DroidwConfig(camera=CameraConfig(refine_focal=focal))
        config.global_solver.cauchy = cauchy
        config.backend = replace(config.backend, **backend)
        store = stored(grid, intrinsics.clone(), start, disps)
        operator = SimpleNamespace(
            session=lambda purpose: SimpleNamespace(
                update=leaning if leans else answer if joined else blind
            )
        )
        parts = Parts(None, None, None, TorchBundleAdjuster(), operator)
        optimiser = Optimiser(store, parts, config.weighting, Stopwatch())

        def residual():
            ii, jj = torch.arange(COUNT - 1), torch.arange(1, COUNT)
            target, valid = measured(ii, jj)
            coords, _ = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
            return float(((coords - target).norm(dim=-1) * valid).mean(dim=(1, 2)).max())

        return Backend(optimiser, config), residual

    return call


def run(backend):
    assert backend.run(lambda done, total: None) > 0


def test_a_wide_kernel_mends_what_a_narrow_one_leaves_broken(broken):
    left = []
    for wide in (1, 16):
        backend, residual = broken(wide_start=wide)
        before = residual()
        run(backend)
        left.append(residual())
    assert before > 1.5  # cells
    assert left[0] > 0.8 * before
    assert left[1] < 0.02 * before


@pytest.mark.parametrize(
    "options", [{"passes": [6]}, {"passes": [3, 3], "cauchy": 0.0}], ids=["one pass", "no kernel"]
)
def test_one_pass_and_no_kernel_are_as_they_were(broken, options):
    poses = []
    for wide in (1, 16):
        backend, _ = broken(wide_start=wide, **options)
        run(backend)
        poses.append(backend.optimiser.store.T_cw.clone())
    assert torch.equal(*poses)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, [(12, 0, 2), (0.75, 0, 2), (0.75, 5, 2), (0.75, 1, 0.5), (0.75, 1, 0.5)]),
        ({"last_tuning": 0.0}, [(12, 0, 2), (0.75, 0, 2), *[(0.75, 5, 2)] * 3]),
        ({"passes": [1, 1, 1]}, [(12, 0, 2), (0.75, 0, 2), (0.75, 5, 2)]),
        ({"passes": [1, 1, 1], "wide_start": 1.0}, [(0.75, 0, 2), (0.75, 5, 2), (0.75, 1, 0.5)]),
        ({"passes": [1, 1]}, [(12, 0, 2), (0.75, 5, 2)]),
        ({"passes": [1]}, [(0.75, 5, 2)]),
    ],
)
def test_the_kernel_narrows_from_pass_to_pass(broken, monkeypatch, options, expected):
    """Width, times the median residual, and what of a slip counts."""
    backend, _ = broken(**{"passes": [1] * 5, **options})
    heard = []
    monkeypatch.setattr(
        backend.optimiser,
        "update",
        lambda graph, session, phase, s, **more: heard.append(
            (s.cauchy, s.cauchy_tuning, s.cauchy_slip)
        ),
    )
    run(backend)
    assert heard == expected


@pytest.mark.parametrize(
    ("rows", "options", "expected"),
    [
        (1, {}, [0, 0, 0, 0.1, 0.1]),
        (1, {"last_planes": 0.0}, [0] * 5),
        (1, {"last_tuning": 0.0}, [0, 0, 0, 0.1, 0.1]),
        (1, {"planes_hidden": 0.2}, [0] * 5),
        (0, {}, [0] * 5),
        (0, {"planes_hidden": 0.0}, [0, 0, 0, 0.1, 0.1]),
    ],
)
def test_walls_are_held_to_be_flat_in_the_last_passes(broken, monkeypatch, rows, options, expected):
    """Before these, the path may be off by more than a plane is wide.

    And where so many rows of each picture, or none, are hidden by a mask.
    """
    backend, _ = broken(**{"passes": [1] * 5, "last_planes": 0.1, **options})
    store = backend.optimiser.store
    assert 0.05 < rows / store.grid.height < 0.2 or not rows
    store["unmasked"][: len(store), :rows] = 0.0
    heard = []
    monkeypatch.setattr(
        backend.optimiser,
        "update",
        lambda graph, session, phase, s, **more: heard.append(s.planes),
    )
    run(backend)
    assert heard == expected


@pytest.mark.parametrize(
    ("rows", "options", "more"),
    [
        (1, {}, [False, False, False, True, True]),
        (1, {"edges_hidden": 0.2}, [False] * 5),
        (0, {}, [False] * 5),
        (0, {"edges_hidden": 0.0}, [False, False, False, True, True]),
        (1, {"passes": [1, 1]}, [False] * 2),
    ],
)
def test_the_last_passes_have_more_edges_where_much_is_hidden(
    broken, monkeypatch, rows, options, more
):
    backend, _ = broken(**{"passes": [1] * 5, **options})
    store = backend.optimiser.store
    store["unmasked"][: len(store), :rows] = 0.0
    few, many = backend.edges(), backend.edges(more=True)
    assert set(few) < set(many)
    heard = []
    monkeypatch.setattr(
        backend.optimiser, "update", lambda graph, *rest, **more: heard.append(len(graph))
    )
    run(backend)
    assert heard == [len(many if wanted else few) for wanted in more]


def test_options_of_the_last_passes_leave_out_no_edge(broken):
    backend, _ = broken(nms=0, factors_per_keyframe=40, last_nms=3, last_factors=4)
    assert backend.edges(more=True) == backend.edges()


def test_the_last_passes_go_by_the_matches_that_fit_best(broken, arc):
    def turned_off(T_cw, right):
        found, true = (mul(T[1:], inv(T[:-1])) for T in (T_cw, right))
        return float(log(mul(found, inv(true)))[:, 3:].norm(dim=-1).mean())

    off = []
    for tuning in (0.0, 1.0):
        backend, _ = broken(leans=True, last_tuning=tuning)
        run(backend)
        off.append(turned_off(backend.optimiser.store.T_cw, arc(COUNT)))
    assert off[1] < 0.6 * off[0]


@pytest.mark.parametrize(
    ("passes", "expected"),
    [([2, 1, 1], [90.0, 90.0, 30.0, 0.0]), ([1, 1], [90.0, 0.0]), ([2], [0.0, 0.0])],
)
def test_steady_motion_counts_less_in_each_pass_and_nothing_in_the_last(
    broken, monkeypatch, passes, expected
):
    backend, _ = broken(passes=passes)
    backend.motion_prior = 90.0
    heard = []
    monkeypatch.setattr(
        backend.optimiser, "update", lambda *given, motion_prior, **more: heard.append(motion_prior)
    )
    run(backend)
    assert heard == expected


def test_steady_motion_joins_what_no_match_joins(broken):
    left = []
    for prior in (0.0, 100.0):
        backend, residual = broken(passes=[6, 6, 6, 1], joined=False)
        backend.motion_prior = prior
        before = residual()
        run(backend)
        left.append(residual() / before)
    assert left[0] > 0.8
    assert left[1] < 0.1


def points_of(T_cw):
    """Points of the world as all keyframes up to two apart see them, exactly."""
    g = torch.Generator().manual_seed(2)
    away = torch.rand(30, 3, generator=g, dtype=torch.float64) * 2 - 1 + torch.tensor([0.0, 0, 3])
    T = T_cw.double()
    X = act(inv(T[COUNT // 2]), away)
    near = [(i, j) for i in range(COUNT) for j in range(i + 1, min(i + 3, COUNT))]
    ends = torch.tensor(near).repeat_interleave(len(X), dim=0)
    rays = [act(T[k], X.repeat(len(near), 1)) for k in ends.T]
    here, there = (ray / ray[:, 2:] for ray in rays)
    return PointMatches(ends[:, 0], ends[:, 1], here, there, 82.0)


@pytest.mark.parametrize("prior", [0.0, 1e-3])
def test_points_turn_what_no_match_joins(broken, arc, prior):
    T_cw = arc(COUNT)
    k = BROKEN - 1

    def turned_off(store):
        motion, right = (mul(T[k + 1], inv(T[k])) for T in (store.T_cw, T_cw))
        return float(log(mul(motion, inv(right)))[3:].norm())

    left = []
    for points in (None, (points_of(T_cw), 5.0)):
        backend, _ = broken(passes=[6, 6], joined=False)
        backend.motion_prior, backend.optimiser.points = prior, points
        before = turned_off(backend.optimiser.store)
        run(backend)
        left.append(turned_off(backend.optimiser.store) / before)
    assert left[0] > 0.8
    assert left[1] < 0.1


@pytest.mark.parametrize(("first", "width"), [(0, 3), (2, None)])
def test_points_count_in_steps_that_all_keyframes_have_a_part_in(broken, arc, first, width):
    backend, _ = broken()
    optimiser, made, terms = backend.optimiser, TorchBundleAdjuster(), []
    optimiser.points = points_of(arc(COUNT)), 5.0
    optimiser.parts = replace(
        optimiser.parts,
        ba=SimpleNamespace(step=lambda p: (terms.append(p.pose_term), made.step(p))[1]),
    )
    graph = FactorGraph(H, W, optimiser.store.device)
    graph.add([(k + a, k + b) for k in range(first, COUNT - 1) for a, b in ((0, 1), (1, 0))])
    phase = replace(backend.config.schedule["global"], learn=False)
    session = optimiser.parts.correspondence.session("global")
    optimiser.update(graph, session, phase, backend.config.global_solver, first_free=first + 1)
    assert terms
    assert {None if t is None else t.band.shape[1] for t in terms} == {width}


@pytest.mark.parametrize(
    ("options", "updates"), [({}, 4), ({"wide_start": 1.0}, 2), ({"cauchy": 0.0}, 2)]
)
def test_the_focal_length_is_looked_for_after_the_first_pass_that_is_not_wide(
    broken, monkeypatch, options, updates
):
    backend, _ = broken(focal=True, passes=[2, 2, 2], **options)
    told = []
    monkeypatch.setattr(module, "MIN_KEYFRAMES", COUNT)
    monkeypatch.setattr(module, "refine_focal", lambda *given: told.append("focal"))
    backend.run(lambda done, total: told.append(done))
    assert told.index("focal") == updates


@pytest.mark.parametrize(
    ("learn", "in_all", "options", "expected"),
    [
        # not in the first pass, which mends the path
        (True, False, {}, [False, "anew", True, True, True]),
        (True, False, {"wide_start": 1.0}, [False, "anew", True, True, True]),
        (True, False, {"passes": [1]}, ["anew", True]),
        (True, True, {}, [True, "anew", True, True, True]),
        (False, False, {}, [False] * 4),
    ],
)
def test_uncertainty_learns_anew_when_the_path_is_mended(
    broken, monkeypatch, learn, in_all, options, expected
):
    backend, _ = broken(**{"passes": [1, 1, 1, 1], **options})
    backend.config.schedule["global"].learn = in_all
    backend.fresh, backend.config.backend.learn = True, learn
    heard = []
    monkeypatch.setattr(
        backend.optimiser,
        "update",
        lambda graph, session, phase, solver, **more: heard.append(phase.learn),
    )
    monkeypatch.setattr(backend.optimiser, "begin_anew", lambda: heard.append("anew"))
    run(backend)
    assert heard == expected


@pytest.mark.parametrize("begun", [True, False])
@pytest.mark.parametrize(
    ("parted", "moves", "opens"), [(True, 4.0, True), (True, 0.6, False), (False, 4.0, False)]
)
def test_the_gate_goes_by_how_uncertainty_parts_once_it_learned_anew(
    broken, monkeypatch, begun, parted, moves, opens
):
    """Where movers stand out, what is in doubt (column 0) stays open; it starts anew if it did."""
    backend, _ = broken()
    optimiser, told = backend.optimiser, []
    optimiser.begun, optimiser.weighting.parted = begun, parted
    monkeypatch.setattr(optimiser, "begin", lambda: told.append("begin"))
    u = torch.linspace(0.2, 0.79, W)
    u[0], u[1:4] = 1.0, moves
    optimiser.store["uncertainty"][:] = u
    assert optimiser.gates()[..., 0].unique() == pytest.approx(0.1)
    assert not optimiser.view().mended
    optimiser.begin_anew()
    assert optimiser.view().mended
    optimiser.doubtful = True
    assert not optimiser.view().mended
    assert told == (["begin"] if begun else [])
    gates = optimiser.gates()
    assert gates[..., 0].unique() == (pytest.approx(1.0) if opens else pytest.approx(0.1, abs=0.1))
    assert gates[..., 4:].unique() == pytest.approx(1.0)
    assert bool((gates[..., 1:4] < 0.1).all()) == (moves > 1)
    assert torch.equal(optimiser.beside(optimiser.store).gates(), gates)


def test_near_keyframes_keep_their_edges(broken):
    edges = {}
    for shape in ("square", "diamond"):
        backend, _ = broken(nms_shape=shape)
        edges[shape] = {(max(e), min(e)) for e in backend.edges()}
    three_apart = {(k + 3, k) for k in range(COUNT - 3)}
    assert three_apart <= edges["diamond"]
    assert len(three_apart & edges["square"]) < len(three_apart) / 2
    assert len(edges["diamond"]) < COUNT * (COUNT - 1) / 2  # far ones are still thinned


@pytest.mark.parametrize(("moves", "nearer", "more"), [(0, 1, False), (4, 1, True), (4, 0, False)])
def test_nearer_keyframes_have_more_edges(broken, moves, nearer, more):
    """Their number is limited by what they span: by twice as many where steps are half as long."""
    counts = []
    for movable in (0, moves):
        backend, _ = broken(factors_per_keyframe=4, threshold=1000.0)
        backend.config.motion_filter.movable_nearer = float(nearer)
        backend.optimiser.store["movable"][:, :movable] = 0.5  # of eight rows
        counts.append(len(backend.edges()))
    assert (counts[1] > counts[0]) is more
    assert 4 * COUNT <= counts[0] <= 4 * COUNT + 2
    assert counts[1] <= (8 if more else 4) * COUNT + 2


def test_cells_that_say_little_do_not_hold_on_to_the_scale_of_a_piece(arc, waves, stored):
    """Half of the path is a tenth too large; damped as in the window, depths would keep it so."""
    grid, intrinsics = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])
    T_cw, disps, half = arc(COUNT), waves(COUNT, H, W), COUNT // 2
    graph = FactorGraph(H, W, torch.device("cpu"))
    graph.add([(i, j) for i in range(COUNT) for j in range(COUNT) if 0 < abs(i - j) < 4])
    ii, jj = graph.index(graph.select())
    graph.target[:], valid = reproject(T_cw, disps, grid.intrinsics(intrinsics), ii, jj)
    graph.confidence[:] = 0.003 * valid[..., None].float()
    centres = inv(T_cw)
    centres[half:, :3] = centres[half, :3] + 1.1 * (centres[half:, :3] - centres[half, :3])
    larger = torch.where(torch.arange(COUNT)[:, None, None] > half, disps / 1.1, disps)

    def off(T):
        c = inv(T)[:, :3]
        return float((c[-1] - c[half]).norm() / (c[half] - c[0]).norm())

    left = []
    for depth_damping in (1.0, DroidwConfig().global_solver.depth_damping):
        store = stored(grid, intrinsics.clone(), inv(centres), larger)
        parts = Parts(None, None, None, TorchBundleAdjuster(), None)
        config = DroidwConfig()
        solver = replace(config.global_solver, cauchy=0.0, depth_damping=depth_damping)
        optimiser = Optimiser(store, parts, config.weighting, Stopwatch())
        optimiser.adjust(graph, graph.select(), config.schedule["global"], solver, first_free=1)
        left.append((off(store.T_cw) / off(T_cw) - 1) / 0.1)
    assert left[0] > 0.3
    assert abs(left[1]) < 0.05


@pytest.mark.parametrize(
    ("options", "fresh", "agreement", "expected"),
    [
        ({}, True, 1.0, 6),
        ({"at_rest": 0.0125}, True, 1.0, 5),
        ({"more_passes": 1}, True, 1.0, 4),
        ({"more_passes": 0}, True, 1.0, 3),
        ({"at_rest": 0.2}, True, 1.0, 3),
        ({"at_rest": 0.05}, True, 1.0, 4),
        # an eighth of each picture is hidden
        ({"edges_hidden": 0.2}, True, 1.0, 3),
        # in doubt: to be measured in other ways
        ({}, True, 0.5, 3),
        # one of those other ways
        ({}, False, 1.0, 3),
    ],
)
def test_the_last_pass_is_made_again_until_the_path_has_come_to_rest(
    broken, monkeypatch, options, fresh, agreement, expected
):
    """It grows longer by a few tenths of a cell, and by a third of that in each further pass."""
    backend, _ = broken(**{"passes": [1, 1, 1], **options})
    backend.fresh = fresh
    store, heard, told = backend.optimiser.store, [], []
    store["unmasked"][: len(store), :1] = 0.0

    def update(graph, session, phase, solver, **more):
        heard.append((solver.cauchy_tuning, phase.learn))
        store.T_cw[:, 0] += torch.linspace(0, 0.9, COUNT) / 3 ** len(heard)

    monkeypatch.setattr(backend.optimiser, "update", update)
    monkeypatch.setattr(module, "explained_share", lambda *given: agreement)
    backend.run(lambda done, total: told.append((done, total)))
    assert len(heard) == expected
    assert set(heard[3:]) <= {heard[2]}
    assert told[-1] == (expected, expected)
    assert all(done <= total for done, total in told)
