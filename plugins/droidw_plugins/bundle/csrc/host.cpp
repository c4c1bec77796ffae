// The kernels of cuda.cu on a CPU, one thread after the other: so that their mathematics is tested
// on machines without a GPU. `native.cpp` is the fast way on a CPU.
#include "launch.h"

DW_API int32_t dw_use_device(int32_t) { return 0; }
DW_API const char* dw_error_text(int32_t) { return ""; }
