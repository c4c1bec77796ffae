"""ATE and RPE by hand, and against evo on the same files."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from droidw.errors import InputError, UsageError
from droidw.eval.metrics import Delta, path_length, score
from droidw.io.tum import read_tum
from droidw.slam.frame import Trajectory


def random_walk(count: int, seed: int) -> Trajectory:
    """A smooth walk with turning cameras."""
    rng = np.random.default_rng(seed)
    centres = np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0)
    q = np.cumsum(rng.normal(0, 0.03, (count, 4)), axis=0)
    q[:, 3] += 1
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return Trajectory(np.arange(count) / 30.0, np.concatenate([centres, q], axis=1))


def moved(trajectory: Trajectory, noise: float = 0.0, scale: float = 0.4) -> Trajectory:
    """The same walk in another frame, at another scale, with noise."""
    from droidw_plugins.observers._truth import rotation

    rng = np.random.default_rng(7)
    turn = np.array([0.1, -0.7, 0.3, 0.6])
    turn /= np.linalg.norm(turn)
    R = rotation(turn)
    T_wc = trajectory.T_wc.copy()
    T_wc[:, :3] = scale * trajectory.centres @ R.T + [5, -3, 2]
    T_wc[:, :3] += rng.normal(0, noise, (len(T_wc), 3)) if noise else 0.0
    x, y, z, w = turn
    left = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
    T_wc[:, 3:] = trajectory.T_wc[:, 3:] @ left.T + rng.normal(0, noise, (len(T_wc), 4))
    T_wc[:, 3:] /= np.linalg.norm(T_wc[:, 3:], axis=1, keepdims=True)
    return Trajectory(trajectory.times, T_wc)


def straight(xs: list[float], y: float = 0.0) -> Trajectory:
    """Centres on a line along x, cameras that look along z."""
    T_wc = np.zeros((len(xs), 7))
    T_wc[:, 0], T_wc[:, 1], T_wc[:, 6] = xs, y, 1.0
    return Trajectory(np.arange(len(xs), dtype=np.float64), T_wc)


def test_by_hand_without_alignment() -> None:
    truth, est = straight([0, 1, 2, 3]), straight([0, 1, 2, 5])
    found = score(est, truth, align="none")
    assert found.errors.tolist() == [0, 0, 0, 2]
    assert found.ate.rmse == pytest.approx(1.0)
    assert (found.ate.mean, found.ate.median, found.ate.max) == (0.5, 0.0, 2.0)
    assert found.ate.std == pytest.approx(np.sqrt(0.75))
    assert (found.path_length, found.path_length_est) == (3.0, 5.0)
    assert found.ate_percent == pytest.approx(100 / 3)
    assert found.rpe_trans is not None
    assert found.rpe_trans.rmse == pytest.approx(np.sqrt(4 / 3))
    assert found.rpe_pairs == 3
    assert found.scale == 1.0


def test_pairs_that_cross_in_time_are_left_out() -> None:
    """Both have gaps, and far more time is allowed than lies between two stamps."""
    whole = straight([float(k) for k in range(30)])
    here, there = (np.setdiff1d(np.arange(30), gone) for gone in ([8, 14, 25], [5, 12, 20]))
    est = Trajectory(whole.times[here], whole.T_wc[here])
    ref = Trajectory(whole.times[there] + 0.1, whole.T_wc[there])
    found = score(est, ref, align="none", max_diff=6.0)
    assert found.path_length_est == pytest.approx(found.path_length)  # nowhere to and fro
    assert found.matched == 24
    assert found.notes[0].startswith("3 pairs of stamps cross others in time")
    three = Trajectory(np.array([0.05, 1.05, 2.05]), whole.T_wc[:3])
    few = Trajectory(np.array([0.9, 1.1, 0.5]), whole.T_wc[:3])
    with pytest.raises(InputError, match="cross others in time") as caught:
        score(three, few, max_diff=9)
    assert "--t-max-diff" in caught.value.hint


def test_similarity_is_taken_out() -> None:
    truth = random_walk(60, 1)
    found = score(moved(truth), truth)
    assert found.ate.max < 1e-12
    assert found.scale == pytest.approx(2.5)
    assert found.rpe_trans is not None and found.rpe_trans.max < 1e-12
    assert found.rpe_rot is not None and found.rpe_rot.max < 1e-6
    assert found.path_length_est == pytest.approx(found.path_length)
    assert found.time_covered == 1.0


def test_rotation_error_in_degrees() -> None:
    truth, est = straight([0, 1, 2]), straight([0, 1, 2])
    half = np.radians(3.0) / 2
    est.T_wc[1:, 3:] = (0, np.sin(half), 0, np.cos(half))
    found = score(est, truth, align="none")
    assert found.rpe_rot is not None
    # The camera turns once and then stays turned.
    assert found.rpe_rot.max == pytest.approx(3.0)
    assert found.rpe_rot.mean == pytest.approx(1.5)


def test_delta_in_frames_and_seconds() -> None:
    truth, est = straight([0, 1, 2, 3, 4]), straight([0, 1, 2, 3, 5])
    by_frames = score(est, truth, align="none", delta=Delta.parse("2"))
    by_time = score(est, truth, align="none", delta=Delta.parse("2s"))
    assert by_frames.rpe_pairs == by_time.rpe_pairs == 3
    assert by_frames.rpe_trans == by_time.rpe_trans
    far = score(est, truth, align="none", delta=Delta.parse("0.4s"))
    assert far.rpe_trans is None and far.rpe_pairs == 0
    assert far.to_dict()["rpe_trans_rmse"] is None
    assert any("no two matched frames lie 0.4 s apart" in note for note in far.notes)


def test_delta_in_metres_of_the_way_of_the_reference() -> None:
    truth = straight([0, 1, 1, 1, 2, 4, 5])
    est = straight([0, 1, 1, 1, 2, 4, 5.5])
    found = score(est, truth, align="none", delta=Delta.parse("2m"))
    # 0 -> 2, the three at 1 -> nothing at 3, 2 -> 4, and 4 -> nothing at 6.
    assert found.rpe_times.tolist() == [0, 4]
    assert found.rpe_trans is not None and found.rpe_trans.max == 0
    one = score(est, truth, align="none", delta=Delta.parse("1m"))
    # To the first of those that stand at 1; from 4 to 5 the estimate goes half a metre too far.
    assert one.rpe_times.tolist() == [0, 1, 2, 3, 5]
    assert one.rpe_errors[:, 0].tolist() == [0, 0, 0, 0, 0.5]
    assert str(one.delta) == "1 m"


def test_normalisation_divides_by_the_reference() -> None:
    truth = random_walk(60, 4)
    est = moved(truth, noise=0.01)
    plain, shift, path = (
        score(est, truth, normalise=name) for name in ("none", "displacement", "path")
    )
    gap = np.linalg.norm(truth.centres[-1] - truth.centres[0])
    assert shift.ate.rmse == pytest.approx(plain.ate.rmse / gap)
    assert path.ate.rmse == pytest.approx(plain.ate.rmse / path_length(truth.centres))
    assert path.path_length == pytest.approx(1.0) and path.unit == "path"
    assert shift.scale == pytest.approx(plain.scale)
    assert shift.rpe_rot == plain.rpe_rot and shift.ate_percent == pytest.approx(plain.ate_percent)
    # A reference in millimetres gives the same figures.
    large = Trajectory(truth.times, truth.T_wc * np.array([1000.0] * 3 + [1.0] * 4))
    again = score(est, large, normalise="displacement")
    assert again.ate.rmse == pytest.approx(shift.ate.rmse)
    # And so without a scale in the alignment, if the estimate is in millimetres too.
    est_large = Trajectory(est.times, est.T_wc * np.array([1000.0] * 3 + [1.0] * 4))
    for align in ("se3", "none"):
        one = score(est, truth, align=align, normalise="path")
        other = score(est_large, large, align=align, normalise="path")
        assert one.ate.rmse == pytest.approx(other.ate.rmse)


def test_what_cannot_be_normalised_is_refused() -> None:
    loop = straight([0, 1, 2, 1, 0])
    with pytest.raises(InputError, match="ends where it begins") as caught:
        score(loop, loop, normalise="displacement", names=("a", "b"))
    assert "--normalise path" in caught.value.hint
    assert score(loop, loop, normalise="path").ate.rmse == pytest.approx(0, abs=1e-12)
    still = straight([1.0] * 4)
    with pytest.raises(InputError, match="b: moves nowhere"):
        score(loop, still, normalise="path", names=("a", "b"))
    with pytest.raises(UsageError, match="available: none, displacement, path"):
        score(loop, loop, normalise="unit")  # type: ignore[arg-type]


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "x", "2km", "", "0m"])
def test_delta_refuses(text: str) -> None:
    with pytest.raises(UsageError, match="--delta"):
        Delta.parse(text)


def test_poses_that_are_not_finite_are_left_out_and_told() -> None:
    truth, est = random_walk(30, 2), random_walk(30, 2)
    est.T_wc[4, 1] = np.nan
    truth.T_wc[9] = np.inf
    truth.T_wc[11, 3:] = 0.0
    found = score(est, truth, names=("a.tum", "b.tum"))
    assert (found.skipped, found.ref_skipped, found.matched, found.frames) == (1, 2, 27, 29)
    assert "a.tum: 1 of 30 poses are not finite and are left out" in found.notes
    assert "b.tum: 2 of 30 poses are not finite and are left out" in found.notes
    assert found.coverage == pytest.approx(27 / 29)
    json.dumps(found.to_dict(), allow_nan=False)


def test_nothing_usable_is_refused() -> None:
    bad = Trajectory(np.arange(3.0), np.full((3, 7), np.nan))
    with pytest.raises(InputError, match=r"x\.tum: holds no finite pose in 3 lines"):
        score(bad, random_walk(3, 0), names=("x.tum", "y.tum"))
    with pytest.raises(InputError, match="holds no pose"):
        score(Trajectory(np.zeros(0), np.zeros((0, 7))), random_walk(3, 0))
    with pytest.raises(UsageError, match="available: sim3, se3, scale, none"):
        score(random_walk(3, 0), random_walk(3, 0), align="sim2")  # type: ignore[arg-type]


def test_a_camera_that_stands_still_is_scored_and_told() -> None:
    still = straight([1.0] * 5)
    found = score(still, straight([0, 1, 2, 3, 4]))
    assert found.ate.rmse == pytest.approx(np.sqrt(2))
    assert any(note.startswith("alignment:") for note in found.notes)
    reverse = score(straight([0, 1, 2, 3, 4]), still)
    assert reverse.ate_percent is None
    json.dumps(reverse.to_dict(), allow_nan=False)


def test_path_length() -> None:
    assert path_length(np.array([[0, 0, 0], [3, 4, 0], [3, 4, 2.0]])) == 7.0
    assert path_length(np.zeros((1, 3))) == 0.0


@pytest.fixture(scope="module")
def evo(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """evo's own functions; importing it writes settings into HOME and may open a plot backend."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(tmp_path_factory.mktemp("home")))
        patch.setenv("MPLBACKEND", "Agg")
        metrics = pytest.importorskip("evo.core.metrics", reason="evo is in the test extra")
        from evo.core import sync, units
        from evo.tools import file_interface
    return SimpleNamespace(metrics=metrics, sync=sync, units=units, files=file_interface)


