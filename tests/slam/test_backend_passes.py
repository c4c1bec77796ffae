"""The passes of global bundle adjustment: what each of them has, and when there is another."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from droidw.geometry.se3 import inv, log, mul
from droidw.slam import backend as module


def run(backend):
    assert backend.run(lambda done, total: None) > 0


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
        off.append(turned_off(backend.optimiser.store.T_cw, arc(len(backend.optimiser.store))))
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


@pytest.mark.parametrize(
    ("options", "updates"), [({}, 4), ({"wide_start": 1.0}, 2), ({"cauchy": 0.0}, 2)]
)
def test_the_focal_length_is_looked_for_after_the_first_pass_that_is_not_wide(
    broken, monkeypatch, options, updates
):
    backend, _ = broken(focal=True, passes=[2, 2, 2], **options)
    told = []
    monkeypatch.setattr(module, "MIN_KEYFRAMES", len(backend.optimiser.store))
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
    u = torch.linspace(0.2, 0.79, optimiser.store.grid.width)
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
        store.T_cw[:, 0] += torch.linspace(0, 0.9, len(store)) / 3 ** len(heard)

    monkeypatch.setattr(backend.optimiser, "update", update)
    monkeypatch.setattr(module, "explained_share", lambda *given: agreement)
    backend.run(lambda done, total: told.append((done, total)))
    assert len(heard) == expected
    assert set(heard[3:]) <= {heard[2]}
    assert told[-1] == (expected, expected)
    assert all(done <= total for done, total in told)


@pytest.mark.parametrize(
    ("options", "agreement", "expected"),
    [
        ({}, 1.0, [9, 9, 9, 10, 10]),
        # a pass is held against what was there when it began: it moves nothing
        ({"passes": [1, 1, 1, 1]}, 1.0, [9, 9, 9, 10]),
        ({"between": 0}, 1.0, [9] * 5),
        # no pass goes by the half that fits best
        ({"passes": [1, 1, 1]}, 1.0, [9, 9, 9]),
        # an eighth of each picture is hidden
        ({"between_hidden": 0.2}, 1.0, [9] * 5),
        # in doubt
        ({}, 0.5, [9] * 5),
        ({"restart_below": 0.4}, 0.5, [9, 9, 9, 10, 10]),
    ],
)
def test_keyframes_come_from_between_before_the_last_passes_where_much_is_hidden(
    broken, monkeypatch, options, agreement, expected
):
    backend, _ = broken(**{"passes": [1] * 5, "between": 1, **options})
    backend.fresh = True
    store, heard, taken_out, looked = backend.optimiser.store, [], [], []
    store["unmasked"][: len(store), :1] = 0.0

    def add():
        assert not between.made
        between.made = True
        store.append(store.infos[-1], **store.values(8))

    between = backend._between = SimpleNamespace(
        made=False,
        add=add,
        remove=lambda: taken_out.append(len(heard)),
        remove_loose=lambda graph, gates: looked.append(len(heard)),
        old=lambda: list(range(len(store))),
    )
    monkeypatch.setattr(
        backend.optimiser, "update", lambda *given, **more: heard.append(len(store))
    )
    monkeypatch.setattr(module, "explained_share", lambda *given: agreement)
    run(backend)
    assert heard == expected
    # what measures a path in doubt does so by the keyframes that it was tracked with
    doubted = agreement < options.get("restart_below", 0.8)
    assert taken_out == ([5] if doubted else [])
    # and what came loose is looked for after each pass with them
    came = expected.index(10) + 1 if 10 in expected else len(expected)
    assert looked == ([] if doubted else list(range(came, len(expected) + 1)))
