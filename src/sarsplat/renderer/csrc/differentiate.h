// differentiate.h: from six sums per Gaussian, view and plane to the gradients of a problem's arrays: everything after
// the pair loops.
#pragma once
#include "stages.h"

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

// Two rows of each of kWidth Gaussians, first(k) and second(k), as columns; with room for kRow, of the first alone.
constexpr int kRow = kWidth > kSums ? kWidth : kSums;
template <class First, class Second, int count> SG_FN void gather(int real, First first, Second second, F (&sums)[count]) {
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

// One view's share: the projection; dL/d(mu_C, mu_I), per metre; of the widened covariances, in cells and pixels; kappa' dL/dkappa'; what is
// summed for kappa, and for the sum of harmonics.
struct Share { Projection<F> proj; F planes[4]; Sym2<F> gc, gi; F m0, kappa, harmonics; };

// The Gaussians [first, end): share_of(v, i, real, bodies, frame) in every view, and end_of(kappa, its sum).
template <class ShareOf, class EndOf>
void differentiate(const sg_problem& p, const sg_gradients& g, int64_t first, int64_t end, float* shift_sums, ShareOf share_of, EndOf end_of) {
  const PlaneUnits u = units(p);
  for (int k = 0; k < 2 * p.views; k++) shift_sums[k] = 0.0f;
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    const Bodies bodies = read_bodies(p, i, real);
    BodyGradient<F> total = no_gradient();
    F d_harmonics[kFields];
    for (F& x : d_harmonics) x = splat(0.0f);
    for (int v = 0; v < p.views; v++) {
      const ViewFrame frame = frame_of(p, v);
      const Share share = share_of(v, i, real, bodies, frame);
      spread(share.proj, frame, u, share.planes, share.gc, share.gi, share.m0, total);
      total.kappa += share.kappa;
      shift_sums[2 * v] += sum(share.planes[2]);
      shift_sums[2 * v + 1] += sum(share.planes[3]);
      if (g.planes) write_few<4>(share.planes, real, g.planes + 4 * ((int64_t)v * p.gaussians + i));
      for (int k = 0; k < p.coefficients; k++) d_harmonics[k] += share.harmonics * p.basis[v * p.coefficients + k];
    }
    write_gradients(bodies, total, end_of(bodies.kappa, total.kappa), g, i, real);
    if (p.coefficients) write_rows(d_harmonics, p.coefficients, real, g.harmonics + p.coefficients * i);
  }
}

// All Gaussians; differentiate_chunk(first, end, shift_sums)
template <class Chunk> int32_t differentiate_all(sg_context& c, const sg_problem& p, float* d_shift, Chunk differentiate_chunk) {
  const int chunks = chunks_of(p.gaussians);
  float* sums = c.arena.take<float>((int64_t)chunks * 2 * p.views);
  if (c.arena.failed()) return SG_MEMORY;
  parallel(chunks, [&](int i) { differentiate_chunk((int64_t)i * kChunk, chunk_end(i, p.gaussians), sums + (int64_t)i * 2 * p.views); });
  add_shifts(p.views, chunks, sums, d_shift);
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
