// The reduced camera system in double precision: assembled from the sums, kept in an envelope (each
// row from its first entry to the diagonal), factorised and solved by Cholesky.
#pragma once

#include "native_problem.h"

namespace dw {

// out[6,6] = A[6,6] B[6,6]
inline void multiply(const double* A, const double* B, double* out) {
    for (int r = 0; r < 6; ++r) {
        double row[6] = {};
        for (int k = 0; k < 6; ++k)
            for (int c = 0; c < 6; ++c) row[c] += A[6 * r + k] * B[6 * k + c];
        for (int c = 0; c < 6; ++c) out[6 * r + c] = row[c];
    }
}

// out[6,6] = A[6,6]^T B[6,6]
inline void multiply_transposed(const double* A, const double* B, double* out) {
    for (int r = 0; r < 6; ++r) {
        double row[6] = {};
        for (int k = 0; k < 6; ++k)
            for (int c = 0; c < 6; ++c) row[c] += A[6 * k + r] * B[6 * k + c];
        for (int c = 0; c < 6; ++c) out[6 * r + c] = row[c];
    }
}

template <class S>
struct System {
    Workspace<S>& work;
    int64_t n;  // free poses

    double* at(int64_t i, int64_t j) const {
        return work.system.data() + work.row[i] + (j - work.head[i]) * 6;
    }
    int64_t stride(int64_t i) const { return (i - work.head[i] + 1) * 6; }

    // Poses that share a source keyframe meet in the system, and those of the band.
    void shape(const Problem& p) {
        work.head.resize(n);
        work.row.resize(n);
        for (int64_t i = 0; i < n; ++i) work.head[i] = i;
        for (const Source& s : work.plan.sources) {
            int64_t first = n;
            each_member(s, [&](int64_t m) { first = std::min(first, m); });
            each_member(s, [&](int64_t m) { work.head[m] = std::min(work.head[m], first); });
        }
        each_in_band(p, [&](int64_t i, int64_t j, const double*) {
            work.head[i] = std::min(work.head[i], j);
        });
        int64_t size = 0;
        for (int64_t i = 0; i < n; ++i) {
            work.row[i] = size;
            size += 6 * stride(i);
        }
        work.system.assign(size, 0.0);
        work.g.assign(6 * n, 0.0);
    }

    // S = A^T (H - E Q E^T) A with y_e = dx_j - Ad_e dx_i (REFERENCE 3.3), and its right side.
    void assemble(bool depth) {
        std::vector<double> sums;
        std::vector<double> adjoints, turned;
        for (const Source& s : work.plan.sources) {
            const int64_t k = s.active - s.first, count = Plan::sums_of(k);
            if (k == 0) continue;
            sums.assign(count, 0.0);
            for (int64_t c = 0; c < work.plan.chunks; ++c) {
                const double* part = work.sums.data() + s.offset + c * count;
                for (int64_t q = 0; q < count; ++q) sums[q] += part[q];
            }
            adjoints.resize(36 * k);
            turned.assign(36 * k, 0.0);
            for (int64_t a = 0; a < k; ++a) adjoint(work.motions[s.first + a], &adjoints[36 * a]);
            const double* pair = sums.data() + k * (POSE_SUMS + 6);
            for (int64_t a = 0; a < k; ++a)
                for (int64_t b = a; b < k; ++b, pair += 36)
                    add_pair(s, a, b, sums.data(), depth ? pair : nullptr, adjoints, turned);
            const int64_t i = work.slot[s.frame];
            double ii[36] = {};
            for (int64_t a = 0; a < k; ++a) {
                const double* hessian = sums.data() + a * POSE_SUMS + HESSIAN;
                const double* seen = sums.data() + k * POSE_SUMS + 6 * a;
                double v[6];
                for (int q = 0; q < 6; ++q) v[q] = hessian[q] - (depth ? seen[q] : 0.0);
                const int64_t j = work.slot[work.plan.jj[s.first + a]];
                if (j >= 0)
                    for (int q = 0; q < 6; ++q) work.g[6 * j + q] += v[q];
                if (i < 0) continue;
                for (int q = 0; q < 6; ++q)
                    for (int r = 0; r < 6; ++r)
                        work.g[6 * i + q] -= adjoints[36 * a + 6 * r + q] * v[r];
                if (j >= 0) add_block(i, j, &turned[36 * a]);
                double own[36];
                multiply(&turned[36 * a], &adjoints[36 * a], own);
                for (int q = 0; q < 36; ++q) ii[q] -= own[q];
            }
            if (i >= 0) add_diagonal(i, ii);
        }
    }

