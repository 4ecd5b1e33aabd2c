// channels.h: the imaging plane with C amplitudes to a Gaussian: a pair's exponential serves all of them. The loops take up
// to kTogether channels at a time; images of a view lie one after the other.
#pragma once
#include "planes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kTogether = 4;

// `count` channels of a view's amplitudes [N, C], from one on
struct Amplitudes { const float* first; int64_t stride; };

// visit(c, std::integral_constant of how many) for the channels in groups
template <class Visit> void for_channels(int channels, Visit visit) {
  for (int c = 0; c < channels; c += kTogether) {
    switch (smaller(kTogether, channels - c)) {
      case 1: visit(c, std::integral_constant<int, 1>()); break;
      case 2: visit(c, std::integral_constant<int, 2>()); break;
      case 3: visit(c, std::integral_constant<int, 3>()); break;
      default: visit(c, std::integral_constant<int, kTogether>());
    }
  }
}

// Entries hold the norm as their height.
template <int C> SG_FN bool read_heights(const Entry& e, const Amplitudes& a, int64_t id, float (&heights)[C]) {
  bool dark = true;
  for (int c = 0; c < C; c++) {
    heights[c] = a.first[a.stride * id + c] * e.g.height;
    dark &= heights[c] == 0.0f;
  }
  return dark;
}

template <int C> void image_channels(const ViewState& s, const Part& part, const Amplitudes& a, float cut, float* S) {
  const Strips& strips = part.strips;
  const int64_t size = strips.size();
  std::memset(S, 0, sizeof(float) * C * size);
  for (int k = part.first; k < part.end; k++) {
    const int32_t ahead = s.pixel_list[smaller(k + kAhead, part.end - 1)], id = s.pixel_list[k];
    __builtin_prefetch(s.on_pixels + ahead);
    __builtin_prefetch(a.first + a.stride * ahead);
    const Entry& e = s.on_pixels[id];
    float heights[C];
    if (read_heights<C>(e, a, id, heights)) continue;
    for_blocks(e, strips, [&](const Offset<F>& d, int64_t at) {
      const F weight = imaging_weight(distance(d), cut);
      for (int c = 0; c < C; c++) store_anywhere(S + c * size + at, weight * heights[c] + load_anywhere(S + c * size + at));
    });
  }
}

// dL/dS of C images to dL/da of every Gaussian of a part, and to the moments of a dL/dS, added to `moments` unless first.
template <int C>
void image_channels_backward(const ViewState& s, const Part& part, const Strips& image, const Amplitudes& a, float cut, const float* dS,
                             bool first, float* moments, float* d_amplitudes) {
  const int64_t size = image.size();
  const F zero = splat(0.0f);
  for (int k = part.first; k < part.end; k++) {
    const int32_t ahead = s.pixel_list[smaller(k + kAhead, part.end - 1)], id = s.pixel_list[k];
    __builtin_prefetch(s.on_pixels + ahead);
    __builtin_prefetch(a.first + a.stride * ahead);
    const Entry& e = s.on_pixels[id];
    float* d_amplitude = d_amplitudes + a.stride * id;
    Eight found;
    if constexpr (C == 1) {
      found = image_backward(e, image, cut, dS);
      *d_amplitude = found[0] * e.g.height;
      found *= a.first[a.stride * id] * e.g.height;
    } else {
      float heights[C];
      read_heights<C>(e, a, id, heights);
      Moments<F> m{zero, zero, zero, zero, zero, zero};
      F sums[kTogether] = {zero, zero, zero, zero};
      for_blocks(e, image, [&](const Offset<F>& d, int64_t at) {
        const F weight = imaging_weight(distance(d), cut);
        F along = zero;
        for (int c = 0; c < C; c++) {
          const F x = load_anywhere(dS + c * size + at);
          sums[c] += weight * x;
          along += heights[c] * x;
        }
        m.add(d, weight * along);
      });
      // the sixth sum follows from those of the channels
      const Eight first_four = sum6(m.mu, m.mv, sums[0], sums[1], sums[2], sums[3]);
      found = sum6(zero, zero, zero, m.muu, m.muv, m.mvv);
      found[1] = first_four[0];
      found[2] = first_four[1];
      for (int c = 0; c < C; c++) {
        found[0] += heights[c] * first_four[2 + c];
        d_amplitude[c] = first_four[2 + c] * e.g.height;
      }
    }
    float* row = moments + kSums * (int64_t)id;
    store_eight(row, first ? found : found + load_eight(row));
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
