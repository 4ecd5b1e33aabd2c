// passes.h: the pair loops. Gaussians are walked in depth order; what a ray carries (T, where it stopped, the suffix sum)
// lives in an image, stored as strips of four columns: kWidth / 4 rows of a strip, from any row on, are one vector. So a
// Gaussian's blocks begin at its own first row: no tiles, fewer idle lanes.
#pragma once
#include <cstring>
#include <type_traits>

#include "simd.h"
#include "pair_math.h"

namespace sarsplat {
namespace SG_ISA {

// A footprint, the inclusive box of rays or pixels it may touch (empty if y1 < y0), and what a loop asks of its Gaussian:
// a line of the cache. 16 words, written by transposition.
struct Entry {
  Footprint g;
  int32_t x0, x1, y0, y1;
};
struct alignas(64) RayEntry : Entry {
  int32_t slot;                   // its sums of band b lie in slot + b - first_band
  int32_t first_band, last_band;  // last < first: it reaches none
  float h;                        // dL/dw
  float slope[2];                 // of the range of the densest point against the ray, per cell
};
struct alignas(64) PixelEntry : Entry {  // height: the norm of the imaging weight
  float gamma0, lit;              // the amplitude, if there is one channel, and what it is multiplied by: A_lit
  float slope;                    // of P(u) over the sum of harmonics
  float elevation[2];             // of what it shows at (u, v) above its centre: of u and of v, m; where channels have wavenumbers
  int32_t unused;
};
static_assert(sizeof(RayEntry) == 64 && sizeof(PixelEntry) == 64, "an entry is a line of the cache");
constexpr int kSums = 8;          // numbers in a row of moments: six, and two more
SG_FN Eight sum6(const Moments<F>& m) { return sum6(m.m0, m.mu, m.mv, m.muu, m.muv, m.mvv); }

constexpr int kBlockX = 4, kBlockY = kWidth / kBlockX;

// A distance in blocks, rounded down: one instruction, which a division of what may be negative is not.
template <int size> SG_FN int block_of(int distance) { return distance >> __builtin_ctz(size); }

// A rectangle of rays or pixels as strips of four columns, with spare rows for blocks that reach beyond the last.
struct Strips {
  int x0, y0, columns, rows;
  const float *x, *y;             // coordinates of a block's lanes: at strip kWidth, and at (row - y0) kBlockX
  int count() const { return (columns + kBlockX - 1) / kBlockX; }
  int height() const { return rows + kBlockY - 1; }
  int64_t size() const { return (int64_t)height() * count() * kBlockX; }
  int64_t at(int column, int row) const {
    return ((int64_t)((column - x0) / kBlockX) * height() + (row - y0)) * kBlockX + (column - x0) % kBlockX;
  }
  Strips part(int first, int end) const { return {x0, first, columns, end - first, x, y + (first - y0) * kBlockX}; }
  int64_t ruler() const { return (int64_t)count() * kWidth + height() * kBlockX; }
  void mark(float* ruler) {       // ruler() floats
    x = ruler;
    y = ruler + count() * kWidth;
    for (int i = 0; i < count() * kWidth; i++) *ruler++ = (float)(x0 + i / kWidth * kBlockX + i % kBlockX);
    for (int i = 0; i < height() * kBlockX; i++) *ruler++ = (float)(y0 + i / kBlockX);
  }
};

// The blocks of one Gaussian in a rectangle, one after the other, strip by strip.
struct Walk {
  int left;                       // blocks to come
  int64_t strip, down, begin, end, height;
  const float *x, *y;
  Walk(const Entry& e, const Strips& s) {
    const int top = e.y0 > s.y0 ? e.y0 : s.y0, bottom = e.y1 < s.y0 + s.rows ? e.y1 : s.y0 + s.rows - 1;
    const int first = block_of<kBlockX>(e.x0 - s.x0), last = block_of<kBlockX>(e.x1 - s.x0);
    const int tall = block_of<kBlockY>(bottom - top) + 1;
    left = bottom < top ? 0 : larger(0, tall * (last - first + 1));
    down = begin = (int64_t)(top - s.y0) * kBlockX;
    end = begin + (int64_t)tall * kWidth;
    height = (int64_t)s.height() * kBlockX;
    strip = first * height;
    x = s.x + first * kWidth;
    y = s.y;
  }
  // visit(offset, index of the block's first lane) for the next blocks, `most` at most
  template <class Visit> SG_FN void next(const Footprint& g, int most, Visit visit) {
    const int count = smaller(left, most);
    left -= count;
    for (int k = 0; k < count; k++) {  // one loop, not one in the other: its end is guessed wrong once
      visit(offset(g, load(x), load_anywhere(y + down)), strip + down);
      down += kWidth;
      const bool next = down == end;
      down = next ? begin : down;
      strip += next ? height : 0;
      x += next ? kWidth : 0;
    }
  }
};

// visit(offset, index of the block's first lane) for the blocks of one Gaussian in a rectangle
template <class Visit> SG_FN void for_blocks(const Entry& e, const Strips& s, Visit visit) {
  Walk walk(e, s);
  walk.next(e.g, walk.left, visit);
}

constexpr int kAhead = 8;  // entries in depth order lie anywhere in memory: they are asked for this early
constexpr int32_t kNever = 0x7fffffff;

// The rays of a band before they meet anything.
static void begin_rays(const Strips& s, float* T, int32_t* stop) {
  for (int64_t strip = 0; strip < s.count(); strip++)
    for (int64_t i = 0; i < s.height() * kBlockX; i++) {
      const bool spare = i >= s.rows * kBlockX;  // never live
      T[strip * s.height() * kBlockX + i] = spare ? 0.0f : 1.0f;
      stop[strip * s.height() * kBlockX + i] = spare ? -1 : kNever;
    }
}

// Where band b writes what it finds of a Gaussian. It is asked for early: a store that waits for memory holds up all after it.
SG_FN int64_t slot_of(const RayEntry& e, int b) { return e.slot + b - e.first_band; }

// Front to back over the list of band b, whose rays are s and have begun. stop: the place in the list after which a ray is no longer
// followed. partial: by slot.
static void attenuate_band(const RayEntry* entries, const int32_t* list, int n, const Strips& s, int b, float min_log_tau,
                           float min_transmittance, float* T, int32_t* stop, float* partial) {
  const F floor = splat(min_transmittance);
  for (int k = 0; k < n; k++) {
    __builtin_prefetch(entries + list[smaller(k + 2 * kAhead, n - 1)]);
    __builtin_prefetch(partial + slot_of(entries[list[smaller(k + kAhead, n - 1)]], b), 1);
    const RayEntry& e = entries[list[k]];
    F sum_w = splat(0.0f);
    for_blocks(e, s, [&](const Offset<F>& d, int64_t at) {
      F t = load_anywhere(T + at);
      const F log_tau = log_depth(e.g, d);
      const I live = (log_tau >= min_log_tau) & (t >= floor);
      sum_w += attenuate(optical_depth(log_tau, live), t);
      store_anywhere(T + at, t);
      const I stopped = live & (t < floor);
      if (any(stopped)) store_anywhere(stop + at, choose(stopped, (I)(k), load_anywhere(stop + at)));
    });
    partial[slot_of(e, b)] = sum(sum_w);
  }
}

// T holds T_end and B the start value T_end dL/dT_end on entry; both are consumed. moments: a row by slot.
static void attenuate_band_backward(const RayEntry* entries, const int32_t* list, int n, const Strips& s, int b,
                                    float min_log_tau, float* T, const int32_t* stop, float* B, float* moments) {
  const F zero = splat(0.0f);
  for (int k = n - 1; k >= 0; k--) {
    __builtin_prefetch(entries + list[larger(k - 2 * kAhead, 0)]);
    __builtin_prefetch(moments + kSums * slot_of(entries[list[larger(k - kAhead, 0)]], b), 1);
    const RayEntry& e = entries[list[k]];
    Moments<F> m{zero, zero, zero, zero, zero, zero};
    for_blocks(e, s, [&](const Offset<F>& d, int64_t at) {
      const F log_tau = log_depth(e.g, d);
      const I live = (log_tau >= min_log_tau) & (load_anywhere(stop + at) >= k);
      F t = load_anywhere(T + at), suffix = load_anywhere(B + at);
      m.add(d, attenuate_backward(optical_depth(log_tau, live), e.h, t, suffix));
      store_anywhere(T + at, t);
      store_anywhere(B + at, suffix);
    });
    store_eight(moments + kSums * slot_of(e, b), sum6(m));
  }
}

// ---- imaging plane: a pair's exponential serves several channels -----------------------------------------------------
constexpr int kTogether = kWidth == 16 ? 8 : 4;  // channels at most: as many as there are registers for

// The amplitudes of a view [N, stride] from some channel on; null: there is one, and the entries hold it.
struct Amplitudes {
  const float* first;
  int64_t stride;
  const float* turns;             // per metre of elevation, of every pair of channels from there on; null: all are constant
  const float* of(const PixelEntry& e, int64_t id) const { return first ? first + stride * id : &e.gamma0; }
  Amplitudes from(int channel) const { return {first ? first + channel : nullptr, stride, turns ? turns + channel / 2 : nullptr}; }
};

SG_FN int group_of(int channels) { return channels >= kTogether ? kTogether : smaller(4, channels); }  // the first of them

// visit(c, std::integral_constant of how many) for the channels in groups
template <class Visit> void for_channels(int channels, Visit visit) {
  for (int c = 0, count; c < channels; c += count) {
    count = group_of(channels - c);
    switch (count) {
      case 1: visit(c, std::integral_constant<int, 1>()); break;
      case 2: visit(c, std::integral_constant<int, 2>()); break;
      case 3: visit(c, std::integral_constant<int, 3>()); break;
      case 4: visit(c, std::integral_constant<int, 4>()); break;
      default: visit(c, std::integral_constant<int, kTogether>());
    }
  }
}

// What C channels of a Gaussian's footprint are multiplied by: cross-section times norm.
template <int C> SG_FN bool read_heights(const PixelEntry& e, const float* amplitudes, float (&heights)[C]) {
  bool dark = true;
  for (int c = 0; c < C; c++) {
    heights[c] = amplitudes[c] * e.lit * e.g.height;
    dark &= heights[c] == 0.0f;
  }
  return dark;
}

// The entries of a list to C images, which lie one after the other.
template <int C>
static void image_part(const PixelEntry* entries, const int32_t* list, int n, const Strips& s, const Amplitudes& a, float cut, float* S) {
  const int64_t size = s.size();
  std::memset(S, 0, sizeof(float) * C * size);
  for (int k = 0; k < n; k++) {
    const int32_t ahead = list[k + kAhead < n ? k + kAhead : k];
    __builtin_prefetch(entries + ahead);
    if (C > 1) __builtin_prefetch(a.first + a.stride * ahead);
    const PixelEntry& e = entries[list[k]];
    float heights[C];
    if (read_heights<C>(e, a.of(e, list[k]), heights)) continue;
    for_blocks(e, s, [&](const Offset<F>& d, int64_t at) {
      const F weight = imaging_weight(distance(d), cut);
      for (int c = 0; c < C; c++) store_anywhere(S + c * size + at, weight * heights[c] + load_anywhere(S + c * size + at));
    });
  }
}

// ---- complex channels whose phase changes across a footprint: pairs of channels, turned at each pixel ---------------------
SG_FN F elevation_at(const PixelEntry& e, const Offset<F>& d) { return d.u * e.elevation[0] + d.v * e.elevation[1]; }

template <int C>
static void wave_part(const PixelEntry* entries, const int32_t* list, int n, const Strips& s, const Amplitudes& a, float cut, float* S) {
  const int64_t size = s.size();
  std::memset(S, 0, sizeof(float) * C * size);
  for (int k = 0; k < n; k++) {
    const int32_t ahead = list[k + kAhead < n ? k + kAhead : k];
    __builtin_prefetch(entries + ahead);
    __builtin_prefetch(a.first + a.stride * ahead);
    const PixelEntry& e = entries[list[k]];
    float heights[C];
    if (read_heights<C>(e, a.of(e, list[k]), heights)) continue;
    for_blocks(e, s, [&](const Offset<F>& d, int64_t at) {
      const F weight = imaging_weight(distance(d), cut), elevation = elevation_at(e, d);
      for (int c = 0; c < C; c += 2) {
        float *real = S + c * size + at, *imaginary = real + size;
        if (a.turns[c / 2] == 0.0f) {  // as of power
          store_anywhere(real, weight * heights[c] + load_anywhere(real));
          if (heights[c + 1] != 0.0f) store_anywhere(imaginary, weight * heights[c + 1] + load_anywhere(imaginary));
          continue;
        }
        const Phase<F> turned = phase(elevation * a.turns[c / 2]);
        store_anywhere(real, weight * (turned.c * heights[c] - turned.s * heights[c + 1]) + load_anywhere(real));
        store_anywhere(imaginary, weight * (turned.s * heights[c] + turned.c * heights[c + 1]) + load_anywhere(imaginary));
      }
    });
  }
}

// As image_backward; elevation: sums of dL/d(elevation) times 1, u and v, to which those of these channels are added.
template <int C> SG_FN Eight wave_backward(const PixelEntry& e, const Strips& s, float cut, const float* dS, const Amplitudes& a, int64_t id,
                                           float* sums, float* elevation) {
  const F zero = splat(0.0f);
  Moments<F> m{zero, zero, zero, zero, zero, zero};
  F all[C], g0 = zero, gu = zero, gv = zero;
  for (F& x : all) x = zero;
  float heights[C];
  read_heights<C>(e, a.of(e, id), heights);
  const int64_t size = s.size();
  for_blocks(e, s, [&](const Offset<F>& d, int64_t at) {
    const F weight = imaging_weight(distance(d), cut), height = elevation_at(e, d);
    F along = zero, turning = zero;
    for (int c = 0; c < C; c += 2) {
      const F x = load_anywhere(dS + c * size + at), y = load_anywhere(dS + (c + 1) * size + at);
      if (a.turns[c / 2] == 0.0f) {
        all[c] += weight * x;
        all[c + 1] += weight * y;
        along += x * heights[c] + y * heights[c + 1];
        continue;
      }
      const Phase<F> turned = phase(height * a.turns[c / 2]);
      const F real = turned.c * x + turned.s * y, imaginary = turned.c * y - turned.s * x;
      all[c] += weight * real;
      all[c + 1] += weight * imaginary;
      along += real * heights[c] + imaginary * heights[c + 1];
      turning += (imaginary * heights[c] - real * heights[c + 1]) * (6.2831853f * a.turns[c / 2]);
    }
    m.add(d, weight * along);
    turning *= weight;
    g0 += turning;
    gu += turning * d.u;
    gv += turning * d.v;
  });
  const Eight found = sum6(g0, gu, gv, zero, zero, zero);
  for (int k = 0; k < 3; k++) elevation[k] += found[k];
  Eight moments = sum6(zero, m.mu, m.mv, m.muu, m.muv, m.mvv);
  for (int c = 0; c < C; c++) {
    sums[c] = sum(all[c]);
    moments[0] += heights[c] * sums[c];
  }
  return moments;
}

// A gather: a Gaussian reads the pixels it touches; spare rows of dS are zero. Returns the moments of the sum over channels of
// height times dL/dS; sums: over the footprint's weight times dL/dS, by channel.
template <int C> SG_FN Eight image_backward(const PixelEntry& e, const Strips& s, float cut, const float* dS, const float* amplitudes, float* sums) {
  const F zero = splat(0.0f);
  Moments<F> m{zero, zero, zero, zero, zero, zero};
  float heights[C];
  if constexpr (C == 1) {
    for_blocks(e, s, [&](const Offset<F>& d, int64_t at) {
      m.add(d, imaging_weight(distance(d), cut) * load_anywhere(dS + at));
    });
    const Eight moments = sum6(m);
    sums[0] = moments[0];
    read_heights<C>(e, amplitudes, heights);
    return moments * heights[0];
  } else {
    read_heights<C>(e, amplitudes, heights);
    const int64_t size = s.size();
    F all[C + 1];                 // by channel, and one that is never read
    for (F& x : all) x = zero;
    for_blocks(e, s, [&](const Offset<F>& d, int64_t at) {
      const F weight = imaging_weight(distance(d), cut);
      F along = zero;
      for (int c = 0; c < C; c++) {
        const F x = load_anywhere(dS + c * size + at);
        all[c] += weight * x;
        along += heights[c] * x;
      }
      m.add(d, weight * along);
    });
    Eight moments = sum6(zero, m.mu, m.mv, m.muu, m.muv, m.mvv);
    for (int c = 0; c < C; c += 6) {
      auto one = [&](int k) { return c + k < C ? all[c + k] : zero; };
      const Eight some = sum6(one(0), one(1), one(2), one(3), one(4), one(5));
      for (int k = 0; k < 6 && c + k < C; k++) {
        sums[c + k] = some[k];
        moments[0] += heights[c + k] * some[k];  // the sixth moment follows from the sums
      }
    }
    return moments;
  }
}

}  // namespace SG_ISA
}  // namespace sarsplat
