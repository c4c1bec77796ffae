"""The GPU kernels as far as they go without a GPU: order of work, tiles, building."""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from droidw.errors import MissingRequirementError
from droidw.plugin.component import BuildContext
from droidw.solve.problem import PoseTerm, Report, Step
from droidw_plugins.bundle import _kernel_calls, cuda_ba
from droidw_plugins.bundle._build import BuildError
from droidw_plugins.bundle._kernel_layout import TILE, make_kernel_layout
from droidw_plugins.bundle._kernel_solve import solve_dense, solve_tiled

ROOT = Path(__file__).resolve().parents[2]


def edges(pairs):
    return torch.tensor(pairs, dtype=torch.int64).T.contiguous()


def test_other_edges_in_the_same_number_are_noticed(make, backends):
    p, _, _ = make(noise=0.02)
    turned = torch.randperm(len(p.ii), generator=torch.Generator().manual_seed(3))
    q = replace(
        p, ii=p.ii[turned], jj=p.jj[turned], target=p.target[turned], weight=p.weight[turned]
    )
    adjuster = backends["host"]()
    adjuster.step(p)
    got = adjuster.step(q)
    expected = backends["host"]().step(q)
    assert torch.equal(got.T_cw, expected.T_cw)
    assert torch.equal(got.disps, expected.disps)


def test_an_edge_to_nowhere_is_refused(make, backends):
    p, _, _ = make()
    with pytest.raises(ValueError, match="jj"):
        backends["host"]().step(replace(p, jj=torch.full_like(p.jj, 9)))


def test_tiles_hold_a_term_of_poses_without_an_edge(make, backends):
    # 70 poses in three pieces, each in a tile of its own: the term alone joins them
    p, _, _ = make(n=70, h=3, w=4, reach=2, noise=0.005, ep=1e-2)
    wide = TILE // 6
    keep = p.ii // wide == p.jj // wide
    band = torch.zeros(70, 2, 6, 6, dtype=torch.float64)
    band[:, 0], band[:, 1] = 2 * torch.eye(6), -torch.eye(6)
    term = PoseTerm(band, torch.linspace(-1, 1, 420, dtype=torch.float64).view(70, 6))
    p = replace(
        p, ii=p.ii[keep], jj=p.jj[keep], target=p.target[keep], weight=p.weight[keep],
        damping=torch.full_like(p.disps, 1e-3), pose_term=term,
    )  # fmt: skip
    expected = backends["torch"]().step(p)
    for got in (backends["host"]().step(p), backends["host"](tiled_from=1).step(p)):
        torch.testing.assert_close(got.T_cw, expected.T_cw, atol=1e-9, rtol=0)
        torch.testing.assert_close(got.disps, expected.disps, atol=1e-8, rtol=0)


@pytest.mark.parametrize("motion_only", [False, True])
def test_tiles_give_the_step_of_the_dense_system(make, backends, motion_only):
    # 70 poses: three tiles a side, the last one in part; a loop joins the ends
    p, _, _ = make(n=70, h=3, w=4, reach=2, noise=0.005, ep=1e-2, motion_only=motion_only)
    ii, jj = torch.cat((p.ii, torch.tensor([0, 69]))), torch.cat((p.jj, torch.tensor([69, 0])))
    p = replace(
        p, ii=ii, jj=jj, target=torch.cat((p.target, p.target[:2])),
        weight=torch.cat((p.weight, 1e-3 * p.weight[:2])), damping=torch.full_like(p.disps, 1e-3),
    )  # fmt: skip
    dense, tiled = backends["host"](), backends["host"](tiled_from=1)
    expected, got = dense.step(p), tiled.step(p)
    assert expected.report.status == got.report.status == "ok"
    torch.testing.assert_close(got.T_cw, expected.T_cw, atol=1e-10, rtol=0)
    torch.testing.assert_close(got.disps, expected.disps, atol=1e-9, rtol=0)


def test_only_tiles_that_fill_are_kept():
    n = 10 * TILE // 6
    chain = [(k, k + 1) for k in range(n - 1)]
    plan = make_kernel_layout(*edges(chain), n, tiled_from=1).tiles
    assert plan.count == 10
    assert len(plan.index) == 10 + 9
    closed = make_kernel_layout(*edges([*chain, (0, n - 1)]), n, tiled_from=1).tiles
    # the loop's row fills from the first column on, and nothing else does
    assert len(closed.index) == 10 + 9 + 8


