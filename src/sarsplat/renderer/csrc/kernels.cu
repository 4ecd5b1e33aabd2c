// kernels.cu: the CUDA engine, compiled at first use by NVRTC for the device found (nvrtc.py), without any header of the
// toolkit. The mathematics is that of the CPU engine: pair_math.h, gaussian_math.h, lobe_math.h, loss_math.h and
// adam_math.h.
//
// project     Gaussians to footprints, placed on both planes; tiles are counted, listed and put in order
// attenuate   rays front to back: lit areas, and cross-sections
// splat       footprints to images of one or several channels
// ground      what of it a pixel sees behind all Gaussians, level or terrain
//
// A whole rendering is these steps on arrays of one pass (cuda.py), and its gradient their adjoints in reverse order.
// No float is ever added atomically: every sum has a fixed order, and results are bit-identical from run to run.
#include "cuda_project.cuh"
#include "cuda_rays.cuh"
#include "cuda_pixels.cuh"
#include "cuda_loss.cuh"
#include "cuda_training.cuh"
#include "cuda_ground.cuh"
#include "cuda_terrain.cuh"
