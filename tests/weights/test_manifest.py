"""The manifest of a run names the weights that were used, with their hashes."""

from __future__ import annotations

import hashlib
from types import SimpleNamespace

from droidw.config.resolve import ResolvedConfig
from droidw.config.schema import DroidwConfig
from droidw.plugin.component import Component
from droidw.plugin.weights import WeightsFile
from droidw.run.manifest import describe_parts

FILE = WeightsFile("acme", file="acme_v2.pth")


def test_weights_and_hashes_stand_beside_the_parts(tmp_path):
    (tmp_path / "acme_v2.pth").write_bytes(b"tensors")
    parts = {
        "depth": (Component("acme", "", lambda *_: None, weights=lambda _: (FILE,)), None),
        "features": (Component("cnn", "", lambda *_: None), None),
        "ba": (Component("torch", "", lambda *_: None), None),
    }
    built = SimpleNamespace(features=SimpleNamespace(weights_sha256="abc"), ba=object())
    found = describe_parts(ResolvedConfig(DroidwConfig(), parts), tmp_path, built)
    digest = hashlib.sha256(b"tensors").hexdigest()
    assert found["depth"]["weights"] == {"acme": {"file": "acme_v2.pth", "sha256": digest}}
    assert found["features"]["weights"] == {"own": {"sha256": "abc"}}
    assert "weights" not in found["ba"]


def test_a_file_that_changed_meanwhile_costs_no_result(tmp_path):
    (tmp_path / "acme_v2.pth").write_bytes(b"tensors")
    (tmp_path / "weights.json").write_text('{"acme": {"file": "acme_v2.pth", "sha256": "0"}}')
    part = Component("acme", "", lambda *_: None, weights=(FILE,))
    config = ResolvedConfig(DroidwConfig(), {"depth": (part, None)})
    assert describe_parts(config, tmp_path)["depth"]["weights"]["acme"]["sha256"] == ""
