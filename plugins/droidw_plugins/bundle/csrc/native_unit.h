// What one thread does: the cells of one source keyframe, a chunk at a time, over all its edges.
#pragma once

#include "native_problem.h"

namespace dw {

// Cells of one measurement, as a register: whole ones from memory, the last ones padded with 0.
template <class S>
struct Reader {
    using R = Pack<S>;
    static DW_HD R one(const S* from, int64_t left) {
        if (left >= R::lanes) return R::load(from);
        R out(S(0));
        for (int64_t k = 0; k < left; ++k) out.v[k] = from[k];  // none if nothing is left
        return out;
    }
    static DW_HD void pair(const S* from, int64_t left, R& x, R& y) {
        if (left >= R::lanes) return split_pairs(from, x, y);
        x = y = R(S(0));
        for (int64_t k = 0; k < left; ++k) {
            x.v[k] = from[2 * k];
            y.v[k] = from[2 * k + 1];
        }
    }
    static DW_HD void triple(const S* from, int64_t left, R& x, R& y, R& z) {
        if (left >= R::lanes) return split_triples(from, x, y, z);
        x = y = z = R(S(0));
        for (int64_t k = 0; k < left; ++k) {
            x.v[k] = from[3 * k];
            y.v[k] = from[3 * k + 1];
            z.v[k] = from[3 * k + 2];
        }
    }
    static DW_HD void write(S* to, int64_t left, R value) {
        if (left >= R::lanes) return value.store(to);
        for (int64_t k = 0; k < left; ++k) to[k] = value.v[k];
    }
};

template <class S, bool CROSS>
struct View {
    using R = Pack<S>;
    static constexpr int64_t CHANNELS = CROSS ? 3 : 2;
    const Problem& p;
    Workspace<S>& work;
    Camera<S> K;
    S huber;
    bool check = false;  // look for measurements that are not finite
    const S* disps;  // the state that is projected; the problem's own unless an energy is asked for

