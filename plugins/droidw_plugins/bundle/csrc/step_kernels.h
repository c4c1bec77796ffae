// The kernels of a Gauss-Newton step, in the order in which they run (REFERENCE 3.2, 3.3).
//
// No kernel adds floating-point numbers from several threads to one place: whoever owns a result
// gathers what belongs to it, in one order.
#pragma once

#include "job.h"

namespace dw {

// Relative motions of the edges for poses [frames,7], in double and in the problem's type.
template <class S>
struct RelativeMotions {
    Job job;
    const S* T_cw;
    Motion<double>* full;
    Motion<S>* rounded_to;
    DW_KERNEL void operator()(int64_t e) const {
        const Motion<double> G = relative_motion(T_cw + 7 * job.ii[e], T_cw + 7 * job.jj[e]);
        if (full) {
            full[e] = G;
            adjoint(G, job.adjoints + 36 * e);
        }
        rounded_to[e] = rounded<S>(G);
    }
};

// Sums over the cells of an edge, a chunk per group; E, curvature and gradient of every cell.
template <class S, bool CROSS>
struct LineariseEdges {
    using Sum = S;
    Job job;
    DW_KERNEL int64_t items(int64_t group) const { return job.cells_of_chunk(group % job.chunks); }
    DW_KERNEL void operator()(int64_t group, int64_t item, S* sums) const {
        const int64_t e = group / job.chunks, cell = (group % job.chunks) * job.chunk + item;
        const Cell<S, CROSS> c(job, e, cell);
        const Seen<S> p = project(c.G, c.x, c.y, c.d);
        const Measured<S> m = measure<CROSS>(c.K, p, p.ok, c.match, S(job.huber));
        const Linear<S> l = linearise<CROSS>(c.K, c.G, p, m, c.d);
        if (job.ii[e] != job.jj[e]) add_pose_sums<CROSS>(l, sums);
        sums[ENERGY] += m.energy;
        sums[DROPPED] += c.dropped;
        if (job.motion_only) return;
        S E[6];
        coupling<CROSS>(l, E);
        const int64_t n = job.cells();
        for (int k = 0; k < 6; ++k) static_cast<S*>(job.E)[(6 * e + k) * n + cell] = E[k];
        static_cast<S*>(job.curvature)[e * n + cell] = depth_curvature(l);
        static_cast<S*>(job.gradient)[e * n + cell] = depth_gradient(l);
    }
};

// Adds the chunks of an edge, and notes sums that are not finite.
struct EdgeTotals {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t e = at / EDGE_SUMS, k = at % EDGE_SUMS;
        double s = 0;
        for (int64_t c = 0; c < job.chunks; ++c) s += job.edge_part[(e * job.chunks + c) * EDGE_SUMS + k];
        job.edge_sums[at] = s;
        if (!finite_number(s)) job.flags[BAD_SUMS] = 1;
    }
};

// 1 for poses that move, 0 for fixed ones, -1 for those that no weight sees.
struct FreePoses {
    Job job;
    DW_KERNEL bool usable(int64_t e) const {
        const double* sums = job.edge_sums + e * EDGE_SUMS;
        return sums[upper(3, 3)] > 0 || sums[upper(4, 4)] > 0;
    }
    DW_KERNEL void operator()(int64_t frame) const {
        bool seen = false;
        const int64_t s = job.frame_source[frame];
        if (s >= 0)
            for (int64_t e = job.source_start[s]; e < job.source_active[s]; ++e) seen |= usable(e);
        for (int64_t q = job.in_start[frame]; q < job.in_start[frame + 1]; ++q)
            seen |= usable(job.in_edges[q]);
        job.free[frame] = job.fixed[frame] ? 0 : seen ? 1 : -1;
    }
};

// Q and right side of every cell of every source.
template <class S>
struct DepthSystem {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t n = job.cells(), s = at / n, cell = at % n;
        const int64_t own = job.source_frame[s] * n + cell;
        S C = 0, w = 0;
        for (int64_t e = job.source_start[s]; e < job.source_start[s + 1]; ++e) {
            C += static_cast<const S*>(job.curvature)[e * n + cell];
            w += static_cast<const S*>(job.gradient)[e * n + cell];
        }
        if (C > S(0)) job.flags[CURVED] = 1;
        const S known = job.prior ? static_cast<const S*>(job.prior)[own] : S(0);
        const Depth<S> z = depth_system(
            C, w, static_cast<const S*>(job.disps)[own], static_cast<const S*>(job.damping)[own],
            known, S(job.prior_weight));
        static_cast<S*>(job.Q)[at] = z.Q;
        static_cast<S*>(job.rhs)[at] = z.rhs;
    }
};

