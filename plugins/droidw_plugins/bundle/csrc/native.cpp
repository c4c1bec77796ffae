// Backend `native`: one Gauss-Newton step on a CPU. Plain C interface, called through ctypes.
//
// A library is compiled for one kind of number, DW_NUMBER: most of the time it takes to compile is
// for its kernels, and a run needs one of them.
//
// The result does not depend on the number of threads: the cells are cut into units of a fixed
// size, each with sums of its own, and those are added up in one order.

#include <cmath>
#include <new>

#include "native_problem.h"
#include "native_solve.h"
#include "native_unit.h"
#include "native_views.h"
#include "parallel.h"

#ifndef DW_NUMBER
#define DW_NUMBER float
#endif

namespace dw {

template <class S, bool CROSS>
class Stepper {
  public:
    Stepper(const Problem& p, Workspace<S>& work)
        : p_(p), work_(work), start_(p, work, p.disps), threads_(std::max(1, p.threads)) {}

    Report run() {
        report_ = Report{};
        report_.cost_after = NAN;
        prepare();
        linearise(false);
        if (!finite_) {
            linearise(true);
            if (!finite_) {
                report_.cost_before = NAN;
                return unchanged(NONFINITE);
            }
        }
        free_poses();
        if (p_.guard) energy_ = energy(start_, work_.motions.data());
        report_.cost_before = energy_ + prior_energy(start_.disps);
        const int64_t n = int64_t(work_.free.size());
        if (n == 0 && !depth_can_move()) return unchanged(EMPTY);
        work_.dx.assign(6 * p_.frames, 0.0);
        if (n && !solve(n)) return unchanged(SINGULAR);
        double norm = 0;
        for (int64_t k = 0; k < p_.frames; ++k) {
            double s = 0;
            for (int q = 0; q < 6; ++q) s += work_.dx[6 * k + q] * work_.dx[6 * k + q];
            if (!finite_number(s)) return unchanged(NONFINITE);
            norm = std::max(norm, std::sqrt(s));
        }
        if (!p_.motion_only) substitute();
        for (int attempt = 0; attempt <= (p_.guard ? p_.halvings : 0); ++attempt) {
            const double scale = std::ldexp(1.0, -attempt);
            if (!move(scale)) return unchanged(NONFINITE);
            report_.step_norm = scale * norm;
            if (!p_.guard) return done();
            std::vector<Motion<double>> moved(p_.edges);
            motions_of(static_cast<const S*>(p_.T_out), moved);
            const View<S, CROSS> now(p_, work_, p_.disps_out);
            const double after =
                energy(now, moved.data()) + prior_energy(now.disps) + band_energy(scale);
            if (after <= report_.cost_before) {
                report_.cost_after = after;
                return done();
            }
        }
        report_.step_norm = 0;
        report_.cost_after = report_.cost_before;
        return unchanged(REJECTED);
    }

  private:
    const Problem& p_;
    Workspace<S>& work_;
    View<S, CROSS> start_;
    int threads_;
    bool finite_ = true;
    double energy_ = 0, curvature_ = 0;
    Report report_{};

    void prepare() {
        Plan& plan = work_.plan;
        plan.make(p_);
        const int64_t cells = plan.cells, k = int64_t(plan.sources.size());
        work_.ray_x.assign(cells + BLOCK, S(0));
        work_.ray_y.assign(cells + BLOCK, S(0));
        for (int64_t c = 0; c < cells; ++c) {
            work_.ray_x[c] = S((double(c % p_.width) - p_.cx) / p_.fx);
            work_.ray_y[c] = S((double(c / p_.width) - p_.cy) / p_.fy);
        }
        grow(work_.Q, k * cells);
        grow(work_.rhs, k * cells);
        grow(work_.sums, plan.sums);
        work_.found.assign(plan.units.size(), Found());
        if (int64_t(work_.scratch.size()) < threads_) work_.scratch.resize(threads_);
        for (Scratch<S>& s : work_.scratch) s.reserve(plan.most_active);
        work_.motions.resize(p_.edges);
        motions_of(static_cast<const S*>(p_.T_cw), work_.motions);
        work_.has_source.assign(p_.frames, 0);
        for (const Source& s : plan.sources) work_.has_source[s.frame] = 1;
    }

    template <class T>
    static void grow(std::vector<T>& held, int64_t size) {
        if (int64_t(held.size()) < size) held.resize(size);
    }

    void motions_of(const S* T_cw, std::vector<Motion<double>>& out) const {
        for (int64_t e = 0; e < p_.edges; ++e)
            out[e] = relative_motion(T_cw + 7 * work_.plan.ii[e], T_cw + 7 * work_.plan.jj[e]);
    }

