"""SE(3): against the matrix exponential, against pypose, and against its own laws."""

from __future__ import annotations

import math

import pytest
import torch

from droidw.geometry import se3

ANGLES = (0.0, 1e-12, 1e-8, 1e-4, 1e-2, 0.4999, 0.5001, 1.0, 2.0, 3.0, math.pi - 1e-6)


def twist_matrix(xi):
    M = torch.zeros(*xi.shape[:-1], 4, 4, dtype=torch.float64)
    M[..., :3, :3] = se3.skew(xi[..., 3:].double())
    M[..., :3, 3] = xi[..., :3]
    return M


def random_twist(n, angle, dtype, seed=0):
    g = torch.Generator().manual_seed(seed)
    xi = torch.randn(n, 6, generator=g, dtype=torch.float64)
    xi[:, 3:] *= angle / xi[:, 3:].norm(dim=1, keepdim=True)
    return xi.to(dtype)


@pytest.fixture
def T():
    g = torch.Generator().manual_seed(3)
    return se3.exp(torch.randn(32, 6, generator=g, dtype=torch.float64))


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(("dtype", "tol"), [(torch.float64, 2e-14), (torch.float32, 2e-6)])
def test_exp_is_the_matrix_exponential(angle, dtype, tol):
    xi = random_twist(20, angle, dtype)
    expected = torch.linalg.matrix_exp(twist_matrix(xi))
    torch.testing.assert_close(se3.matrix(se3.exp(xi)).double(), expected, atol=tol, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(("dtype", "tol"), [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_log_undoes_exp(angle, dtype, tol):
    xi = random_twist(20, angle, dtype)
    torch.testing.assert_close(se3.log(se3.exp(xi)), xi, atol=tol, rtol=0)


def test_log_takes_the_shorter_way(T):
    opposite = torch.cat((T[:, :3], -T[:, 3:]), dim=1)
    torch.testing.assert_close(se3.log(opposite), se3.log(T), atol=1e-14, rtol=0)
    long_turn = se3.log(se3.exp(random_twist(5, 1.5 * math.pi, torch.float64)))
    torch.testing.assert_close(
        long_turn[:, 3:].norm(dim=1), torch.full((5,), 0.5 * math.pi, dtype=torch.float64)
    )


def test_small_translation_keeps_its_digits():
    xi = torch.tensor([1e-9, -2e-9, 3e-9, 1e-10, 0.0, -1e-10])
    torch.testing.assert_close(se3.log(se3.exp(xi)), xi, atol=0, rtol=1e-6)


def test_agrees_with_pypose(T):
    pypose = pytest.importorskip("pypose", reason="pypose comes with the test extra")
    xi = random_twist(32, 1.3, torch.float64, seed=5)
    theirs = pypose.se3(xi).Exp()
    torch.testing.assert_close(se3.exp(xi), theirs.tensor(), atol=1e-13, rtol=0)
    torch.testing.assert_close(se3.log(T), pypose.SE3(T).Log().tensor(), atol=1e-12, rtol=0)
    product = (pypose.SE3(T) @ theirs).tensor()
    torch.testing.assert_close(
        se3.matrix(se3.mul(T, se3.exp(xi))), pypose.SE3(product).matrix(), atol=1e-13, rtol=0
    )
    torch.testing.assert_close(
        (se3.adjoint(T) @ xi[..., None])[..., 0],
        pypose.SE3(T).Adj(pypose.se3(xi)).tensor(),
        atol=1e-12,
        rtol=0,
    )


def test_group_laws(T):
    S = se3.exp(random_twist(32, 0.7, torch.float64, seed=9))
    eye = torch.eye(4, dtype=torch.float64).expand(32, 4, 4)
    close = {"atol": 1e-13, "rtol": 0}
    torch.testing.assert_close(se3.matrix(se3.mul(T, se3.inv(T))), eye, **close)
    torch.testing.assert_close(se3.matrix(se3.mul(T, S)), se3.matrix(T) @ se3.matrix(S), **close)
    torch.testing.assert_close(se3.mul(se3.identity(dtype=torch.float64), T), T, **close)
    X = torch.randn(32, 3, dtype=torch.float64)
    moved = se3.matrix(T)[:, :3, :3] @ X[..., None] + se3.matrix(T)[:, :3, 3:]
    torch.testing.assert_close(se3.act(T, X), moved[..., 0], **close)
    assert se3.act(T[:, None], X).shape == (32, 32, 3)


def test_adjoint_moves_a_twist_through_a_motion(T):
    xi = random_twist(32, 0.5, torch.float64, seed=11)
    left = se3.mul(se3.exp((se3.adjoint(T) @ xi[..., None])[..., 0]), T)
    right = se3.mul(T, se3.exp(xi))
    torch.testing.assert_close(se3.matrix(left), se3.matrix(right), atol=1e-12, rtol=0)


def test_adjoint_transpose_on_rows(T):
    a = torch.randn(32, 6, dtype=torch.float64)
    R_t = se3.rotation(T).transpose(1, 2)
    spin = a[:, 3:] - torch.linalg.cross(T[:, :3], a[:, :3])
    expected = torch.cat(((R_t @ a[:, :3, None])[..., 0], (R_t @ spin[..., None])[..., 0]), dim=1)
    got = (se3.adjoint(T).transpose(1, 2) @ a[..., None])[..., 0]
    torch.testing.assert_close(got, expected, atol=1e-13, rtol=0)


@pytest.mark.parametrize("angle", [*ANGLES, math.pi])
def test_from_matrix_for_every_angle(angle):
    T = se3.exp(random_twist(64, angle, torch.float64, seed=2))
    M = se3.matrix(T)
    torch.testing.assert_close(se3.matrix(se3.from_matrix(M)), M, atol=1e-14, rtol=0)
    torch.testing.assert_close(se3.from_matrix(M[:, :3]), se3.from_matrix(M))


def test_retraction_is_on_the_left_and_keeps_unit_quaternions(T):
    xi = random_twist(32, 0.3, torch.float64, seed=4)
    expected = torch.linalg.matrix_exp(twist_matrix(xi)) @ se3.matrix(T)
    torch.testing.assert_close(se3.matrix(se3.retract(T, xi)), expected, atol=1e-13, rtol=0)
    moved = T.float()
    for _ in range(500):
        moved = se3.retract(moved, xi.float())
    lengths = moved[:, 3:].norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(32), atol=3e-7, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0])
def test_derivatives_exist_everywhere(angle):
    xi = random_twist(3, angle, torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(se3.exp, (xi,), atol=1e-6)
    assert torch.autograd.gradcheck(lambda x: se3.log(se3.exp(x)), (xi,), atol=1e-6)


def test_empty_batch():
    none = torch.zeros(0, 6)
    assert se3.exp(none).shape == (0, 7)
    assert se3.log(se3.exp(none)).shape == (0, 6)
    assert se3.adjoint(se3.exp(none)).shape == (0, 6, 6)
