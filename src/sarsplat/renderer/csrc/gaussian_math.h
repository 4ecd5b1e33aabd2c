// gaussian_math.h: what happens once per Gaussian and view: projection on both planes, scattering, and their adjoints
// (§2-§4). F is a SIMD vector (one Gaussian a lane) on a CPU and float on a GPU thread. Plane quantities are in units of
// ray cells (computation plane) or pixels (imaging plane).
#pragma once
#include "pair_math.h"

namespace sarsplat {
namespace SG_ISA {

template <class F> struct Sym2 { F xx, xy, yy; };

// View-independent: centre, rotation R(q) (column k is the Gaussian's axis k) and standard deviations.
template <class F> struct Body { F mean[3], rot[9], scale[3]; };

struct ViewFrame { float r[9]; };                            // R_r, row-major
struct PlaneUnits { float ray[2], pixel[2], widening, response[2]; };  // spacings (m), c, response variance (m^2)

template <class F> SG_FN void rotation(F w, F x, F y, F z, F* rot, F* unit, F& norm) {
  norm = root(w * w + x * x + y * y + z * z);
  w /= norm; x /= norm; y /= norm; z /= norm;
  unit[0] = w; unit[1] = x; unit[2] = y; unit[3] = z;
  rot[0] = 1.0f - 2.0f * (y * y + z * z); rot[1] = 2.0f * (x * y - w * z); rot[2] = 2.0f * (x * z + w * y);
  rot[3] = 2.0f * (x * y + w * z); rot[4] = 1.0f - 2.0f * (x * x + z * z); rot[5] = 2.0f * (y * z - w * x);
  rot[6] = 2.0f * (x * z - w * y); rot[7] = 2.0f * (y * z + w * x); rot[8] = 1.0f - 2.0f * (x * x + y * y);
}

// The covariance in the radar frame, factored: axis[i][k] = (R_r R)_ik; nothing is ever subtracted from a determinant.
template <class F> struct Projection {
  F mean[3];               // x_r
  F axis[3][3];
  F minor[3];              // product of the other two variances: the weights of the determinants
  F det_c;                 // det Sigma_C, m^4
  Sym2<F> cov_c, cov_i;    // widened, in cells^2 and pixels^2
  F det_cw, det_iw;        // their determinants
  F xz, yz;                // Sigma_r entries that tilt the Gaussian along the ray, m^2
};

template <class F> SG_FN Projection<F> project(const Body<F>& g, const ViewFrame& f, const PlaneUnits& u) {
  Projection<F> p;
  for (int i = 0; i < 3; i++) {
    const float *r = f.r + 3 * i;
    p.mean[i] = g.mean[0] * r[0] + g.mean[1] * r[1] + g.mean[2] * r[2];
    for (int k = 0; k < 3; k++) p.axis[i][k] = g.rot[k] * r[0] + g.rot[3 + k] * r[1] + g.rot[6 + k] * r[2];
  }
  F var[3];
  for (int k = 0; k < 3; k++) var[k] = g.scale[k] * g.scale[k];
  p.minor[0] = var[1] * var[2]; p.minor[1] = var[0] * var[2]; p.minor[2] = var[0] * var[1];
  auto dot = [&](int i, int j, const F* weight) {
    return p.axis[i][0] * p.axis[j][0] * weight[0] + p.axis[i][1] * p.axis[j][1] * weight[1] + p.axis[i][2] * p.axis[j][2] * weight[2];
  };
  const F xx = dot(0, 0, var), xy = dot(0, 1, var), yy = dot(1, 1, var), zz = dot(2, 2, var);
  p.xz = dot(0, 2, var); p.yz = dot(1, 2, var);
  p.det_c = dot(2, 2, p.minor);
  const float cx = 1.0f / (u.ray[0] * u.ray[0]), cxy = 1.0f / (u.ray[0] * u.ray[1]), cy = 1.0f / (u.ray[1] * u.ray[1]);
  const F rx = xx * cx, ry = yy * cy;
  p.cov_c = {rx + u.widening, xy * cxy, ry + u.widening};
  p.det_cw = p.det_c * (cx * cy) + (rx + ry) * u.widening + u.widening * u.widening;
  const float px = 1.0f / (u.pixel[0] * u.pixel[0]), pxz = 1.0f / (u.pixel[0] * u.pixel[1]), pz = 1.0f / (u.pixel[1] * u.pixel[1]);
  const float vx = u.response[0] * px, vz = u.response[1] * pz;
  const F ix = xx * px, iz = zz * pz;
  p.cov_i = {ix + vx, p.xz * pxz, iz + vz};
  p.det_iw = dot(1, 1, p.minor) * (px * pz) + ix * vz + iz * vx + vx * vz;
  return p;
}

// ratio of kappa' to kappa: it conserves the integral of tau when the cell widens a footprint
template <class F> SG_FN F widening_ratio(const Projection<F>& p, const PlaneUnits& u) {
  return root(p.det_c / (p.det_cw * (u.ray[0] * u.ray[0] * u.ray[1] * u.ray[1])));
}

// The triangular factor L of an inverse covariance: S = 2 ln 2 L^T L, and the Gaussian is 2^-(u^2 + v^2) at (u, v) = L d.
template <class F> struct Whitening {
  F ux, uy, vy;
  SG_FN F x(F u, F) const { return ux * u; }                  // L^T (u, v)
  SG_FN F y(F u, F v) const { return uy * u + vy * v; }
};
template <class F> SG_FN Whitening<F> whitening(const Sym2<F>& cov, F det) {
  const F inverse = 1.0f / cov.yy, ux = root(cov.yy * (0.5f * kLog2e) / det);
  return {ux, -(cov.xy * inverse) * ux, root(inverse * (0.5f * kLog2e))};
}

// Where a Gaussian is densest along a ray, z_r = mean + slope (dx, dy): S (Sigma_xz, Sigma_yz).
template <class F> SG_FN void densest(const Projection<F>& p, const PlaneUnits& units, F* slope) {
  const Whitening<F> w = whitening(p.cov_c, p.det_cw);
  const F x = p.xz / units.ray[0] * (2.0f * kLn2), y = p.yz / units.ray[1] * (2.0f * kLn2);
  const F u = w.ux * x + w.uy * y, v = w.vy * y;
  slope[0] = w.x(u, v);
  slope[1] = w.y(u, v);
}

// ln(1 + e^x) without cancellation, log1p(e) = ln(1 + e) e / ((1 + e) - 1), and its slope 1 / (1 + e^-x)
template <class F> struct Softplus { F value, slope; };
template <class F> SG_FN Softplus<F> softplus(F x) {
  const F e = power2(larger(absolute(x) * -kLog2e, splat(-120.0f)));
  const F one = e + 1.0f, rounded = one - 1.0f;
  const F log1p = choose(rounded == 0.0f, e, natural_log(one) * e / choose(rounded == 0.0f, splat(1.0f), rounded));
  return {choose(x < 0.0f, splat(0.0f), x) + log1p, choose(x < 0.0f, e, splat(1.0f)) / one};  // NaN stays NaN
}

// ---- adjoints --------------------------------------------------------------------------------------------------------
// Sums over views: dL/dmu, G = symmetric full gradient of Sigma, and the terms of ln sqrt(det Sigma_C), which are
// kept apart because Sigma_C^-1 of a thin Gaussian would drown the rest in rounding.
template <class F> struct BodyGradient { F mean[3], g[6], scale[3], rot[9]; };

// half [S M2 S - m0 S] with S the inverse of a widened covariance and M2 the second moments: ln 2 L^T [2 ln 2 M - m0] L
template <class F> SG_FN Sym2<F> covariance_gradient(const Whitening<F>& w, const Moments<F>& m, F m0) {
  const F uu = m.muu * (2.0f * kLn2) - m0, uv = m.muv * (2.0f * kLn2), vv = m.mvv * (2.0f * kLn2) - m0;
  const F ux = w.ux * kLn2, along = uu * w.uy + uv * w.vy, across = uv * w.uy + vv * w.vy;
  return {uu * w.ux * ux, along * ux, (along * w.uy + across * w.vy) * kLn2};
}

// The gradient of L itself, of which G is another form, and back: -2 ln 2 M = (dL/dL) L^T, whatever the units of L are.
// m: of the plane's moments, the second ones.
template <class F> SG_FN void root_gradient(const Whitening<F>& w, const Moments<F>& m, F* d_roots) {
  d_roots[1] = m.muv * (-2.0f * kLn2) / w.vy;
  d_roots[0] = (m.muu * (-2.0f * kLn2) - w.uy * d_roots[1]) / w.ux;
  d_roots[2] = m.mvv * (-2.0f * kLn2) / w.vy;
}
template <class F> SG_FN Moments<F> second_moments(const Whitening<F>& w, const F* d_roots) {
  const float half = -0.5f / kLn2;
  Moments<F> m{};
  m.muu = (w.ux * d_roots[0] + w.uy * d_roots[1]) * half;
  m.muv = w.vy * d_roots[1] * half;
  m.mvv = w.vy * d_roots[2] * half;
  return m;
}

// ---- footprints in arrays: metres, and roots to base e -----------------------------------------------------------------
constexpr float kRootUnit = 0.84932180f;  // sqrt(log2(e) / 2): what roots to base 2 are longer by

// On a plane: where (still in metres), of which shape, and its standard deviations along both axes, in cells or pixels.
template <class F> struct Placed { F x, y; Whitening<F> w; F deviation_x, deviation_y; };
template <class F> SG_FN Placed<F> placed_from(const F* center, const F* roots, const float* spacing) {
  const float x = spacing[0] * kRootUnit, y = spacing[1] * kRootUnit;
  const F narrowing = roots[1] / roots[2];
  return {center[0], center[1], {roots[0] * x, roots[1] * y, roots[2] * y},
          root(narrowing * narrowing + 1.0f) / (roots[0] * spacing[0]), 1.0f / (roots[2] * spacing[1])};
}
template <class F> SG_FN void roots_in_metres(const Whitening<F>& w, const float* spacing, F* roots) {
  const float x = 1.0f / (spacing[0] * kRootUnit), y = 1.0f / (spacing[1] * kRootUnit);
  roots[0] = w.ux * x;
  roots[1] = w.uy * y;
  roots[2] = w.vy * y;
}
// from moments to the gradients of centre and roots
template <class F> SG_FN void footprint_gradient(const Whitening<F>& w, const float* spacing, const Moments<F>& m, F* d_center, F* d_roots) {
  d_center[0] = w.x(m.mu, m.mv) * (2.0f * kLn2 / spacing[0]);
  d_center[1] = w.y(m.mu, m.mv) * (2.0f * kLn2 / spacing[1]);
  root_gradient(w, m, d_roots);
  const float x = spacing[0] * kRootUnit, y = spacing[1] * kRootUnit;
  d_roots[0] *= x;
  d_roots[1] *= y;
  d_roots[2] *= y;
}
// from the gradient of roots to that of the widened covariance, in cells or pixels; m0: see covariance_gradient
template <class F> SG_FN Sym2<F> from_root_gradient(const Whitening<F>& w, const float* spacing, const F* d_roots, F m0) {
  const float x = 1.0f / (spacing[0] * kRootUnit), y = 1.0f / (spacing[1] * kRootUnit);
  const F in_cells[3] = {d_roots[0] * x, d_roots[1] * y, d_roots[2] * y};
  return covariance_gradient(w, second_moments(w, in_cells), m0);
}

// One view's share of the gradients. planes: dL/d(mu_C, mu_I), per metre; gc, gi: of the widened covariances, in cells and
// pixels; m0 = kappa' dL/dkappa'.
template <class F>
SG_FN void spread(const Projection<F>& p, const ViewFrame& f, const PlaneUnits& u, const F* planes, const Sym2<F>& gc,
                  const Sym2<F>& gi, F m0, BodyGradient<F>& out) {
  // the radar frame's full gradient: (x, y) from plane C, (x, z) from plane I, per m^2
  const F gxx = gc.xx * (1.0f / (u.ray[0] * u.ray[0])) + gi.xx * (1.0f / (u.pixel[0] * u.pixel[0]));
  const F gxy = gc.xy * (1.0f / (u.ray[0] * u.ray[1])), gyy = gc.yy * (1.0f / (u.ray[1] * u.ray[1]));
  const F gxz = gi.xy * (1.0f / (u.pixel[0] * u.pixel[1])), gzz = gi.yy * (1.0f / (u.pixel[1] * u.pixel[1]));
  const F mx = planes[0] + planes[2];
  for (int j = 0; j < 3; j++) out.mean[j] += mx * f.r[j] + planes[1] * f.r[3 + j] + planes[3] * f.r[6 + j];
  for (int j = 0, n = 0; j < 3; j++) {  // G += R_r^T g R_r
    const F x = gxx * f.r[j] + gxy * f.r[3 + j] + gxz * f.r[6 + j];
    const F y = gxy * f.r[j] + gyy * f.r[3 + j];
    const F z = gxz * f.r[j] + gzz * f.r[6 + j];
    for (int k = j; k < 3; k++, n++) out.g[n] += x * f.r[k] + y * f.r[3 + k] + z * f.r[6 + k];
  }
  F share[3], term[3];                  // m0 times d ln sqrt(det Sigma_C), det Sigma_C being the sum of three terms
  for (int k = 0; k < 3; k++) {
    share[k] = p.minor[k] * p.axis[2][k] / p.det_c * m0;
    term[k] = share[k] * p.axis[2][k];
    for (int j = 0; j < 3; j++) out.rot[3 * j + k] += share[k] * f.r[6 + j];
  }
  for (int k = 0; k < 3; k++) out.scale[k] += term[(k + 1) % 3] + term[(k + 2) % 3];  // divided by s_k at the end
}

// What `spread` takes, from one view's moments: a = kappa' sum F{1, w, ww}, b = sum dL/dS sigma b{1, w, ww} with w = (u, v).
template <class F>
SG_FN void share_of_moments(const Projection<F>& p, const PlaneUnits& u, const Moments<F>& a, const Moments<F>& b, bool peak, F* planes,
                            Sym2<F>& gc, Sym2<F>& gi) {
  const Whitening<F> wc = whitening(p.cov_c, p.det_cw), wi = whitening(p.cov_i, p.det_iw);
  planes[0] = wc.x(a.mu, a.mv) * (2.0f * kLn2 / u.ray[0]);
  planes[1] = wc.y(a.mu, a.mv) * (2.0f * kLn2 / u.ray[1]);
  planes[2] = wi.x(b.mu, b.mv) * (2.0f * kLn2 / u.pixel[0]);
  planes[3] = wi.y(b.mu, b.mv) * (2.0f * kLn2 / u.pixel[1]);
  gc = covariance_gradient(wc, a, a.m0);
  gi = covariance_gradient(wi, b, peak ? b.m0 * 0.0f : b.m0);
}

// From the sums to dL/ds and dL/dq; linear in them.
template <class F>
SG_FN void finish(const Body<F>& body, const F* q, F norm, const BodyGradient<F>& sum, F* d_scale, F* d_quaternion) {
  const F full[9] = {sum.g[0], sum.g[1], sum.g[2], sum.g[1], sum.g[3], sum.g[4], sum.g[2], sum.g[4], sum.g[5]};
  F d_rot[9];
  for (int k = 0; k < 3; k++) {
    F column[3];                        // G R, column k
    for (int j = 0; j < 3; j++)
      column[j] = full[3 * j] * body.rot[k] + full[3 * j + 1] * body.rot[3 + k] + full[3 * j + 2] * body.rot[6 + k];
    const F rgr = column[0] * body.rot[k] + column[1] * body.rot[3 + k] + column[2] * body.rot[6 + k];
    d_scale[k] = rgr * body.scale[k] * 2.0f + sum.scale[k] / body.scale[k];
    for (int j = 0; j < 3; j++) d_rot[3 * j + k] = column[j] * (body.scale[k] * body.scale[k] * 2.0f) + sum.rot[3 * j + k];
  }
  const F w = q[0], x = q[1], y = q[2], z = q[3];
  F d[4];
  d[0] = 2.0f * (x * (d_rot[7] - d_rot[5]) + y * (d_rot[2] - d_rot[6]) + z * (d_rot[3] - d_rot[1]));
  d[1] = 2.0f * (w * (d_rot[7] - d_rot[5]) + y * (d_rot[1] + d_rot[3]) + z * (d_rot[2] + d_rot[6]) - 2.0f * x * (d_rot[4] + d_rot[8]));
  d[2] = 2.0f * (w * (d_rot[2] - d_rot[6]) + x * (d_rot[1] + d_rot[3]) + z * (d_rot[5] + d_rot[7]) - 2.0f * y * (d_rot[0] + d_rot[8]));
  d[3] = 2.0f * (w * (d_rot[3] - d_rot[1]) + x * (d_rot[2] + d_rot[6]) + y * (d_rot[5] + d_rot[7]) - 2.0f * z * (d_rot[0] + d_rot[4]));
  const F along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
  for (int k = 0; k < 4; k++) d_quaternion[k] = (d[k] - q[k] * along) / norm;
}

}  // namespace SG_ISA
}  // namespace sarsplat
