// differentiate.h: from six sums per Gaussian, view and plane to the gradients of a problem's arrays: everything after
// the pair loops.
#pragma once
#include "planes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// What the pair loops left of kWidth Gaussians: a row of each plane, as columns.
void gather(const ViewState& s, const Backward& scratch, int64_t i, int real, F (&sums)[kFields]) {
  turn([&](int k, [[maybe_unused]] int part) {
    if (k >= real) return splat(0.0f);
    auto ray = [&] {
      const RayEntry& e = s.on_rays[i + k];
      Eight sum = (Eight)(0.0f);
      for (int slot = e.slot; slot <= e.slot + e.last_band - e.first_band; slot++)
        sum += load_eight(scratch.ray_moments + kSums * (int64_t)slot);
      return sum;
    };
    auto pixel = [&] { return load_eight(scratch.pixel_moments + kSums * (i + k)); };
#if SG_WIDTH == 16
    return (F)__builtin_shufflevector(ray(), pixel(), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
#elif SG_WIDTH == 8
    return part < kSums ? ray() : pixel();
#else
    const Eight row = part < kSums ? ray() : pixel();
    return part % kSums ? row.hi : row.lo;
#endif
  }, sums);
}

void differentiate(const sg_context& c, const sg_problem& p, const sg_gradients& g, const Backward* scratch, int64_t first,
                   int64_t end, float* shift_sums) {
  const PlaneUnits u = units(p);
  const int64_t n = p.gaussians;
  for (int k = 0; k < 2 * p.views; k++) shift_sums[k] = 0.0f;
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = least(kWidth, (int)(n - i));
    const Bodies bodies = read_bodies(p, i, real);
    const Body<F>& b = bodies.body;
    const F zero = splat(0.0f), kappa = bodies.kappa;
    BodyGradient<F> total;
    for (F& x : total.mean) x = zero;
    for (F& x : total.g) x = zero;
    for (F& x : total.scale) x = zero;
    for (F& x : total.rot) x = zero;
    total.kappa = zero;
    F d_harmonics[kFields];
    for (F& x : d_harmonics) x = zero;
    for (int v = 0; v < p.views; v++) {
      const ViewState& s = c.views[v];
      F sums[kFields];
      gather(s, scratch[v], i, real, sums);
      const F d_gamma0 = sums[14], d_sum = d_gamma0 * sums[15];
      for (int k = 0; k < 6; k++) sums[k] *= kLn2;  // tau is in units of log2(e)
      const Moments<F> mr{sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]};
      const Moments<F> mp{sums[8], sums[9], sums[10], sums[11], sums[12], sums[13]};
      const Projection<F> proj = project(b, s.frame, u);
      F planes[4];
      accumulate(proj, s.frame, u, mr, mp, p.peak != 0, total, planes);
      total.kappa += mr.m0;
      shift_sums[2 * v] += sum(planes[2]);
      shift_sums[2 * v + 1] += sum(planes[3]);
      if (g.planes)
        for (int k = 0; k < real; k++)
          for (int q = 0; q < 4; q++) g.planes[((int64_t)v * n + i + k) * 4 + q] = planes[q][k];
      if (g.gamma0)
        for (int k = 0; k < real; k++) g.gamma0[(int64_t)v * n + i + k] = d_gamma0[k];
      for (int k = 0; k < p.coefficients; k++) d_harmonics[k] += d_sum * p.basis[v * p.coefficients + k];
    }
    F d_scale[3], d_quaternion[4];
    finish(b, bodies.unit, bodies.norm, total, d_scale, d_quaternion);
    const F d_kappa = choose(kappa > 0.0f, total.kappa / choose(kappa > 0.0f, kappa, splat(1.0f)), zero);
    write_few<3>(total.mean, real, g.means + 3 * i);
    write_few<3>(d_scale, real, g.scales + 3 * i);
    write_few<4>(d_quaternion, real, g.quaternions + 4 * i);
    write_few<1>(&d_kappa, real, g.kappa + i);
    if (p.coefficients) write_rows(d_harmonics, p.coefficients, real, g.harmonics + p.coefficients * i);
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
