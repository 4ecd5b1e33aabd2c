// likelihood.h: how surprising the signals of stacks are, given what covariances of their channels are expected, and its
// gradients, in one go.
//
// The covariance C of a pixel is Hermitian: planes hold its diagonal, and of pairs of channels i < j the real and the
// imaginary part of C_ij. Pairs may share planes, and then differ in phase alone. Row by row:
// planes -> phases taken out -> means over a window, at edges over what of it there is -> with noise, tr C^-1 Y + log det C
// and its slope G = C^-1 - C^-1 Y C^-1 -> all transposed -> gradients.
#pragma once
#include "context.h"
#include "pair_math.h"
#include "parallel.h"
#include "tail.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kMostPasses = 16;

struct Complex { F re, im; };
SG_FN Complex operator+(Complex a, Complex b) { return {a.re + b.re, a.im + b.im}; }
SG_FN Complex times(Complex a, Complex b) { return {a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re}; }
SG_FN Complex times_conjugate(Complex a, Complex b) { return {a.re * b.re + a.im * b.im, a.im * b.re - a.re * b.im}; }
SG_FN Complex scaled(Complex a, F by) { return {a.re * by, a.im * by}; }

typedef Complex Matrix[kMostPasses][kMostPasses];  // of kWidth pixels; of triangular and Hermitian ones the lower half counts

// C = L L^H; returns log det C and replaces C by L^-1. Pixels where there is no such L are marked, and go on with another.
static F invert_root(Matrix& c, int passes, I& failed) {
  F log_determinant = splat(0.0f), inverse[kMostPasses];
  for (int j = 0; j < passes; j++) {
    F pivot = c[j][j].re;
    for (int k = 0; k < j; k++) pivot -= c[j][k].re * c[j][k].re + c[j][k].im * c[j][k].im;
    const I good = pivot > 0.0f;
    failed |= ~good;
    pivot = choose(good, pivot, splat(1.0f));
    log_determinant += natural_log(pivot);
    inverse[j] = 1.0f / root(pivot);
    for (int i = j + 1; i < passes; i++) {
      Complex sum = c[i][j];
      for (int k = 0; k < j; k++) {
        const Complex product = times_conjugate(c[i][k], c[j][k]);
        sum.re -= product.re;
        sum.im -= product.im;
      }
      c[i][j] = scaled(sum, inverse[j]);
    }
  }
  for (int j = 0; j < passes; j++) {  // column j of the inverse needs of L what lies at and right of it
    for (int i = j + 1; i < passes; i++) {
      Complex sum = scaled(c[i][j], inverse[j]);
      for (int k = j + 1; k < i; k++) sum = sum + times(c[i][k], c[k][j]);
      c[i][j] = scaled(sum, -inverse[i]);
    }
    c[j][j] = {inverse[j], splat(0.0f)};
  }
  return log_determinant;
}

// tr C^-1 Y from M = L^-1 and Y, which is replaced by G = M^H (1 - M Y M^H) M.
static F surprise_and_slope(const Matrix& m, Matrix& y, int passes) {
  Matrix my, t;
  for (int i = 0; i < passes; i++)
    for (int j = 0; j < passes; j++) {
      Complex sum{splat(0.0f), splat(0.0f)};
      for (int k = 0; k <= i; k++) {
        const Complex of = k >= j ? y[k][j] : Complex{y[j][k].re, -y[j][k].im};
        sum = sum + times(m[i][k], of);
      }
      my[i][j] = sum;
    }
  F surprise = splat(0.0f);
  for (int i = 0; i < passes; i++)
    for (int j = 0; j <= i; j++) {  // 1 - M Y M^H
      Complex sum{splat(0.0f), splat(0.0f)};
      for (int k = 0; k <= j; k++) sum = sum + times_conjugate(my[i][k], m[j][k]);
      if (i == j) surprise += sum.re;
      t[i][j] = {(i == j ? 1.0f : 0.0f) - sum.re, -sum.im};
    }
  for (int i = 0; i < passes; i++)  // (1 - T) M, of which M^H needs the lower half
    for (int j = 0; j <= i; j++) {
      Complex sum{splat(0.0f), splat(0.0f)};
      for (int k = j; k < passes; k++) {
        const Complex of = k <= i ? t[i][k] : Complex{t[k][i].re, -t[k][i].im};
        sum = sum + times(of, m[k][j]);
      }
      my[i][j] = sum;
    }
  for (int i = 0; i < passes; i++)
    for (int j = 0; j <= i; j++) {  // M^H of it: sums over rows at and below i
      Complex sum{splat(0.0f), splat(0.0f)};
      for (int k = i; k < passes; k++) sum = sum + times_conjugate(my[k][j], m[k][i]);
      y[i][j] = sum;
    }
  return surprise;
}