def write(path: Path, trajectory: Trajectory) -> Path:
    """A TUM file with every digit."""
    rows = np.column_stack([trajectory.times, trajectory.T_wc])
    np.savetxt(path, rows, fmt="%.17g")
    return path


@pytest.mark.parametrize("align", ["sim3", "se3", "scale", "none"])
@pytest.mark.parametrize("step", [1, 7])
def test_same_figures_as_evo(evo: SimpleNamespace, tmp_path: Path, align: str, step: int) -> None:
    truth = random_walk(120, 3)
    noisy = moved(truth, noise=0.01)
    # Every other frame, with stamps that are a little off.
    est = Trajectory(noisy.times[::2] + 0.003, noisy.T_wc[::2])
    est_file, ref_file = write(tmp_path / "est.tum", est), write(tmp_path / "ref.tum", truth)
    ours = score(
        read_tum(est_file),
        read_tum(ref_file),
        align=align,
        delta=Delta(step),  # type: ignore[arg-type]
    )

    ref, mine = evo.sync.associate_trajectories(
        evo.files.read_tum_trajectory_file(str(ref_file)),
        evo.files.read_tum_trajectory_file(str(est_file)),
        max_diff=0.02,
    )
    if align != "none":
        mine.align(ref, correct_scale=align == "sim3", correct_only_scale=align == "scale")
    ape = evo.metrics.APE(evo.metrics.PoseRelation.translation_part)
    ape.process_data((ref, mine))
    theirs = ape.get_all_statistics()
    for name in ("rmse", "mean", "median", "max", "std"):
        assert getattr(ours.ate, name) == pytest.approx(theirs[name], rel=1e-9), name
    for relation, got in (
        (evo.metrics.PoseRelation.translation_part, ours.rpe_trans),
        (evo.metrics.PoseRelation.rotation_angle_deg, ours.rpe_rot),
    ):
        rpe = evo.metrics.RPE(
            relation, delta=step, delta_unit=evo.units.Unit.frames, all_pairs=True
        )
        rpe.process_data((ref, mine))
        theirs = rpe.get_all_statistics()
        assert got is not None
        for name in ("rmse", "mean", "median", "max", "std"):
            assert getattr(got, name) == pytest.approx(theirs[name], rel=1e-7), (relation, name)
    assert ours.matched == ref.num_poses == 60
    assert ours.path_length == pytest.approx(ref.path_length)
    assert ours.path_length_est == pytest.approx(mine.path_length)


