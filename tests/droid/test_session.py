"""Sessions: what they remember of edges, for how long, and in how much memory."""

from __future__ import annotations

import pytest
import torch

from droidw_plugins.correspondence import _droid_session
from droidw_plugins.correspondence._droid import DroidKeyframe
from droidw_plugins.correspondence._droid_net import motion_features, upsample_convex

PAIRS = [(1, 0), (0, 1), (2, 1), (1, 2), (3, 1)]


@pytest.fixture
def part(operator):
    return operator()


@pytest.fixture
def payloads(part, encoded):
    return encoded(part)


def close(a, b, limit=1e-4):
    return float((a - b).norm() / b.norm()) < limit


def test_one_update_is_one_round_of_the_network(part, payloads, ask, net):
    request = ask(payloads, PAIRS)
    answer = part.session().update(request)
    grid = torch.stack(torch.meshgrid(torch.arange(12.0), torch.arange(8.0), indexing="xy"), -1)
    from droidw_plugins.correspondence._droid_corr import Pyramid, lookup, volume

    pyramid = Pyramid(8, 12)
    with torch.no_grad():
        volumes = [volume(payloads[i].fmap, pyramid.features(payloads[j].fmap)) for i, j in PAIRS]
        corr = lookup(volumes, request.coords, pyramid)
        # a new edge has measured nothing yet: its target is where geometry puts it
        motion = motion_features(request.coords, request.coords, grid)
        hidden = torch.stack([payloads[i].net for i, _ in PAIRS])
        inp = torch.stack([payloads[i].inp for i, _ in PAIRS])
        new = net.update(hidden, inp, corr, motion)
        gathered = {
            source: new.gathered[[n for n, (i, _) in enumerate(PAIRS) if i == source]].mean(0)
            for source in (0, 1, 2, 3)
        }
        features = net.update.features(torch.stack(list(gathered.values())))
        eta, mask = net.update.damping(features), net.update.upmask(features)
    assert close(answer.target, request.coords + new.delta)
    assert close(answer.confidence, new.weight)
    assert answer.sources == [0, 1, 2, 3]
    assert close(answer.damping, eta) and close(answer.upmask, mask)


def test_the_second_update_goes_on_from_the_first(part, payloads, ask, net):
    session = part.session()
    first = session.update(ask(payloads, PAIRS))
    second = session.update(ask(payloads, PAIRS, shift=0.2))
    fresh = part.session().update(ask(payloads, PAIRS, shift=0.2))
    assert not close(second.target, fresh.target, 1e-3)
    state = session._edges[2]
    assert torch.equal(state.target, second.target[2])
    assert not torch.equal(state.net, payloads[2].net)
    assert not torch.equal(first.target, second.target)


def test_a_forgotten_edge_starts_anew(part, payloads, ask):
    session = part.session()
    first = session.update(ask(payloads, PAIRS))
    session.update(ask(payloads, PAIRS))
    session.forget([0, 3, 99])
    assert set(session._edges) == {1, 2, 4}
    again = session.update(ask(payloads, PAIRS))
    for row in range(len(PAIRS)):
        assert close(again.target[row], first.target[row]) == (row in (0, 3))


def test_an_edge_is_known_by_its_id_not_by_its_frames(part, payloads, ask):
    session = part.session()
    session.update(ask(payloads, PAIRS))
    second = session.update(ask(payloads, PAIRS))
    other = part.session()
    other.update(ask(payloads, PAIRS))
    # a keyframe before all others was removed: every number is one less
    shifted = [(i + 1, j + 1) for i, j in PAIRS]
    renumbered = ask([None, *payloads], shifted)
    renumbered = type(renumbered)(
        renumbered.ids, renumbered.ii, renumbered.jj, ask(payloads, PAIRS).coords,
        renumbered.valid, renumbered.payload,
    )  # fmt: skip
    assert torch.equal(other.update(renumbered).target, second.target)


def test_order_and_batches_do_not_matter(part, payloads, ask, monkeypatch):
    whole = part.session().update(ask(payloads, PAIRS))
    turned = part.session().update(ask(payloads, PAIRS[::-1]))
    assert close(turned.target.flip(0), whole.target, 1e-5)
    monkeypatch.setattr(_droid_session, "_TOGETHER", {"cpu": 1})
    bit_by_bit = part.session().update(ask(payloads, PAIRS))
    assert close(bit_by_bit.target, whole.target, 1e-5)
    assert close(bit_by_bit.damping, whole.damping, 1e-5)
    assert close(bit_by_bit.upmask, whole.upmask, 1e-5)


