// kernels.cu: the CUDA engine, compiled at first use by NVRTC for the device found (nvrtc.py), without any header of the
// toolkit. The mathematics is that of the CPU engine: pair_math.h and gaussian_math.h.
//
// forward:  project -> count and list tiles on both planes (sorted in between by torch) -> pass A -> cross-sections -> pass B
// backward: pass B (gather per Gaussian) -> pass A (back to front) -> adjoint of the projection, views summed in order
//
// No float is ever added atomically: every sum has a fixed order, and results are bit-identical from run to run.
#include "cuda_project.cuh"
#include "cuda_rays.cuh"
#include "cuda_pixels.cuh"
#include "cuda_gradients.cuh"
#include "cuda_steps.cuh"