// E_a Q E_b^T of pairs of edges of one source, a chunk per group; E_a Q rhs where a is b.
template <class S>
struct PairProducts {
    using Sum = S;
    Job job;
    DW_KERNEL int64_t items(int64_t group) const { return job.cells_of_chunk(group % job.chunks); }
    DW_KERNEL void operator()(int64_t group, int64_t item, S* sums) const {
        const int64_t pair = group / job.chunks, cell = (group % job.chunks) * job.chunk + item;
        const int64_t a = job.pair_a[pair], b = job.pair_b[pair], n = job.cells();
        const int64_t own = job.edge_source[a] * n + cell;
        const S q = static_cast<const S*>(job.Q)[own];
        const S *Ea = static_cast<const S*>(job.E) + 6 * a * n + cell;
        const S *Eb = static_cast<const S*>(job.E) + 6 * b * n + cell;
        S left[6], right[6];
        for (int k = 0; k < 6; ++k) {
            left[k] = Ea[k * n] * q;
            right[k] = Eb[k * n];
        }
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c < 6; ++c) sums[6 * r + c] += left[r] * right[c];
        if (a != b) return;
        const S z = static_cast<const S*>(job.rhs)[own];
        for (int k = 0; k < 6; ++k) sums[36 + k] += left[k] * z;
    }
};

// X = H - E Q E^T of a pair (H only where a is b), and the right side of its edge behind it.
struct PairTotals {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t pair = at / PAIR_SUMS, k = at % PAIR_SUMS, a = job.pair_a[pair];
        double s = 0;
        if (!job.motion_only)
            for (int64_t c = 0; c < job.chunks; ++c)
                s -= job.pair_part[(pair * job.chunks + c) * PAIR_SUMS + k];
        if (a == job.pair_b[pair]) {
            const double* sums = job.edge_sums + a * EDGE_SUMS;
            const int r = int(k / 6), c = int(k % 6);
            s += k < 36 ? sums[r < c ? upper(r, c) : upper(c, r)] : sums[HESSIAN + k - 36];
        }
        job.pair_sums[at] = s;
    }
};

// Entry (r, c) of X for two edges of a source, in either order.
DW_HD double pair_entry(const Job& job, int64_t s, int64_t a, int64_t b, int r, int c) {
    const int64_t first = job.source_start[s], k = job.source_active[s] - first;
    const bool turn = a > b;
    const int64_t low = (turn ? b : a) - first, high = (turn ? a : b) - first;
    const double* X = job.pair_sums + (job.pair_start[s] + pair_index(low, high, k)) * PAIR_SUMS;
    return turn ? X[6 * c + r] : X[6 * r + c];
}

// -sum_a Ad_a^T X_ab of every edge b: the row of its source against its target.
struct TurnedSums {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t b = at / 36, s = job.edge_source[b];
        const int r = int(at % 36) / 6, c = int(at % 6);
        double sum = 0;
        if (b < job.source_active[s])
            for (int64_t a = job.source_start[s]; a < job.source_active[s]; ++a) {
                const double* const Ad = job.adjoints + 36 * a;
                for (int q = 0; q < 6; ++q) sum -= Ad[6 * q + r] * pair_entry(job, s, a, b, q, c);
            }
        job.turned[at] = sum;
    }
};

// -sum_b turned_b Ad_b of every source: its block on the diagonal.
struct OwnSums {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t s = at / 36;
        const int r = int(at % 36) / 6, c = int(at % 6);
        double sum = 0;
        for (int64_t b = job.source_start[s]; b < job.source_active[s]; ++b) {
            const double* Ad = job.adjoints + 36 * b;
            for (int q = 0; q < 6; ++q) sum -= job.turned[36 * b + 6 * r + q] * Ad[6 * q + c];
        }
        job.own[at] = sum;
    }
};

