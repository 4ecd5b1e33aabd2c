// passes.h: the pair loops. Gaussians are walked in depth order; what a ray carries (T, where it stopped, the suffix sum)
// lives in an image, stored as strips of four columns: kWidth / 4 rows of a strip, from any row on, are one vector. So a
// Gaussian's blocks begin at its own first row: no tiles, fewer idle lanes.
#pragma once
#include "simd.h"
#include "pair_math.h"

namespace sarsplat {
namespace SG_ISA {

// A footprint and the inclusive box of rays or pixels it may touch; empty if y1 < y0. 16 words: written by transposition.
struct alignas(64) Entry {
  Footprint g;
  int32_t x0, x1, y0, y1;
  int32_t slot;              // its sums of band b lie in slot + b - first_band
  int32_t first_band, last_band;
  int32_t unused[2];
};
static_assert(sizeof(Entry) == 64, "an entry is a line of the cache");

struct Band { int first, end; };  // rows [first, end)

constexpr int kBlockX = 4, kBlockY = kWidth / kBlockX;
constexpr int kMostBands = 8;

// A plane cut into bands of rows. Every band has memory of its own, with room for blocks that reach beyond its last row.
struct Strips {
  int x0, y0, columns, rows, bands;  // where the plane's first ray or pixel stands
  Band band[kMostBands];
  int count() const { return (columns + kBlockX - 1) / kBlockX; }
  int height(int b) const { return band[b].end - band[b].first + kBlockY - 1; }
  int64_t start(int b) const { return (int64_t)(band[b].first - y0 + b * (kBlockY - 1)) * count() * kBlockX; }
  int64_t size(int b) const { return (int64_t)height(b) * count() * kBlockX; }
  int64_t size() const { return (int64_t)(rows + bands * (kBlockY - 1)) * count() * kBlockX; }
  int64_t at(int b, int x, int y) const {  // in the band's memory
    return ((int64_t)((x - x0) / kBlockX) * height(b) + (y - band[b].first)) * kBlockX + (x - x0) % kBlockX;
  }
};

struct Lanes {
  F x, y;
  Lanes() {
    alignas(64) float px[kWidth], py[kWidth];
    for (int i = 0; i < kWidth; i++) { px[i] = (float)(i % kBlockX); py[i] = (float)(i / kBlockX); }
    x = load(px); y = load(py);
  }
};

// visit(offset, limit of q, index of the block's first lane) for the blocks of one Gaussian in a band; the limit leaves
// out the rows behind the band's end
template <class Visit> SG_FN void for_blocks(const Entry& e, const Strips& s, int b, const Lanes& lanes, Visit visit) {
  const Band band = s.band[b];
  const int y0 = e.y0 > band.first ? e.y0 : band.first, y1 = e.y1 < band.end ? e.y1 : band.end - 1;
  const int first = (e.x0 - s.x0) / kBlockX, last = (e.x1 - s.x0) / kBlockX, height = s.height(b);
  for (int strip = first; strip <= last; strip++) {
    const F x = lanes.x + (float)(s.x0 + strip * kBlockX);
    int64_t at = ((int64_t)strip * height + (y0 - band.first)) * kBlockX;
    for (int y = y0; y <= y1; y += kBlockY, at += kWidth)
      visit(offset(e.g, x, lanes.y + (float)y), choose(lanes.y <= (float)(y1 - y), splat(e.g.limit), splat(-1.0f)), at);
  }
}

constexpr int kAhead = 8;  // entries in depth order lie anywhere in memory: they are asked for this early
constexpr int32_t kNever = 0x7fffffff;

// Front to back over a band's list. T and stop: the band's own rows; stop is the place in the list after which a ray is
// no longer followed. partial: by slot.
static void attenuate_band(const Entry* entries, const int32_t* list, int n, const Strips& s, int b, float min_transmittance,
                           float* T, int32_t* stop, float* partial) {
  const Lanes lanes;
  const F floor = splat(min_transmittance);
  for (int64_t i = 0; i < s.size(b); i++) { T[i] = 1.0f; stop[i] = kNever; }
  for (int k = 0; k < n; k++) {
    __builtin_prefetch(entries + list[k + kAhead < n ? k + kAhead : k]);
    const Entry& e = entries[list[k]];
    F sum_w = splat(0.0f);
    for_blocks(e, s, b, lanes, [&](const Offset<F>& d, F limit, int64_t at) {
      F t = load_anywhere(T + at);
      const I live = (d.q <= limit) & (t >= floor);
      if (!any(live)) return;
      sum_w += attenuate(e.g, d, live, t);
      store_anywhere(T + at, t);
      const I stopped = live & (t < floor);
      if (any(stopped)) store_anywhere(stop + at, choose(stopped, (I)(k), load_anywhere(stop + at)));
    });
    partial[e.slot + b - e.first_band] = sum(sum_w);
  }
}

// T holds T_end and B the start value T_end dL/dT_end on entry; both are consumed. h: dL/dw by id; moments: six by slot.
static void attenuate_band_backward(const Entry* entries, const int32_t* list, int n, const Strips& s, int b, const float* h,
                                    float* T, const int32_t* stop, float* B, float* moments) {
  const Lanes lanes;
  const F zero = splat(0.0f);
  for (int k = n - 1; k >= 0; k--) {
    __builtin_prefetch(entries + list[k > kAhead ? k - kAhead : k]);
    const Entry& e = entries[list[k]];
    Moments<F> m{zero, zero, zero, zero, zero, zero};
    const float h_k = h[list[k]];
    for_blocks(e, s, b, lanes, [&](const Offset<F>& d, F limit, int64_t at) {
      const I live = (d.q <= limit) & (load_anywhere(stop + at) >= k);
      if (!any(live)) return;
      F t = load_anywhere(T + at), suffix = load_anywhere(B + at);
      m.add(d, attenuate_backward(e.g, d, live, h_k, t, suffix));
      store_anywhere(T + at, t);
      store_anywhere(B + at, suffix);
    });
    sum6(m.m0, m.mx, m.my, m.mxx, m.mxy, m.myy, moments + 6 * (int64_t)(e.slot + b - e.first_band));
  }
}

// entry.g.depth carries the amplitude here. S: the band's own rows
static void image_band(const Entry* entries, const int32_t* list, int n, const Strips& s, int b, float* S) {
  const Lanes lanes;
  for (int64_t i = 0; i < s.size(b); i++) S[i] = 0.0f;
  for (int k = 0; k < n; k++) {
    const Entry& e = entries[list[k]];
    if (e.g.depth == 0.0f) continue;
    for_blocks(e, s, b, lanes, [&](const Offset<F>& d, F limit, int64_t at) {
      store_anywhere(S + at, imaging_weight(d, d.q <= limit) * e.g.depth + load_anywhere(S + at));
    });
  }
}

// a gather: every Gaussian reads the pixels it touches; dS has one band's worth of spare rows
static void image_backward(const Entry& e, const Strips& s, const Lanes& lanes, const float* dS, float* moments) {
  const F zero = splat(0.0f);
  Moments<F> m{zero, zero, zero, zero, zero, zero};
  for_blocks(e, s, 0, lanes, [&](const Offset<F>& d, F limit, int64_t at) {
    m.add(d, imaging_weight(d, d.q <= limit) * load_anywhere(dS + at));
  });
  sum6(m.m0, m.mx, m.my, m.mxx, m.mxy, m.myy, moments);
}

}  // namespace SG_ISA
}  // namespace sarsplat
