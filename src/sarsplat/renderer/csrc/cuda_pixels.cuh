// cuda_pixels.cuh: pass B. Forward a block is a tile of pixels; backward a warp is a Gaussian that reads its pixels.
#pragma once
#include "cuda_state.cuh"

namespace sarsplat {
namespace SG_ISA {

// From the sums of w to cross-sections, and to the amplitudes of pass B.
extern "C" __global__ void __launch_bounds__(kThreads) illuminate(sg_problem p, State s, sg_outputs out) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j < 0) return;
  const float w = sum_of_weights(s, j);
  const float lit = w * (p.ray[0] * p.ray[1]), sigma = s.gamma0[j] * lit;
  s.weight[j] = w;
  out.lit_area[j] = lit;
  out.cross_sections[j] = sigma;
  s.pixels.splats[j].g.height = s.pixels.splats[j].extra * sigma;
}

extern "C" __global__ void __launch_bounds__(kThreads) image_tiles(sg_problem p, State s, float* images) {
  __shared__ Footprint staged[kThreads];
  const Lattice lattice = lattice_of_tile(s.pixels.lattices, p.views, blockIdx.x);
  const Point pixel = point_of_thread(lattice, blockIdx.x);
  const int64_t first = s.pixels.starts[blockIdx.x];
  const int count = (int)(s.pixels.starts[blockIdx.x + 1] - first);
  const float cut = image_cut(p);
  float S = 0.0f;
  for (int begin = 0; begin < count; begin += kThreads) {
    const int size = count - begin < kThreads ? count - begin : kThreads;
    __syncthreads();  // nobody still reads what was staged before
    if (thread() < size)
      staged[thread()] = placed(s.pixels.splats[s.pixels.owners[s.pixels.order[first + begin + thread()]]].g, lattice);
    __syncthreads();
    for (int k = 0; k < size; k++) {
      const Footprint& g = staged[k];
      if (g.height == 0.0f) continue;  // unlit
      const Offset<float> d = offset(g, (float)pixel.x, (float)pixel.y);
      S += imaging_weight(distance(d), cut) * g.height;
    }
  }
  if (pixel.inside) images[pixel.index] = S;
}

// dL/dS and dL/dsigma (or null) to the moments of every Gaussian, to dL/dsigma through both, and to dL/dw.
extern "C" __global__ void __launch_bounds__(kThreads)
image_backward(sg_problem p, State s, const float* d_images, const float* d_cross_sections) {
  const int64_t j = (int64_t)blockIdx.x * kWarps + warp(), n = p.gaussians;
  if (j >= n * p.views) return;
  const Splat splat = s.pixels.splats[j];
  const Lattice lattice = s.pixels.lattices[j / n];
  const Footprint g = placed(splat.g, lattice);
  const Box box = points(g, s.pixels.reach + 2 * j, lattice);
  const float cut = image_cut(p);
  Moments<float> m{};
  if (s.weight[j] != 0.0f && !empty(box)) {  // an unlit Gaussian has no gradient
    const int64_t width = box.x.last - box.x.first + 1, pixels = width * (box.y.last - box.y.first + 1);
    for (int64_t k = lane(); k < pixels; k += kWarp) {
      const int x = box.x.first + (int)(k % width), y = box.y.first + (int)(k / width);
      const Offset<float> d = offset(g, (float)x, (float)y);
      m.add(d, imaging_weight(distance(d), cut) * d_images[lattice.first_point + (int64_t)y * lattice.columns + x]);
    }
  }
  const float sum = sum6(m.m0, m.mu, m.mv, m.muu, m.muv, m.mvv, lane());
  const int sixth = sixth_of(lane());
  if (sixth >= 0) s.pixel_moments[6 * j + sixth] = sum;
  if (lane() != 0) return;
  const float d_sigma = sum * splat.extra + (d_cross_sections ? d_cross_sections[j] : 0.0f);
  s.d_sigma[j] = d_sigma;
  s.h[j] = d_sigma * s.gamma0[j] * (p.ray[0] * p.ray[1]);
}

}  // namespace SG_ISA
}  // namespace sarsplat
