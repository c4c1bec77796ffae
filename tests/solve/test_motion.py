"""The motion prior against autograd, and what it says of paths."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from droidw.geometry import se3
from droidw.solve.motion import steady_motion


def path(n=12, seed=0, rough=0.1):
    """A path with its times: turning, speeding up, keyframes at uneven times, some shaking."""
    g = torch.Generator().manual_seed(seed)
    times = torch.cumsum(torch.randint(1, 5, (n,), generator=g), 0).double() / 3
    s = times / times[-1]
    xi = torch.stack((2 * s, s.sin(), s**2, 0.4 * s, 0.8 * (2 * s).sin(), -0.2 * s), dim=1)
    xi = xi + rough * torch.randn(n, 6, generator=g, dtype=torch.float64)
    return se3.exp(xi), times


def jumps(T, times, speed=None):
    """Changes of velocity, as a share of the speed, and of turning rate, by root time, [N-2,6]."""
    dt = times[1:] - times[:-1]
    centres = se3.inv(T)[:, :3]
    velocity = (centres[1:] - centres[:-1]) / dt[:, None]
    rate = se3.log(se3.mul(T[1:], se3.inv(T[:-1])))[:, 3:] / dt[:, None]
    stands = 0.1 * velocity.detach().norm(dim=1).median() if speed is None else 0.1 * speed
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    change = (velocity[1:] - velocity[:-1]) / (mean.square().sum(1) + stands**2).sqrt()[:, None]
    both = torch.cat((change, rate[1:] - rate[:-1]), dim=1)
    return both / (0.5 * (dt[1:] + dt[:-1])).sqrt()[:, None]


def usual(T, times):
    e = jumps(T, times)
    squares = [part.square().sum(1).median() / 2.366 for part in (e[:, :3], e[:, 3:])]
    return torch.stack(squares).sqrt().repeat_interleave(3)


def lengths(e):
    """Squares of both changes, in thirds of what is usual, [N-2,2]."""
    return e.view(-1, 2, 3).square().sum(2) / 3


def energy(T, times, spread):
    return 27 * torch.log1p(lengths(jumps(T, times) / spread) / 9).sum()


def dense(term):
    """The matrix [6N,6N] of a term."""
    n = len(term.band)
    H = torch.zeros(n, 6, n, 6, dtype=torch.float64)
    for k in range(n):
        for m in range(min(3, k + 1)):
            H[k, :, k - m] = term.band[k, m]
            H[k - m, :, k] = term.band[k, m].T
    return H.view(6 * n, 6 * n)


def test_gradient_and_curvature_are_those_of_the_energy():
    T, times = path()
    spread = usual(T, times)

    dt = times[1:] - times[:-1]
    speed = ((se3.inv(T)[1:] - se3.inv(T)[:-1])[:, :3] / dt[:, None]).norm(dim=1).median()

    def stepped(xi):
        return jumps(se3.mul(se3.exp(xi), T), times, speed) / spread

    zero = torch.zeros(len(T), 6, dtype=torch.float64)
    J = torch.autograd.functional.jacobian(stepped, zero).flatten(2).flatten(0, 1)
    e = stepped(zero)
    kept = (1 / (1 + lengths(e) / 9)).repeat_interleave(3, dim=1).flatten()
    e = e.flatten()
    term = steady_motion(T, times, 0.7)
    n = len(T)
    H = dense(term)
    torch.testing.assert_close(H, 0.7 * J.T @ (kept[:, None] * J), atol=1e-8, rtol=1e-8)
    # all of the gradient but what is a change of scale
    expected = (-0.7 * J.T @ (kept * e)).view(n, 6)
    missing = expected - term.rhs
    larger = torch.zeros(n, 6, dtype=torch.float64)
    eps = 1e-6
    scaled = se3.inv(T).clone()
    scaled[:, :3] = scaled[0, :3] + (1 + eps) * (scaled[:, :3] - scaled[0, :3])
    larger[:, :3] = (se3.inv(scaled) - T)[:, :3] / eps
    share = (missing * larger).sum() / larger.square().sum()
    torch.testing.assert_close(missing, share * larger, atol=1e-5, rtol=1e-5)
    assert float((term.rhs * larger).sum()) == pytest.approx(0, abs=1e-4)


def test_steps_make_a_path_steadier_without_shrinking_it():
    T, times = path(rough=0.05)
    spread, length = usual(T, times), (se3.inv(T)[1:] - se3.inv(T)[0])[:, :3].norm()
    energies = [float(energy(T, times, spread))]
    for _ in range(10):
        term = steady_motion(T, times, 1.0)
        n = len(T)
        H = dense(term)
        H = H + 1e3 * torch.eye(6 * n, dtype=torch.float64)
        x = torch.linalg.solve(H, term.rhs.view(-1)).view(n, 6)
        assert float(term.energy(x)) < 0
        T = se3.retract(T, x)
        energies.append(float(energy(T, times, spread)))
    assert all(later < earlier for earlier, later in pairwise(energies))
    after = (se3.inv(T)[1:] - se3.inv(T)[0])[:, :3].norm()
    assert float(after / length) == pytest.approx(1, abs=0.03)


def test_scale_and_direction_of_time_change_nothing():
    T, times = path()
    here = steady_motion(T, times, 1.0)
    larger = T.clone()
    larger[:, :3] *= 5
    there = steady_motion(larger, times, 1.0)
    unit = torch.tensor([5.0, 5, 5, 1, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(there.rhs * unit, here.rhs)
    torch.testing.assert_close(there.band * unit[:, None] * unit, here.band)
    slow = steady_motion(T, 7 * times + 3, 1.0)
    torch.testing.assert_close(slow.rhs, here.rhs)
    back = steady_motion(T.flip(0), -times.flip(0), 1.0)
    falling = steady_motion(T.flip(0), times.flip(0), 1.0)
    torch.testing.assert_close(back.rhs, falling.rhs)
    # but for the choice of the first camera, which fixes what a change of scale is
    torch.testing.assert_close(back.band[:, 0].flip(0), here.band[:, 0])


def test_nothing_is_said_where_nothing_accelerates_or_little_is_known():
    T, times = path(n=7)
    assert steady_motion(T, times, 1.0) is None
    still = se3.identity(12, dtype=torch.float64)
    assert steady_motion(still, path()[1], 1.0) is None