    void linearise(bool check) {
        start_.check = check;
        const std::vector<Unit>& units = work_.plan.units;
        parallel(int64_t(units.size()), threads_, [&](int64_t u, int thread) {
            Scratch<S>& mine = work_.scratch[thread];
            Found& found = work_.found[u];
            if (p_.motion_only) linearise_unit<S, CROSS, false>(start_, units[u], mine, found);
            else linearise_unit<S, CROSS, true>(start_, units[u], mine, found);
        });
        energy_ = curvature_ = 0;
        double dropped = 0;
        finite_ = true;
        for (const Found& found : work_.found) {
            energy_ += found.energy;
            curvature_ += found.curvature;
            dropped += found.dropped;
            finite_ &= found.finite;
        }
        report_.dropped = int64_t(dropped);
    }

    // A pose moves if it is not fixed and an edge with a positive weight sees it.
    void free_poses() {
        std::vector<uint8_t> seen(p_.frames, 0);
        for (const Source& s : work_.plan.sources) {
            const int64_t count = Plan::sums_of(s.active - s.first);
            for (int64_t e = s.first; e < s.active; ++e) {
                bool usable = false;
                for (int64_t c = 0; c < work_.plan.chunks; ++c) {
                    const double* sums =
                        work_.sums.data() + s.offset + c * count + (e - s.first) * POSE_SUMS;
                    usable |= sums[upper(3, 3)] > 0 || sums[upper(4, 4)] > 0;
                }
                if (usable) seen[s.frame] = seen[work_.plan.jj[e]] = 1;
            }
        }
        work_.slot.assign(p_.frames, -1);
        work_.free.clear();
        for (int64_t k = 0; k < p_.frames; ++k) {
            if (p_.fixed[k]) continue;
            if (!seen[k]) {
                p_.isolated[report_.isolated++] = k;
                continue;
            }
            work_.slot[k] = int64_t(work_.free.size());
            work_.free.push_back(k);
        }
    }

    bool has_prior() const { return p_.prior && p_.prior_weight > 0 && !p_.motion_only; }
    bool depth_moves(int64_t frame) const { return !p_.fixed[frame] || work_.has_source[frame]; }
    const S* prior_of(int64_t frame) const {
        return static_cast<const S*>(p_.prior) + frame * work_.plan.cells;
    }

    bool depth_can_move() const {
        if (p_.motion_only) return false;
        if (curvature_ > 0) return true;
        if (!has_prior()) return false;
        for (int64_t k = 0; k < p_.frames; ++k)
            if (depth_moves(k))
                for (int64_t c = 0; c < work_.plan.cells; ++c)
                    if (prior_of(k)[c] > 0) return true;
        return false;
    }

    double prior_energy(const S* disps) const {
        if (!has_prior()) return 0;
        using R = Pack<S>;
        double sum = 0;
        const int64_t cells = work_.plan.cells;
        for (int64_t k = 0; k < p_.frames; ++k) {
            if (!depth_moves(k)) continue;
            R lanes(S(0));
            for (int64_t c = 0; c < cells; c += R::lanes) {
                const R known = Reader<S>::one(prior_of(k) + c, cells - c);
                const R off = Reader<S>::one(disps + k * cells + c, cells - c) - known;
                lanes += select(known > R(S(0)), off * off, R(S(0)));
            }
            sum += total(lanes);
        }
        return p_.prior_weight * sum;
    }

    // x^T H x - 2 g^T x of a scaled step.
    double band_energy(double scale) const {
        double sum = 0;
        for (int64_t k = 0; p_.reach >= 0 && k < p_.frames; ++k) {
            const double* x = work_.dx.data() + 6 * k;
            for (int64_t m = 0; m <= std::min(p_.reach, k); ++m) {
                const double* X = p_.band + (k * (p_.reach + 1) + m) * 36;
                double product = 0;
                for (int r = 0; r < 6; ++r)
                    for (int c = 0; c < 6; ++c) product += x[r] * X[6 * r + c] * x[c - 6 * m];
                sum += (m == 0 ? 1 : 2) * scale * scale * product;
            }
            for (int q = 0; q < 6; ++q) sum -= 2 * scale * p_.band_rhs[6 * k + q] * x[q];
        }
        return sum;
    }

    double energy(const View<S, CROSS>& now, const Motion<double>* moved) {
        const std::vector<Unit>& units = work_.plan.units;
        std::vector<double> parts(units.size());
        parallel(int64_t(units.size()), threads_, [&](int64_t u, int) {
            parts[u] = energy_unit(start_, now, moved, units[u]);
        });
        double sum = 0;
        for (const double part : parts) sum += part;
        return sum;
    }

    bool solve(int64_t n) {
        System<S> system{work_, n};
        work_.inverse.resize(6 * n);
        system.shape(p_);
        system.assemble(!p_.motion_only);
        system.add_band(p_);
        // least share of its diagonal entry that is taken for information and not for rounding
        const double floor = sizeof(S) == 8 ? 1e-11 : 1e-5;
        if (!system.factorise(p_.lm, p_.ep, floor)) return false;
        system.solve();
        for (int64_t k = 0; k < n; ++k)
            for (int q = 0; q < 6; ++q) work_.dx[6 * work_.free[k] + q] = work_.g[6 * k + q];
        return true;
    }

