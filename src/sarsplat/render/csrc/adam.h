// adam.h: one step of Adam over all parameters of a training, and back into their bounds.
#pragma once
#include "api.h"
#include "parallel.h"
#include "simd.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kVectors = 256;       // vectors per task and column
constexpr int kMostColumns = 16;

void adam(const sg_adam_group* groups, int32_t count, float beta1, float beta2, float epsilon) {
  for (int32_t n = 0; n < count; n++) {
    const sg_adam_group& g = groups[n];
    const int64_t per_task = (int64_t)kVectors * kWidth * g.columns, tasks = (g.count + per_task - 1) / per_task;
    F low[kMostColumns], high[kMostColumns];  // of the j-th vector from a multiple of `columns` vectors on
    for (int j = 0; j < g.columns; j++)
      for (int k = 0; k < kWidth; k++) { low[j][k] = g.low[(j * kWidth + k) % g.columns]; high[j][k] = g.high[(j * kWidth + k) % g.columns]; }
    const float rate = g.rate / (1.0f - g.beta1_power), spread = 1.0f / __builtin_sqrtf(1.0f - g.beta2_power);
    auto step = [&](F& value, F gradient, F& mean, F& square, int j) {
      mean += (gradient - mean) * (1.0f - beta1);
      square = square * beta2 + gradient * gradient * (1.0f - beta2);
      value -= mean / (root(square) * spread + epsilon) * rate;
      value = smaller(larger(value, low[j]), high[j]);
    };
    parallel((int)tasks, [&](int task) {
      const int64_t end = (task + 1) * per_task < g.count ? (task + 1) * per_task : g.count;
      int j = 0;
      for (int64_t i = task * per_task; i < end; i += kWidth, j = j + 1 < g.columns ? j + 1 : 0) {
        alignas(64) float tail[4][kWidth] = {};
        const bool whole = i + kWidth <= end;
        float *value = g.value + i, *mean = g.mean + i, *square = g.square + i;
        const float* gradient = g.gradient + i;
        if (!whole) {
          for (int64_t k = 0; k < end - i; k++) { tail[0][k] = value[k]; tail[1][k] = gradient[k]; tail[2][k] = mean[k]; tail[3][k] = square[k]; }
          value = tail[0]; gradient = tail[1]; mean = tail[2]; square = tail[3];
        }
        F v = load_anywhere(value), m = load_anywhere(mean), s = load_anywhere(square);
        step(v, load_anywhere(gradient), m, s, j);
        store_anywhere(value, v); store_anywhere(mean, m); store_anywhere(square, s);
        if (!whole)
          for (int64_t k = 0; k < end - i; k++) { g.value[i + k] = tail[0][k]; g.mean[i + k] = tail[2][k]; g.square[i + k] = tail[3][k]; }
      }
    });
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