    View(const Problem& p_, Workspace<S>& work_, const void* disps_)
        : p(p_), work(work_), huber(S(p_.huber)), disps(static_cast<const S*>(disps_)) {
        K = {S(p.fx), S(p.fy), S(p.cx), S(p.cy)};
    }
    const S* target(int64_t e) const {
        return static_cast<const S*>(p.target) + work.plan.order[e] * 2 * work.plan.cells;
    }
    const S* weight(int64_t e) const {
        return static_cast<const S*>(p.weight) + work.plan.order[e] * CHANNELS * work.plan.cells;
    }
    // Matches from cell `at` of an edge on; a target that is not wanted may be null.
    static DW_HD Match<R> match(const S* target, const S* weight, int64_t at, int64_t left) {
        Match<R> m;
        m.tu = m.tv = m.cross = R(S(0));
        if (target) Reader<S>::pair(target + 2 * at, left, m.tu, m.tv);
        if constexpr (CROSS) Reader<S>::triple(weight + 3 * at, left, m.wu, m.wv, m.cross);
        else Reader<S>::pair(weight + 2 * at, left, m.wu, m.wv);
        return m;
    }
};

// Rows of one edge over a block of cells: sums to `lanes`, E to its buffer, C and w added up.
template <class S, bool CROSS, bool POSE, bool DEPTH>
void edge_block(const View<S, CROSS>& view, int64_t e, const Motion<S> G, const S* d, int64_t first,
                int64_t n, Pack<S>* lanes, S* E, S* C, S* w, Pack<S>& energy, Pack<S>& dropped) {
    using R = Pack<S>;
    const S *target = view.target(e) + 2 * first;
    const S *weight = view.weight(e) + view.CHANNELS * first;
    const S *ray_x = view.work.ray_x.data() + first, *ray_y = view.work.ray_y.data() + first;
    // copies that no store below can change, for all that the compiler knows
    const Camera<S> K = view.K;
    const S huber = view.huber;
    const bool check = view.check;
    R energies(S(0));
    for (int64_t at = 0; at < n; at += R::lanes) {
        Match<R> t = view.match(target, weight, at, n - at);
        if (check) dropped += drop_unusable<CROSS>(t);
        const R here = R::load(d + at);
        const Seen<R> p = project(G, R::load(ray_x + at), R::load(ray_y + at), here);
        const Measured<R> m = measure<CROSS>(K, p, p.ok, t, huber);
        energies += m.energy;
        if (!POSE && !DEPTH) continue;
        const Linear<R> l = linearise<CROSS>(K, G, p, m, here);
        if (DEPTH) {
            (R::load(C + at) + depth_curvature(l)).store(C + at);
            (R::load(w + at) + depth_gradient(l)).store(w + at);
        }
        if (POSE && DEPTH) {
            R row[6];
            coupling<CROSS>(l, row);
            row[0].store(E + at);
            row[1].store(E + PLANE + at);
            row[2].store(E + 2 * PLANE + at);
            row[3].store(E + 3 * PLANE + at);
            row[4].store(E + 4 * PLANE + at);
            row[5].store(E + 5 * PLANE + at);
        }
        if (POSE) add_pose_sums<CROSS>(l, lanes);
    }
    energy += energies;
}

// Rows r and r + 1 of E_a Q E_b^T from column `from` on. The twelve sums have names of their own,
// so that they stay in registers.
template <class S, int from>
void pair_rows(const S* Ea, const S* Eb, const S* Q, int64_t n, Pack<S>* lanes) {
    using R = Pack<S>;
    R t0 = lanes[0], t1 = lanes[1], t2 = lanes[2], t3 = lanes[3], t4 = lanes[4], t5 = lanes[5];
    R s0 = lanes[6], s1 = lanes[7], s2 = lanes[8], s3 = lanes[9], s4 = lanes[10], s5 = lanes[11];
    for (int64_t at = 0; at < n; at += R::lanes) {
        const R q = R::load(Q + at);
        const R a = R::load(Ea + at) * q, b = R::load(Ea + PLANE + at) * q;
#define DW_ADD(c)                                      \
    if (c >= from) {                                   \
        const R right = R::load(Eb + c * PLANE + at);  \
        t##c += a * right;                             \
        s##c += b * right;                             \
    }
        DW_ADD(0) DW_ADD(1) DW_ADD(2) DW_ADD(3) DW_ADD(4) DW_ADD(5)
#undef DW_ADD
    }
    lanes[0] = t0, lanes[1] = t1, lanes[2] = t2, lanes[3] = t3, lanes[4] = t4, lanes[5] = t5;
    lanes[6] = s0, lanes[7] = s1, lanes[8] = s2, lanes[9] = s3, lanes[10] = s4, lanes[11] = s5;
}

// E_a times a row of cells.
template <class S>
void row_sums(const S* Ea, const S* row, int64_t n, Pack<S>* lanes) {
    using R = Pack<S>;
    R s0 = lanes[0], s1 = lanes[1], s2 = lanes[2], s3 = lanes[3], s4 = lanes[4], s5 = lanes[5];
    for (int64_t at = 0; at < n; at += R::lanes) {
        const R right = R::load(row + at);
        s0 += R::load(Ea + at) * right;
        s1 += R::load(Ea + PLANE + at) * right;
        s2 += R::load(Ea + 2 * PLANE + at) * right;
        s3 += R::load(Ea + 3 * PLANE + at) * right;
        s4 += R::load(Ea + 4 * PLANE + at) * right;
        s5 += R::load(Ea + 5 * PLANE + at) * right;
    }
    lanes[0] = s0, lanes[1] = s1, lanes[2] = s2, lanes[3] = s3, lanes[4] = s4, lanes[5] = s5;
}

// The sums of a unit: poses of every active edge, E Q rhs, and E Q E^T of every pair of edges.
template <class S, bool CROSS, bool DEPTH>
void linearise_unit(const View<S, CROSS>& view, const Unit& unit, Scratch<S>& mine, Found& found) {
    using R = Pack<S>;
    Workspace<S>& work = view.work;
    const Source& source = work.plan.sources[unit.source];
    const int64_t k = source.active - source.first, cells = work.plan.cells;
    R* const lanes = mine.lanes.data();
    R* const lanes_rhs = lanes + k * POSE_SUMS;
    R* const lanes_pairs = lanes_rhs + k * 6;
    const int64_t count = Plan::sums_of(k);
    for (int64_t s = 0; s < count; ++s) lanes[s] = R(S(0));
    R energy(S(0)), dropped(S(0)), curvature(S(0));
    const int64_t frame = source.frame * cells;
    const S* const damping = static_cast<const S*>(view.p.damping) + frame;
    const S* const prior = view.p.prior ? static_cast<const S*>(view.p.prior) + frame : nullptr;
    S d[BLOCK], C[BLOCK], w[BLOCK], Q[BLOCK], Qr[BLOCK];
    for (int64_t first = unit.begin; first < unit.end; first += BLOCK) {
        const int64_t n = std::min<int64_t>(BLOCK, unit.end - first);
        for (int64_t at = 0; at < n; at += R::lanes) {
            Reader<S>::one(view.disps + frame + first + at, n - at).store(d + at);
            R(S(0)).store(C + at);
            R(S(0)).store(w + at);
        }
        for (int64_t e = source.first; e < source.last; ++e) {
            const Motion<S> G = rounded<S>(work.motions[e]);
            const int64_t a = e - source.first;
            if (e < source.active)
                edge_block<S, CROSS, true, DEPTH>(
                    view, e, G, d, first, n, lanes + a * POSE_SUMS, mine.E.data() + a * 6 * PLANE,
                    C, w, energy, dropped);
            else
                edge_block<S, CROSS, false, DEPTH>(
                    view, e, G, d, first, n, nullptr, nullptr, C, w, energy, dropped);
        }
        if (!DEPTH) continue;
        S* const keep_Q = work.Q.data() + unit.source * cells + first;
        S* const keep_rhs = work.rhs.data() + unit.source * cells + first;
        for (int64_t at = 0; at < n; at += R::lanes) {
            const R sum = R::load(C + at);
            curvature += sum;
            const R known = prior ? Reader<S>::one(prior + first + at, n - at) : R(S(0));
            const Depth<R> z = depth_system(
                sum, R::load(w + at), R::load(d + at),
                Reader<S>::one(damping + first + at, n - at), known, S(view.p.prior_weight));
            z.Q.store(Q + at);
            (z.Q * z.rhs).store(Qr + at);
            Reader<S>::write(keep_Q + at, n - at, z.Q);
            Reader<S>::write(keep_rhs + at, n - at, z.rhs);
        }
        R* pair = lanes_pairs;
        for (int64_t a = 0; a < k; ++a) {
            const S* const Ea = mine.E.data() + a * 6 * PLANE;
            row_sums(Ea, Qr, n, lanes_rhs + 6 * a);
            pair_rows<S, 0>(Ea, Ea, Q, n, pair);
            pair_rows<S, 2>(Ea + 2 * PLANE, Ea, Q, n, pair + 12);
            pair_rows<S, 4>(Ea + 4 * PLANE, Ea, Q, n, pair + 24);
            pair += 36;
            for (int64_t b = a + 1; b < k; ++b, pair += 36) {
                const S* const Eb = mine.E.data() + b * 6 * PLANE;
                pair_rows<S, 0>(Ea, Eb, Q, n, pair);
                pair_rows<S, 0>(Ea + 2 * PLANE, Eb, Q, n, pair + 12);
                pair_rows<S, 0>(Ea + 4 * PLANE, Eb, Q, n, pair + 24);
            }
        }
    }
    double* const out = work.sums.data() + source.offset + unit.chunk * count;
    for (int64_t s = 0; s < count; ++s) out[s] = total(lanes[s]);
    found.energy = total(energy);
    found.dropped = total(dropped);
    found.curvature = total(curvature);
    found.finite = finite_number(found.energy);
    for (int64_t s = 0; s < k * POSE_SUMS; ++s) found.finite &= finite_number(out[s]);
}

// Disparity steps Q (rhs - E^T y) of a unit, with E computed once more: that is less work than to
// store and load it. `steps` [edges,6] is what every edge sees of the pose steps.
template <class S, bool CROSS>
void substitute_unit(const View<S, CROSS>& view, const Unit& unit, const double* steps) {
    using R = Pack<S>;
    Workspace<S>& work = view.work;
    const Source& source = work.plan.sources[unit.source];
    const int64_t cells = work.plan.cells, frame = source.frame * cells;
    S d[BLOCK], sum[BLOCK];
    // without a robust kernel the residual has no share in E: its target need not be read
    const bool residuals = view.check || view.huber >= S(0);
    const Camera<S> K = view.K;
    const S huber = view.huber;
    for (int64_t first = unit.begin; first < unit.end; first += BLOCK) {
        const int64_t n = std::min<int64_t>(BLOCK, unit.end - first);
        S* const dz = work.rhs.data() + unit.source * cells + first;
        for (int64_t at = 0; at < n; at += R::lanes) {
            Reader<S>::one(view.disps + frame + first + at, n - at).store(d + at);
            Reader<S>::one(dz + at, n - at).store(sum + at);
        }
        for (int64_t e = source.first; e < source.active; ++e) {
            S y[6];
            bool moves = false;
            for (int k = 0; k < 6; ++k) {
                y[k] = S(steps[6 * e + k]);
                moves |= y[k] != S(0);
            }
            if (!moves) continue;
            const Motion<S> G = rounded<S>(work.motions[e]);
            const S* const target = residuals ? view.target(e) + 2 * first : nullptr;
            const S* const weight = view.weight(e) + view.CHANNELS * first;
            for (int64_t at = 0; at < n; at += R::lanes) {
                Match<R> t = view.match(target, weight, at, n - at);
                if (view.check) drop_unusable<CROSS>(t);
                const R here = R::load(d + at);
                const Seen<R> p = project(
                    G, R::load(work.ray_x.data() + first + at),
                    R::load(work.ray_y.data() + first + at), here);
                const Measured<R> m = measure<CROSS>(K, p, p.ok, t, huber);
                const Linear<R> l = linearise<CROSS>(K, G, p, m, here);
                (R::load(sum + at) - coupled_step<CROSS>(l, y)).store(sum + at);
            }
        }
        const S* const Q = work.Q.data() + unit.source * cells + first;
        for (int64_t at = 0; at < n; at += R::lanes)
            Reader<S>::write(dz + at, n - at, R::load(sum + at) * Reader<S>::one(Q + at, n - at));
    }
}

// Energy of another state over the cells that passed the near test at the start of the step.
template <class S, bool CROSS>
double energy_unit(const View<S, CROSS>& start, const View<S, CROSS>& now,
                   const Motion<double>* moved, const Unit& unit) {
    using R = Pack<S>;
    Workspace<S>& work = start.work;
    const Source& source = work.plan.sources[unit.source];
    const int64_t frame = source.frame * work.plan.cells;
    R energy(S(0));
    for (int64_t e = source.first; e < source.last; ++e) {
        const Motion<S> G = rounded<S>(moved[e]), G0 = rounded<S>(work.motions[e]);
        const S *target = start.target(e), *weight = start.weight(e);
        for (int64_t at = unit.begin; at < unit.end; at += R::lanes) {
            const int64_t left = unit.end - at;
            Match<R> t = start.match(target, weight, at, left);
            if (start.check) drop_unusable<CROSS>(t);
            const R x = R::load(work.ray_x.data() + at), y = R::load(work.ray_y.data() + at);
            const R before = depth_ratio(G0, x, y, Reader<S>::one(start.disps + frame + at, left));
            const R ok = select(before >= R(S(NEAR_DEPTH)), R(S(1)), R(S(0)));
            const Seen<R> p = project(G, x, y, Reader<S>::one(now.disps + frame + at, left));
            energy += measure<CROSS>(start.K, p, ok, t, start.huber).energy;
        }
    }
    return total(energy);
}

}  // namespace dw
