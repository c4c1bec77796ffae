"""Conformance of bundle adjustment backends."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from droidw.geometry import projective, se3
from droidw.interfaces.bundle import BundleAdjuster
from droidw.solve.problem import BAProblem, Report, Step
from droidw.testing._contract import Subject, same, snapshot
from droidw.testing.scenes import Scene, SceneSpec

__all__ = ["bundle_adjuster"]

_STATUS = ("ok", "rejected", "singular", "nonfinite", "empty")
_INDICES = (0, 3, 6, 9)


def bundle_adjuster(subject: Subject) -> None:
    """See `droidw.testing.conformance.check_bundle_adjuster`."""
    part = subject.build(seed=3)
    subject.follows(part, BundleAdjuster)
    problem = _problem(subject)
    step = _step(subject, part, problem, "a plain problem")
    subject.expect(
        "status",
        step.report.status == "ok",
        f"a plain problem ends with status '{step.report.status}'",
    )
    subject.expect(
        "fresh",
        step.T_cw.data_ptr() != problem.T_cw.data_ptr()
        and step.disps.data_ptr() != problem.disps.data_ptr(),
        "the step returns the tensors of the problem instead of fresh ones",
    )
    again = _step(subject, subject.build(seed=3), problem, "a plain problem")
    if subject.device.type == "cpu":
        subject.expect("deterministic", same(step, again), "two steps on the same problem differ")
    order = torch.tensor([4, 0, 5, 2, 1, 3], device=subject.device)
    turned = _step(
        subject,
        part,
        dataclasses.replace(
            problem,
            ii=problem.ii[order],
            jj=problem.jj[order],
            target=problem.target[order],
            weight=problem.weight[order],
        ),
        "the same edges in another order",
    )
    subject.expect(
        "edge-order",
        _alike(turned, step),
        "the order of the edges changes the step",
    )
    _options_of_the_problem(subject, part, problem)
    _bad_numbers(subject, part, problem)
    _convergence(subject, part, problem)
    _information(subject, part, problem, step)


def _alike(one: Step, other: Step) -> bool:
    """Whether two ways of summing may have led to these."""
    return torch.allclose(one.T_cw, other.T_cw, atol=2e-4) and torch.allclose(
        one.disps, other.disps, atol=2e-3
    )


def _options_of_the_problem(subject: Subject, part: Any, problem: BAProblem) -> None:
    motion = _step(subject, part, dataclasses.replace(problem, motion_only=True), "motion only")
    subject.expect(
        "motion-only", same(motion.disps, problem.disps), "motion_only moved the disparities"
    )
    prior = torch.full_like(problem.disps, 0.4)
    pulled = _step(
        subject,
        part,
        dataclasses.replace(
            problem, weight=torch.zeros_like(problem.weight), prior=prior, prior_weight=1.0
        ),
        "a prior alone",
    )
    if pulled.report.status == "ok":
        subject.expect(
            "prior",
            bool(((pulled.disps - 0.4).abs() <= (problem.disps - 0.4).abs() + 1e-5).all()),
            "a depth prior alone does not draw the disparities towards itself",
        )
    bounded = _step(
        subject,
        part,
        dataclasses.replace(problem, min_disp=0.25, max_disp=0.3),
        "bounds on the disparity",
    )
    if bounded.report.status == "ok":
        ends = bounded.disps[torch.unique(problem.ii)]
        subject.expect(
            "bounds",
            bool((ends >= 0.25 - 1e-6).all() and (ends <= 0.3 + 1e-6).all()),
            "disparities leave min_disp..max_disp",
        )
    robust = _step(subject, part, dataclasses.replace(problem, huber=0.5), "a Huber kernel")
    subject.expect(
        "status",
        robust.report.status == "ok",
        f"with a Huber kernel the status is '{robust.report.status}'",
    )
    guarded = _step(subject, part, dataclasses.replace(problem, guard=True), "guard")
    subject.expect(
        "guard",
        guarded.report.status != "ok" or guarded.report.cost_after <= guarded.report.cost_before,
        "a guarded step raised the energy",
    )


def _information(subject: Subject, part: Any, problem: BAProblem, plain: Step) -> None:
    """Weights with a third channel, the off-diagonal of the information."""
    draw = torch.Generator().manual_seed(11)
    tilt = 2 * torch.rand(problem.weight.shape[:3], generator=draw).to(subject.device) - 1
    xy = (tilt * problem.weight.prod(-1).sqrt())[..., None]
    none, tilted = (
        dataclasses.replace(problem, weight=torch.cat((problem.weight, x), dim=-1))
        for x in (torch.zeros_like(xy), xy)
    )
    step = _step(subject, part, none, "an off-diagonal of zeros")
    subject.expect(
        "information",
        _alike(step, plain),
        "an off-diagonal of zeros changes the step",
    )
    step = _step(subject, part, tilted, "a full information")
    coords, valid = projective.reproject(
        problem.T_cw, problem.disps, problem.intrinsics, problem.ii, problem.jj
    )
    x, y = (problem.target - coords).double().unbind(-1)
    xx, yy, off = (tilted.weight * valid[..., None]).double().unbind(-1)
    energy = float((xx * x * x + 2 * off * x * y + yy * y * y).sum())
    found = step.report.cost_before
    subject.expect(
        "information",
        step.report.status == "ok" and abs(found - energy) < 1e-3 * energy,
        f"with a full information the status is '{step.report.status}' and the energy "
        f"{found:.6g}; {energy:.6g} is due",
    )


def _bad_numbers(subject: Subject, part: Any, problem: BAProblem) -> None:
    target, weight = problem.target.clone(), problem.weight.clone()
    target[0, 2, 3] = float("nan")
    weight[1, 0, 0, 0] = float("inf")
    spoilt = _step(
        subject,
        part,
        dataclasses.replace(problem, target=target, weight=weight),
        "NaN in a target and inf in a weight",
    )
    subject.expect(
        "bad-numbers",
        spoilt.report.dropped > 0,
        "measurements that are not finite are not counted in report.dropped",
    )
    nothing = _step(
        subject,
        part,
        dataclasses.replace(
            problem,
            ii=problem.ii[:0],
            jj=problem.jj[:0],
            target=problem.target[:0],
            weight=problem.weight[:0],
        ),
        "no edges",
    )
    subject.expect(
        "status",
        nothing.report.status == "empty",
        f"without edges the status is '{nothing.report.status}', not 'empty'",
    )
    _step(
        subject,
        part,
        dataclasses.replace(problem, weight=torch.zeros_like(problem.weight)),
        "weights that are all zero",
    )
    keep = (problem.ii != 3) & (problem.jj != 3)
    alone = _step(
        subject,
        part,
        dataclasses.replace(
            problem,
            ii=problem.ii[keep],
            jj=problem.jj[keep],
            target=problem.target[keep],
            weight=problem.weight[keep],
        ),
        "a frame without edges",
    )
    subject.expect(
        "isolated", same(alone.T_cw[3], problem.T_cw[3]), "a frame without edges was moved"
    )


def _convergence(subject: Subject, part: Any, problem: BAProblem) -> None:
    """Exact measurements and a perturbed start: the error must all but vanish."""
    state = dataclasses.replace(problem, ep=1e-3)
    start = _error(state)
    for _ in range(15):
        step = _step(subject, part, state, "a step towards convergence")
        state = dataclasses.replace(state, T_cw=step.T_cw, disps=step.disps)
    subject.expect(
        "converges",
        _error(state) < 0.05 * start,
        f"15 steps on exact measurements bring the mean error from {start:.3g} to "
        f"{_error(state):.3g} cells; less than a twentieth is due",
    )


def _error(problem: BAProblem) -> float:
    coords, valid = projective.reproject(
        problem.T_cw, problem.disps, problem.intrinsics, problem.ii, problem.jj
    )
    use = valid & (problem.weight[..., 0] > 0)
    return float((coords - problem.target).norm(dim=-1)[use].mean())


def _step(subject: Subject, part: Any, problem: BAProblem, label: str) -> Step:
    """One step, and the clauses that hold for every one."""
    before = snapshot(problem)
    with subject.calling(f"step on {label}"):
        step: Step = part.step(problem)
    subject.unchanged(f"the problem ({label})", before, problem)
    subject.expect(
        "shape",
        isinstance(step, Step) and isinstance(step.report, Report),
        f"step on {label} did not return a Step with a Report",
    )
    subject.tensor(
        f"T_cw after a step on {label}", step.T_cw, tuple(problem.T_cw.shape), (problem.T_cw.dtype,)
    )
    subject.tensor(
        f"disps after a step on {label}",
        step.disps,
        tuple(problem.disps.shape),
        (problem.disps.dtype,),
    )
    subject.expect(
        "status",
        step.report.status in _STATUS,
        f"the status '{step.report.status}' is not one of {', '.join(_STATUS)}",
    )
    norms = step.T_cw[:, 3:].norm(dim=-1)
    subject.expect(
        "unit",
        bool(((norms - 1).abs() < 1e-4).all()),
        f"a quaternion is not of unit length after a step on {label}",
    )
    subject.expect(
        "fixed",
        same(step.T_cw[problem.fixed], problem.T_cw[problem.fixed]),
        f"a fixed pose moved in a step on {label}",
    )
    if step.report.status != "ok":
        subject.expect(
            "status",
            same(step.T_cw, problem.T_cw) and same(step.disps, problem.disps),
            f"a step on {label} ends with status '{step.report.status}' but "
            "does not return its input",
        )
    return step


def _truth() -> tuple[torch.Tensor, ...]:
    """True poses and disparities of four frames on a 10x14 grid, and exact targets of six edges."""
    scene = Scene(SceneSpec(width=112, height=80, frames=10, fps=10.0, moving=False))
    y, x = np.mgrid[:10, :14].astype(np.float64)
    pixels = np.stack([x, y], axis=-1) * 8 + 3.5
    T_wc = torch.from_numpy(np.stack([scene.T_wc(k) for k in _INDICES]))
    disps = torch.from_numpy(np.stack([1 / scene.depth_at(k, pixels) for k in _INDICES]))
    edges = [(0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 1)]
    found = [scene.correspond(_INDICES[i], _INDICES[j], pixels) for i, j in edges]
    target = torch.from_numpy(np.stack([(f.target - 3.5) / 8 for f in found]))
    weight = torch.from_numpy(np.stack([f.visible for f in found])).double()
    K = torch.from_numpy(scene.intrinsics)
    K_grid = torch.cat([K[:2] / 8, (K[2:] - 3.5) / 8])
    return (
        se3.inv(T_wc),
        disps,
        K_grid,
        target,
        weight[..., None].expand(-1, -1, -1, 2),
        torch.tensor(edges).T,
    )


def _problem(subject: Subject) -> BAProblem:
    """The true scene, with poses and disparities perturbed; the first two poses are fixed."""
    T_cw, disps, K, target, weight, edges = _truth()
    draw = torch.Generator().manual_seed(5)
    nudge = 0.02 * torch.randn(4, 6, generator=draw, dtype=torch.float64)
    nudge[:2] = 0
    disps = disps * (1 + 0.1 * torch.randn(disps.shape, generator=draw, dtype=torch.float64))
    d = subject.device
    return BAProblem(
        T_cw=se3.retract(T_cw, nudge).float().to(d),
        disps=disps.float().to(d),
        intrinsics=K.float().to(d),
        ii=edges[0].to(d),
        jj=edges[1].to(d),
        target=target.float().to(d),
        weight=weight.float().contiguous().to(d),
        fixed=torch.tensor([True, True, False, False], device=d),
        damping=torch.full(disps.shape, 1e-6, device=d),
    )
