// loss.h: (1 - lambda) L1 + lambda (1 - SSIM) of amplitudes, and its gradient with respect to power, in one go.
//
// amplitude a = sqrt(power / reference^2 + floor^2) - floor against truth t; SSIM of the places where the window fits
// whole. rows -> blur along rows -> blur along columns, similarity and its slopes -> both blurs transposed -> gradient.
#pragma once
#include "context.h"
#include "parallel.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kTaps = 11, kRowsPerTask = 16;

struct LossImage {  // one view's scratch; every row has `stride` numbers
  float *a, *slope;         // amplitude, d a / d power
  float *blurred[5];        // along rows: of a, t, a^2, t^2, a t
  float *slopes[3];         // dS / d(mean of a, of a^2, of a t), then blurred along columns
  float *absolute, *similar;  // sums by row
};

// sum over the window of rows or columns: `step` numbers apart
SG_FN F window_sum(const float* w, const float* p, int64_t step) {
  F sum = load_anywhere(p) * w[0];
  for (int k = 1; k < kTaps; k++) sum += load_anywhere(p + k * step) * w[k];
  return sum;
}
// its transpose: place y takes from the windows that begin at y - k, as far as they are there
SG_FN F window_sum_transposed(const float* w, const float* p, int64_t step, int first, int last) {
  F sum = splat(0.0f);
  for (int k = first; k <= last; k++) sum += load_anywhere(p - k * step) * w[k];
  return sum;
}

