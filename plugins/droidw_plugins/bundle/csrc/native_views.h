// Maps and distances on a CPU: similarity of features, the data term of the uncertainty update, frame
// distance (REFERENCE 4.3, 5.5). Every result is owned by one thread, and added up in one order.
#pragma once

#include "native_unit.h"
#include "parallel.h"

namespace dw {

// Mirrors droidw_plugins.bundle._native_maps.Samples: E edges, P cells, K frames, C channels. Where
// the cells fall is said by the upper left neighbour, row of a table [K*P], and four weights.
struct SampleJob {
    int64_t frames, edges, cells, channels;
    const int64_t *source, *first;
    int64_t steps[4];
    const void* weights;                // [4,E*P]
    const void *features, *lengths;     // [K,P,C], [K,P]
    const void *u, *rho;                // [K,P], [E,P]
    void *here, *there, *gradient;      // [E,P] scratch twice, [K,P]
    void* cosine;                       // [E,P]
    double* energy;                     // [E]
    int64_t threads;
};

// Cosine of the feature of each cell and the interpolated one in the other frame.
template <class S>
void similarity(const SampleJob& job) {
    using R = Pack<S>;
    const S *features = static_cast<const S*>(job.features), *lengths = static_cast<const S*>(job.lengths);
    const S* weights = static_cast<const S*>(job.weights);
    const int64_t rows = job.edges * job.cells, c = job.channels, parts = (job.cells + BLOCK - 1) / BLOCK;
    parallel(job.edges * parts, int(job.threads), [&](int64_t unit, int) {
        const int64_t e = unit / parts, begin = (unit % parts) * BLOCK;
        const int64_t end = std::min(job.cells, begin + BLOCK);
        for (int64_t cell = begin; cell < end; ++cell) {
            const int64_t at = e * job.cells + cell, own = job.source[e] * job.cells + cell;
            const S* const f = features + own * c;
            const S* corner[4];
            R w[4];
            for (int q = 0; q < 4; ++q) {
                corner[q] = features + (job.first[at] + job.steps[q]) * c;
                w[q] = R(weights[q * rows + at]);
            }
            R dot(S(0)), square(S(0));
            const auto add = [&](R mine, R c0, R c1, R c2, R c3) {
                const R there = c0 * w[0] + c1 * w[1] + (c2 * w[2] + c3 * w[3]);
                dot += there * mine;
                square += there * there;
            };
            int64_t k = 0;
            for (; k + R::lanes <= c; k += R::lanes)
                add(R::load(f + k), R::load(corner[0] + k), R::load(corner[1] + k),
                    R::load(corner[2] + k), R::load(corner[3] + k));
            if (k < c) {
                using T = Reader<S>;
                add(T::one(f + k, c - k), T::one(corner[0] + k, c - k), T::one(corner[1] + k, c - k),
                    T::one(corner[2] + k, c - k), T::one(corner[3] + k, c - k));
            }
            const double length = double(lengths[own]) * sqrt(total(square));
            static_cast<S*>(job.cosine)[at] = S(total(dot) / (length + 1e-6));
        }
    });
}

// Gradient of sum rho / (u_i u_ij) with respect to u, and the energy of every edge.
template <class S>
void data_term(const SampleJob& job) {
    const S *u = static_cast<const S*>(job.u), *rho = static_cast<const S*>(job.rho);
    const S* weights = static_cast<const S*>(job.weights);
    S *here = static_cast<S*>(job.here), *there = static_cast<S*>(job.there);
    const int64_t n = job.cells, rows = job.edges * n;
    parallel(job.edges, int(job.threads), [&](int64_t e, int) {
        double energy = 0;
        for (int64_t cell = 0; cell < n; ++cell) {
            const int64_t at = e * n + cell;
            S value = 0;
            for (int q = 0; q < 4; ++q) value += u[job.first[at] + job.steps[q]] * weights[q * rows + at];
            const S own = u[job.source[e] * n + cell], pair = rho[at] / (own * value);
            energy += double(pair);
            here[at] = -pair / own;
            there[at] = -pair / value;
        }
        job.energy[e] = energy;
    });
    S* const gradient = static_cast<S*>(job.gradient);
    parallel(job.frames, int(job.threads), [&](int64_t frame, int) {
        S* const mine = gradient + frame * n;
        std::fill(mine, mine + n, S(0));
        for (int64_t e = 0; e < job.edges; ++e) {
            if (job.source[e] == frame)
                for (int64_t cell = 0; cell < n; ++cell) mine[cell] += here[e * n + cell];
            if (n == 0 || job.first[e * n] / n != frame) continue;
            for (int64_t at = e * n; at < (e + 1) * n; ++at)
                for (int q = 0; q < 4; ++q)
                    gradient[job.first[at] + job.steps[q]] += there[at] * weights[q * rows + at];
        }
    });
}

// Mirrors droidw_plugins.bundle._native_maps.Flow.
struct FlowJob {
    int64_t edges, height, width;
    const void *T_cw, *disps;           // [N,7], [N,P]
    const int64_t *ii, *jj;
    double fx, fy, cx, cy;
    double* sums;  // [E,4]: length and number of cells of the full motion, then of its translation
    int64_t threads;
};

template <class S>
void flow_sums(const FlowJob& job) {
    using R = Pack<S>;
    const Camera<S> K{S(job.fx), S(job.fy), S(job.cx), S(job.cy)};
    const int64_t w = job.width;
    parallel(job.edges, int(job.threads), [&](int64_t e, int) {
        const S* T = static_cast<const S*>(job.T_cw);
        const Motion<S> G = rounded<S>(relative_motion(T + 7 * job.ii[e], T + 7 * job.jj[e]));
        const Motion<S> shift{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {G.t[0], G.t[1], G.t[2]}};
        double sums[4] = {};
        R first;
        for (int k = 0; k < R::lanes; ++k) first.v[k] = S(k);
        for (int64_t row = 0; row < job.height; ++row) {
            const S* d = static_cast<const S*>(job.disps) + (job.ii[e] * job.height + row) * w;
            const R y = R(S(row)), ry = (y - R(K.cy)) / R(K.fy);
            R lanes[4] = {R(S(0)), R(S(0)), R(S(0)), R(S(0))};
            for (int64_t at = 0; at < w; at += R::lanes) {
                const R x = first + R(S(at)), rx = (x - R(K.cx)) / R(K.fx);
                const R here = Reader<S>::one(d + at, w - at);
                const auto beyond = x < R(S(w));
                for (int part = 0; part < 2; ++part) {
                    const Motion<S>& motion = part ? shift : G;
                    const Seen<R> p = project(motion, rx, ry, here);
                    const R u = R(K.fx) * p.a + R(K.cx) - x, v = R(K.fy) * p.b + R(K.cy) - y;
                    const auto used = (depth_ratio(motion, rx, ry, here) > R(S(NEAR_DEPTH))) & beyond;
                    lanes[2 * part] += select(used, root(u * u + v * v), R(S(0)));
                    lanes[2 * part + 1] += select(used, R(S(1)), R(S(0)));
                }
            }
            for (int k = 0; k < 4; ++k) sums[k] += total(lanes[k]);
        }
        for (int k = 0; k < 4; ++k) job.sums[4 * e + k] = sums[k];
    });
}

}  // namespace dw
