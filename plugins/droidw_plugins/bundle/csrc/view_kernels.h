// Kernels beside the step: frame distance, the depth-consistency filter, and the data term of the
// uncertainty update (REFERENCE 5.5, 5.9, 4.3).
#pragma once

#include "job.h"

namespace dw {

// Mirrors droidw_plugins.bundle._kernel_calls.Pairs.
struct Pairs {
    int64_t frames, edges, height, width, chunk, chunks;
    const void *T_cw, *disps, *intrinsics;
    const int64_t *ii, *jj;
    void* rounded;                      // [edges,12] scratch
    double* part;                       // [edges * chunks, 4]
    int64_t reach;                      // neighbours on either side
    double threshold;
    int32_t* views;                     // [frames, cells]

    DW_HD int64_t cells() const { return height * width; }
};

// Flow lengths and numbers of usable cells: of the full motion, then of its translation alone.
template <class S>
struct FlowSums {
    using Sum = S;
    Pairs job;
    DW_KERNEL int64_t items(int64_t group) const {
        const int64_t left = job.cells() - (group % job.chunks) * job.chunk;
        return left < job.chunk ? left : job.chunk;
    }
    DW_KERNEL static void add(S u, S v, S x, S y, S Z, S* sums) {
        if (!(Z > S(NEAR_DEPTH))) return;
        sums[0] += root((u - x) * (u - x) + (v - y) * (v - y));
        sums[1] += S(1);
    }
    DW_KERNEL void operator()(int64_t group, int64_t item, S* sums) const {
        const int64_t e = group / job.chunks, cell = (group % job.chunks) * job.chunk + item;
        const S* k = static_cast<const S*>(job.intrinsics);
        const Camera<S> K{k[0], k[1], k[2], k[3]};
        const S x = S(cell % job.width), y = S(cell / job.width);
        const S rx = (x - K.cx) / K.fx, ry = (y - K.cy) / K.fy;
        const S d = static_cast<const S*>(job.disps)[job.ii[e] * job.cells() + cell];
        const Motion<S> G = static_cast<const Motion<S>*>(job.rounded)[e];
        const Seen<S> p = project(G, rx, ry, d);
        add(K.fx * p.a + K.cx, K.fy * p.b + K.cy, x, y, depth_ratio(G, rx, ry, d), sums);
        Motion<S> shift{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {G.t[0], G.t[1], G.t[2]}};
        const Seen<S> q = project(shift, rx, ry, d);
        add(K.fx * q.a + K.cx, K.fy * q.b + K.cy, x, y, depth_ratio(shift, rx, ry, d), sums + 2);
    }
};

template <class S>
struct PairMotions {
    Pairs job;
    DW_KERNEL void operator()(int64_t e) const {
        const S* T = static_cast<const S*>(job.T_cw);
        static_cast<Motion<S>*>(job.rounded)[e] =
            rounded<S>(relative_motion(T + 7 * job.ii[e], T + 7 * job.jj[e]));
    }
};

// How many of the `reach` neighbours on either side confirm the depth of a cell: the depth that the
// cell would have there agrees with one of the four cells around the place where it falls.
template <class S>
struct ConfirmedViews {
    Pairs job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t n = job.cells(), i = at / n, cell = at % n;
        const S* k = static_cast<const S*>(job.intrinsics);
        const Camera<S> K{k[0], k[1], k[2], k[3]};
        const S rx = (S(cell % job.width) - K.cx) / K.fx, ry = (S(cell / job.width) - K.cy) / K.fy;
        const S *T = static_cast<const S*>(job.T_cw), *disps = static_cast<const S*>(job.disps);
        const S d = disps[at];
        int32_t views = 0;
        for (int64_t j = i - job.reach; j <= i + job.reach; ++j) {
            if (j == i || j < 0 || j >= job.frames) continue;
            const Motion<S> G = rounded<S>(relative_motion(T + 7 * i, T + 7 * j));
            const Seen<S> p = project(G, rx, ry, d);
            const S Z = depth_ratio(G, rx, ry, d);
            if (!(Z >= S(NEAR_DEPTH))) continue;
            const S there = Z / d, u = K.fx * p.a + K.cx, v = K.fy * p.b + K.cy;
            // also false for NaN; one cell beyond the border has a neighbour inside
            if (!(u >= S(-1) && v >= S(-1) && u < S(job.width) && v < S(job.height))) continue;
            const int64_t left = int64_t(floor(double(u))), top = int64_t(floor(double(v)));
            bool agrees = false;
            for (int64_t q = 0; q < 4; ++q) {
                const int64_t x = left + (q & 1), y = top + (q >> 1);
                if (x < 0 || y < 0 || x >= job.width || y >= job.height) continue;
                const S off = there * disps[j * n + y * job.width + x] - S(1);
                agrees |= off < S(job.threshold) && -off < S(job.threshold);
            }
            views += agrees;
        }
        job.views[at] = views;
    }
};

