// columns.h: arrays of structures to vectors, one Gaussian a lane, and back. `real`: how many of the lanes there are.
#pragma once
#include <utility>

#include "tail.h"

namespace sarsplat {
namespace SG_ISA {

constexpr int kFields = 16;  // numbers of a row that are turned at a time

// 16 vectors of one field each from rows of 16 numbers; row(k, part): numbers [part, part + kWidth) of lane k's
template <class Row> SG_FN void turn(Row row, F (&columns)[kFields]) {
  for (int part = 0; part < kFields; part += kWidth) {
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
// Lane k of column q is number K k + q of K vectors; the first two of them are joined, then each of the others.
template <int K, int Q, int V, int... k> SG_FN F join_column(F so_far, F next, std::integer_sequence<int, k...>) {
  return __builtin_shufflevector(so_far, next, ((K * k + Q) / kWidth == V ? kWidth + (K * k + Q) % kWidth : V == 1 && K * k + Q < kWidth ? K * k + Q : k)...);
}
template <int K, int Q, int V = 1> SG_FN F column_of(const F* vectors, F so_far) {
  if constexpr (V == K) return so_far;
  else return column_of<K, Q, V + 1>(vectors, join_column<K, Q, V>(so_far, vectors[V], std::make_integer_sequence<int, kWidth>()));
}
// Lane l of vector j is row (kWidth j + l) / K of column (kWidth j + l) % K.
template <int K, int J, int Q, int... l> SG_FN F join_vector(F so_far, F next, std::integer_sequence<int, l...>) {
  return __builtin_shufflevector(so_far, next, ((kWidth * J + l) % K == Q ? kWidth + (kWidth * J + l) / K : Q == 1 && (kWidth * J + l) % K == 0 ? (kWidth * J + l) / K : l)...);
}
template <int K, int J, int Q = 1> SG_FN F vector_of(const F* columns, F so_far) {
  if constexpr (Q == K) return so_far;
  else return vector_of<K, J, Q + 1>(columns, join_vector<K, J, Q>(so_far, columns[Q], std::make_integer_sequence<int, kWidth>()));
}

template <int K, int... q> SG_FN void read_few(const float* rows, int real, F* columns, std::integer_sequence<int, q...>) {
  const F vectors[K] = {load_some(rows + kWidth * q, K * real - kWidth * q)...};
  ((columns[q] = column_of<K, q>(vectors, vectors[0])), ...);
}
template <int K> SG_FN void read_few(const float* rows, int real, F* columns) { read_few<K>(rows, real, columns, std::make_integer_sequence<int, K>()); }

template <int K, int... j> SG_FN void write_few(const F* columns, int real, float* rows, std::integer_sequence<int, j...>) {
  (store_some(rows + kWidth * j, vector_of<K, j>(columns, columns[0]), K * real - kWidth * j), ...);
}
template <int K> SG_FN void write_few(const F* columns, int real, float* rows) { write_few<K>(columns, real, rows, std::make_integer_sequence<int, K>()); }

}  // namespace SG_ISA
}  // namespace sarsplat