// A block of the lower triangle of the system: the parts that belong to it, in the order listed.
struct AssembleBlocks {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t block = at / 36;
        const int r = int(at % 36) / 6, c = int(at % 6);
        if (job.free[job.block_row[block]] != 1 || job.free[job.block_col[block]] != 1) return;
        double sum = 0;
        for (int64_t q = job.part_start[block]; q < job.part_start[block + 1]; ++q) {
            const int64_t part = job.part[q], index = part >> 3;
            const bool turn = part & 1;
            const int64_t kind = (part >> 1) & 3;
            const double* X = kind == 0   ? job.pair_sums + index * PAIR_SUMS
                              : kind == 1 ? job.turned + index * 36
                                          : job.own + index * 36;
            sum += turn ? X[6 * c + r] : X[6 * r + c];
        }
        job.system[job.block_at[block] + r * job.stride + c] = sum;
    }
};

// Right side of a pose, and its diagonal: damped where it moves, one where it stays.
struct DampDiagonal {
    Job job;
    DW_KERNEL double edge_rhs(int64_t s, int64_t e, int k) const {
        const int64_t a = e - job.source_start[s], n = job.source_active[s] - job.source_start[s];
        return job.pair_sums[(job.pair_start[s] + pair_index(a, a, n)) * PAIR_SUMS + 36 + k];
    }
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t frame = at / 6;
        const int k = int(at % 6);
        double& diagonal = job.system[job.diagonal[frame] + k * job.stride + k];
        job.least[at] = 0;
        job.g[at] = 0;
        if (job.free[frame] != 1) {
            diagonal = 1;
            return;
        }
        const double added = job.lm * diagonal + job.ep;
        // damping of that size vouches for the pivot: undamped ones are not negative
        if (added < job.floor * diagonal) job.least[at] = job.floor * diagonal;
        diagonal += added;
        double sum = 0;
        const int64_t s = job.frame_source[frame];
        if (s >= 0)
            for (int64_t e = job.source_start[s]; e < job.source_active[s]; ++e) {
                const double* Ad = job.adjoints + 36 * e;
                for (int q = 0; q < 6; ++q) sum -= Ad[6 * q + k] * edge_rhs(s, e, q);
            }
        for (int64_t q = job.in_start[frame]; q < job.in_start[frame + 1]; ++q) {
            const int64_t e = job.in_edges[q];
            sum += edge_rhs(job.edge_source[e], e, k);
        }
        job.g[at] = sum;
    }
};

// What an edge sees of the pose steps: dx_j - Ad dx_i.
template <class S>
struct SeenSteps {
    Job job;
    DW_KERNEL void operator()(int64_t e) const {
        const double* Ad = job.adjoints + 36 * e;
        for (int r = 0; r < 6; ++r) {
            double y = job.dx[6 * job.jj[e] + r];
            for (int c = 0; c < 6; ++c) y -= Ad[6 * r + c] * job.dx[6 * job.ii[e] + c];
            static_cast<S*>(job.steps)[6 * e + r] = S(y);
        }
    }
};

// Disparity steps Q (rhs - E^T y), in place of the right side.
template <class S>
struct Substitute {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t n = job.cells(), s = at / n, cell = at % n;
        S z = static_cast<const S*>(job.rhs)[at];
        for (int64_t e = job.source_start[s]; e < job.source_active[s]; ++e)
            for (int k = 0; k < 6; ++k)
                z -= static_cast<const S*>(job.E)[(6 * e + k) * n + cell] *
                     static_cast<const S*>(job.steps)[6 * e + k];
        static_cast<S*>(job.rhs)[at] = z * static_cast<const S*>(job.Q)[at];
    }
};

template <class S>
struct MovePoses {
    Job job;
    DW_KERNEL void operator()(int64_t frame) const {
        const S* T = static_cast<const S*>(job.T_cw) + 7 * frame;
        S* out = static_cast<S*>(job.T_out) + 7 * frame;
        double xi[6];
        bool finite = true;
        for (int k = 0; k < 6; ++k) {
            xi[k] = job.scale * job.dx[6 * frame + k];
            finite &= finite_number(xi[k]);
        }
        if (job.free[frame] == 1) retract(T, xi, out);
        else
            for (int k = 0; k < 7; ++k) out[k] = T[k];
        for (int k = 0; k < 7; ++k) finite &= finite_number(out[k]);
        if (!finite) job.flags[BAD_STEP] = 1;
    }
};

// Whether the depth of a frame moves: it has edges, or is free and may follow its prior.
DW_HD bool depth_moves(const Job& job, int64_t frame) {
    return !job.fixed[frame] || job.frame_source[frame] >= 0;
}