@pytest.mark.parametrize("metres", [0.3, 1.0])
def test_same_figures_as_evo_over_metres(
    evo: SimpleNamespace, tmp_path: Path, metres: float
) -> None:
    truth = random_walk(120, 5)
    est_file = write(tmp_path / "est.tum", moved(truth, noise=0.01))
    ref_file = write(tmp_path / "ref.tum", truth)
    ours = score(read_tum(est_file), read_tum(ref_file), delta=Delta(metres, "metres"))
    ref = evo.files.read_tum_trajectory_file(str(ref_file))
    mine = evo.files.read_tum_trajectory_file(str(est_file))
    mine.align(ref, correct_scale=True)
    for relation, got in (
        (evo.metrics.PoseRelation.translation_part, ours.rpe_trans),
        (evo.metrics.PoseRelation.rotation_angle_deg, ours.rpe_rot),
    ):
        rpe = evo.metrics.RPE(
            relation,
            delta=metres,
            delta_unit=evo.units.Unit.meters,
            all_pairs=True,
            pairs_from_reference=True,
        )
        rpe.process_data((ref, mine))
        theirs = rpe.get_all_statistics()
        assert got is not None and ours.rpe_pairs == len(rpe.error) > 20
        for name in ("rmse", "mean", "median", "max", "std"):
            assert getattr(got, name) == pytest.approx(theirs[name], rel=1e-7), (relation, name)


def test_normalised_figures_as_published(evo: SimpleNamespace, tmp_path: Path) -> None:
    """REFERENCE 6.4: the truth divided by its first-to-last distance, then evo with Sim(3)."""
    truth = random_walk(80, 6)
    est = moved(truth, noise=0.02)
    divided = Trajectory(truth.times, truth.T_wc.copy())
    divided.T_wc[:, :3] /= np.linalg.norm(truth.centres[-1] - truth.centres[0])
    ref = evo.files.read_tum_trajectory_file(str(write(tmp_path / "ref.tum", divided)))
    mine = evo.files.read_tum_trajectory_file(str(write(tmp_path / "est.tum", est)))
    mine.align(ref, correct_scale=True)
    ape = evo.metrics.APE(evo.metrics.PoseRelation.translation_part)
    ape.process_data((ref, mine))
    ours = score(est, truth, normalise="displacement")
    assert ours.ate.rmse == pytest.approx(ape.get_statistic(evo.metrics.StatisticsType.rmse))