    // What is known of the poses besides.
    void add_band(const Problem& p) {
        each_in_band(p, [&](int64_t i, int64_t j, const double* X) {
            if (i == j) return add_diagonal(i, X);
            for (int r = 0; r < 6; ++r)
                for (int c = 0; c < 6; ++c) at(i, j)[r * stride(i) + c] += X[6 * r + c];
        });
        for (int64_t i = 0; p.reach >= 0 && i < n; ++i)
            for (int q = 0; q < 6; ++q) work.g[6 * i + q] += p.band_rhs[6 * work.free[i] + q];
    }

    // diag <- diag (1 + lm) + ep, then L L^T in place; false if it is singular.
    bool factorise(double lm, double ep, double floor) {
        for (int64_t i = 0; i < n; ++i) {
            const int64_t li = stride(i);
            double least[6];
            for (int r = 0; r < 6; ++r) {
                double& diagonal = at(i, i)[r * li + r];
                const double added = lm * diagonal + ep;
                // damping of that size vouches for the pivot: undamped ones are not negative
                least[r] = added < floor * diagonal ? floor * diagonal : 0.0;
                diagonal += added;
            }
            for (int64_t j = work.head[i]; j < i; ++j) {
                const int64_t k = std::max(work.head[i], work.head[j]), lj = stride(j);
                double* const X = at(i, j);
                subtract_products(at(i, k), li, at(j, k), lj, (j - k) * 6, X);
                const double* const L = at(j, j);
                for (int c = 0; c < 6; ++c)
                    for (int r = 0; r < 6; ++r) {
                        double x = X[r * li + c];
                        for (int q = 0; q < c; ++q) x -= X[r * li + q] * L[c * lj + q];
                        X[r * li + c] = x * work.inverse[6 * j + c];
                    }
            }
            double* const D = at(i, i);
            subtract_products(at(i, work.head[i]), li, at(i, work.head[i]), li,
                              (i - work.head[i]) * 6, D);
            for (int c = 0; c < 6; ++c) {
                double pivot = D[c * li + c];
                for (int q = 0; q < c; ++q) pivot -= D[c * li + q] * D[c * li + q];
                if (!(pivot > least[c])) return false;
                const double inverse = 1.0 / sqrt(pivot);
                work.inverse[6 * i + c] = inverse;
                D[c * li + c] = pivot * inverse;
                for (int r = c + 1; r < 6; ++r) {
                    double x = D[r * li + c];
                    for (int q = 0; q < c; ++q) x -= D[r * li + q] * D[c * li + q];
                    D[r * li + c] = x * inverse;
                }
            }
        }
        return true;
    }

    // x = (L L^T)^-1 g, in place of g.
    void solve() {
        double* const x = work.g.data();
        for (int64_t i = 0; i < n; ++i)
            for (int r = 0; r < 6; ++r) {
                const double* row = at(i, work.head[i]) + r * stride(i);
                const int64_t from = 6 * work.head[i], to = 6 * i + r;
                double sum = x[to];
                for (int64_t c = from; c < to; ++c) sum -= row[c - from] * x[c];
                x[to] = sum * work.inverse[to];
            }
        for (int64_t i = n - 1; i >= 0; --i)
            for (int r = 5; r >= 0; --r) {
                const double* row = at(i, work.head[i]) + r * stride(i);
                const int64_t from = 6 * work.head[i], to = 6 * i + r;
                const double value = x[to] *= work.inverse[to];
                for (int64_t c = from; c < to; ++c) x[c] -= row[c - from] * value;
            }
    }

