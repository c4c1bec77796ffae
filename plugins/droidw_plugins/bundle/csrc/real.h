// What the mathematics needs of a number, for plain scalars. `pack.h` has the same for several
// cells at a time, so that one source serves a CUDA thread and a SIMD register.
#pragma once

#include <math.h>
#include <stdint.h>

#if defined(__CUDACC__)
#define DW_HD __host__ __device__ __forceinline__
#else
#define DW_HD inline __attribute__((always_inline))
#endif

namespace dw {

// Element of a number: float and double are their own, a pack has that of its lanes.
template <class R>
struct Element {
    using type = R;
};
template <class R>
using element = typename Element<R>::type;

template <class R>
struct Fill {
    static DW_HD R of(R s) { return s; }
};
template <class R>
DW_HD R fill(element<R> s) {
    return Fill<R>::of(s);
}

DW_HD float select(bool mask, float a, float b) { return mask ? a : b; }
DW_HD double select(bool mask, double a, double b) { return mask ? a : b; }
DW_HD bool both(bool a, bool b) { return a && b; }
DW_HD float root(float x) { return sqrtf(x); }
DW_HD double root(double x) { return sqrt(x); }

// False for NaN and infinities, whatever the compiler thinks of comparing with itself.
DW_HD bool finite_number(float x) { return fabsf(x) <= 3.402823466e38f; }
DW_HD bool finite_number(double x) { return fabs(x) <= 1.7976931348623157e308; }

// The larger of x and a bound; NaN stays NaN.
template <class R>
DW_HD R at_least(R x, R bound) {
    return select(x < bound, bound, x);
}

// Least positive normal number of the type.
template <class S>
struct Limits;
template <>
struct Limits<float> {
    static constexpr float tiny = 1.17549435e-38f;
};
template <>
struct Limits<double> {
    static constexpr double tiny = 2.2250738585072014e-308;
};

}  // namespace dw
