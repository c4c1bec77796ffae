"""Every value of the presets against the tables of the published systems (REFERENCE 3 to 5, 13)."""

from __future__ import annotations

import pytest

from droidw.config.load import load_config

ON = {"learn": True, "weigh": True, "depth_prior": True}
PAPER = {
    "features.name": "fit3d", "depth.name": "metric3d", "correspondence.name": "droid",
    "uncertainty.name": "affine-softplus",
    "motion_filter.threshold": 3.0, "motion_filter.force_every": 9,
    "motion_filter.movable_nearer": 0,
    "frontend.warmup": 12, "frontend.beta": 0.75, "frontend.init_beta": 0.25,
    "frontend.keyframe_threshold": 3.0, "frontend.redundant": "newest",
    "frontend.threshold": 16.0, "frontend.window": 25, "frontend.radius": 2, "frontend.nms": 1,
    "frontend.max_factors": 75, "frontend.max_age": 50, "frontend.predict": "hold",
    "frontend.starts": False, "frontend.keep_below": 0.0,
    "backend.learn": False, "backend.passes": [7, 12], "backend.beta": 0.75,
    "backend.threshold": 25.0, "backend.radius": 1, "backend.nms": 5, "backend.nms_shape": "square",
    "backend.normalize": False, "backend.factors_per_keyframe": 6,
    "filler.updates": 12, "filler.keyframes": 1, "filler.batch": 16,
    "weighting.similarity": "raw", "weighting.parted": False, "weighting.closed_below": 0.0,
    "weighting.gate": "rational", "weighting.slope": 45.0, "weighting.shift": 35.0,
    "weighting.floor": 0.1, "weighting.bidirectional": False,
    "weighting.confidence_scale": 0.001, "weighting.damping_scale": 0.2,
    "weighting.damping_floor": 1e-7, "weighting.min_disp": 1e-5, "weighting.max_disp": 0.0,
    "weighting.prior_weight": 0.001,
    "schedule.init_blind": {"updates": 8, "iterations": 2, **ON, "weigh": False},
    "schedule.init": {"updates": 8, "iterations": 2, **ON},
    "schedule.init_again": {"updates": 8, "iterations": 2, **ON},
    "schedule.window": {"updates": 3, "iterations": 2, **ON},
    "schedule.window_kept": {"updates": 2, "iterations": 2, **ON},
    "schedule.global": {
        "updates": 0, "iterations": 2, "learn": False, "weigh": True, "depth_prior": False,
    },
    "solver": {
        "lm": 1e-4, "ep": 0.1, "huber": 0.0, "cauchy": 0.0, "cauchy_tuning": 0.0,
        "cauchy_slip": 0.0, "guard": False, "depth_damping": 1.0, "planes": 0.0,
    },
    "global_solver": {
        "lm": 1e-5, "ep": 1e-2, "huber": 0.0, "cauchy": 0.0, "cauchy_tuning": 0.0,
        "cauchy_slip": 0.0, "guard": False, "depth_damping": 1.0, "planes": 0.0,
    },
    "filler_solver": {
        "lm": 1e-4, "ep": 0.1, "huber": 0.0, "cauchy": 0.0, "cauchy_tuning": 0.0,
        "cauchy_slip": 0.0, "guard": False, "depth_damping": 1.0, "planes": 0.0,
    },
    "seed": 43, "compat": [], "camera.refine_focal": False,
}  # fmt: skip
OFF = {"learn": False, "weigh": False, "depth_prior": True}
DROID_SLAM = {
    **PAPER,
    "features.name": "none", "depth.name": "none", "uncertainty.name": "none",
    "motion_filter.threshold": 2.4, "motion_filter.force_every": 0,
    "motion_filter.movable_nearer": 0,
    "frontend.warmup": 8, "frontend.beta": 0.3, "frontend.keyframe_threshold": 4.0,
    "frontend.redundant": "middle", "frontend.max_factors": 48, "frontend.max_age": 20,
    "frontend.predict": "damped",
    "backend.beta": 0.3, "backend.threshold": 22.0, "backend.radius": 2, "backend.nms": 3,
    "backend.nms_shape": "diamond", "backend.normalize": True,
    "backend.factors_per_keyframe": 16,
    "filler.updates": 6, "weighting.gate": "none", "weighting.min_disp": 1e-3,
    "weighting.prior_weight": 0.05,
    "schedule.init_blind": {"updates": 8, "iterations": 2, **OFF},
    "schedule.init": {"updates": 8, "iterations": 2, **OFF},
    "schedule.init_again": {"updates": 0, "iterations": 2, **ON},
    "schedule.window": {"updates": 3, "iterations": 2, **OFF},
    "schedule.window_kept": {"updates": 2, "iterations": 2, **OFF},
    "schedule.global": {"updates": 0, "iterations": 2, **OFF},
    "seed": 0,
}  # fmt: skip


@pytest.mark.parametrize(("preset", "table"), [("paper", PAPER), ("droid-slam", DROID_SLAM)])
def test_values_of_the_published_system(preset, table):
    data = load_config(preset=preset).data
    found = {}
    for key in table:
        value = data
        for part in key.split("."):
            value = value[part]
        found[key] = value
    assert found == table


def test_droid_slam_is_ready_but_for_its_weights(monkeypatch, tmp_path):
    import droidw

    plugins = droidw.load_plugins(environ={"DROIDW_WEIGHTS": str(tmp_path)})
    data = load_config(preset="droid-slam").data
    state = {
        slot: plugins.registry(slot).status(data[slot]["name"])
        for slot in ("features", "depth", "uncertainty", "ba", "correspondence")
    }
    assert state.pop("correspondence") == "weights missing: droid"
    assert set(state.values()) == {"ready"}
