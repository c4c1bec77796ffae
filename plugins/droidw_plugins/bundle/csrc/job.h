// What the kernels of one step read and write, as raw pointers into memory of the device.
#pragma once

#include "exec.h"
#include "se3.h"

namespace dw {

// Sums of an edge: POSE_SUMS, then energy and dropped measurements.
constexpr int EDGE_SUMS = POSE_SUMS + 2, ENERGY = POSE_SUMS, DROPPED = POSE_SUMS + 1;
// Sums of a pair of edges: E_a Q E_b^T, then E_a Q rhs where a is b.
constexpr int PAIR_SUMS = 36 + 6;

enum Flag { BAD_SUMS = 0, CURVED = 1, PRIOR = 2, BAD_STEP = 3, OTHER_EDGES = 4, SINGULAR_SYSTEM = 5 };
constexpr int FLAGS = 6;

// Mirrors droidw_plugins.bundle._kernel_calls.Job. Void pointers are of the problem's type.
struct Job {
    int64_t frames, edges, height, width, sources, pairs, blocks, chunk, chunks, stride;
    int64_t channels;  // of weight: 2, or 3 with the cross term
    const void *T_cw, *disps, *intrinsics, *target, *weight, *damping, *prior;
    const uint8_t* fixed;
    double prior_weight, lm, ep, huber, min_disp, max_disp, floor, scale;
    int64_t motion_only, check;
    // The order of work. Edges are sorted by (source, whether it leads back to it, target).
    const int64_t *order, *ii, *jj, *edge_source;
    const int64_t *source_frame, *source_start, *source_active, *pair_start;  // per source
    const int64_t *pair_a, *pair_b;                                          // per pair, a <= b
    const int64_t *frame_source, *in_start, *in_edges, *diagonal;            // per frame
    const int64_t *block_row, *block_col, *block_at, *part_start, *part;     // of the system
    // Scratch.
    double *motions, *adjoints, *edge_part, *edge_sums, *pair_part, *pair_sums, *turned, *own;
    double *system, *g, *least, *dx;
    void *rounded, *E, *curvature, *gradient, *Q, *rhs, *steps;
    int32_t *free, *flags;
    double* energy_part;
    // Result, and what is read back: flags, energy, dropped, prior energy, then the state and the norm
    // of the step of every pose.
    void *T_out, *disps_out;
    double* told;
    const int64_t *given_ii, *given_jj;  // edges of the caller, and those that the order was made for
    const int64_t *held_ii, *held_jj;
    const double* factor;                // Cholesky factor, where it is one dense matrix
    const int32_t* info;

    DW_HD int64_t cells() const { return height * width; }
    DW_HD int64_t cells_of_chunk(int64_t c) const {
        const int64_t left = cells() - c * chunk;
        return left < chunk ? left : chunk;
    }
};

// Where pair (a, b) of edges of a source with k edges is, counted from its first; a <= b.
DW_HD int64_t pair_index(int64_t a, int64_t b, int64_t k) { return a * k - a * (a - 1) / 2 + (b - a); }

template <class S>
DW_HD Camera<S> camera_of(const Job& job) {
    const S* K = static_cast<const S*>(job.intrinsics);
    return {K[0], K[1], K[2], K[3]};
}

template <class S>
DW_HD S ray_x(const Job& job, const Camera<S>& K, int64_t cell) {
    return (S(cell % job.width) - K.cx) / K.fx;
}
template <class S>
DW_HD S ray_y(const Job& job, const Camera<S>& K, int64_t cell) {
    return (S(cell / job.width) - K.cy) / K.fy;
}

// One cell of one edge, as far as all kernels need it.
template <class S, bool CROSS>
struct Cell {
    Camera<S> K;
    Motion<S> G;
    Match<S> match;
    S x, y, d, dropped;

    DW_HD Cell(const Job& job, int64_t e, int64_t cell) : K(camera_of<S>(job)) {
        G = static_cast<const Motion<S>*>(job.rounded)[e];
        x = ray_x(job, K, cell);
        y = ray_y(job, K, cell);
        d = static_cast<const S*>(job.disps)[job.ii[e] * job.cells() + cell];
        const int64_t at = job.order[e] * job.cells() + cell;
        const S* const target = static_cast<const S*>(job.target) + 2 * at;
        const S* const weight = static_cast<const S*>(job.weight) + (CROSS ? 3 : 2) * at;
        match = {target[0], target[1], weight[0], weight[1], CROSS ? weight[2] : S(0)};
        dropped = job.check ? drop_unusable<CROSS>(match) : S(0);
    }
};

}  // namespace dw
