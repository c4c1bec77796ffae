// A loop over independent pieces of work, on as many threads as are asked for.
#pragma once

#include <cstdint>

#if defined(_OPENMP)
#include <omp.h>
#endif

namespace dw {

// Runs f(index, thread) for every index below n.
template <class F>
void parallel(int64_t n, int threads, F f) {
#if defined(_OPENMP)
    if (threads > 1 && n > 1) {
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
        for (int64_t k = 0; k < n; ++k) f(k, omp_get_thread_num());
        return;
    }
#else
    (void)threads;
#endif
    for (int64_t k = 0; k < n; ++k) f(k, 0);
}

}  // namespace dw
