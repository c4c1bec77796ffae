// Several cells in one SIMD register, by the vector extension that g++ and clang share.
#pragma once

#include <string.h>

#include "real.h"

#if defined(__AVX2__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
#define DW_BYTES 64
#elif defined(__AVX__)
#define DW_BYTES 32
#else
#define DW_BYTES 16
#endif

namespace dw {

template <class S>
struct Register;
template <>
struct Register<float> {
    typedef float type __attribute__((vector_size(DW_BYTES)));
    typedef int32_t mask __attribute__((vector_size(DW_BYTES)));
};
template <>
struct Register<double> {
    typedef double type __attribute__((vector_size(DW_BYTES)));
    typedef int64_t mask __attribute__((vector_size(DW_BYTES)));
};

template <class S>
struct Pack {
    using V = typename Register<S>::type;
    static constexpr int lanes = DW_BYTES / int(sizeof(S));
    V v;

    Pack() = default;
    DW_HD Pack(V v_) : v(v_) {}
    DW_HD Pack(S s) { v = s - V{}; }  // s itself: nothing is left of the subtraction
    static DW_HD Pack load(const S* from) {
        Pack p;
        memcpy(&p.v, from, sizeof(V));
        return p;
    }
    DW_HD void store(S* to) const { memcpy(to, &v, sizeof(V)); }
    DW_HD S operator[](int k) const { return v[k]; }
    DW_HD Pack& operator+=(Pack o) { v += o.v; return *this; }
    DW_HD Pack& operator-=(Pack o) { v -= o.v; return *this; }
    DW_HD Pack& operator*=(Pack o) { v *= o.v; return *this; }

    friend DW_HD Pack operator+(Pack a, Pack b) { return a.v + b.v; }
    friend DW_HD Pack operator-(Pack a, Pack b) { return a.v - b.v; }
    friend DW_HD Pack operator*(Pack a, Pack b) { return a.v * b.v; }
    friend DW_HD Pack operator/(Pack a, Pack b) { return a.v / b.v; }
    friend DW_HD Pack operator-(Pack a) { return -a.v; }
};

template <class S>
struct Mask {
    typename Register<S>::mask m;
    friend DW_HD Mask operator&(Mask a, Mask b) { return {a.m & b.m}; }
    friend DW_HD Mask operator|(Mask a, Mask b) { return {a.m | b.m}; }
};

template <class S>
DW_HD Mask<S> operator<(Pack<S> a, Pack<S> b) { return {a.v < b.v}; }
template <class S>
DW_HD Mask<S> operator>=(Pack<S> a, Pack<S> b) { return {a.v >= b.v}; }
template <class S>
DW_HD Mask<S> operator>(Pack<S> a, Pack<S> b) { return {a.v > b.v}; }
template <class S>
DW_HD Mask<S> operator<=(Pack<S> a, Pack<S> b) { return {a.v <= b.v}; }

template <class S>
DW_HD Pack<S> select(Mask<S> mask, Pack<S> a, Pack<S> b) {
    return Pack<S>(mask.m ? a.v : b.v);
}

template <class S>
DW_HD Mask<S> both(Mask<S> a, Mask<S> b) {
    return a & b;
}

template <class S>
struct Element<Pack<S>> {
    using type = S;
};
template <class S>
struct Fill<Pack<S>> {
    static DW_HD Pack<S> of(S s) { return Pack<S>(s); }
};

template <class S>
DW_HD Pack<S> root(Pack<S> x) {
    Pack<S> out;
    for (int k = 0; k < Pack<S>::lanes; ++k) out.v[k] = root(x.v[k]);
    return out;
}

template <class S>
DW_HD Mask<S> finite_number(Pack<S> x) {
    // x - x is 0 for finite numbers and NaN for all others
    return {(x.v - x.v) == typename Pack<S>::V{}};
}

// Sum of the lanes in double precision, always in the same order.
template <class S>
DW_HD double total(Pack<S> x) {
    constexpr int n = Pack<S>::lanes;
    double t[n];
    for (int k = 0; k < n; ++k) t[k] = double(x.v[k]);
    for (int width = n / 2; width > 0; width /= 2)
        for (int k = 0; k < width; ++k) t[k] += t[k + width];
    return t[0];
}

// Separates pairs (x0 y0 x1 y1 ...) into x and y.
template <class S>
DW_HD void split_pairs(const S* from, Pack<S>& x, Pack<S>& y) {
    constexpr int n = Pack<S>::lanes;
    const Pack<S> low = Pack<S>::load(from), high = Pack<S>::load(from + n);
    typename Register<S>::mask even, odd;
    for (int k = 0; k < n; ++k) {
        even[k] = 2 * k;
        odd[k] = 2 * k + 1;
    }
#if defined(__clang__)
    for (int k = 0; k < n; ++k) {
        x.v[k] = k < n / 2 ? low.v[2 * k] : high.v[2 * k - n];
        y.v[k] = k < n / 2 ? low.v[2 * k + 1] : high.v[2 * k + 1 - n];
    }
#else
    x.v = __builtin_shuffle(low.v, high.v, even);
    y.v = __builtin_shuffle(low.v, high.v, odd);
#endif
}

// Separates triples (x0 y0 z0 x1 ...) into x, y and z. No two numbers of one of them have the same
// lane in the three registers that hold them: blended into one, they only need another order.
template <class S>
DW_HD void split_triples(const S* from, Pack<S>& x, Pack<S>& y, Pack<S>& z) {
    constexpr int n = Pack<S>::lanes;
    using V = typename Register<S>::type;
    const V low = Pack<S>::load(from).v, middle = Pack<S>::load(from + n).v;
    const V high = Pack<S>::load(from + 2 * n).v;
    Pack<S>* const out[3] = {&x, &y, &z};
    for (int c = 0; c < 3; ++c) {
        typename Register<S>::mask second, third, order;
        for (int k = 0; k < n; ++k) {
            const int at = 3 * k + c;
            order[k] = at % n;
            second[at % n] = at / n == 1 ? -1 : 0;
            third[at % n] = at / n == 2 ? -1 : 0;
        }
        const V mixed = third ? high : (second ? middle : low);
#if defined(__clang__)
        for (int k = 0; k < n; ++k) out[c]->v[k] = mixed[(3 * k + c) % n];
#else
        out[c]->v = __builtin_shuffle(mixed, order);
#endif
    }
}

#if defined(__AVX2__) && DW_BYTES == 32
template <>
DW_HD Pack<float> root<float>(Pack<float> x) {
    return Pack<float>(_mm256_sqrt_ps(x.v));
}

// The compiler's own answer takes half as many instructions again.
template <>
DW_HD void split_pairs<float>(const float* from, Pack<float>& x, Pack<float>& y) {
    const __m256 low = _mm256_loadu_ps(from), high = _mm256_loadu_ps(from + 8);
    const __m256 even = _mm256_shuffle_ps(low, high, 0x88), odd = _mm256_shuffle_ps(low, high, 0xdd);
    x.v = _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(even), 0xd8));
    y.v = _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(odd), 0xd8));
}
#endif

}  // namespace dw
