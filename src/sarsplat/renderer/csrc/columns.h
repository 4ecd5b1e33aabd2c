// columns.h: arrays of structures to vectors, one Gaussian a lane, and back. `real`: how many of the lanes there are.
#pragma once
#include <utility>

#include "tail.h"

namespace sarsplat {
namespace SG_ISA {

constexpr int kFields = 16;  // numbers of a row that are turned at a time

// Vectors of one field each from the first `count` numbers of rows; row(k, part): numbers [part, part + kWidth) of lane k's
template <class Row, int count> SG_FN void turn(Row row, F (&columns)[count]) {
  for (int part = 0; part < count; part += kWidth) {
    F m[kWidth];
    for (int k = 0; k < kWidth; k++) m[k] = row(k, part);
    transpose(m);
    for (int k = 0; k < kWidth; k++) columns[part + k] = m[k];
  }
}
template <class Visit> SG_FN void turn_back(const F (&columns)[kFields], Visit visit) {  // visit(k, part, numbers)
  for (int part = 0; part < kFields; part += kWidth) {
    F m[kWidth];
    for (int k = 0; k < kWidth; k++) m[k] = columns[part + k];
    transpose(m);
    for (int k = 0; k < kWidth; k++) visit(k, part, m[k]);
  }
}

// Rows of `count` <= 16 numbers, one after the other; the rest is zero.
SG_FN void read_rows(const float* rows, int count, int real, F (&columns)[kFields]) {
  turn([&](int k, int part) { return k < real ? load_some(rows + count * k + part, count - part) : splat(0.0f); }, columns);
}
SG_FN void write_rows(const F (&columns)[kFields], int count, int real, float* rows) {
  turn_back(columns, [&](int k, int part, F x) { if (k < real) store_some(rows + count * k + part, x, count - part); });
}

// ---- rows of K numbers, without a detour by 16 -------------------------------------------------------------------------
// Number n of the rows is lane n % kWidth of vector n / kWidth, and lane n / K of column n % K. A column is joined from its
// vectors, and a vector from its columns, two by two; an index below kWidth is a lane of what is joined so far.
typedef std::make_integer_sequence<int, kWidth> AllLanes;

constexpr int in_vector(int n, int v, int lane) { return n / kWidth == v ? kWidth + n % kWidth : v == 1 && n < kWidth ? n : lane; }
template <int K, int Q, int V, int... k> SG_FN F join_column(F so_far, F next, std::integer_sequence<int, k...>) {
  return __builtin_shufflevector(so_far, next, in_vector(K * k + Q, V, k)...);
}
template <int K, int Q, int V = 1> SG_FN F column_of(const F* vectors, F so_far) {
  if constexpr (V == K) return so_far;
  else return column_of<K, Q, V + 1>(vectors, join_column<K, Q, V>(so_far, vectors[V], AllLanes()));
}

constexpr int in_column(int n, int K, int q, int lane) { return n % K == q ? kWidth + n / K : q == 1 && n % K == 0 ? n / K : lane; }
template <int K, int V, int Q, int... k> SG_FN F join_vector(F so_far, F next, std::integer_sequence<int, k...>) {
  return __builtin_shufflevector(so_far, next, in_column(kWidth * V + k, K, Q, k)...);
}
template <int K, int V, int Q = 1> SG_FN F vector_of(const F* columns, F so_far) {
  if constexpr (Q == K) return so_far;
  else return vector_of<K, V, Q + 1>(columns, join_vector<K, V, Q>(so_far, columns[Q], AllLanes()));
}

template <int K, int... k> SG_FN void read_few(const float* rows, int real, F* columns, std::integer_sequence<int, k...>) {
  const F vectors[K] = {load_some(rows + kWidth * k, K * real - kWidth * k)...};
  ((columns[k] = column_of<K, k>(vectors, vectors[0])), ...);
}
template <int K> SG_FN void read_few(const float* rows, int real, F* columns) {
  read_few<K>(rows, real, columns, std::make_integer_sequence<int, K>());
}
template <int K, int... k> SG_FN void write_few(const F* columns, int real, float* rows, std::integer_sequence<int, k...>) {
  (store_some(rows + kWidth * k, vector_of<K, k>(columns, columns[0]), K * real - kWidth * k), ...);
}
template <int K> SG_FN void write_few(const F* columns, int real, float* rows) {
  write_few<K>(columns, real, rows, std::make_integer_sequence<int, K>());
}

}  // namespace SG_ISA
}  // namespace sarsplat
