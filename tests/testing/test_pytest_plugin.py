"""The fixtures that droidw brings into every pytest session."""

import subprocess
import sys

import torch

from droidw_plugins.features.none import COMPONENT as NONE
from droidw_plugins.uncertainty.affine_softplus import COMPONENT as AFFINE


def test_fixtures(device, scene, droidw_build):
    assert isinstance(device, torch.device)
    assert scene.render(0).image.shape == (scene.spec.height, scene.spec.width, 3)
    assert droidw_build(NONE).dim == 0
    assert droidw_build(AFFINE, seed=3, lr=0.05).fields == droidw_build(AFFINE).fields


def test_the_plugin_costs_other_projects_nothing():
    code = (
        "import sys, droidw.testing.pytest_plugin\n"
        "print([m for m in ('torch', 'cv2', 'kornia') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
