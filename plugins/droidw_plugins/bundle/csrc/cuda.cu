// The kernels on a GPU. No torch headers: nvcc alone makes a shared library of this file.
#include "launch.h"

// The GPU that this thread launches on from now on. torch has a runtime of its own, so that its choice
// need not be ours.
DW_API int32_t dw_use_device(int32_t index) { return int32_t(cudaSetDevice(index)); }

// What the runtime says about a code that a launcher returned.
DW_API const char* dw_error_text(int32_t code) { return cudaGetErrorString(cudaError_t(code)); }