int32_t amplitude_loss(sg_context* context, const sg_loss* loss) {
  const sg_loss& l = *loss;
  Arena& arena = context->arena;
  arena.reset();
  const int R = l.rows, C = l.columns, V = l.views;
  const bool similar = l.ssim_weight > 0.0f;
  const int64_t pad = kWidth + kTaps, stride = C + 2 * pad, size = (int64_t)R * stride;  // blocks may reach beyond both ends
  const int valid_rows = R - kTaps + 1, valid_columns = C - kTaps + 1;
  LossImage* images = arena.take<LossImage>(V);
  if (arena.failed()) { arena.give_back(); return SG_MEMORY; }
  for (int v = 0; v < V; v++) {
    LossImage& s = images[v];
    s.a = arena.take<float>(size);
    s.slope = arena.take<float>(size);
    for (float*& p : s.blurred) p = similar ? arena.take<float>(size) : nullptr;
    for (float*& p : s.slopes) p = similar ? arena.take<float>(2 * size) : nullptr;  // before and after the columns' blur
    s.absolute = arena.take<float>(R);
    s.similar = arena.take<float>(R);
  }
  if (arena.failed()) { arena.give_back(); return SG_MEMORY; }

  const int tasks = (R + kRowsPerTask - 1) / kRowsPerTask;
  auto for_rows = [&](auto visit) {  // visit(view, row)
    parallel(V * tasks, [&](int i) {
      for (int y = i % tasks * kRowsPerTask; y < least(R, (i % tasks + 1) * kRowsPerTask); y++) visit(i / tasks, y);
    });
  };
  const float scale = 1.0f / (l.reference * l.reference), floor2 = l.floor * l.floor;
  const float share = (1.0f - l.ssim_weight) / ((float)V * R * C);
  const float ssim_share = similar ? -l.ssim_weight / ((float)V * valid_rows * valid_columns) : 0.0f;

  for_rows([&](int v, int y) {
    const LossImage& s = images[v];
    const float *power = l.power + ((int64_t)v * R + y) * C, *truth = l.truth + ((int64_t)v * R + y) * C;
    float *a = s.a + y * stride + pad, *slope = s.slope + y * stride + pad, absolute = 0.0f;
    for (int x = 0; x < C; x++) {
      const float root = __builtin_sqrtf(power[x] * scale + floor2);
      a[x] = root - l.floor;
      slope[x] = 0.5f * scale / root;
      absolute += __builtin_fabsf(a[x] - truth[x]);
    }
    s.absolute[y] = absolute;
    if (!similar) return;
    float* row[5];
    for (int q = 0; q < 5; q++) row[q] = s.blurred[q] + y * stride + pad;
    for (int x = 0; x < C; x++) {
      row[0][x] = a[x]; row[1][x] = truth[x];
      row[2][x] = a[x] * a[x]; row[3][x] = truth[x] * truth[x]; row[4][x] = a[x] * truth[x];
    }
    for (int q = 0; q < 5; q++)
      for (int x = 0; x < valid_columns; x += kWidth) store_anywhere(row[q] + x, window_sum(l.window, row[q] + x, 1));  // reads ahead only
  });
  if (similar) {
    for_rows([&](int v, int y) {
      if (y >= valid_rows) return;
      const LossImage& s = images[v];
      F total = splat(0.0f);
      for (int64_t x = 0; x < valid_columns; x += kWidth) {
        const int64_t at = y * stride + pad + x;
        F m[5];
        for (int q = 0; q < 5; q++) m[q] = window_sum(l.window, s.blurred[q] + at, stride);
        const F ma = m[0], mb = m[1], aa = m[2] - ma * ma, bb = m[3] - mb * mb, ab = m[4] - ma * mb;
        const F a1 = ma * mb * 2.0f + l.c1, a2 = ab * 2.0f + l.c2, b1 = ma * ma + mb * mb + l.c1, b2 = aa + bb + l.c2;
        const F inverse = 1.0f / (b1 * b2), S = a1 * a2 * inverse;
        alignas(64) float columns[kWidth];
        for (int k = 0; k < kWidth; k++) columns[k] = (float)(x + k);
        const I inside = load(columns) < (float)valid_columns;
        total += choose(inside, S, splat(0.0f));
        const F slopes[3] = {(mb * (a2 - a1) * inverse - ma * S * (1.0f / b1 - 1.0f / b2)) * 2.0f, -S / b2, a1 * inverse * 2.0f};
        for (int q = 0; q < 3; q++) store_anywhere(s.slopes[q] + at, choose(inside, slopes[q], splat(0.0f)));
      }
      for (int q = 0; q < 3; q++)  // what the transposed blur along rows finds beside the valid columns
        for (int64_t x = 1; x <= pad; x++) {
          s.slopes[q][y * stride + pad - x] = 0.0f;
          if (valid_columns + x <= C + pad) s.slopes[q][y * stride + pad + valid_columns + x - 1] = 0.0f;
        }
      s.similar[y] = sum(total);
    });
    for_rows([&](int v, int y) {
      const LossImage& s = images[v];
      const int first = most(0, y - valid_rows + 1), last = least(kTaps - 1, y);
      for (int q = 0; q < 3; q++)
        for (int64_t x = 0; x + kWidth <= stride; x += kWidth) {
          const int64_t at = y * stride + x;
          store_anywhere(s.slopes[q] + size + at, window_sum_transposed(l.window, s.slopes[q] + at, stride, first, last));
        }
    });
  }
  for_rows([&](int v, int y) {
    const LossImage& s = images[v];
    const float *a = s.a + y * stride + pad, *slope = s.slope + y * stride + pad;
    const float* truth = l.truth + ((int64_t)v * R + y) * C;
    float* gradient = l.gradient + ((int64_t)v * R + y) * C;
    float* along = similar ? s.blurred[0] + y * stride + pad : nullptr;
    float* times_truth = similar ? s.blurred[1] + y * stride + pad : nullptr;
    for (int x = 0; similar && x < C; x += kWidth) {
      F sums[3];
      for (int q = 0; q < 3; q++)
        sums[q] = window_sum_transposed(l.window, s.slopes[q] + size + y * stride + pad + x, 1, 0, kTaps - 1);
      store_anywhere(along + x, (sums[0] + load_anywhere(a + x) * sums[1] * 2.0f) * ssim_share);
      store_anywhere(times_truth + x, sums[2] * ssim_share);
    }
    for (int x = 0; x < C; x++) {
      const float d = a[x] > truth[x] ? share : a[x] < truth[x] ? -share : 0.0f;
      gradient[x] = (similar ? d + along[x] + truth[x] * times_truth[x] : d) * slope[x];
    }
  });
  for (int v = 0; v < V; v++) {
    double absolute = 0.0, similarity = 0.0;
    for (int y = 0; y < R; y++) absolute += images[v].absolute[y];
    for (int y = 0; similar && y < valid_rows; y++) similarity += images[v].similar[y];
    l.loss[v] = (float)((1.0 - l.ssim_weight) * absolute / ((double)R * C) +
                        (similar ? l.ssim_weight * (1.0 - similarity / ((double)valid_rows * valid_columns)) : 0.0));
  }
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
