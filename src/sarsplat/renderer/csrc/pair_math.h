// pair_math.h: the one place where the mathematics of a pair lives: (Gaussian, ray) and (Gaussian, pixel).
// F is a SIMD vector on a CPU and float on a GPU thread; the includer provides splat, choose, power2, power2_parts,
// power2_minus_one, nearest and sum6 for its F. Exponents and optical depths are kept in base 2: they carry a factor log2(e).
#pragma once

namespace sarsplat {
namespace SG_ISA {

constexpr float kLog2e = 1.4426950408889634f, kLn2 = 0.6931471805599453f;

// A projected Gaussian in lattice or pixel units: 2^-(u^2 + v^2) with u = ux dx + uy dy and v = vy dy, the inverse
// covariance by its Cholesky factor. height: log2 of the optical depth at its centre; the amplitude on the imaging plane.
struct Footprint { float x, y, ux, uy, vy, height; };

template <class F> struct Offset { F u, v; };

template <class F> SG_FN Offset<F> offset(const Footprint& g, F x, F y) {
  const F dx = x - g.x, dy = y - g.y;
  return {dx * g.ux + dy * g.uy, dy * g.vy};
}
template <class F> SG_FN F distance(const Offset<F>& d) { return d.u * d.u + d.v * d.v; }
template <class F> SG_FN F log_depth(const Footprint& g, const Offset<F>& d) { return (g.height - d.u * d.u) - d.v * d.v; }

// What a live pair's optical depth is; who is not live meets none.
template <class F, class M> SG_FN F optical_depth(F log_tau, M live) { return choose(live, power2(log_tau), splat(0.0f)); }

// Pass A, front to back (§3): w = T (1 - e^-tau); T becomes the transmittance behind the Gaussian. Where there is no depth T
// stays as it is to the bit: so it can be stored whole (masked stores are slow to read back).
template <class F> SG_FN F attenuate(F tau, F& T) {
  const auto e = power2_parts(-tau);
  const F w = -(T * power2_minus_one(e));
  T = T * power2(e);
  return w;
}

// Pass A, back to front (§4): on entry T is the transmittance behind the Gaussian and B = sum of h w behind it;
// on return both hold the values before it. Returns tau dL/dtau, with tau in units of log2(e).
template <class F> SG_FN F attenuate_backward(F tau, float h, F& T, F& B) {
  const auto e = power2_parts(tau);
  const F f = tau * (T * h - B);
  B = T * power2_minus_one(e) * h + B;
  T = T * power2(e);
  return f;
}

// Pass B (§3): the footprint's weight, without its norm.
template <class F> SG_FN F imaging_weight(F q, float cut) { return choose(q <= cut, power2(-q), splat(0.0f)); }

// cos and sin of an angle in turns, from those of half of it; errors below 2e-7.
template <class F> struct Phase { F c, s; };
template <class F> SG_FN Phase<F> phase(F turns) {
  const F f = turns - nearest(turns), f2 = f * f;
  F s = f2 * 0.07721839f - 0.59804419f, c = f2 * 0.21968961f - 1.33187657f;
  s = s * f2 + 2.55003119f;
  c = c * f2 + 4.05841135f;
  s = s * f2 - 5.16770687f;
  c = c * f2 - 4.93479283f;
  s = (s * f2 + 3.14159258f) * f;
  c = c * f2 + 0.99999995f;
  return {s * s * -2.0f + 1.0f, s * c * 2.0f};
}

// Six sums per Gaussian and plane are all that the backward pass needs (§4): f {1, u, v, u^2, u v, v^2}.
template <class F> struct Moments {
  F m0, mu, mv, muu, muv, mvv;
  SG_FN void add(const Offset<F>& d, F f) {
    const F fu = f * d.u, fv = f * d.v;
    m0 += f; mu += fu; mv += fv;
    muu = fu * d.u + muu; muv = fu * d.v + muv; mvv = fv * d.v + mvv;
  }
};

}  // namespace SG_ISA
}  // namespace sarsplat