@pytest.mark.parametrize("options", [
    {"correlation": "lowmem"},
    {"correlation": "auto", "volume_mb": 0},
], ids=["lowmem", "no room"])  # fmt: skip
def test_low_memory_gives_the_same(operator, encoded, ask, options):
    part, lean = operator(correlation="volume"), operator(**options)
    payloads = encoded(part)
    kept, thrown = part.session(), lean.session()
    for shift in (0.0, 0.3):
        a = kept.update(ask(payloads, PAIRS, shift=shift))
        b = thrown.update(ask(payloads, PAIRS, shift=shift))
        assert close(b.target, a.target, 1e-5) and close(b.damping, a.damping, 1e-4)
    assert all(edge.volume is None for edge in thrown._edges.values())


def test_volumes_are_kept_while_there_is_room(operator, encoded, ask):
    cells = 96 * (96 + 24 + 6 + 1) * 4
    part = operator()
    payloads = encoded(part)
    session = part.session()
    session._room = 2.5 * cells
    answer = session.update(ask(payloads, PAIRS))
    kept = [name for name, edge in session._edges.items() if edge.volume is not None]
    assert len(kept) == 2
    session.forget(kept[:1])
    session.update(ask(payloads, PAIRS))
    assert session._edges[kept[0]].volume is not None
    assert close(answer.target, part.session().update(ask(payloads, PAIRS)).target, 1e-5)


def test_purposes(part, payloads, ask):
    request = ask(payloads, PAIRS)
    window, everything, fill = (part.session(p) for p in ("window", "global", "fill"))
    expected = window.update(request)
    found, filled = everything.update(request), fill.update(request)
    assert torch.allclose(found.target, expected.target) and found.upmask is None
    assert torch.allclose(found.damping, expected.damping)
    assert all(edge.volume is None for edge in everything._edges.values())
    assert torch.allclose(filled.target, expected.target, atol=1e-5)
    assert filled.damping is None and filled.sources is None and filled.upmask is None
    assert all(edge.volume is not None for edge in fill._edges.values())


def test_filling_needs_no_context_of_the_frames_filled(part, payloads, ask, frames, grid):
    bare = part.encode(frames[3], grid)
    answer = part.session("fill").update(ask([*payloads[:3], bare], [(0, 3), (1, 3)]))
    assert torch.isfinite(answer.target).all()


def test_no_edges(part, payloads, ask):
    answer = part.session().update(ask(payloads, PAIRS[:0]))
    assert answer.target.shape == (0, 8, 12, 2) and answer.damping is None


def test_upsampling_after_the_last_update(operator, encoded, ask, net):
    part = operator()
    payloads = encoded(part)
    session = part.session("global")
    disp = torch.rand(8, 12) + 0.5
    assert session.upsample(1, disp) is None
    session.update(ask(payloads, PAIRS))
    window = part.session().update(ask(payloads, PAIRS))
    fine = session.upsample(1, disp)
    assert fine.shape == (64, 96)
    assert torch.allclose(fine, upsample_convex(disp[None], window.upmask[1:2])[0], atol=1e-4)
    assert float(fine.min()) > 0.49 and float(fine.max()) < 1.51
    published = operator(published=True).session("global")
    published.update(ask(payloads, PAIRS))
    assert float(published.upsample(1, disp)[0, 0]) < float(fine[0, 0])


def test_memory_at_512x384(operator):
    """REFERENCE 7.3, in the default precision: 26 MB per volume edge, 5.0 MB per keyframe."""
    from droidw.geometry.projective import pixel_grid
    from droidw.interfaces.correspondence import EdgeRequest

    part = operator(store="half")
    g = torch.Generator().manual_seed(0)
    maps = [torch.rand(128, 48, 64, generator=g).half() for _ in range(3)]
    payloads = [DroidKeyframe(k, *maps) for k in range(2)]
    coords = pixel_grid(48, 64)[None]
    request = EdgeRequest([0], [0], [1], coords, coords[..., 0] > -1, payloads.__getitem__)
    sessions = {}
    for mode in ("volume", "lowmem"):
        part.options = type(part.options)(correlation=mode)
        sessions[mode] = part.session()
        sessions[mode]._state(request, [0], coords)
    hidden = 128 * 48 * 64 * 2
    assert sessions["volume"]._edges[0].volume.nbytes < 26e6
    assert sessions["volume"].nbytes < 26e6
    assert sessions["lowmem"].nbytes < 0.84e6 and sessions["lowmem"].nbytes > hidden
    payload = sum(m.nbytes for m in maps)
    features, small_maps = 384 * 48 * 64 * 2, 8 * 48 * 64 * 4
    assert payload + features + small_maps < 5.0e6
