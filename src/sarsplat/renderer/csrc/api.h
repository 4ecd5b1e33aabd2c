// api.h: the engine's C ABI. Kernels know arrays, not classes. All arrays are contiguous and row-major; float32 unless said
// otherwise; lengths in metres, angles nowhere.
//
// Python reads its structures and functions from this file (engines/abi.py), so it has plain declarations only; and a library
// that was compiled with another one is refused.
#pragma once
#include <cstdint>

extern "C" {

struct sg_problem {
  int32_t peak;           // 1: imaging weight without the norm (ablation)
  int32_t views;          // V
  int32_t gaussians;      // N
  int32_t coefficients;   // K harmonics per Gaussian; 0 when amplitudes are given
  int32_t channels;       // C; 1 with harmonics
  int32_t rows, columns;  // image size: range, azimuth
  const float* means;        // [N, 3]
  const float* quaternions;  // [N, 4] wxyz
  const float* scales;       // [N, 3]
  const float* kappa;        // [N] two-way peak optical depth
  const float* harmonics;    // [N, K]
  const float* amplitudes;   // [V, N, C] what a channel returns per lit area, or null: then P(u) of the harmonics
  const float* frames;       // [V, 9] radar frames, row-major
  const float* basis;        // [V, K] harmonic basis at the direction to the radar
  const float* shift;        // [V, 2] image shift (x, r)
  const float* in_sight;     // [V, N] factor on kappa: 0 of what terrain hides from a view, else 1; or null
  float p_min;
  float pixel[2], center[2], response_var[2];  // spacing, image centre, system response variance: (azimuth, range)
  float ray[2];                                // ray spacing (x, y)
  float cell_widening, min_ray_depth, min_transmittance, image_cut;
  float min_scale, max_scale, max_depth;       // limits the input is checked against (checks.py)
  float farthest, strongest;                   // metres; everything else
  float flattest, steepest;                    // roots, 1/m
};

struct sg_outputs {       // forward
  float* images;          // [V, C, rows, columns]
  float* cross_sections;  // [V, N, C]
  float* lit_area;        // [V, N]
};

struct sg_gradients {
  const float* images;          // dL/dS [V, C, rows, columns]
  const float* cross_sections;  // dL/dsigma [V, N, C], or null
  const float* transmittance;   // dL/dT_end of all views' lattices one after the other, or null
  const float* lit_area;        // dL/d(lit area) [V, N] beside that through dL/dsigma, or null
  float *means, *quaternions, *scales, *kappa;  // out
  float* harmonics;             // out [N, K], or null
  float* amplitudes;            // out [V, N, C], or null
  float* shift;                 // out [V, 2], or null
  float* planes;                // out [V, N, 4]: dL/d(mu_C, mu_I), or null
};

struct sg_lattice {       // rays of one view: ((k0x + column + 1/2) dx, (k0y + row + 1/2) dy)
  int64_t k0x, k0y;
  int32_t rows, columns;
};

struct sg_bounce {        // what a pass along another way needs; see bounce.h
  const float* image_frames;    // [V, 9] for the imaging plane; the problem's frames are for the computation plane
  const float* offset;          // [V, 2] of footprints on the computation plane, m
  const float* transmittance;   // T_end of the first pass, of all views' lattices one after the other
  const sg_lattice* lattices;   // [V] those
  const float* lit_area;        // [V, N] of the first pass
  float factor;                 // on the geometric mean of both lit areas
};

struct sg_statistics {    // of the last forward: for the benchmarks
  int64_t blocks_attenuation, live_attenuation, blocks_imaging, live_imaging, lanes;
};

struct sg_adam_group {    // one parameter of a training
  float* value;             // [rows, columns]
  const float* gradient;
  float *mean, *square;     // moments
  int64_t rows;
  int32_t columns;          // 1 to 16
  int32_t logarithmic;      // 1: the step is one of the value's logarithm
  float decay;              // factor on the rates
  float rate[16], low[16], high[16];  // of each column
};

struct sg_adam_step {
  const sg_adam_group* groups;
  int32_t count;            // of groups
  float beta1, beta2, epsilon;
  float beta1_power, beta2_power;  // beta to the number of steps, this one included
  const float* now;         // null, or [count + 2], where the groups' decays and both powers are instead
};

struct sg_loss {          // of V images; see loss.h
  int32_t views, rows, columns;
  const float *power, *truth;  // [V, rows, columns]
  float window[11];       // weights
  float reference, floor, ssim_weight, c1, c2;
  float* loss;            // out: one number, the mean over the images
  float* d_power;         // out [V, rows, columns]
};

struct sg_sections {      // of D pairs of channels, in V views of N Gaussians; see sections.h; forward, or with d_parts backward
  int32_t views, pairs;
  int64_t gaussians;
  int32_t shared;         // 1: the real part is one number for all pairs
  const float *means, *quaternions, *scales;  // [N, 3], [N, 4], [N, 3]
  const float* frames;    // [V, 9] R_r, row-major
  const float* roots;     // [V, N, 3] of the footprints on the imaging plane, 1/m
  const float* numbers;   // [V, D] phase per elevation, rad/m
  const float *real, *imaginary;  // [V, N, D], or of the real part [V, N], and of the imaginary one perhaps null
  float* parts;           // out [V, N, 2 D]: real and imaginary parts in turn
  float* slopes;          // out [V, N, 2]
  const float *d_parts, *d_slopes;  // backward
  float *d_means, *d_quaternions, *d_scales, *d_roots, *d_real, *d_imaginary;  // out, backward
};

struct sg_lobes {         // gamma0 of V views of N Gaussians in a lobe; see lobes.h; forward, or with d_amplitudes backward
  int32_t views;
  float p_min;
  int64_t gaussians;
  const float* directions;  // [V, 3] unit vectors to the radar
  const float *quaternions, *scales, *parameters;  // [N, 4], [N, 3], [N, 3]
  float* amplitudes;        // out [V, N]
  const float* d_amplitudes;  // backward
  float *d_quaternions, *d_parameters;  // out, backward
};

struct sg_likelihood {    // of V stacks of P channels; see likelihood.h
  int32_t views, rows, columns, passes;
  int32_t powers, pairs;  // planes that channels and pairs of channels share
  int32_t reach;          // of the window, on each side
  const float *power, *pair;  // [V, powers, rows, columns] and, real and imaginary parts in turn, [V, 2 pairs, rows, columns]
  const int32_t *of_channels, *of_pairs;  // [P] and [P (P - 1) / 2]: which planes are theirs
  const float* phases;    // [V, P, rows, columns] rad, to be taken out
  const float* noise;     // [V, P]
  const float* truth;     // [V, P^2, rows, columns]: sample covariances; a diagonal, then real and imaginary parts in turn
  float* loss;            // out: one number, the mean over the pixels
  float *d_power, *d_pair, *d_phases, *d_noise;  // out; of the phases perhaps null
  int64_t* failed;        // out: covariances that are not positive definite
};

struct sg_axis {          // places first + k step, m; of cells, the edges before each
  double first, step;
  int32_t count;
};

struct sg_patches {       // that the rays of a view make on the ground
  sg_axis rows, columns;  // in slant range and azimuth
  int64_t first;          // of the rays, among those of all views
};

struct sg_ground {        // see ground.h; forward, or with d_lit backward
  int32_t views;
  sg_axis rows, columns;  // centres of the pixels
  double std[2];          // of the response: (azimuth, range)
  const sg_patches* patches;   // [of_views]
  int32_t of_views;       // V; or of so many, among which a GPU is told which are the views'
  const int64_t* chosen;  // [V] which patches are the views', or null: they are in order
  int64_t pitch;          // rays from a view's first one on, if they are chosen: then all views have as many
  const float* transmittance;  // T_end of all views' lattices one after the other
  const float* shift;     // [V, 2], or null
  float* lit;             // out [V, rows, columns]
  const float* d_lit;     // [V, rows, columns], or null
  float* d_transmittance; // out
  float* d_shift;         // out [V, 2], or null
};

struct sg_terrain_patches {  // where the rays of a view end
  int32_t rows;            // of cells
  sg_axis across;          // azimuths of the edges before their columns
  const float *low, *high; // [rows, columns] slant range where the lower and the upper edge of a cell end
  int32_t traced_first[2], traced[2];  // (row, column) among the cells of the first ray whose T_end is given, and how many there are
  int64_t first;           // of those rays, among those of all views
  float x[4], y[4];        // the place of a cell's centre on the lattice of gamma0: a constant, and per column, row and slant range
};

struct sg_terrain {      // see terrain.h; forward, or with d_lit backward
  int32_t views;
  sg_axis rows, columns;  // centres of the pixels
  double std[2];          // of the response: (azimuth, range)
  double cell;            // height of a cell across the line of sight
  int32_t places[2];      // of gamma0: (ny, nx)
  const sg_terrain_patches* patches;  // [of_views]
  int32_t of_views;       // these three as in sg_ground
  const int64_t* chosen;
  int64_t pitch;
  const float* transmittance;  // T_end of all views' rays one after the other
  const float* gamma0;    // [V, ny, nx]
  const float* shift;     // [V, 2], or null
  float* lit;             // out [V, rows, columns]
  const float* d_lit;     // [V, rows, columns], or null
  float *d_transmittance, *d_gamma0;  // out
  float* d_shift;         // out [V, 2], or null
};

// Footprints of V views of N Gaussians: what `project` makes and the other steps read; backward, the gradients of them.
struct sg_projection {
  float* ray_centers;     // [V, N, 2] on the computation plane
  float* ray_roots;       // [V, N, 3] 1/m: (a, b, c), the factor L = (a b; 0 c) of the inverse covariance L^T L
  float* optical_depth;   // [V, N] of a ray through the centre
  float* range;           // [V, N]; no gradient
  float* tilt;            // [V, N, 2] slope of the range of the densest point; no gradient
  float* pixel_centers;   // [V, N, 2] on the imaging plane
  float* pixel_roots;     // [V, N, 3]
  float* gamma0;          // [V, N] P(u); not touched without harmonics
};

struct sg_channels {      // what is splatted
  int32_t count;          // C
  const float* cross_sections;  // [V, N, C], m^2
  const float* wavenumbers;     // [V, C / 2] turns per metre, or null: channels are pairs, real and imaginary parts, and their phase
  const float* slopes;          // [V, N, 2] changes across a footprint with its elevation, of so many metres per metre
};

struct sg_context;        // what backward needs; opaque

enum sg_status { SG_OK = 0, SG_MEANS, SG_QUATERNIONS, SG_SCALES, SG_KAPPA, SG_SCATTERING, SG_AMPLITUDES, SG_SHIFT, SG_LATTICE, SG_MEMORY,
                 SG_CENTERS, SG_ROOTS, SG_DEPTH, SG_RANGE, SG_TILT, SG_CROSS_SECTIONS, SG_SLOPES };

}  // extern "C"

