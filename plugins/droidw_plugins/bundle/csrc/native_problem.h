// The bundle adjustment problem as raw pointers, and in what order a CPU works on it.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "pack.h"
#include "se3.h"

namespace dw {

// Mirrors droidw_plugins.bundle._native_calls.Problem; floating arrays are all of one type.
struct Problem {
    int64_t frames, edges, height, width;
    int64_t channels;  // of weight: 2, or 3 with the cross term
    const int64_t *ii, *jj;
    const void *T_cw, *disps, *target, *weight, *damping, *prior;  // prior may be null
    const uint8_t* fixed;
    const double *band, *band_rhs;  // what is known of poses besides: [frames, reach + 1, 36], [frames, 6]
    int64_t reach;                  // -1 where there is none
    double fx, fy, cx, cy;
    double prior_weight, lm, ep, huber, min_disp, max_disp;  // huber < 0: none
    int32_t motion_only, guard, halvings, threads;
    void *T_out, *disps_out;
    int64_t* isolated;  // [frames]
};

enum Status : int32_t { OK = 0, REJECTED = 1, SINGULAR = 2, NONFINITE = 3, EMPTY = 4 };

struct Report {
    double cost_before, cost_after, step_norm;
    int64_t dropped, isolated;
    int32_t status, reserved;
};

// Cells that a thread works on before it goes to the next edge: small enough for the first cache.
constexpr int BLOCK = 256;
// Room of such a row of cells: rows that begin a power of two apart would share lines of the cache.
constexpr int PLANE = BLOCK + 16;
// Cells whose sums are kept in the precision of the problem before they go to double.
constexpr int CHUNK = 1024;

struct Source {
    int64_t frame, first, active, last;  // edges first..active move a pose, active..last do not
    int64_t offset;                      // of its sums in `Plan::sums`, one set per chunk
};

struct Unit {
    int64_t source, begin, end, chunk;
};

// Edges by (source, whether a pose can move, target): the order of the caller does not matter.
struct Plan {
    std::vector<int64_t> order, ii, jj;
    std::vector<Source> sources;
    std::vector<Unit> units;
    int64_t cells = 0, chunks = 0, sums = 0, most_active = 0;

    static int64_t sums_of(int64_t k) { return k * (POSE_SUMS + 6) + k * (k + 1) / 2 * 36; }

    void make(const Problem& p) {
        const int64_t n = p.edges;
        cells = p.height * p.width;
        order.resize(n);
        ii.resize(n);
        jj.resize(n);
        auto passive = [&](int64_t e) {
            return p.ii[e] == p.jj[e] || (p.fixed[p.ii[e]] && p.fixed[p.jj[e]]);
        };
        for (int64_t e = 0; e < n; ++e) order[e] = e;
        std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) {
            if (p.ii[a] != p.ii[b]) return p.ii[a] < p.ii[b];
            const bool pa = passive(a), pb = passive(b);
            if (pa != pb) return pb;
            return p.jj[a] < p.jj[b];
        });
        // equal chunks, so that no thread gets a remnant
        chunks = std::max<int64_t>(1, (cells + CHUNK - 1) / CHUNK);
        const int64_t size = ((cells + chunks - 1) / chunks + 15) / 16 * 16;
        chunks = std::max<int64_t>(1, (cells + size - 1) / size);
        sources.clear();
        units.clear();
        sums = most_active = 0;
        for (int64_t e = 0; e < n;) {
            Source s{p.ii[order[e]], e, e, e, sums};
            for (; e < n && p.ii[order[e]] == s.frame; ++e) {
                ii[e] = s.frame;
                jj[e] = p.jj[order[e]];
                if (!passive(order[e])) s.active = e + 1;
            }
            s.last = e;
            const int64_t k = s.active - s.first;
            most_active = std::max(most_active, k);
            sums += chunks * sums_of(k);
            for (int64_t c = 0; c < chunks; ++c)
                units.push_back({int64_t(sources.size()), c * size, std::min(cells, (c + 1) * size), c});
            sources.push_back(s);
        }
    }
};

// Memory that a thread has for itself.
template <class S>
struct Scratch {
    std::vector<S> E;
    std::vector<Pack<S>> lanes;
    void reserve(int64_t k) {
        E.resize(std::max<size_t>(E.size(), size_t(k * 6 * PLANE)));
        lanes.resize(std::max<size_t>(lanes.size(), size_t(Plan::sums_of(k))));
    }
};

// What a unit found beside its sums.
struct Found {
    double energy = 0, curvature = 0, dropped = 0;
    bool finite = true;
};

// Everything that lives from one call to the next, so that no memory is fresh.
template <class S>
struct Workspace {
    Plan plan;
    std::vector<S> ray_x, ray_y;
    std::vector<S> Q, rhs;  // [sources, cells]; rhs becomes the disparity step
    std::vector<double> sums;
    std::vector<Found> found;
    std::vector<Motion<double>> motions;
    std::vector<Scratch<S>> scratch;
    std::vector<double> system, g, dx, inverse;
    std::vector<int64_t> slot, free, head, row;
    std::vector<uint8_t> has_source;
};

}  // namespace dw
