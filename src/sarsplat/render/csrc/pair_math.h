// pair_math.h: the one place where the mathematics of a pair lives: (Gaussian, ray) and (Gaussian, pixel).
// F is a SIMD vector on a CPU and float on a GPU thread; the includer provides splat, choose, power2, power2_parts,
// power2_minus_one and sum6 for its F. Exponents are kept in base 2: q, depth and limit carry a factor log2(e).
#pragma once

namespace sarsplat {
namespace SG_ISA {

constexpr float kLog2e = 1.4426950408889634f, kLn2 = 0.6931471805599453f;

// A projected Gaussian in lattice or pixel units: q = a dx^2 + b dx dy + c dy^2 <= limit is inside the footprint.
struct Footprint { float x, y, a, b, c, limit, depth; };

template <class F> struct Offset { F dx, dy, q; };

template <class F> SG_FN Offset<F> offset(const Footprint& g, F x, F y) {
  const F dx = x - g.x, dy = y - g.y;
  return {dx, dy, (dx * g.a + dy * g.b) * dx + dy * dy * g.c};
}

// Pass A, front to back (§3): w = T (1 - e^-tau); T becomes the transmittance behind the Gaussian.
template <class F, class M> SG_FN F attenuate(const Footprint& g, const Offset<F>& d, M live, F& T) {
  const auto e = power2_parts(-(power2(-d.q) * g.depth));
  const F w = choose(live, -(T * power2_minus_one(e)), splat(0.0f));
  T = choose(live, T * power2(e), T);
  return w;
}

// Pass A, back to front (§4): on entry T is the transmittance behind the Gaussian and B = sum of h w behind it;
// on return both hold the values before it. Returns tau dL/dtau, with tau in units of log2(e).
template <class F, class M>
SG_FN F attenuate_backward(const Footprint& g, const Offset<F>& d, M live, float h, F& T, F& B) {
  const F tau = power2(-d.q) * g.depth;
  const auto e = power2_parts(tau);
  const F f = choose(live, tau * (T * h - B), splat(0.0f));
  B = choose(live, T * power2_minus_one(e) * h + B, B);
  T = choose(live, T * power2(e), T);
  return f;
}

// Pass B (§3): the footprint's weight, without its norm.
template <class F, class M> SG_FN F imaging_weight(const Offset<F>& d, M live) {
  return choose(live, power2(-d.q), splat(0.0f));
}

// Six sums per Gaussian and plane are all that the backward pass needs (§4): f {1, d, d d^T}.
template <class F> struct Moments {
  F m0, mx, my, mxx, mxy, myy;
  SG_FN void add(const Offset<F>& d, F f) {
    const F fx = f * d.dx, fy = f * d.dy;
    m0 += f; mx += fx; my += fy;
    mxx = fx * d.dx + mxx; mxy = fx * d.dy + mxy; myy = fy * d.dy + myy;
  }
};

}  // namespace SG_ISA
}  // namespace sarsplat
