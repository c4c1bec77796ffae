"""Camera, grid and rectifier: the half pixel, resizing, cropping, undistortion, refusals."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from droidw.errors import InputError
from droidw.geometry.camera import Camera, Grid
from droidw.geometry.rectify import Rectifier
from droidw.geometry.sizes import working_size
from droidw.slam.frame import RawFrame

CAMERA = Camera(640, 480, 525.0, 520.0, 318.3, 243.1)


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)


@pytest.fixture
def points():
    rng = np.random.default_rng(1)
    return rng.uniform([-1, -1, 2], [1, 1, 5], (50, 3))


@pytest.mark.parametrize("size", [(320, 240), (213, 97), (1280, 960)])
def test_projecting_then_resizing_equals_projecting_with_the_resized_camera(points, size):
    scale = np.array(size) / (640, 480)
    moved = (project(CAMERA, points) + 0.5) * scale - 0.5
    np.testing.assert_allclose(project(CAMERA.resized(*size), points), moved, atol=1e-9)


def test_cropping_moves_the_principal_point_only(points):
    cropped = CAMERA.cropped(7, 3, 600, 400)
    assert (cropped.width, cropped.height) == (600, 400)
    np.testing.assert_allclose(project(cropped, points), project(CAMERA, points) - (7, 3))


def test_resizing_there_and_back_is_the_identity():
    back = CAMERA.resized(100, 77).resized(640, 480)
    np.testing.assert_allclose(
        [back.fx, back.fy, back.cx, back.cy], [525.0, 520.0, 318.3, 243.1], rtol=1e-12
    )


def test_a_guess_has_the_field_of_view_asked_for_and_a_centred_axis():
    camera = Camera.guess(641, 480, 60.0)
    assert camera.fov_deg == pytest.approx(60.0)
    assert (camera.cx, camera.cy) == (320.0, 239.5)
    assert 2 * math.degrees(math.atan(320.5 / camera.fx)) == pytest.approx(60.0)
    with pytest.raises(InputError, match="field of view"):
        Camera.guess(640, 480, 180.0)


def test_intrinsics_are_float32_in_the_order_of_the_fields():
    K = CAMERA.intrinsics()
    assert K.dtype == torch.float32
    np.testing.assert_allclose(K.numpy(), [525.0, 520.0, 318.3, 243.1], rtol=1e-7)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": math.nan}, "fx is nan"),
        ({"cy": math.inf}, "cy is inf"),
        ({"fy": 0.0}, "fy is 0"),
        ({"fx": -5.0}, "focal length is positive"),
        ({"cx": 640.0}, "outside the picture of 640x480"),
        ({"cy": -1.0}, "outside the picture"),
        ({"width": 0}, "0x480"),
        ({"distortion": (0.1, 0.2, 0.3), "model": "opencv"}, "3 distortion coefficients"),
        ({"distortion": (0.1, math.nan, 0.0, 0.0), "model": "opencv"}, r"distortion\[1\] is nan"),
        ({"model": "fisheye"}, "0 distortion coefficients"),
    ],
)
def test_impossible_cameras_are_refused_in_words_that_name_the_source(change, words):
    with pytest.raises(InputError, match=words) as caught:
        replace(CAMERA, **change).validated("calib.txt, line 3")
    assert str(caught.value).startswith("calib.txt, line 3")
    assert caught.value.exit_code == 3


def test_a_good_camera_is_returned_itself():
    assert CAMERA.validated("here") is CAMERA


@pytest.mark.parametrize(
    ("size", "long_side", "expected"),
    [
        ((640, 480), 320, (320, 240)),
        ((854, 480), 320, (320, 176)),
        ((480, 854), 320, (176, 320)),
        ((200, 100), 320, (200, 96)),
        ((640, 480), 300, (296, 224)),
    ],
)
def test_working_sizes_are_multiples_of_eight_never_larger(size, long_side, expected):
    assert working_size(*size, long_side) == expected


def test_pictures_too_small_to_work_on_are_refused():
    with pytest.raises(InputError, match="at least 32"):
        working_size(640, 20, 320)
    with pytest.raises(InputError, match="too small"):
        Rectifier(CAMERA, size=(24, 240))


def test_grid_covers_every_centre_in_the_image_and_no_more():
    for stride, offset in ((8, 3.5), (8, 0.0), (4, 1.5), (8, 3.0), (1, 0.0)):
        for size in (240, 241, 244, 247):
            grid = Grid.of(size, 320, stride, offset)
            last = (grid.height - 1) * stride + offset
            assert last <= size - 1 < last + stride
    with pytest.raises(ValueError, match="no cell"):
        Grid.of(3, 320, 8, 3.5)
    with pytest.raises(ValueError, match="offset"):
        Grid.of(240, 320, 8, -1.0)


def test_grid_intrinsics_project_to_the_cell_of_the_pixel(points):
    grid = Grid.of(480, 640, 8, 3.5)
    K = grid.intrinsics(CAMERA.intrinsics().double())
    in_cells = np.stack(
        [
            float(K[0]) * points[:, 0] / points[:, 2] + float(K[2]),
            float(K[1]) * points[:, 1] / points[:, 2] + float(K[3]),
        ],
        axis=-1,
    )
    np.testing.assert_allclose(in_cells * 8 + 3.5, project(CAMERA, points), atol=1e-4)
    assert grid.intrinsics(torch.ones(5, 2, 4)).shape == (5, 2, 4)


@pytest.mark.parametrize("offset", [0.0, 3.0, 3.5, 0.25])
def test_sampling_a_ramp_gives_the_centres_themselves(offset):
    grid = Grid.of(61, 83, 8, offset)
    y, x = torch.meshgrid(torch.arange(61.0), torch.arange(83.0), indexing="ij")
    sampled = grid.sample(torch.stack([x, y])).permute(1, 2, 0)
    torch.testing.assert_close(sampled, grid.centres())


def test_nearest_sampling_keeps_the_type_and_takes_rows_3_11_19():
    grid = Grid.of(24, 24, 8, 3.5)
    rows = torch.arange(24)[:, None].expand(24, 24)
    picked = grid.sample(rows, mode="nearest")
    assert picked.dtype == torch.int64
    assert picked[:, 0].tolist() == [3, 11, 19]
    assert grid.sample(rows > 10, mode="nearest").dtype == torch.bool
    with pytest.raises(ValueError, match="do not cover"):
        grid.sample(rows[:10])


def test_rectifier_moves_a_spot_where_its_camera_says():
    """A blurred spot is found where the projection of the working camera puts it."""
    camera = Camera(700, 500, 400.0, 410.0, 340.0, 260.0)
    rectifier = Rectifier(camera, long_side=320, edge=4)
    working = rectifier.camera
    assert (working.width, working.height) == (312, 216)
    X = np.array([[0.2, -0.15, 1.0]])
    u, v = project(camera, X)[0]
    y, x = np.mgrid[:500, :700]
    spot = 250 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2))
    out = rectifier.rectify_image(np.repeat(spot[..., None], 3, 2).round().astype(np.uint8))
    assert out.shape == (216, 312, 3)
    assert out.dtype == np.uint8
    weight = out[..., 0].astype(float)
    y, x = np.mgrid[:216, :312]
    found = [(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()]
    np.testing.assert_allclose(found, project(working, X)[0], atol=0.02)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("opencv", (-0.25, 0.08, 0.002, -0.001, 0.0)), ("fisheye", (0.05, -0.01, 0.0, 0.0))],
)
def test_undistortion_puts_points_where_a_pinhole_sees_them(model, coefficients):
    camera = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, coefficients, model)
    X = np.array([[[0.35, -0.25, 1.0]]])
    project_cv = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    seen = project_cv(X, np.zeros(3), np.zeros(3), camera.matrix(), np.array(coefficients))[0]
    u, v = seen.reshape(2)
    y, x = np.mgrid[:480, :640]
    spot = 250 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 3.0**2))
    rectifier = Rectifier(camera, size=(640, 480))
    out = rectifier.rectify_image(np.repeat(spot[..., None], 3, 2).round().astype(np.uint8))
    weight = out[..., 0].astype(float)
    found = [(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()]
    expected = project(rectifier.camera, X[0])[0]
    assert np.linalg.norm(expected - (u, v)) > 5
    np.testing.assert_allclose(found, expected, atol=0.15)
    assert not rectifier.camera.is_distorted


def test_frame_is_rgb_in_unit_range_and_size_may_change_the_aspect():
    rectifier = Rectifier(CAMERA, size=(512, 384), edge=8)
    assert rectifier.camera == CAMERA.resized(528, 400).cropped(8, 8, 512, 384)
    image = np.zeros((480, 640, 3), np.uint8)
    image[..., 0] = 255
    frame = rectifier(RawFrame(4, 1.25, image, "a.png"))
    assert (frame.index, frame.time, frame.name) == (4, 1.25, "a.png")
    assert frame.image.shape == (3, 384, 512)
    assert frame.image.dtype == torch.float32
    assert frame.image.is_contiguous()
    assert frame.image.amax((1, 2)).tolist() == [1.0, 0.0, 0.0]
    torch.testing.assert_close(frame.intrinsics, rectifier.camera.intrinsics())


def test_rectifier_refuses_what_it_was_not_made_for():
    rectifier = Rectifier(CAMERA, long_side=320)
    with pytest.raises(InputError, match="320x200 pixels does not fit"):
        rectifier.rectify_image(np.zeros((200, 320, 3), np.uint8))
    with pytest.raises(ValueError, match="either"):
        Rectifier(CAMERA)
    with pytest.raises(ValueError, match="either"):
        Rectifier(CAMERA, long_side=320, size=(320, 240))


def test_rectifier_gives_the_same_from_many_threads():
    camera = replace(CAMERA, distortion=(0.1, -0.05, 0.0, 0.0), model="opencv")
    rectifier = Rectifier(camera, long_side=320)
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    alone = rectifier.rectify_image(image)
    with ThreadPoolExecutor(4) as pool:
        for out in pool.map(rectifier.rectify_image, [image] * 8):
            np.testing.assert_array_equal(out, alone)