struct LikelihoodPlanes {  // of one view; a row has `pad` zeros before and after it
  float *model, *slope;      // [P^2]: a diagonal, then real and imaginary parts in turn
  float* turned;             // [2 P]: cos and sin of each channel's phase
  float* row;                // [1] scratch
  int64_t rows, stride, pad;
  SG_FN float* at(float* planes, int64_t plane, int64_t y) const { return planes + (plane * rows + y) * stride + pad; }
};

// Sums over windows along a row, in place.
SG_FN void sum_along(float* p, float* scratch, int columns, int reach) {
  for (int x = 0; x < columns; x += kWidth) {
    F sum = splat(0.0f);
    for (int k = -reach; k <= reach; k++) sum += load_anywhere(p + x + k);
    store(scratch + x, sum);
  }
  for (int x = 0; x < columns; x += kWidth) store_some(p + x, load(scratch + x), columns - x);
}
SG_FN F sum_across(const LikelihoodPlanes& s, float* planes, int plane, int y, int x, int reach) {
  F sum = splat(0.0f);
  for (int k = larger(0, y - reach); k <= smaller((int)s.rows - 1, y + reach); k++) sum += load(s.at(planes, plane, k) + x);
  return sum;
}
SG_FN float inverse_count(int at, int size, int reach) {
  return 1.0f / (smaller(size - 1, at + reach) - larger(0, at - reach) + 1);
}

// exp(-j (phase of i - phase of j))
SG_FN Complex turn_between(const LikelihoodPlanes& s, int i, int j, int y, int x) {
  const F ci = load(s.at(s.turned, 2 * i, y) + x), si = load(s.at(s.turned, 2 * i + 1, y) + x);
  const F cj = load(s.at(s.turned, 2 * j, y) + x), sj = load(s.at(s.turned, 2 * j + 1, y) + x);
  return {ci * cj + si * sj, ci * sj - si * cj};
}

