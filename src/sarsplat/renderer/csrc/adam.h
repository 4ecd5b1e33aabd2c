// adam.h: one step of Adam over all parameters of a training, and back into their bounds.
#pragma once
#include "parallel.h"
#include "tail.h"
#include "adam_math.h"  // of the number type above

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kRows = 1024;  // per task; a multiple of every kWidth
constexpr int kMaxColumns = 16;

int adam_tasks(const sg_adam_group& g) { return (int)((g.rows + kRows - 1) / kRows); }

int32_t adam(sg_context*, const sg_adam_step* adam) {
  int tasks = 0;
  for (int32_t n = 0; n < adam->count; n++) tasks += adam_tasks(adam->groups[n]);
  parallel(tasks, [&](int task) {
    const sg_adam_group* group = adam->groups;
    for (; task >= adam_tasks(*group); group++) task -= adam_tasks(*group);
    const sg_adam_group& g = *group;
    const AdamShares shares = shares_of(*adam, g, (int)(group - adam->groups));
    alignas(64) float low[kMaxColumns * kWidth], high[kMaxColumns * kWidth], rates[kMaxColumns * kWidth];
    for (int k = 0, column = 0; k < g.columns * kWidth; k++, column = column + 1 < g.columns ? column + 1 : 0) {
      low[k] = g.low[column]; high[k] = g.high[column]; rates[k] = rate_of(shares, g, column);
    }
    const int64_t end = (task + 1 < adam_tasks(g) ? (int64_t)(task + 1) * kRows : g.rows) * g.columns;
    for (int64_t i = (int64_t)task * kRows * g.columns, k = 0; i < end; i += kWidth, k = k + kWidth < g.columns * kWidth ? k + kWidth : 0) {
      const int64_t some = end - i;
      F mean = load_some(g.mean + i, some), square = load_some(g.square + i, some);
      const F value = stepped(load_some(g.value + i, some), load_some(g.gradient + i, some), mean, square,
                              load(rates + k), load(low + k), load(high + k), g.logarithmic, shares);
      store_some(g.mean + i, mean, some);
      store_some(g.square + i, square, some);
      store_some(g.value + i, value, some);
    }
  });
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
