"""Reader and correspondence `synthetic`: they agree with each other and with the scene."""

import numpy as np
import pytest
import torch

from droidw.errors import InputError, UsageError
from droidw.geometry import projective, se3
from droidw.geometry.camera import Grid
from droidw.geometry.rectify import Rectifier
from droidw.interfaces.correspondence import Correspondence, EdgeRequest
from droidw.interfaces.datasets import DatasetReader, FrameSource, Selection
from droidw.plugin.component import BuildContext
from droidw_plugins.correspondence import synthetic as correspondence_plugin
from droidw_plugins.datasets import synthetic as reader_plugin

SIZE = {"width": 160, "height": 112, "frames": 8, "fps": 8.0}
CONTEXT = BuildContext(torch.device("cpu"), seed=5)


def reader(**options):
    component = reader_plugin.COMPONENT
    return component.factory(component.options(**{**SIZE, **options}), CONTEXT)


def matcher(context=CONTEXT, **options):
    component = correspondence_plugin.COMPONENT
    return component.factory(component.options(**{**SIZE, **options}), context)


def encoded(op, long_side=160):
    source = reader().open("synthetic", Selection())
    rectify = Rectifier(source.camera, long_side=long_side)
    frames = [rectify(raw) for raw in source.frames()]
    grid = Grid.of(*frames[0].image.shape[-2:], op.stride, op.offset)
    return source, frames, grid, [op.encode(frame, grid) for frame in frames]


def ask(session, payloads, grid, edges, ids=None):
    shape = len(edges), grid.height, grid.width
    return session.update(
        EdgeRequest(
            ids if ids is not None else list(range(len(edges))),
            [i for i, _ in edges],
            [j for _, j in edges],
            torch.zeros(*shape, 2),
            torch.ones(shape, dtype=torch.bool),
            payloads.__getitem__,
        )
    )


def test_reader_gives_frames_camera_and_truth():
    source = reader().open("synthetic:orbit", Selection())
    assert isinstance(reader(), DatasetReader)
    assert isinstance(source, FrameSource)
    frames = list(source.frames())
    assert [f.index for f in frames] == list(range(8)) == list(range(source.length))
    assert all(f.image.shape == (112, 160, 3) for f in frames)
    assert np.allclose(source.truth.times, [f.time for f in frames])
    assert (source.camera.width, source.camera.height) == (160, 112)
    again = next(source.frames())
    assert again.image.tobytes() == frames[0].image.tobytes()


def test_reader_selects():
    source = reader().open("synthetic", Selection(stride=2, skip=1, max_frames=3))
    assert source.length == 3
    assert [f.index for f in source.frames()] == [1, 3, 5]


def test_reader_recognises_its_own_and_refuses_the_unknown():
    assert reader().recognises("synthetic")
    assert reader().recognises("synthetic:static")
    assert not reader().recognises("synthetic_clip.mp4")
    with pytest.raises(InputError, match="synthetic:handheld"):
        reader().open("synthetic:moon", Selection())
    with pytest.raises(InputError, match=r"reader\.options\.frames"):
        reader().open("synthetic", Selection(skip=8))


@pytest.mark.parametrize("long_side", [160, 96])
def test_targets_are_the_reprojection_of_the_truth_at_any_working_size(long_side):
    op = matcher(scene="handheld")
    assert isinstance(op, Correspondence)
    source, frames, grid, payloads = encoded(op, long_side)
    update = ask(op.session(), payloads, grid, [(0, 3), (3, 0)])
    assert update.target.dtype == update.confidence.dtype == torch.float32
    depth = np.stack([op.scene.depth_at(p.index, p.cells) for p in payloads])
    moving = op.scene.correspond(0, 3, payloads[0].cells).moving
    coords, valid = projective.reproject(
        se3.inv(torch.from_numpy(source.truth.T_wc)),
        torch.from_numpy(1 / depth),
        grid.intrinsics(frames[0].intrinsics.double()),
        torch.tensor([0]),
        torch.tensor([3]),
    )
    static = (update.confidence[0, ..., 0] > 0) & valid[0] & ~torch.from_numpy(moving)
    assert static.float().mean() > 0.4
    assert (update.target[0] - coords[0])[static].abs().max() < 1e-4
    followed = (update.confidence[0, ..., 0] > 0) & torch.from_numpy(moving)
    assert (update.target[0] - coords[0])[followed].abs().max() > 0.3


def test_cells_out_of_view_have_no_confidence():
    op = matcher()
    _, _, grid, payloads = encoded(op)
    update = ask(op.session(), payloads, grid, [(0, 7)])
    pixels = update.target * op.stride + op.offset
    outside = ((pixels < 0) | (pixels > torch.tensor([159, 111]))).any(-1)
    assert outside.any()
    assert (update.confidence[outside] == 0).all()
    assert update.confidence.max() == 1


def test_noise_depends_on_the_pair_and_the_seed_alone():
    op = matcher(noise_px=1.0, outlier_share=0.1)
    _, _, grid, payloads = encoded(op)
    first = ask(op.session(), payloads, grid, [(0, 1), (1, 2)]).target
    other_order = ask(op.session(), payloads, grid, [(1, 2), (0, 1)]).target
    assert torch.equal(first, other_order.flip(0))
    reseeded = matcher(BuildContext(torch.device("cpu"), seed=6), noise_px=1.0, outlier_share=0.1)
    assert not torch.equal(first, ask(reseeded.session(), payloads, grid, [(0, 1), (1, 2)]).target)
    exact = ask(matcher().session(), payloads, grid, [(0, 1), (1, 2)]).target
    error = (first - exact).abs().amax(-1) * op.stride
    assert 0.02 < (error > 6).float().mean() < 0.2
    assert 0.3 < error.median() < 2


def test_session_answers_known_edges_again_until_forgotten():
    op = matcher()
    _, _, grid, payloads = encoded(op)
    session = op.session()
    first = ask(session, payloads, grid, [(0, 3)], ids=[7]).target
    # Nodes get other numbers when a keyframe is removed; the id still names the same edge.
    assert torch.equal(ask(session, payloads, grid, [(0, 2)], ids=[7]).target, first)
    session.forget([7, 99])
    assert not torch.equal(ask(session, payloads, grid, [(0, 2)], ids=[7]).target, first)


def test_motion_of_a_camera_at_rest_is_zero_even_while_things_move():
    op = matcher(scene="static")
    _, _, _, payloads = encoded(op)
    assert op.motion(payloads[0], payloads[5]).flow < 1e-9
    op = matcher()
    near, far = (op.motion(payloads[0], payloads[k]).flow for k in (1, 5))
    assert 0 < near < far


def test_frames_beyond_the_scene_are_refused():
    op = matcher(frames=4)
    source = reader().open("synthetic", Selection(skip=5))
    frame = Rectifier(source.camera, long_side=160)(next(source.frames()))
    with pytest.raises(UsageError, match="frames go from 0 to 3"):
        op.encode(frame, Grid.of(112, 160, op.stride, op.offset))