  private:
    // f(i, j, block) of free poses i >= j.
    template <class F>
    void each_in_band(const Problem& p, F f) const {
        for (int64_t i = 0; i < n; ++i)
            for (int64_t m = 0; m <= std::min(p.reach, work.free[i]); ++m) {
                const int64_t j = work.slot[work.free[i] - m];
                if (j >= 0) f(i, j, p.band + (work.free[i] * (p.reach + 1) + m) * 36);
            }
    }
    template <class F>
    void each_member(const Source& s, F f) const {
        if (s.active == s.first) return;
        if (work.slot[s.frame] >= 0) f(work.slot[s.frame]);
        for (int64_t e = s.first; e < s.active; ++e)
            if (work.slot[work.plan.jj[e]] >= 0) f(work.slot[work.plan.jj[e]]);
    }

    // Adds X to block (i, j), or its transpose to (j, i), whichever is stored.
    void add_block(int64_t i, int64_t j, const double* X) const {
        if (i == j) {
            double both[36];
            for (int r = 0; r < 6; ++r)
                for (int c = 0; c < 6; ++c) both[6 * r + c] = X[6 * r + c] + X[6 * c + r];
            return add_diagonal(i, both);
        }
        double* const to = i > j ? at(i, j) : at(j, i);
        const int64_t stride_to = stride(std::max(i, j));
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c < 6; ++c) to[r * stride_to + c] += i > j ? X[6 * r + c] : X[6 * c + r];
    }
    void add_diagonal(int64_t i, const double* X) const {
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c <= r; ++c)
                at(i, i)[r * stride(i) + c] += 0.5 * (X[6 * r + c] + X[6 * c + r]);
    }

    // One pair of edges of a source: block (j_a, j_b), and its share of row i in `turned`.
    void add_pair(const Source& s, int64_t a, int64_t b, const double* sums, const double* seen,
                  const std::vector<double>& adjoints, std::vector<double>& turned) const {
        double X[36];
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c < 6; ++c) {
                const int lower = std::min(r, c), higher = std::max(r, c);
                double x = a == b ? sums[a * POSE_SUMS + upper(lower, higher)] : 0.0;
                if (seen) x -= a == b ? seen[6 * lower + higher] : seen[6 * r + c];
                X[6 * r + c] = x;
            }
        const int64_t ja = work.slot[work.plan.jj[s.first + a]];
        const int64_t jb = work.slot[work.plan.jj[s.first + b]];
        if (ja >= 0 && jb >= 0 && a == b) add_diagonal(ja, X);
        if (ja >= 0 && jb >= 0 && a != b) add_block(ja, jb, X);
        if (work.slot[s.frame] < 0) return;
        double B[36];
        multiply_transposed(&adjoints[36 * a], X, B);
        for (int q = 0; q < 36; ++q) turned[36 * b + q] -= B[q];
        if (a == b) return;
        double Xt[36];
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c < 6; ++c) Xt[6 * r + c] = X[6 * c + r];
        multiply_transposed(&adjoints[36 * b], Xt, B);
        for (int q = 0; q < 36; ++q) turned[36 * a + q] -= B[q];
    }

    // out[6,6] -= A B^T over `length` columns.
    static void subtract_products(const double* A, int64_t la, const double* B, int64_t lb,
                                  int64_t length, double* out) {
        using R = Pack<double>;
        const int64_t whole = length - length % R::lanes;
        for (int r = 0; r < 6; r += 2) {
            R top[6], low[6];
            for (int c = 0; c < 6; ++c) top[c] = low[c] = R(0.0);
            for (int64_t k = 0; k < whole; k += R::lanes) {
                const R a = R::load(A + r * la + k), b = R::load(A + (r + 1) * la + k);
                for (int c = 0; c < 6; ++c) {
                    const R right = R::load(B + c * lb + k);
                    top[c] += a * right;
                    low[c] += b * right;
                }
            }
            for (int c = 0; c < 6; ++c) {
                double t = total(top[c]), l = total(low[c]);
                for (int64_t k = whole; k < length; ++k) {
                    t += A[r * la + k] * B[c * lb + k];
                    l += A[(r + 1) * la + k] * B[c * lb + k];
                }
                out[r * la + c] -= t;
                out[(r + 1) * la + c] -= l;
            }
        }
    }
};

}  // namespace dw