// Mirrors droidw_plugins.bundle._kernel_calls.Consistency: the data term over E edges of P cells
// of K frames, with the samples of droidw_plugins.uncertainty._objective.
struct Consistency {
    int64_t frames, edges, cells, chunk, chunks;
    const void *u, *rho, *weights;      // [K,P], [E,P], [4,E*P]
    const int64_t* first;               // [E*P] upper left neighbour, row of a table [K*P]
    int64_t steps[4];                   // from there to the four neighbours
    const int64_t *source_start, *source_edges;  // edges by source frame
    const int64_t* source;              // [E]
    void *here, *there;                 // [E,P] derivative with respect to u_i, and to u_ij
    double* part;                       // [E * chunks] energy
    const double* scale;                // [1] power of two by which a spread value is multiplied
    int64_t* sums;                      // [K,P] fixed point
    void* gradient;                     // [K,P]
};

template <class S>
struct PairValues {
    using Sum = S;
    Consistency job;
    DW_KERNEL int64_t items(int64_t group) const {
        const int64_t left = job.cells - (group % job.chunks) * job.chunk;
        return left < job.chunk ? left : job.chunk;
    }
    DW_KERNEL void operator()(int64_t group, int64_t item, S* sums) const {
        const int64_t e = group / job.chunks, cell = (group % job.chunks) * job.chunk + item;
        const int64_t at = e * job.cells + cell;
        const S *u = static_cast<const S*>(job.u), *weights = static_cast<const S*>(job.weights);
        S there = 0;
        for (int k = 0; k < 4; ++k)
            there += u[job.first[at] + job.steps[k]] * weights[k * job.edges * job.cells + at];
        const S here = u[job.source[e] * job.cells + cell];
        const S energy = static_cast<const S*>(job.rho)[at] / (here * there);
        static_cast<S*>(job.here)[at] = -energy / here;
        static_cast<S*>(job.there)[at] = -energy / there;
        sums[0] += energy;
    }
};

// Spreads the derivative with respect to the interpolated value onto its four cells. Numbers are
// added as integers, so that the order in which threads arrive cannot change the result.
template <class S>
struct SpreadValues {
    Consistency job;
    DW_KERNEL void operator()(int64_t at) const {
        const double value = double(static_cast<const S*>(job.there)[at]);
        const S* weights = static_cast<const S*>(job.weights);
        for (int k = 0; k < 4; ++k) {
            const double weight = double(weights[k * job.edges * job.cells + at]);
            const int64_t share = int64_t(llrint(value * weight * *job.scale));
            if (share != 0) add_integer(job.sums + job.first[at] + job.steps[k], share);
        }
    }
};

template <class S>
struct GatherGradient {
    Consistency job;
    DW_KERNEL void operator()(int64_t at) const {
        const int64_t frame = at / job.cells, cell = at % job.cells;
        double sum = double(job.sums[at]) / *job.scale;
        for (int64_t q = job.source_start[frame]; q < job.source_start[frame + 1]; ++q)
            sum += double(static_cast<const S*>(job.here)[job.source_edges[q] * job.cells + cell]);
        static_cast<S*>(job.gradient)[at] = S(sum);
    }
};

// Mirrors droidw_plugins.bundle._kernel_calls.Parameters: slope[c] = sum_m weight[m] rows[m,c].
struct Parameters {
    int64_t rows, channels, chunk, chunks;
    const void *weight, *table;         // [M], [M,C]
    double* part;                       // [C + 1, chunks]; the last row is the sum of the weights
};

template <class S>
struct ParameterSums {
    using Sum = S;
    Parameters job;
    DW_KERNEL int64_t items(int64_t group) const {
        const int64_t left = job.rows - (group % job.chunks) * job.chunk;
        return left < job.chunk ? left : job.chunk;
    }
    DW_KERNEL void operator()(int64_t group, int64_t item, S* sums) const {
        const int64_t c = group / job.chunks, m = (group % job.chunks) * job.chunk + item;
        const S w = static_cast<const S*>(job.weight)[m];
        sums[0] += c == job.channels ? w : w * static_cast<const S*>(job.table)[m * job.channels + c];
    }
};

template <class S>
int launch_frame_distance(const Pairs& job, void* stream) {
    Queue queue(stream);
    map(queue, job.edges, PairMotions<S>{job});
    reduce<4>(queue, job.edges * job.chunks, FlowSums<S>{job}, job.part);
    return queue.code();
}
template <class S>
int launch_confirmed_views(const Pairs& job, void* stream) {
    Queue queue(stream);
    map(queue, job.frames * job.cells(), ConfirmedViews<S>{job});
    return queue.code();
}
template <class S>
int launch_pair_values(const Consistency& job, void* stream) {
    Queue queue(stream);
    reduce<1>(queue, job.edges * job.chunks, PairValues<S>{job}, job.part);
    return queue.code();
}
template <class S>
int launch_pair_gradient(const Consistency& job, void* stream) {
    Queue queue(stream);
    map(queue, job.edges * job.cells, SpreadValues<S>{job});
    map(queue, job.frames * job.cells, GatherGradient<S>{job});
    return queue.code();
}
template <class S>
int launch_parameter_gradient(const Parameters& job, void* stream) {
    Queue queue(stream);
    reduce<1>(queue, (job.channels + 1) * job.chunks, ParameterSums<S>{job}, job.part);
    return queue.code();
}

}  // namespace dw
