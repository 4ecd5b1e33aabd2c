// differentiate.h: from six sums per Gaussian, view and plane to the gradients of a problem's arrays: everything after
// the pair loops.
#pragma once
#include "planes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// What the pair loops left of a Gaussian on each plane.
SG_FN Eight ray_row(const ViewState& s, const Backward& scratch, int64_t id) {
  const RayEntry& e = s.on_rays[id];
  Eight sum = (Eight)(0.0f);
  for (int slot = e.slot; slot <= e.slot + e.last_band - e.first_band; slot++)
    sum += load_eight(scratch.ray_moments + kSums * (int64_t)slot);
  return sum;
}
SG_FN Eight pixel_row(const Backward& scratch, int64_t id) { return load_eight(scratch.pixel_moments + kSums * id); }

// Two rows of each of kWidth Gaussians, first(k) and second(k), as columns.
template <class First, class Second> SG_FN void gather(int real, First first, Second second, F (&sums)[kFields]) {
  turn([&](int k, [[maybe_unused]] int part) {
    if (k >= real) return splat(0.0f);
#if SG_WIDTH == 16
    return (F)__builtin_shufflevector(first(k), second(k), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
#elif SG_WIDTH == 8
    return part < kSums ? first(k) : second(k);
#else
    const Eight row = part < kSums ? first(k) : second(k);
    return part % kSums ? row.hi : row.lo;
#endif
  }, sums);
}

SG_FN Moments<F> moments_of(const F* sums) { return {sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]}; }

SG_FN BodyGradient<F> no_gradient() {
  BodyGradient<F> g;
  const F zero = splat(0.0f);
  for (F& x : g.mean) x = zero;
  for (F& x : g.g) x = zero;
  for (F& x : g.scale) x = zero;
  for (F& x : g.rot) x = zero;
  g.kappa = zero;
  return g;
}

SG_FN void write_gradients(const Bodies& bodies, const BodyGradient<F>& total, F d_kappa, const sg_gradients& g, int64_t i, int real) {
  F d_scale[3], d_quaternion[4];
  finish(bodies.body, bodies.unit, bodies.norm, total, d_scale, d_quaternion);
  write_few<3>(total.mean, real, g.means + 3 * i);
  write_few<3>(d_scale, real, g.scales + 3 * i);
  write_few<4>(d_quaternion, real, g.quaternions + 4 * i);
  write_few<1>(&d_kappa, real, g.kappa + i);
}

// What every chunk found for the shifts, in their order.
void add_shifts(int views, int chunks, const float* sums, float* shift) {
  for (int k = 0; k < 2 * views; k++) {
    shift[k] = 0.0f;
    for (int i = 0; i < chunks; i++) shift[k] += sums[(int64_t)i * 2 * views + k];
  }
}

void differentiate(const sg_context& c, const sg_problem& p, const sg_gradients& g, const Backward* scratch, int64_t first,
                   int64_t end, float* shift_sums) {
  const PlaneUnits u = units(p);
  const int64_t n = p.gaussians;
  for (int k = 0; k < 2 * p.views; k++) shift_sums[k] = 0.0f;
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(n - i));
    const Bodies bodies = read_bodies(p, i, real);
    const Body<F>& b = bodies.body;
    const F zero = splat(0.0f), kappa = bodies.kappa;
    BodyGradient<F> total = no_gradient();
    F d_harmonics[kFields];
    for (F& x : d_harmonics) x = zero;
    for (int v = 0; v < p.views; v++) {
      const ViewState& s = c.views[v];
      F sums[kFields];
      gather(real, [&](int k) { return ray_row(s, scratch[v], i + k); }, [&](int k) { return pixel_row(scratch[v], i + k); }, sums);
      const F d_gamma0 = sums[14], d_sum = d_gamma0 * sums[15];
      for (int k = 0; k < 6; k++) sums[k] *= kLn2;  // tau is in units of log2(e)
      const Moments<F> mr = moments_of(sums), mp = moments_of(sums + kSums);
      const Projection<F> proj = project(b, s.frame, u);
      F planes[4];
      accumulate(proj, s.frame, u, mr, mp, p.peak != 0, total, planes);
      total.kappa += mr.m0;
      shift_sums[2 * v] += sum(planes[2]);
      shift_sums[2 * v + 1] += sum(planes[3]);
      if (g.planes)
        for (int k = 0; k < real; k++)
          for (int q = 0; q < 4; q++) g.planes[((int64_t)v * n + i + k) * 4 + q] = planes[q][k];
      if (g.amplitudes)
        for (int k = 0; k < real; k++) g.amplitudes[(int64_t)v * n + i + k] = d_gamma0[k];
      for (int k = 0; k < p.coefficients; k++) d_harmonics[k] += d_sum * p.basis[v * p.coefficients + k];
    }
    write_gradients(bodies, total, choose(kappa > 0.0f, total.kappa / choose(kappa > 0.0f, kappa, splat(1.0f)), zero), g, i, real);
    if (p.coefficients) write_rows(d_harmonics, p.coefficients, real, g.harmonics + p.coefficients * i);
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
