// The kernels on a GPU. No torch headers: nvcc alone makes a shared library of this file.
#include "launch.h"

// What the runtime says about a code that a launcher returned.
DW_API const char* dw_error_text(int32_t code) { return cudaGetErrorString(cudaError_t(code)); }
