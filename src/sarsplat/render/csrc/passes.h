// passes.h: the pair loops. Gaussians are walked in depth order; what a ray carries (T, the last Gaussian, the suffix sum)
// lives in an image stored block by block, one block a SIMD vector: no tiles, no lists.
#pragma once
#include "simd.h"
#include "pair_math.h"

namespace sarsplat {
namespace SG_ISA {

constexpr int kBlockX = 4, kBlockY = kWidth / 4;

// A footprint on a blocked lattice: inclusive block range. `id` is the Gaussian's index.
struct Entry { Footprint g; int32_t id; int16_t x0, x1, y0, y1; };
struct Band { int first, end; };  // block rows [first, end)

struct Lanes {
  F x, y;
  Lanes() {
    alignas(64) float px[kWidth], py[kWidth];
    for (int i = 0; i < kWidth; i++) { px[i] = (float)(i % kBlockX); py[i] = (float)(i / kBlockX); }
    x = load(px); y = load(py);
  }
};

// visit(offset, index of the block's first lane) for the blocks of one Gaussian inside a band of block rows
template <class Visit> SG_FN void for_blocks(const Entry& e, Band band, int blocks_x, const Lanes& lanes, Visit visit) {
  const int y0 = e.y0 > band.first ? e.y0 : band.first, y1 = e.y1 < band.end ? e.y1 + 1 : band.end;
  for (int by = y0; by < y1; by++) {
    const F y = lanes.y + (float)(by * kBlockY);
    int64_t at = ((int64_t)by * blocks_x + e.x0) * kWidth;
    for (int bx = e.x0; bx <= e.x1; bx++, at += kWidth) visit(offset(e.g, lanes.x + (float)(bx * kBlockX), y), at);
  }
}
SG_FN bool overlaps(const Entry& e, Band band) { return e.y0 < band.end && e.y1 >= band.first; }

static void attenuate_band(const Entry* entries, int n, Band band, int blocks_x, float min_transmittance, float* T,
                           int32_t* last, float* weight) {
  const Lanes lanes;
  const F floor = splat(min_transmittance);
  for (int64_t i = (int64_t)band.first * blocks_x * kWidth; i < (int64_t)band.end * blocks_x * kWidth; i += kWidth) {
    store(T + i, splat(1.0f));
    store(last + i, (I)(-1));
  }
  for (int k = 0; k < n; k++) {
    const Entry& e = entries[k];
    if (!overlaps(e, band)) continue;
    F sum_w = splat(0.0f);
    for_blocks(e, band, blocks_x, lanes, [&](const Offset<F>& d, int64_t at) {
      F t = load(T + at);
      const I live = (d.q <= e.g.limit) & (t >= floor);
      if (!any(live)) return;
      sum_w += attenuate(e.g, d, live, t);
      store(T + at, t);
      store(last + at, choose(live, (I)(k), load(last + at)));
    });
    weight[k] = sum(sum_w);
  }
}

// T holds T_end and B the start value T_end dL/dT_end on entry; both are consumed. h: dL/dw per Gaussian, by id.
static void attenuate_band_backward(const Entry* entries, int n, Band band, int blocks_x, const float* h, float* T,
                                    const int32_t* last, float* B, float* moments) {
  const Lanes lanes;
  const F zero = splat(0.0f);
  for (int k = n - 1; k >= 0; k--) {
    const Entry& e = entries[k];
    if (!overlaps(e, band)) continue;
    Moments<F> m{zero, zero, zero, zero, zero, zero};
    const float h_k = h[e.id];
    for_blocks(e, band, blocks_x, lanes, [&](const Offset<F>& d, int64_t at) {
      const I live = (d.q <= e.g.limit) & (load(last + at) >= k);
      if (!any(live)) return;
      F t = load(T + at), b = load(B + at);
      m.add(d, attenuate_backward(e.g, d, live, h_k, t, b));
      store(T + at, t);
      store(B + at, b);
    });
    sum6(m.m0, m.mx, m.my, m.mxx, m.mxy, m.myy, moments + 6 * (int64_t)k);
  }
}

// entry.g.depth carries the amplitude here
static void image_band(const Entry* entries, int n, Band band, int blocks_x, float* S) {
  const Lanes lanes;
  for (int64_t i = (int64_t)band.first * blocks_x * kWidth; i < (int64_t)band.end * blocks_x * kWidth; i += kWidth)
    store(S + i, splat(0.0f));
  for (int k = 0; k < n; k++) {
    const Entry& e = entries[k];
    if (!overlaps(e, band)) continue;
    for_blocks(e, band, blocks_x, lanes, [&](const Offset<F>& d, int64_t at) {
      store(S + at, imaging_weight(d, d.q <= e.g.limit) * e.g.depth + load(S + at));
    });
  }
}

// a gather: every Gaussian reads the pixels it touches
static void image_backward(const Entry* entries, int first, int end, Band whole, int blocks_x, const float* dS, float* moments) {
  const Lanes lanes;
  const F zero = splat(0.0f);
  for (int k = first; k < end; k++) {
    const Entry& e = entries[k];
    Moments<F> m{zero, zero, zero, zero, zero, zero};
    for_blocks(e, whole, blocks_x, lanes, [&](const Offset<F>& d, int64_t at) {
      m.add(d, imaging_weight(d, d.q <= e.g.limit) * load(dS + at));
    });
    sum6(m.m0, m.mx, m.my, m.mxx, m.mxy, m.myy, moments + 6 * (int64_t)k);
  }
}

// blocked to row-major and back, rows [first, end)
static void from_blocks(const float* in, int blocks_x, int rows, int columns, int first, int end, float* out) {
  for (int y = first; y < end && y < rows; y++)
    for (int x = 0; x < columns; x++)
      out[(int64_t)y * columns + x] = in[((int64_t)(y / kBlockY) * blocks_x + x / kBlockX) * kWidth + y % kBlockY * kBlockX + x % kBlockX];
}
static void to_blocks(const float* in, int blocks_x, int rows, int columns, int first, int end, float* out) {
  for (int y = first; y < end; y++)
    for (int x = 0; x < blocks_x * kBlockX; x++)
      out[((int64_t)(y / kBlockY) * blocks_x + x / kBlockX) * kWidth + y % kBlockY * kBlockX + x % kBlockX] =
          y < rows && x < columns ? in[(int64_t)y * columns + x] : 0.0f;
}

}  // namespace SG_ISA
}  // namespace sarsplat