int32_t stack_likelihood(sg_context* context, const sg_likelihood* likelihood) {
  const sg_likelihood& l = *likelihood;
  Arena& arena = context->arena;
  arena.reset();
  const int R = l.rows, C = l.columns, V = l.views, P = l.passes, N = P * P;
  const int64_t pad = padded(l.reach), stride = pad + padded(C) + pad, size = (int64_t)R * C;
  LikelihoodPlanes s{arena.take<float>(N * R * stride), arena.take<float>(N * R * stride), arena.take<float>(2 * P * R * stride),
                     arena.take<float>(R * stride), R, stride, pad};
  double* nats = arena.take<double>((int64_t)V * R);
  double* noise = arena.take<double>((int64_t)R * P);
  int64_t* failures = arena.take<int64_t>((int64_t)V * R);
  float* inverse_columns = arena.take<float>(padded(C));
  if (arena.failed()) { arena.give_back(); return SG_MEMORY; }
  for (int x = 0; x < padded(C); x++) inverse_columns[x] = x < C ? inverse_count(x, C, l.reach) : 0.0f;
  const float share = 1.0f / ((float)V * R * C);
  I lanes;
  for (int k = 0; k < kWidth; k++) lanes[k] = k;

  for (int64_t v = 0; v < V; v++) {
    const float *power = l.power + v * l.powers * size, *pairs = l.pair + v * 2 * l.pairs * size, *truth = l.truth + v * N * size;
    const float* phases = l.phases + v * P * size;
    parallel(R, [&](int y) {  // phases taken out, sums along the row
      for (int plane = 0; plane < N; plane++)
        for (float* planes : {s.model, s.slope}) {
          float* row = s.at(planes, plane, y);
          for (int64_t x = 0; x < pad; x += kWidth) { store(row - pad + x, splat(0.0f)); store(row + padded(C) + x, splat(0.0f)); }
        }
      for (int x = 0; x < C; x += kWidth) {
        const int64_t at = (int64_t)y * C + x, left = C - x;
        for (int i = 0; i < P; i++) {
          const Phase<F> turned = phase(load_some(phases + i * size + at, left) * 0.15915494f);
          store(s.at(s.turned, 2 * i, y) + x, turned.c);
          store(s.at(s.turned, 2 * i + 1, y) + x, turned.s);
          store(s.at(s.model, i, y) + x, load_some(power + l.of_channels[i] * size + at, left));
        }
        for (int i = 0, q = 0; i < P; i++)
          for (int j = i + 1; j < P; j++, q++) {
            const float* own = pairs + 2 * l.of_pairs[q] * size + at;
            const Complex found = times({load_some(own, left), load_some(own + size, left)}, turn_between(s, i, j, y, x));
            store(s.at(s.model, P + 2 * q, y) + x, found.re);
            store(s.at(s.model, P + 2 * q + 1, y) + x, found.im);
          }
      }
      for (int plane = 0; l.reach && plane < N; plane++) sum_along(s.at(s.model, plane, y), s.at(s.row, 0, y), C, l.reach);
    });
    parallel(R, [&](int y) {  // likelihood
      F total = splat(0.0f), of_noise[kMostPasses];
      int64_t failed = 0;
      for (int i = 0; i < P; i++) of_noise[i] = splat(0.0f);
      const float inverse_rows = inverse_count(y, R, l.reach);
      Matrix c, g;
      for (int x = 0; x < C; x += kWidth) {
        const int64_t at = (int64_t)y * C + x, left = C - x;
        const F inverse = load(inverse_columns + x) * inverse_rows;
        for (int i = 0; i < P; i++) {
          c[i][i] = {sum_across(s, s.model, i, y, x, l.reach) * inverse + l.noise[v * P + i], splat(0.0f)};
          g[i][i] = {load_some(truth + i * size + at, left), splat(0.0f)};
        }
        for (int i = 0, q = P; i < P; i++)
          for (int j = i + 1; j < P; j++, q += 2) {  // the lower half is the conjugate
            c[j][i] = {sum_across(s, s.model, q, y, x, l.reach) * inverse, -sum_across(s, s.model, q + 1, y, x, l.reach) * inverse};
            g[j][i] = {load_some(truth + q * size + at, left), -load_some(truth + (q + 1) * size + at, left)};
          }
        const I inside = lanes < (int32_t)(left < kWidth ? left : kWidth);
        I wrong = lanes < 0;
        const F logarithm = invert_root(c, P, wrong), surprise = surprise_and_slope(c, g, P);
        total += choose(inside, logarithm + surprise, splat(0.0f));
        failed += __builtin_popcount(bits(wrong & inside));
        const F weight = choose(inside, inverse * share, splat(0.0f));
        for (int i = 0; i < P; i++) {
          of_noise[i] += choose(inside, g[i][i].re, splat(0.0f));
          store(s.at(s.slope, i, y) + x, choose(inside, g[i][i].re * weight, splat(0.0f)));
        }
        for (int i = 0, q = P; i < P; i++)
          for (int j = i + 1; j < P; j++, q += 2) {
            store(s.at(s.slope, q, y) + x, choose(inside, g[j][i].re * (weight * 2.0f), splat(0.0f)));
            store(s.at(s.slope, q + 1, y) + x, choose(inside, g[j][i].im * (weight * -2.0f), splat(0.0f)));
          }
      }
      nats[v * R + y] = sum(total);
      failures[v * R + y] = failed;
      for (int i = 0; i < P; i++) noise[y * P + i] = sum(of_noise[i]);
      for (int plane = 0; l.reach && plane < N; plane++) sum_along(s.at(s.slope, plane, y), s.at(s.row, 0, y), C, l.reach);
    });
    float *d_power = l.d_power + v * l.powers * size, *d_pairs = l.d_pair + v * 2 * l.pairs * size;
    float* d_phases = l.d_phases ? l.d_phases + v * P * size : nullptr;
    parallel(R, [&](int y) {  // gradients
      const int64_t first = (int64_t)y * C;
      for (int k = 0; k < l.powers; k++) std::memset(d_power + k * size + first, 0, sizeof(float) * C);
      for (int k = 0; k < 2 * l.pairs; k++) std::memset(d_pairs + k * size + first, 0, sizeof(float) * C);
      for (int k = 0; d_phases && k < P; k++) std::memset(d_phases + k * size + first, 0, sizeof(float) * C);
      auto add = [&](float* p, F more, int64_t left) __attribute__((always_inline)) { store_some(p, load_some(p, left) + more, left); };
      for (int x = 0; x < C; x += kWidth) {
        const int64_t at = first + x, left = C - x;
        for (int i = 0; i < P; i++) add(d_power + l.of_channels[i] * size + at, sum_across(s, s.slope, i, y, x, l.reach), left);
        for (int i = 0, q = 0; i < P; i++)
          for (int j = i + 1; j < P; j++, q++) {
            const int64_t own = 2 * l.of_pairs[q] * size + at;
            const Complex turn = turn_between(s, i, j, y, x);
            const Complex slope{sum_across(s, s.slope, P + 2 * q, y, x, l.reach), sum_across(s, s.slope, P + 2 * q + 1, y, x, l.reach)};
            const Complex back = times_conjugate(slope, turn);
            add(d_pairs + own, back.re, left);
            add(d_pairs + own + size, back.im, left);
            if (!d_phases) continue;
            const F real = load_some(pairs + own, left), imaginary = load_some(pairs + own + size, left);
            const F turning = back.re * imaginary - back.im * real;
            add(d_phases + i * size + at, turning, left);
            add(d_phases + j * size + at, -turning, left);
          }
      }
    });
    for (int i = 0; i < P; i++) {
      double along = 0.0;
      for (int y = 0; y < R; y++) along += noise[(int64_t)y * P + i];
      l.d_noise[v * P + i] = (float)(along * share);
    }
  }
  double all = 0.0;
  *l.failed = 0;
  for (int64_t k = 0; k < (int64_t)V * R; k++) { all += nats[k]; *l.failed += failures[k]; }
  *l.loss = (float)(all * share);
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
