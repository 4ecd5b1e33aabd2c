// adam.h: one step of Adam over all parameters of a training, and back into their bounds.
#pragma once
#include "api.h"
#include "parallel.h"
#include "tail.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kRows = 1024;  // per task; a multiple of every kWidth
constexpr int kMaxColumns = 16;

// NaN stays NaN: the next forward pass says so
SG_FN F clamp(F x, F low, F high) { return choose(x < low, low, choose(x > high, high, x)); }

int adam_tasks(const sg_adam_group& g) { return (int)((g.rows + kRows - 1) / kRows); }

void adam(const sg_adam_step* adam) {
  const float mean_share = 1.0f - adam->beta1, square_share = 1.0f - adam->beta2;
  const float rate = 1.0f / (1.0f - adam->beta1_power), spread = 1.0f / __builtin_sqrtf(1.0f - adam->beta2_power);
  int tasks = 0;
  for (int32_t n = 0; n < adam->count; n++) tasks += adam_tasks(adam->groups[n]);
  parallel(tasks, [&](int task) {
    const sg_adam_group* group = adam->groups;
    for (; task >= adam_tasks(*group); group++) task -= adam_tasks(*group);
    const sg_adam_group& g = *group;
    alignas(64) float low[kMaxColumns * kWidth], high[kMaxColumns * kWidth], rates[kMaxColumns * kWidth];
    for (int k = 0, column = 0; k < g.columns * kWidth; k++, column = column + 1 < g.columns ? column + 1 : 0) {
      low[k] = g.low[column]; high[k] = g.high[column]; rates[k] = g.rate[column] * g.decay * rate;
    }
    const int64_t end = (task + 1 < adam_tasks(g) ? (int64_t)(task + 1) * kRows : g.rows) * g.columns;
    for (int64_t i = (int64_t)task * kRows * g.columns, k = 0; i < end; i += kWidth, k = k + kWidth < g.columns * kWidth ? k + kWidth : 0) {
      const int64_t some = end - i;
      F value = load_some(g.value + i, some), gradient = load_some(g.gradient + i, some);
      if (g.logarithmic) gradient *= value;
      F mean = load_some(g.mean + i, some), square = load_some(g.square + i, some);
      mean += (gradient - mean) * mean_share;
      square = square * adam->beta2 + gradient * gradient * square_share;
      const F down = mean / (root(square) * spread + adam->epsilon) * load(rates + k);
      value = g.logarithmic ? value * power2(clamp(down * -1.44269504f, splat(-99.0f), splat(99.0f))) : value - down;
      store_some(g.mean + i, mean, some);
      store_some(g.square + i, square, some);
      store_some(g.value + i, clamp(value, load(low + k), load(high + k)), some);
    }
  });
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
