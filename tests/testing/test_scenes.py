"""Synthetic scenes: what they claim to know is true, and equal specs give equal bytes."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from droidw.errors import UsageError
from droidw.geometry import projective, se3
from droidw.testing.scenes import MOTIONS, SCENES, Scene, SceneSpec, named_spec

SMALL = SceneSpec(width=96, height=72, frames=6, fps=6)


def pixels(spec):
    y, x = np.mgrid[: spec.height, : spec.width].astype(np.float64)
    return np.stack([x, y], axis=-1)


def back_project(scene, depth):
    fx, fy, cx, cy = scene.intrinsics
    x, y = np.moveaxis(pixels(scene.spec), -1, 0)
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones(depth.shape)], axis=-1)
    return rays * depth[..., None]


def test_frame_has_the_promised_shapes():
    frame = Scene(SMALL).render(2)
    assert frame.image.shape == (72, 96, 3)
    assert frame.image.dtype == np.uint8
    assert frame.depth.shape == frame.moving.shape == (72, 96)
    assert frame.depth.dtype == np.float32
    assert frame.time == pytest.approx(2 / 6)
    assert np.linalg.norm(frame.T_wc[3:]) == pytest.approx(1, abs=1e-12)
    assert np.isfinite(frame.depth).all()
    assert frame.depth.min() > 0.3


def test_equal_specs_give_equal_bytes_and_other_seeds_others():
    first, again = Scene(SMALL).render(3), Scene(SMALL).render(3)
    assert first.image.tobytes() == again.image.tobytes()
    assert first.depth.tobytes() == again.depth.tobytes()
    other = Scene(dataclasses.replace(SMALL, seed=1)).render(3)
    assert np.abs(other.image.astype(int) - first.image).mean() > 5


def test_static_correspondence_is_the_projection_of_the_true_depth():
    scene = Scene(SMALL)
    depth = scene.depth_at(0, pixels(SMALL))
    found = scene.correspond(0, 4, pixels(SMALL))
    T_cw = se3.inv(torch.from_numpy(np.stack([scene.T_wc(0), scene.T_wc(4)])))
    coords, valid = projective.reproject(
        T_cw,
        torch.from_numpy(1 / depth)[None].expand(2, -1, -1),
        torch.from_numpy(scene.intrinsics),
        torch.tensor([0]),
        torch.tensor([1]),
    )
    use = found.visible & ~found.moving & valid[0].numpy()
    assert use.mean() > 0.5
    assert np.abs(coords[0].numpy() - found.target)[use].max() < 1e-9


def test_correspondence_there_and_back_returns():
    scene = Scene(SMALL)
    start = pixels(SMALL)
    there = scene.correspond(1, 5, start)
    back = scene.correspond(5, 1, there.target)
    both = there.visible & back.visible
    assert there.moving[both].any()
    assert np.abs(back.target - start)[both].max() < 1e-5
    assert (there.moving == back.moving)[both].all()


def test_moving_points_do_not_follow_the_static_projection():
    scene = Scene(SMALL)
    found = scene.correspond(0, 5, pixels(SMALL))
    X_c = back_project(scene, scene.depth_at(0, pixels(SMALL)))
    T_wc = torch.from_numpy(np.stack([scene.T_wc(0), scene.T_wc(5)]))
    M = se3.matrix(se3.mul(se3.inv(T_wc[1]), T_wc[0])).numpy()
    X_c = X_c @ M[:3, :3].T + M[:3, 3]
    fx, fy, cx, cy = scene.intrinsics
    still = np.stack([fx * X_c[..., 0] / X_c[..., 2] + cx, fy * X_c[..., 1] / X_c[..., 2] + cy], -1)
    error = np.linalg.norm(still - found.target, axis=-1)
    assert np.median(error[found.moving]) > 1
    assert error[found.visible & ~found.moving].max() < 1e-9


def test_hidden_points_are_not_visible():
    scene = Scene(SMALL)
    target, visible = scene.flow(0, 5)
    inside = ((target >= 0) & (target <= [SMALL.width - 1, SMALL.height - 1])).all(-1)
    assert (inside & ~visible).any()
    assert not (visible & ~inside).any()


def test_the_same_frame_maps_to_itself():
    scene = Scene(SMALL)
    target, visible = scene.flow(3, 3)
    assert np.abs(target - pixels(SMALL)).max() < 1e-9
    assert visible.mean() > 0.98


def test_pictures_agree_with_the_truth_so_that_flow_can_work():
    scene = Scene(SceneSpec(width=160, height=120, frames=4, fps=15, noise=0.5))
    first, second = scene.render(0), scene.render(3)
    target, visible = scene.flow(0, 3)
    warped = cv2.remap(
        second.image,
        target[..., 0].astype(np.float32),
        target[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
    )
    same = np.abs(warped.astype(int) - first.image).mean(-1)[visible]
    still = np.abs(second.image.astype(int) - first.image).mean(-1)[visible]
    assert np.median(same) < 2.5
    assert same.mean() < 0.6 * still.mean()
    grey = [cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY) for f in (first, second)]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*grey, None)
    error = np.linalg.norm(flow - (target - pixels(scene.spec)), axis=-1)
    assert np.median(error[visible]) < 0.4


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("motion", MOTIONS)
def test_moving_objects_cover_a_fair_share_and_the_camera_stays_in_the_room(motion, seed):
    scene = Scene(SceneSpec(width=64, height=48, frames=120, fps=12, seed=seed, motion=motion))
    grid = pixels(scene.spec)
    shares, near = [], []
    for index in range(0, 120, 10):
        found = scene.correspond(index, index, grid)
        shares.append(found.moving.mean())
        near.append(scene.depth_at(index, grid).min())
    assert 0.08 < np.mean(shares) < 0.27
    assert min(near) > 0.25


def test_motions_are_what_their_names_say():
    def centres(motion):
        return Scene(dataclasses.replace(SMALL, motion=motion, frames=60)).trajectory

    static, rotation = centres("static"), centres("rotation")
    assert np.ptp(static.T_wc, axis=0).max() == 0
    assert np.ptp(rotation.centres, axis=0).max() == 0
    assert np.ptp(rotation.T_wc[:, 3:], axis=0).max() > 0.1
    for motion in ("handheld", "orbit", "forward"):
        assert np.linalg.norm(np.ptp(centres(motion).centres, axis=0)) > 0.5


def test_scene_without_moving_objects():
    frame = Scene(named_spec("no-moving", width=64, height=48, frames=2)).render(0)
    assert not frame.moving.any()
    assert named_spec("orbit-no-moving").motion == "orbit"
    assert {"handheld", "static", "rotation", "no-moving"} <= set(SCENES)


def test_wrong_specs_are_refused_with_what_is_valid():
    with pytest.raises(UsageError, match="handheld"):
        SceneSpec(motion="flying")
    with pytest.raises(UsageError, match="frames"):
        SceneSpec(frames=0)
    with pytest.raises(UsageError, match="no-moving"):
        named_spec("moon")
    with pytest.raises(UsageError, match="0 to 5"):
        Scene(SMALL).render(6)


def test_written_folder_holds_pictures_and_truth(tmp_path):
    spec = dataclasses.replace(SMALL, frames=2)
    scene = Scene(spec)
    scene.write(tmp_path / "clip")
    frame = scene.render(1)
    folder = tmp_path / "clip"
    image = cv2.imread(str(folder / "rgb/000001.png"))[..., ::-1]
    assert (image == frame.image).all()
    mask = cv2.imread(str(folder / "mask/000001.png"), cv2.IMREAD_UNCHANGED)
    assert ((mask == 255) == frame.moving).all()
    depth = cv2.imread(str(folder / "depth/000001.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert np.abs(depth / 1000 - frame.depth).max() < 0.00051
    truth = np.loadtxt(folder / "groundtruth.txt")
    assert np.allclose(truth[1], [frame.time, *frame.T_wc], atol=1e-6)
    camera = dict(line.split() for line in (folder / "camera.txt").read_text().splitlines())
    assert [float(camera[k]) for k in ("fx", "fy", "cx", "cy")] == pytest.approx(scene.intrinsics)
    assert (folder / "rgb.txt").read_text().splitlines()[2].endswith("rgb/000001.png")
