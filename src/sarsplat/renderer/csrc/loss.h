// loss.h: (1 - lambda) L1 + lambda (1 - SSIM) of amplitudes, and its gradient with respect to power, in one go.
//
// Amplitude against that of the truth; SSIM of the places where the window fits whole (loss_math.h). A task makes some rows of the gradient and computes what they need of their neighbours for itself:
// amplitudes -> windows, along columns and along rows -> similarity and its slopes -> both transposed -> gradient.
#pragma once
#include "context.h"
#include "parallel.h"
#include "tail.h"
#include "loss_math.h"  // of the number type above

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kPad = 16;  // numbers before a row of scratch: at least kReach, and whole vectors

struct LossTask {  // its scratch; every row has `stride` numbers and begins after kPad of them
  float *a, *truth;       // [rows and neighbours]
  float* blurred[5];      // one row: of a, t, a^2, t^2, a t, along columns
  float* slopes[3];       // one row: dS / d(mean of a, of a^2, of a t)
  float* spread[3];       // [windows]: the same, transposed along the row
  double absolute, similar;  // sums
};

// Sum over the window that begins at p, whose numbers are `step` apart. The window is symmetric: what a place takes from
// all windows that contain it is the same sum over windows, begun kReach before it.
SG_FN F window_sum(const F (&w)[kReach / 2 + 1], const float* p, int64_t step) {
  F sum = load_anywhere(p + kReach / 2 * step) * w[kReach / 2];
  for (int k = 0; k < kReach / 2; k++) sum += (load_anywhere(p + k * step) + load_anywhere(p + (kReach - k) * step)) * w[k];
  return sum;
}

int32_t amplitude_loss(sg_context* context, const sg_loss* loss) {
  const sg_loss& l = *loss;
  Arena& arena = context->arena;
  arena.reset();
  const int R = l.rows, C = l.columns, V = l.views;
  const int reach = l.ssim_weight > 0.0f ? kReach : 0, valid_rows = R - reach, valid_columns = C - reach;
  const int64_t stride = kPad + padded(C) + kPad;
  const int rows = reach ? 32 : 128;  // of a task: without windows, fewer cost less than waking a thread
  const int tasks = (R + rows - 1) / rows;
  LossTask* all = arena.take<LossTask>(V * tasks);
  for (int i = 0; i < V * tasks && !arena.failed(); i++) {
    LossTask& s = all[i];
    s.a = arena.take<float>((rows + 2 * reach) * stride);
    s.truth = arena.take<float>((rows + 2 * reach) * stride);
    if (!reach) continue;
    for (float*& p : s.blurred) p = arena.take<float>(stride);
    for (float*& p : s.slopes) p = arena.take<float>(stride);
    for (float*& p : s.spread) p = arena.take<float>((rows + reach) * stride);
  }
  if (arena.failed()) { arena.give_back(); return SG_MEMORY; }
  const float share = absolute_share(l), ssim_share = similarity_share(l);

  parallel(V * tasks, [&](int task) {
    LossTask& s = all[task];
    const int64_t image = (int64_t)(task / tasks) * R * C;
    const int begin = task % tasks * rows, end = smaller(R, begin + rows);
    const int first = begin - reach;  // the first window that contains one of the rows; some lie beyond the edges
    auto row = [&](float* p, int y) { return p + (y - first) * stride + kPad; };
    F w[kReach / 2 + 1];
    for (int k = 0; k <= kReach / 2; k++) w[k] = splat(l.window[k]);
    for (int y = larger(0, first); y < smaller(R, end + reach); y++)
      for (int x = 0; x < C; x += kWidth) {
        const int64_t at = image + (int64_t)y * C + x;
        store(row(s.a, y) + x, rendered_amplitude(load_some(l.power + at, C - x), l));
        store(row(s.truth, y) + x, true_amplitude(load_some(l.truth + at, C - x), l));
      }
    s.similar = 0.0;
    auto clear = [&](float* p) { for (int64_t x = 0; x < stride; x += kWidth) store(p + x, splat(0.0f)); };
    for (int q = 0; reach && q < 3; q++) clear(s.slopes[q]);  // beside the windows there are none
    for (int y = first; reach && y < end; y++) {
      if (y < 0 || y >= valid_rows) {
        for (float* p : s.spread) clear(row(p, y) - kPad);
        continue;
      }
      for (int x = 0; x < C; x += kWidth) {
        F sums[5] = {splat(0.0f), splat(0.0f), splat(0.0f), splat(0.0f), splat(0.0f)};
        for (int k = 0; k < kTaps; k++) {
          const F a = load(row(s.a, y + k) + x), t = load(row(s.truth, y + k) + x), wa = a * w[smaller(k, kReach - k)], wt = t * w[smaller(k, kReach - k)];
          sums[0] += wa; sums[1] += wt; sums[2] += wa * a; sums[3] += wt * t; sums[4] += wa * t;
        }
        for (int q = 0; q < 5; q++) store(s.blurred[q] + kPad + x, sums[q]);
      }
      F total = splat(0.0f);
      for (int x = 0; x < valid_columns; x += kWidth) {
        F means[5];
        for (int q = 0; q < 5; q++) means[q] = window_sum(w, s.blurred[q] + kPad + x, 1);
        const Similarity<F> found = similarity(means, l.c1, l.c2);
        total += load_some((const float*)&found.value, valid_columns - x);
        for (int q = 0; q < 3; q++) store_some(s.slopes[q] + kPad + x, found.slopes[q], valid_columns - x);
      }
      if (y >= begin) s.similar += sum(total);  // the task above counts the others
      for (int q = 0; q < 3; q++)
        for (int x = 0; x < C; x += kWidth)
          store(row(s.spread[q], y) + x, window_sum(w, s.slopes[q] + kPad + x - kReach, 1));
    }
    s.absolute = 0.0;
    for (int y = begin; y < end; y++) {
      F total = splat(0.0f);
      for (int x = 0; x < C; x += kWidth) {
        const F a = load(row(s.a, y) + x), t = load(row(s.truth, y) + x);  // beyond the end both are 0: the root of a square is exact
        total += absolute(a - t);
        F slope = absolute_slope(a, t, share);
        if (reach) {
          F sums[3];
          for (int q = 0; q < 3; q++) sums[q] = window_sum(w, row(s.spread[q], y - kReach) + x, stride);
          slope += similarity_slope(sums, a, t) * ssim_share;
        }
        store_some(l.d_power + image + (int64_t)y * C + x, power_slope(slope, a, l), C - x);
      }
      s.absolute += sum(total);
    }
  });
  double absolute = 0.0, similar = 0.0;
  for (int i = 0; i < V * tasks; i++) { absolute += all[i].absolute; similar += all[i].similar; }
  *l.loss = (float)((1.0 - l.ssim_weight) * absolute / ((double)V * R * C) +
                    (reach ? l.ssim_weight * (1.0 - similar / ((double)V * valid_rows * valid_columns)) : 0.0));
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
