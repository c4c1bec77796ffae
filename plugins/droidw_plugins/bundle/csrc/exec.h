// How a kernel is run: on a GPU, or as a plain loop over the same threads on a CPU.
//
// There are two shapes. `map` calls f(i) for every i. `reduce` adds up N numbers over the items of
// each group, one group per block: every thread takes the items t, t + THREADS, ... in order, and
// the sums of the threads are added in one fixed tree. Both executors do the same additions.
#pragma once

#include "real.h"

namespace dw {

constexpr int THREADS = 256, WARP = 32, WARPS = THREADS / WARP;

#if defined(__CUDACC__)

struct Queue {
    cudaStream_t stream;
    cudaError_t error = cudaSuccess;
    explicit Queue(void* s) : stream(static_cast<cudaStream_t>(s)) {}
    void launched() {
        if (error == cudaSuccess) error = cudaGetLastError();
    }
    int code() const { return int(error); }
};

template <class F>
__global__ void __launch_bounds__(THREADS) map_kernel(const F f, int64_t n) {
    const int64_t step = int64_t(gridDim.x) * THREADS;
    for (int64_t i = int64_t(blockIdx.x) * THREADS + threadIdx.x; i < n; i += step) f(i);
}

template <int N, class F>
__global__ void __launch_bounds__(THREADS) reduce_kernel(const F f, int64_t groups, double* out) {
    using Sum = typename F::Sum;
    __shared__ double parts[WARPS * N];
    const int lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    for (int64_t group = blockIdx.x; group < groups; group += gridDim.x) {
        Sum sums[N];
#pragma unroll
        for (int k = 0; k < N; ++k) sums[k] = Sum(0);
        const int64_t items = f.items(group);
        for (int64_t item = threadIdx.x; item < items; item += THREADS) f(group, item, sums);
#pragma unroll
        for (int k = 0; k < N; ++k) {
            Sum s = sums[k];
            for (int far = WARP / 2; far > 0; far /= 2) s += __shfl_down_sync(~0u, s, far);
            if (lane == 0) parts[warp * N + k] = double(s);
        }
        __syncthreads();
        for (int k = threadIdx.x; k < N; k += THREADS) {
            double s = 0;
            for (int w = 0; w < WARPS; ++w) s += parts[w * N + k];
            out[group * N + k] = s;
        }
        __syncthreads();
    }
}

// Blocks of a launch; kernels stride over what is left.
inline unsigned blocks_for(int64_t n) {
    constexpr int64_t most = int64_t(1) << 20;
    return unsigned(n < most ? n : most);
}

template <class F>
void map(Queue& queue, int64_t n, const F& f) {
    if (n <= 0 || queue.error != cudaSuccess) return;
    map_kernel<<<blocks_for((n + THREADS - 1) / THREADS), THREADS, 0, queue.stream>>>(f, n);
    queue.launched();
}

template <int N, class F>
void reduce(Queue& queue, int64_t groups, const F& f, double* out) {
    if (groups <= 0 || queue.error != cudaSuccess) return;
    reduce_kernel<N><<<blocks_for(groups), THREADS, 0, queue.stream>>>(f, groups, out);
    queue.launched();
}

// Adds to an integer that many threads add to; the order cannot change the result.
__device__ __forceinline__ void add_integer(int64_t* to, int64_t value) {
    atomicAdd(reinterpret_cast<unsigned long long*>(to), static_cast<unsigned long long>(value));
}
#define DW_KERNEL __device__ __forceinline__

#else

struct Queue {
    explicit Queue(void*) {}
    int code() const { return 0; }
};

template <class F>
void map(Queue&, int64_t n, const F& f) {
    for (int64_t i = 0; i < n; ++i) f(i);
}

template <int N, class F>
void reduce(Queue&, int64_t groups, const F& f, double* out) {
    using Sum = typename F::Sum;
    for (int64_t group = 0; group < groups; ++group) {
        Sum sums[THREADS][N] = {};
        const int64_t items = f.items(group);
        for (int64_t thread = 0; thread < THREADS; ++thread)
            for (int64_t item = thread; item < items; item += THREADS) f(group, item, sums[thread]);
        for (int k = 0; k < N; ++k) {
            double total = 0;
            for (int warp = 0; warp < WARPS; ++warp) {
                Sum lanes[WARP];
                for (int lane = 0; lane < WARP; ++lane) lanes[lane] = sums[warp * WARP + lane][k];
                for (int far = WARP / 2; far > 0; far /= 2)
                    for (int lane = 0; lane < far; ++lane) lanes[lane] += lanes[lane + far];
                total += double(lanes[0]);
            }
            out[group * N + k] = total;
        }
    }
}

inline void add_integer(int64_t* to, int64_t value) { *to += value; }
#define DW_KERNEL inline

#endif

}  // namespace dw