def test_a_singular_system_is_said_by_both_solvers():
    n = 2 * TILE // 6
    plan = make_kernel_layout(*edges([(k, k + 1) for k in range(n - 1)]), n, tiled_from=1).tiles
    g = torch.ones(6 * n, dtype=torch.float64)
    for pivot, good in ((1.0, True), (1e-9, False), (-1.0, False)):
        S = 2 * torch.eye(6 * n, dtype=torch.float64)
        S[5, 5] = pivot
        least = torch.full((6 * n,), 1e-6, dtype=torch.float64)
        x, factor, info = solve_dense(S, g)
        assert (int(info) == 0 and bool((factor.diagonal() ** 2 > least).all())) is good
        tiles = torch.zeros(len(plan.index), TILE, TILE, dtype=torch.float64)
        for k in range(plan.count):
            tiles[plan.index[k, k]] = S[k * TILE : (k + 1) * TILE, k * TILE : (k + 1) * TILE]
        y, solved = solve_tiled(tiles, plan, g, least)
        assert bool(solved) is good
        if good:
            torch.testing.assert_close(y, x)


def test_without_a_gpu_the_backend_says_so():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    assert cuda_ba.COMPONENT.available() == "no GPU visible"
    with pytest.raises(MissingRequirementError, match="no GPU"):
        cuda_ba.COMPONENT.factory(
            cuda_ba.CudaBundleOptions(), BuildContext(device=torch.device("cuda"))
        )


def test_a_library_of_another_kind_is_refused(tmp_path):
    wrong = tmp_path / "wrong.so"
    wrong.write_bytes(b"no library at all")
    with pytest.raises(BuildError, match="cannot be loaded"):
        _kernel_calls.KernelLibrary(wrong)


def test_a_library_made_beforehand_has_to_be_there(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setenv(_kernel_calls.PREBUILT_VARIABLE, str(tmp_path / "gone.so"))
    with pytest.raises(BuildError, match=r"DROIDW_CUDA_KERNELS names .*gone\.so, which is no file"):
        _kernel_calls.KernelLibrary.for_cuda()


@pytest.mark.parametrize("status", ["singular", None])
def test_kernels_that_cannot_run_are_refused_before_a_run(monkeypatch, status):
    """As with a driver older than the compiler: all is well until the first launch."""

    class Failing:
        def __init__(self, options, device):
            pass

        def step(self, problem):
            if status is None:
                raise RuntimeError("35 CUDA driver version is insufficient")
            return Step(problem.T_cw, problem.disps, Report(status, 1.0))

    monkeypatch.setattr(cuda_ba, "CudaBundleAdjuster", Failing)
    with pytest.raises(MissingRequirementError, match="ba 'cuda' cannot run here") as error:
        cuda_ba.COMPONENT.factory(
            cuda_ba.CudaBundleOptions(), BuildContext(device=torch.device("cpu"))
        )
    assert (status or "driver version") in error.value.message
    assert "ba=torch" in error.value.hint


def needs_nvcc():
    if not _kernel_calls.nvcc_path():
        pytest.skip("no nvcc here")


def test_machine_code_is_made_for_the_gpu_and_ptx_is_kept():
    needs_nvcc()
    known = _kernel_calls.known_architectures(_kernel_calls.nvcc_path())
    assert known and min(known) >= 75 and max(known) <= 121
    assert "code=[sm_90,compute_90]" in _kernel_calls.cuda_flags(90)[-1]


def cuda_check(tmp_path, architectures):
    library = tmp_path / "cuda.so"
    done = subprocess.run(
        ["make", "--no-print-directory", "cuda-check", f"ARGS={library}"],
        cwd=ROOT, env={**os.environ, "ARCHITECTURES": architectures},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout, library


def test_the_cuda_kernels_compile_and_offer_what_is_called(tmp_path):
    needs_nvcc()
    said, library = cuda_check(tmp_path, "75")
    assert "sm_75" in said
    loaded = _kernel_calls.KernelLibrary(library)  # needs no GPU
    names = "system finish move energy frame_distance confirmed_views"
    for name in [*names.split(), "pair_values", "pair_gradient", "parameter_gradient"]:
        assert hasattr(loaded._library, f"dw_{name}")


@pytest.mark.slow
def test_the_cuda_kernels_compile_for_every_architecture(tmp_path):
    needs_nvcc()
    said, _ = cuda_check(tmp_path, "")
    for architecture in _kernel_calls.known_architectures(_kernel_calls.nvcc_path()):
        assert f"sm_{architecture}" in said