template <class S>
struct MoveDepths {
    Job job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t n = job.cells(), frame = at / n, cell = at % n;
        const int64_t source = job.frame_source[frame];
        const S here = static_cast<const S*>(job.disps)[at];
        S step = 0, there = here;
        if (!job.motion_only) {
            const S known = job.prior && depth_moves(job, frame) ? static_cast<const S*>(job.prior)[at] : S(0);
            if (known > S(0)) job.flags[PRIOR] = 1;
            if (source >= 0) step = static_cast<const S*>(job.rhs)[source * n + cell];
            else if (known > S(0)) step = known - here;
            there = here + step * S(job.scale);
            there = there < S(job.min_disp) ? S(job.min_disp) : there;
            there = there > S(job.max_disp) ? S(job.max_disp) : there;
        }
        static_cast<S*>(job.disps_out)[at] = there;
        if (!finite_number(step) || !finite_number(there)) job.flags[BAD_STEP] = 1;
    }
};

// Energy of another state over the cells that passed the near test at the start of the step.
template <class S, bool CROSS>
struct MovedEnergy {
    using Sum = S;
    Job job;
    const S* disps;
    const Motion<S>* moved;
    DW_KERNEL int64_t items(int64_t group) const { return job.cells_of_chunk(group % job.chunks); }
    DW_KERNEL void operator()(int64_t group, int64_t item, S* sums) const {
        const int64_t e = group / job.chunks, cell = (group % job.chunks) * job.chunk + item;
        const Cell<S, CROSS> c(job, e, cell);
        const S ok = depth_ratio(c.G, c.x, c.y, c.d) >= S(NEAR_DEPTH) ? S(1) : S(0);
        const Seen<S> p = project(moved[e], c.x, c.y, disps[job.ii[e] * job.cells() + cell]);
        sums[0] += measure<CROSS>(c.K, p, ok, c.match, S(job.huber)).energy;
    }
};

// sum (d - D)^2 over the cells with a prior in frames whose depth moves.
template <class S>
struct PriorEnergy {
    using Sum = S;
    Job job;
    const S* disps;
    DW_KERNEL int64_t items(int64_t group) const { return job.cells_of_chunk(group % job.chunks); }
    DW_KERNEL void operator()(int64_t group, int64_t item, S* sums) const {
        const int64_t frame = group / job.chunks;
        if (!depth_moves(job, frame)) return;
        const int64_t at = frame * job.cells() + (group % job.chunks) * job.chunk + item;
        const S known = static_cast<const S*>(job.prior)[at];
        const S off = disps[at] - known;
        if (known > S(0)) sums[0] += off * off;
    }
};

// Flags for edges other than those that the order of work was made for.
struct CompareEdges {
    Job job;
    DW_KERNEL void operator()(int64_t e) const {
        if (job.given_ii[e] != job.held_ii[e] || job.given_jj[e] != job.held_jj[e])
            job.flags[OTHER_EDGES] = 1;
    }
};

// Flags a system that could not be factorised, or whose pivots are rounding.
struct CheckPivots {
    Job job;
    DW_KERNEL void operator()(int64_t k) const {
        const double pivot = job.factor[k * (6 * job.frames + 1)];
        if (!(pivot * pivot > job.least[k]) || *job.info != 0) job.flags[SINGULAR_SYSTEM] = 1;
    }
};

struct EdgeEnergy {
    using Sum = double;
    Job job;
    DW_KERNEL int64_t items(int64_t) const { return job.edges; }
    DW_KERNEL void operator()(int64_t, int64_t e, double* sums) const {
        sums[0] += job.edge_sums[e * EDGE_SUMS + ENERGY];
        sums[1] += job.edge_sums[e * EDGE_SUMS + DROPPED];
    }
};

// Sum of a row of numbers.
struct RowSum {
    using Sum = double;
    const double* values;
    int64_t count;
    DW_KERNEL int64_t items(int64_t) const { return count; }
    DW_KERNEL void operator()(int64_t, int64_t k, double* sums) const { sums[0] += values[k]; }
};

struct TellPoses {
    Job job;
    DW_KERNEL void operator()(int64_t frame) const {
        double* const told = job.told + FLAGS + 3;
        double sum = 0;
        for (int k = 0; k < 6; ++k) sum += job.dx[6 * frame + k] * job.dx[6 * frame + k];
        told[frame] = double(job.free[frame]);
        told[job.frames + frame] = sqrt(sum);
    }
};

struct TellFlags {
    Job job;
    DW_KERNEL void operator()(int64_t k) const { job.told[k] = double(job.flags[k]); }
};

}  // namespace dw
