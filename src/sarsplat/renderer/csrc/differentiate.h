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
  return g;
}

// Both rows of a view, the first in units of the optical depth.
SG_FN void sums_of(const ViewState& s, const Backward& scratch, int64_t i, int real, F (&sums)[kFields]) {
  gather(real, [&](int k) { return ray_row(s, scratch, i + k); }, [&](int k) { return pixel_row(scratch, i + k); }, sums);
  for (int k = 0; k < 6; k++) sums[k] *= kLn2;  // tau is in units of log2(e)
}

// Numbers of a Gaussian that views have a gradient for: mean, scales, quaternion, optical depth, harmonics.
constexpr int kNumbers = 11 + kFields;

SG_FN void write_gradients(const sg_problem& p, const F* total, const sg_gradients& g, int64_t i, int real) {
  write_few<3>(total, real, g.means + 3 * i);
  write_few<3>(total + 3, real, g.scales + 3 * i);
  write_few<4>(total + 6, real, g.quaternions + 4 * i);
  write_few<1>(total + 10, real, g.kappa + i);
  if (!p.coefficients) return;
  F harmonics[kFields];
  for (int k = 0; k < kFields; k++) harmonics[k] = k < p.coefficients ? total[11 + k] : splat(0.0f);
  write_rows(harmonics, p.coefficients, real, g.harmonics + p.coefficients * i);
}

// The gradients of views, one after the other, to their sum over a tree: n views are the first p of them, p the largest power of
// two below n, and the rest.
class ViewSum {
 public:
  explicit ViewSum(int count) : count_(count) {}
  F* next() { return branches_[open_]; }  // where the next view's numbers go
  void add() {                            // they are there
    __asm__ volatile("" : : "r"(branches_) : "memory");  // or a last product would be fused into the sum
    open_++;
    for (int n = ++views_; n % 2 == 0; n /= 2) join();
  }
  const F* total() {
    while (open_ > 1) join();
    return branches_[0];
  }

 private:
  void join() {
    open_--;
    for (int k = 0; k < count_; k++) branches_[open_ - 1][k] += branches_[open_][k];
  }
  F branches_[33][kNumbers];
  int count_, open_ = 0, views_ = 0;
};

// What every chunk found for the shifts, in their order.
void add_shifts(int views, int chunks, const float* sums, float* shift) {
  for (int k = 0; k < 2 * views; k++) {
    shift[k] = 0.0f;
    for (int i = 0; i < chunks; i++) shift[k] += sums[(int64_t)i * 2 * views + k];
  }
}

// One view's share: the projection; dL/d(mu_C, mu_I), per metre; of the widened covariances, in cells and pixels; kappa' dL/dkappa'; what is
// found for kappa, and for the sum of harmonics.
struct Share { Projection<F> proj; F planes[4]; Sym2<F> gc, gi; F m0, kappa, harmonics; };

// dL/dkappa of what is found for kappa, kappa' dL/dkappa'.
SG_FN F per_depth(F kappa, F sum) { return choose(kappa > 0.0f, sum / choose(kappa > 0.0f, kappa, splat(1.0f)), splat(0.0f)); }

// The Gaussians [first, end): share_of(v, i, real, bodies, frame) in every view, spread_share(share, v, frame, gradient), and
// end_of(kappa, its share).
template <class ShareOf, class EndOf, class SpreadShare>
void differentiate(const sg_problem& p, const sg_gradients& g, int64_t first, int64_t end, float* shift_sums, ShareOf share_of, EndOf end_of,
                   SpreadShare spread_share) {
  for (int k = 0; k < 2 * p.views; k++) shift_sums[k] = 0.0f;
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    const Bodies bodies = read_bodies(p, i, real);
    ViewSum sum_of_views(11 + p.coefficients);
    for (int v = 0; v < p.views; v++) {
      const ViewFrame frame = frame_of(p, v);
      const auto share = share_of(v, i, real, bodies, frame);
      BodyGradient<F> own = no_gradient();
      spread_share(share, v, frame, own);
      F* numbers = sum_of_views.next();
      for (int k = 0; k < 3; k++) numbers[k] = own.mean[k];
      finish(bodies.body, bodies.unit, bodies.norm, own, numbers + 3, numbers + 6);
      numbers[10] = end_of(bodies.kappa, share.kappa);
      for (int k = 0; k < p.coefficients; k++) numbers[11 + k] = share.harmonics * p.basis[v * p.coefficients + k];
      sum_of_views.add();
      shift_sums[2 * v] += sum(share.planes[2]);
      shift_sums[2 * v + 1] += sum(share.planes[3]);
      if (g.planes) write_few<4>(share.planes, real, g.planes + 4 * ((int64_t)v * p.gaussians + i));
    }
    write_gradients(p, sum_of_views.total(), g, i, real);
  }
}

// As usual: both planes are of one frame.
template <class ShareOf, class EndOf>
void differentiate(const sg_problem& p, const sg_gradients& g, int64_t first, int64_t end, float* shift_sums, ShareOf share_of, EndOf end_of) {
  const PlaneUnits u = units(p);
  differentiate(p, g, first, end, shift_sums, share_of, end_of, [&](const Share& share, int, const ViewFrame& frame, BodyGradient<F>& own) __attribute__((always_inline)) {
    spread(share.proj, frame, u, share.planes, share.gc, share.gi, share.m0, own);
  });
}

// All Gaussians; differentiate_chunk(first, end, shift_sums)
template <class Chunk> int32_t differentiate_all(sg_context& c, const sg_problem& p, float* d_shift, Chunk differentiate_chunk) {
  const int chunks = chunks_of(p.gaussians);
  float* sums = c.arena.take<float>((int64_t)chunks * 2 * p.views);
  if (c.arena.failed()) return SG_MEMORY;
  parallel(chunks, [&](int i) { differentiate_chunk((int64_t)i * kChunk, chunk_end(i, p.gaussians), sums + (int64_t)i * 2 * p.views); });
  if (d_shift) add_shifts(p.views, chunks, sums, d_shift);
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
