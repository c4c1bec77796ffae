// One cell of one edge: projection, Jacobians, residual, robust weight (REFERENCE 2.2, 2.3, 3.1).
//
// R is a number (float, double) or a pack of them; S is its element. The same functions run in a
// CUDA thread, in a plain loop, and over SIMD registers. With CROSS the information of a match has
// an off-diagonal part; without it that part does not exist in what is compiled.
#pragma once

#include "real.h"

namespace dw {

// Least relative depth of a usable cell; droidw.geometry.projective.NEAR.
constexpr double NEAR_DEPTH = 0.25;
// Least information along x, as a share of that along y, that is divided by: below it the cross term,
// which is at most their geometric mean, is left out.
constexpr double LEAST_PIVOT = 1e-12;

template <class S>
struct Camera {
    S fx, fy, cx, cy;
};

// G_ij = T_j T_i^-1 as rotation (row by row) and translation.
template <class S>
struct Motion {
    S R[9], t[3];
};

// Place in the image plane of j: a = X / Z, b = Y / Z, with Z clamped to the near plane.
template <class R>
struct Seen {
    R a, b, inv_z, ok;
};

template <class R, class S>
DW_HD Seen<R> project(const Motion<S>& G, R ray_x, R ray_y, R d) {
    const R X = fill<R>(G.R[0]) * ray_x + (fill<R>(G.R[1]) * ray_y + (fill<R>(G.t[0]) * d + fill<R>(G.R[2])));
    const R Y = fill<R>(G.R[3]) * ray_x + (fill<R>(G.R[4]) * ray_y + (fill<R>(G.t[1]) * d + fill<R>(G.R[5])));
    const R Z = fill<R>(G.R[6]) * ray_x + (fill<R>(G.R[7]) * ray_y + (fill<R>(G.t[2]) * d + fill<R>(G.R[8])));
    const R nearest = fill<R>(S(NEAR_DEPTH)), one = fill<R>(S(1)), zero = fill<R>(S(0));
    Seen<R> p;
    p.ok = select(Z >= nearest, one, zero);
    p.inv_z = one / at_least(Z, nearest);
    p.a = X * p.inv_z;
    p.b = Y * p.inv_z;
    return p;
}

// Relative depth alone, for the near test.
template <class R, class S>
DW_HD R depth_ratio(const Motion<S>& G, R ray_x, R ray_y, R d) {
    return fill<R>(G.R[6]) * ray_x + (fill<R>(G.R[7]) * ray_y + (fill<R>(G.t[2]) * d + fill<R>(G.R[8])));
}

// What was measured of a cell: its place, and the information [[wu, cross], [cross, wv]] of that.
template <class R>
struct Match {
    R tu, tv, wu, wv, cross;
};

// Weighted measurement of a cell. `wu`, `wv` hold the robust weight already. With CROSS the residual
// u is that of u + k v, so that the weights are those of two independent measurements.
template <class R>
struct Measured {
    R ru, rv, wu, wv, energy, k;
};

// Residual, weights 0 where `ok` is 0, Huber weight and robust energy (huber < 0: quadratic).
template <bool CROSS, class R, class S>
DW_HD Measured<R> measure(
    const Camera<S>& K, const Seen<R>& p, R ok, const Match<R>& t, S huber) {
    Measured<R> m;
    m.ru = t.tu - (fill<R>(K.fx) * p.a + fill<R>(K.cx));
    m.rv = t.tv - (fill<R>(K.fy) * p.b + fill<R>(K.cy));
    R sum;
    if constexpr (CROSS) {
        // r^T W r = wu (ru + k rv)^2 + (wv - cross k) rv^2; the last pivot may be rounding
        const R zero = fill<R>(S(0));
        m.k = select(t.wu > fill<R>(S(LEAST_PIVOT)) * t.wv, t.cross / t.wu, zero);
        m.ru = m.ru + m.k * m.rv;
        m.wu = t.wu * ok;
        m.wv = at_least(t.wv - t.cross * m.k, zero) * ok;
        sum = (t.wu + t.wv) * ok;
    } else {
        m.wu = t.wu * ok;
        m.wv = t.wv * ok;
        sum = m.wu + m.wv;
    }
    m.energy = m.wu * m.ru * m.ru + m.wv * m.rv * m.rv;
    if (huber >= S(0)) {
        // one over the squared residual length: infinite where the residual or the weight is 0
        const R mean = at_least(fill<R>(S(0.5)) * sum, fill<R>(Limits<S>::tiny));
        const R share = mean / m.energy * fill<R>(huber * huber);
        const R knee = select(share < fill<R>(S(1)), root(share), fill<R>(S(1)));
        m.wu = m.wu * knee;
        m.wv = m.wv * knee;
        m.energy = m.energy * (knee * (fill<R>(S(2)) - knee));
    }
    return m;
}

// A measurement that is not finite, or whose information is below 0, gets the weight and target 0;
// returns 1 where it was dropped.
template <bool CROSS, class R>
DW_HD R drop_unusable(Match<R>& t) {
    using S = element<R>;
    const R zero = fill<R>(S(0)), one = fill<R>(S(1));
    auto usable = both(
        finite_number(t.wu * (t.tu * t.tu)), finite_number(t.wv * (t.tv * t.tv)));
    usable = both(usable, both(t.wu >= zero, t.wv >= zero));
    if constexpr (CROSS) {
        usable = both(usable, finite_number(t.cross * (t.tu * t.tv)));
        t.cross = select(usable, t.cross, zero);
    }
    t.tu = select(usable, t.tu, zero);
    t.tv = select(usable, t.tv, zero);
    t.wu = select(usable, t.wu, zero);
    t.wv = select(usable, t.wv, zero);
    return select(usable, zero, one);
}

// Linearised cell. Rows of the Jacobian with respect to the target's pose, in normalised image
// units: u = (h, u1, u2, u3, u4, u5) and v = (0, h, v2, v3, v4, v5); the focal length is in su,
// sv (weight of a product of two rows) and gu, gv (weight times residual). u1 is 0 without CROSS.
template <class R>
struct Linear {
    R h, u1, u2, u3, u4, u5, v2, v3, v4, v5;
    R zu, zv;  // derivative with respect to the disparity of the cell
    R su, sv, gu, gv;
};

template <bool CROSS, class R, class S>
DW_HD Linear<R> linearise(
    const Camera<S>& K, const Motion<S>& G, const Seen<R>& p, const Measured<R>& m, R d) {
    const R one = fill<R>(S(1)), fx = fill<R>(K.fx), fy = fill<R>(K.fy);
    const R tx = fill<R>(G.t[0]), ty = fill<R>(G.t[1]), tz = fill<R>(G.t[2]);
    Linear<R> l;
    l.h = d * p.inv_z;
    const R ab = p.a * p.b;
    l.u2 = -(p.a * l.h);
    l.u3 = -ab;
    l.u4 = one + p.a * p.a;
    l.u5 = -p.b;
    l.v2 = -(p.b * l.h);
    l.v3 = -(one + p.b * p.b);
    l.v4 = ab;
    l.v5 = p.a;
    l.zu = p.inv_z * (tx - tz * p.a);
    l.zv = p.inv_z * (ty - tz * p.b);
    if constexpr (CROSS) {
        const R k = m.k * fill<R>(K.fy / K.fx);
        l.u1 = k * l.h;
        l.u2 = l.u2 + k * l.v2;
        l.u3 = l.u3 + k * l.v3;
        l.u4 = l.u4 + k * l.v4;
        l.u5 = l.u5 + k * l.v5;
        l.zu = l.zu + k * l.zv;
    }
    const R wfu = m.wu * fx, wfv = m.wv * fy;
    l.su = wfu * fx;
    l.sv = wfv * fy;
    l.gu = wfu * m.ru;
    l.gv = wfv * m.rv;
    return l;
}

// Entries of the upper triangle of the 6x6 block, row by row, and the right side.
constexpr int HESSIAN = 21, GRADIENT = 6, POSE_SUMS = HESSIAN + GRADIENT;

DW_HD constexpr int upper(int r, int c) { return r * 6 - r * (r - 1) / 2 + (c - r); }

// Adds W J_j^T J_j and W J_j^T r of a cell to POSE_SUMS sums.
template <bool CROSS, class R>
DW_HD void add_pose_sums(const Linear<R>& l, R* sums) {
    const R uh = l.su * l.h, u2 = l.su * l.u2, u3 = l.su * l.u3, u4 = l.su * l.u4;
    const R vh = l.sv * l.h, v2 = l.sv * l.v2, v3 = l.sv * l.v3, v4 = l.sv * l.v4;
    sums[upper(0, 0)] += uh * l.h;
    sums[upper(0, 2)] += uh * l.u2;
    sums[upper(0, 3)] += uh * l.u3;
    sums[upper(0, 4)] += uh * l.u4;
    sums[upper(0, 5)] += uh * l.u5;
    sums[upper(1, 1)] += vh * l.h;
    sums[upper(1, 2)] += vh * l.v2;
    sums[upper(1, 3)] += vh * l.v3;
    sums[upper(1, 4)] += vh * l.v4;
    sums[upper(1, 5)] += vh * l.v5;
    sums[upper(2, 2)] += u2 * l.u2 + v2 * l.v2;
    sums[upper(2, 3)] += u2 * l.u3 + v2 * l.v3;
    sums[upper(2, 4)] += u2 * l.u4 + v2 * l.v4;
    sums[upper(2, 5)] += u2 * l.u5 + v2 * l.v5;
    sums[upper(3, 3)] += u3 * l.u3 + v3 * l.v3;
    sums[upper(3, 4)] += u3 * l.u4 + v3 * l.v4;
    sums[upper(3, 5)] += u3 * l.u5 + v3 * l.v5;
    sums[upper(4, 4)] += u4 * l.u4 + v4 * l.v4;
    sums[upper(4, 5)] += u4 * l.u5 + v4 * l.v5;
    sums[upper(5, 5)] += l.su * l.u5 * l.u5 + l.sv * l.v5 * l.v5;
    sums[HESSIAN + 0] += l.gu * l.h;
    sums[HESSIAN + 1] += l.gv * l.h;
    sums[HESSIAN + 2] += l.gu * l.u2 + l.gv * l.v2;
    sums[HESSIAN + 3] += l.gu * l.u3 + l.gv * l.v3;
    sums[HESSIAN + 4] += l.gu * l.u4 + l.gv * l.v4;
    sums[HESSIAN + 5] += l.gu * l.u5 + l.gv * l.v5;
    if constexpr (CROSS) {
        const R u1 = l.su * l.u1;
        sums[upper(0, 1)] += uh * l.u1;
        sums[upper(1, 1)] += u1 * l.u1;
        sums[upper(1, 2)] += u1 * l.u2;
        sums[upper(1, 3)] += u1 * l.u3;
        sums[upper(1, 4)] += u1 * l.u4;
        sums[upper(1, 5)] += u1 * l.u5;
        sums[HESSIAN + 1] += l.gu * l.u1;
    }
}

// E: W J_j^T J_z of a cell, six values.
template <bool CROSS, class R>
DW_HD void coupling(const Linear<R>& l, R* E) {
    const R eu = l.su * l.zu, ev = l.sv * l.zv;
    E[0] = eu * l.h;
    E[1] = ev * l.h;
    E[2] = eu * l.u2 + ev * l.v2;
    E[3] = eu * l.u3 + ev * l.v3;
    E[4] = eu * l.u4 + ev * l.v4;
    E[5] = eu * l.u5 + ev * l.v5;
    if constexpr (CROSS) E[1] = E[1] + eu * l.u1;
}

// E^T y of a cell, without E.
template <bool CROSS, class R, class S>
DW_HD R coupled_step(const Linear<R>& l, const S* y) {
    R u = l.h * fill<R>(y[0]) + l.u2 * fill<R>(y[2]) + l.u3 * fill<R>(y[3]) +
          l.u4 * fill<R>(y[4]) + l.u5 * fill<R>(y[5]);
    if constexpr (CROSS) u = u + l.u1 * fill<R>(y[1]);
    const R v = l.h * fill<R>(y[1]) + l.v2 * fill<R>(y[2]) + l.v3 * fill<R>(y[3]) +
                l.v4 * fill<R>(y[4]) + l.v5 * fill<R>(y[5]);
    return l.su * l.zu * u + l.sv * l.zv * v;
}

// W J_z^2 and W J_z r of a cell.
template <class R>
DW_HD R depth_curvature(const Linear<R>& l) {
    return l.su * l.zu * l.zu + l.sv * l.zv * l.zv;
}
template <class R>
DW_HD R depth_gradient(const Linear<R>& l) {
    return l.gu * l.zu + l.gv * l.zv;
}

// The depth diagonal with prior or damping, its inverse Q (0 where it is 0), and the right side
// (REFERENCE 3.2). prior is 0 where there is none.
template <class R>
struct Depth {
    R Q, rhs;
};

template <class R, class S>
DW_HD Depth<R> depth_system(R C, R w, R d, R damping, R prior, S prior_weight) {
    const R zero = fill<R>(S(0)), one = fill<R>(S(1)), gamma = fill<R>(prior_weight);
    const auto known = prior > zero;
    C = C + select(known, gamma, damping);
    Depth<R> out;
    out.rhs = w - select(known, gamma * (d - prior), zero);
    out.Q = select(C > fill<R>(Limits<S>::tiny * S(1e8)), one / C, zero);
    return out;
}

}  // namespace dw