// Operations of one structure: the functions that do them, each in a file of its own, which engine.cpp gets from here.
#define SG_OPERATIONS(_)             \
  _(adam, sg_adam_step)              \
  _(amplitude_loss, sg_loss)         \
  _(lit_ground, sg_ground)           \
  _(lit_terrain, sg_terrain)         \
  _(normal_lobes, sg_lobes)          \
  _(pair_sections, sg_sections)      \
  _(stack_likelihood, sg_likelihood)
#ifdef SG_KERNELS
#include "adam.h"
#include "ground.h"
#include "likelihood.h"
#include "lobes.h"
#include "loss.h"
#include "sections.h"
#include "terrain.h"
#endif

struct sg_engine {        // one per instruction set; functions with a status return one of sg_status
  const char* name;
  sg_context* (*create)();
  void (*destroy)(sg_context*);
  int32_t (*render)(sg_context*, const sg_problem*, const sg_outputs*, int64_t* culprit);
  int32_t (*render_backward)(sg_context*, const sg_problem*, const sg_gradients*);
  // one step alone each: of the problem's arrays, `project` alone reads any
  int32_t (*project)(sg_context*, const sg_problem*, const sg_projection* out, int64_t* culprit);
  int32_t (*project_backward)(sg_context*, const sg_problem*, const sg_projection* seeds, const sg_gradients*);
  int32_t (*attenuate)(sg_context*, const sg_problem*, const sg_projection*, float* lit_area, int64_t* culprit);
  int32_t (*attenuate_backward)(sg_context*, const sg_problem*, const float* d_lit_area, const float* d_transmittance, const sg_projection* out);
  int32_t (*splat)(sg_context*, const sg_problem*, const sg_projection*, const sg_channels*, float* images, int64_t* culprit);
  int32_t (*splat_backward)(sg_context*, const sg_problem*, const sg_channels*, const float* d_images, const sg_projection* out, float* d_cross_sections,
                            float* d_elevation);
  // a pass along another way, from where the rays of one along the line of sight end
  int32_t (*bounce)(sg_context*, const sg_problem*, const sg_bounce*, float* images, int64_t* culprit);
  int32_t (*bounce_backward)(sg_context*, const sg_problem*, const sg_bounce*, const sg_gradients*, float* d_transmittance, float* d_lit_area);
  // of the last forward pass
  void (*lattice)(const sg_context*, int32_t view, sg_lattice*);
  int32_t (*trace)(const sg_context*, const sg_problem*, int32_t view, float depth, float* transmittance, float* first_return);
  void (*statistics)(const sg_context*, const sg_problem*, sg_statistics*);
#define SG_MEMBER(name, structure) int32_t (*name)(sg_context*, const structure*);
  SG_OPERATIONS(SG_MEMBER)
};