    void substitute() {
        std::vector<double> steps(6 * p_.edges, 0.0);
        for (const Source& s : work_.plan.sources)
            for (int64_t e = s.first; e < s.active; ++e) {
                double Ad[36];
                adjoint(work_.motions[e], Ad);
                for (int r = 0; r < 6; ++r) {
                    double y = work_.dx[6 * work_.plan.jj[e] + r];
                    for (int c = 0; c < 6; ++c) y -= Ad[6 * r + c] * work_.dx[6 * s.frame + c];
                    steps[6 * e + r] = y;
                }
            }
        const std::vector<Unit>& units = work_.plan.units;
        parallel(int64_t(units.size()), threads_, [&](int64_t u, int) {
            substitute_unit(start_, units[u], steps.data());
        });
    }

    // Poses and disparities after a scaled step into the output; false if one is not finite.
    bool move(double scale) {
        const S* T = static_cast<const S*>(p_.T_cw);
        S* T_out = static_cast<S*>(p_.T_out);
        bool finite = true;
        for (int64_t k = 0; k < p_.frames; ++k) {
            double xi[6];
            for (int q = 0; q < 6; ++q) xi[q] = scale * work_.dx[6 * k + q];
            if (work_.slot[k] >= 0) retract(T + 7 * k, xi, T_out + 7 * k);
            else std::copy(T + 7 * k, T + 7 * k + 7, T_out + 7 * k);
            for (int q = 0; q < 7; ++q) finite &= finite_number(T_out[7 * k + q]);
        }
        const int64_t cells = work_.plan.cells;
        std::vector<int64_t> source_of(p_.frames, -1);
        for (size_t s = 0; s < work_.plan.sources.size(); ++s)
            source_of[work_.plan.sources[s].frame] = int64_t(s);
        for (int64_t k = 0; k < p_.frames; ++k) finite &= move_depths(k, source_of[k], S(scale), cells);
        return finite;
    }

    bool move_depths(int64_t k, int64_t source, S scale, int64_t cells) const {
        using R = Pack<S>;
        const S* d = static_cast<const S*>(p_.disps) + k * cells;
        S* out = static_cast<S*>(p_.disps_out) + k * cells;
        const bool towards_prior = source < 0 && has_prior() && depth_moves(k);
        const R low = R(S(p_.min_disp)), high = R(S(p_.max_disp)), zero = R(S(0));
        R broken = zero;
        for (int64_t c = 0; c < cells; c += R::lanes) {
            const int64_t left = cells - c;
            const R here = Reader<S>::one(d + c, left);
            R step = zero, there = here;
            if (!p_.motion_only) {
                if (source >= 0) step = Reader<S>::one(&work_.rhs[source * cells + c], left);
                if (towards_prior) {
                    const R known = Reader<S>::one(prior_of(k) + c, left);
                    step = select(known > zero, known - here, zero);
                }
                there = here + step * R(scale);
                there = select(there < low, low, there);
                there = select(there > high, high, there);
            }
            Reader<S>::write(out + c, left, there);
            broken += select(finite_number(step) & finite_number(there), zero, R(S(1)));
        }
        return total(broken) == 0;
    }

    Report unchanged(Status status) {
        const S* T = static_cast<const S*>(p_.T_cw);
        const S* d = static_cast<const S*>(p_.disps);
        std::copy(T, T + 7 * p_.frames, static_cast<S*>(p_.T_out));
        std::copy(d, d + p_.frames * p_.height * p_.width, static_cast<S*>(p_.disps_out));
        report_.status = status;
        return report_;
    }
    Report done() {
        report_.status = OK;
        return report_;
    }
};

template <class S>
Report step(const Problem& p, Workspace<S>& work) {
    return p.channels == 3 ? Stepper<S, true>(p, work).run() : Stepper<S, false>(p, work).run();
}

using Number = DW_NUMBER;

}  // namespace dw

extern "C" {

// Raised whenever a call, or the layout of `Problem` or `Report`, changes.
int32_t dw_native_version() { return 4; }

void* dw_native_open() { return new (std::nothrow) dw::Workspace<dw::Number>(); }

void dw_native_close(void* work) { delete static_cast<dw::Workspace<dw::Number>*>(work); }

// One step. Returns 0, or 1 if there was not enough memory.
int32_t dw_native_step(void* work, const dw::Problem* p, dw::Report* report) {
    try {
        *report = dw::step(*p, *static_cast<dw::Workspace<dw::Number>*>(work));
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

// Maps and distances.
void dw_native_similarity(const dw::SampleJob* job) { dw::similarity<dw::Number>(*job); }
void dw_native_data_term(const dw::SampleJob* job) { dw::data_term<dw::Number>(*job); }
void dw_native_flow(const dw::FlowJob* job) { dw::flow_sums<dw::Number>(*job); }

}  // extern "C"
