// cuda_state.cuh: what one pass keeps on the device. Python reads Lattice, Plane and State from here (cuda_tiles.py) and
// owns the arrays; a pair (view v, Gaussian i) has the index j = v N + i. Both planes are cut into square tiles; a (tile,
// Gaussian) pair has a slot. Slots are numbered Gaussian by Gaussian, so that sums over a Gaussian's slots run in a fixed
// order without atomics; `order` lists them tile by tile, front to back.
#pragma once
#include "api.h"
#include "cuda_float.cuh"
#include "gaussian_math.h"

namespace sarsplat {
namespace SG_ISA {

constexpr int kTile = 16;                       // points a side
constexpr int kThreads = kTile * kTile;         // of every block
constexpr int kWarps = kThreads / kWarp;
constexpr int kResident = 4;                    // blocks on a multiprocessor: aiming at more, compilers spill registers
constexpr int kChunk = 128;                     // entries of a tile's list that a block goes through

constexpr float kNever = 3e38f;                 // the bound, and the other way the reach, of what touches nothing
typedef unsigned long long Key;                 // of an entry, by which a list is put in order

// extra: z_r on rays
struct alignas(16) Splat { Footprint g; float extra; };

struct Lattice {          // the rays or pixels of one view
  float x0, y0;           // coordinates of the first
  int32_t rows, columns;
  int32_t tiles_x, first_tile;
  int64_t first_point;
};

struct Plane {
  Splat* splats;            // [V N]
  float* reach;             // [V N, 2] half the footprint's extent, points; -1: it touches nothing
  const Lattice* lattices;  // [V]
  int64_t* counts;          // [V N] slots
  const int64_t* ends;      // [V N] their running sum
  int32_t* owners;          // [slots] j
  Key* keys;                // [slots] what `order` is made from (list_tiles)
  int64_t* order;           // [slots] slots, tile by tile, each front to back
  unsigned* in_tile;        // [1 + tiles] after a zero, slots of each tile that are not placed yet
  const int64_t* starts;    // [tiles + 1] of each tile in `order`
  int32_t tiles;
  float* sums;              // [chunks, threads] optical depth of a chunk on a ray; [chunks, channels, threads] what it adds to a pixel
  float* returns;           // [chunks, threads] sum of h w of a chunk on a ray
};

struct State {
  unsigned long long* minima;  // [2 + 4 V] the first fault; lowest x, y, -x, -y of each view's footprints on rays; 0: no room
  Plane rays, pixels;
  float* slope;             // [V N, 2] tilt of the densest surface: z_r per ray
  float* transmittance;     // [rays] behind everything
  int32_t* last;            // [rays] place in its tile's list of the last Gaussian that touched the ray, -1 for none
  float* slot_weights;      // [ray slots] sum of w
  float* lit_area;          // [V N] of a whole rendering; null when a step runs alone
  // backward
  float* h;                 // [V N] dL/dw
  float* slot_moments;      // [ray slots, 6]
  float* pixel_moments;     // [V N, 6]
  float* planes;            // [V N, 4] dL/d(mu_C, mu_I)
};

SG_FN int thread() { return (int)threadIdx.x; }
SG_FN int lane() { return thread() % kWarp; }
SG_FN int warp() { return thread() / kWarp; }
SG_FN void copy(const float* from, int count, float* to) {
  for (int k = 0; k < count; k++) to[k] = from[k];
}

// Kernels of one thread a pair have whole blocks for a view: block b serves view b / chunks.
SG_FN int chunks(const sg_problem& p) { return (p.gaussians + kThreads - 1) / kThreads; }
struct Pair { int view, gaussian; int64_t index; };  // index: -1 beyond the last Gaussian
SG_FN Pair this_pair(const sg_problem& p) {
  const int view = blockIdx.x / chunks(p), i = blockIdx.x % chunks(p) * kThreads + thread();
  return {view, i, i < p.gaussians ? (int64_t)view * p.gaussians + i : -1};
}

// log2 of the optical depth at which a footprint ends, and q at which an imaging weight ends; base 2
SG_FN float min_log_tau(const sg_problem& p) { return log2f(p.min_ray_depth * kLog2e); }
SG_FN float image_cut(const sg_problem& p) { return 0.5f * kLog2e * p.image_cut; }

SG_FN PlaneUnits units(const sg_problem& p) {
  return {{p.ray[0], p.ray[1]}, {p.pixel[0], p.pixel[1]}, p.cell_widening, {p.response_var[0], p.response_var[1]}};
}
SG_FN ViewFrame frame(const sg_problem& p, int view) {
  ViewFrame f;
  for (int k = 0; k < 9; k++) f.r[k] = p.frames[9 * view + k];
  return f;
}
SG_FN Body<float> body(const sg_problem& p, int64_t i, float* unit, float& norm) {
  Body<float> b;
  for (int k = 0; k < 3; k++) { b.mean[k] = p.means[3 * i + k]; b.scale[k] = p.scales[3 * i + k]; }
  const float* q = p.quaternions + 4 * i;
  rotation(q[0], q[1], q[2], q[3], b.rot, unit, norm);
  return b;
}

SG_FN float sum_of_harmonics(const sg_problem& p, int view, int64_t i) {
  float sum = 0.0f;
  for (int k = 0; k < p.coefficients; k++) sum += p.harmonics[p.coefficients * i + k] * p.basis[view * p.coefficients + k];
  return sum;
}

// inclusive range of lattice points within `reach` of `at`
struct Range { int first, last; };
SG_FN Range points(float at, float reach, int count) {
  const float low = at - reach - 1e-3f, high = at + reach + 1e-3f;
  return {low > 0.0f ? (low < (float)count ? (int)ceilf(low) : count) : 0,
          high < (float)(count - 1) ? (high >= 0.0f ? (int)high : -1) : count - 1};
}
struct Box { Range x, y; };
SG_FN bool empty(const Box& b) { return b.x.last < b.x.first || b.y.last < b.y.first; }
SG_FN Footprint placed(Footprint g, const Lattice& lattice) {
  g.x -= lattice.x0;
  g.y -= lattice.y0;
  return g;
}
SG_FN Box points(const Footprint& placed, const float* reach, const Lattice& lattice) {
  return {points(placed.x, reach[0], lattice.columns), points(placed.y, reach[1], lattice.rows)};
}

// This thread's point of a tile. A warp covers 8 x 4 points: small footprints then miss most warps.
struct Point { int x, y; bool inside; int64_t index; };
SG_FN Point point_of_thread(const Lattice& lattice, int tile) {
  const int in_view = tile - lattice.first_tile;
  Point p;
  p.x = in_view % lattice.tiles_x * kTile + warp() % 2 * 8 + lane() % 8;
  p.y = in_view / lattice.tiles_x * kTile + warp() / 2 * 4 + lane() / 8;
  p.inside = p.x < lattice.columns && p.y < lattice.rows;
  p.index = lattice.first_point + (int64_t)p.y * lattice.columns + p.x;
  return p;
}
SG_FN Lattice lattice_of_tile(const Lattice* lattices, int views, int tile) {
  int low = 0, high = views - 1;  // the last view that begins at or before the tile
  while (low < high) {
    const int middle = (low + high + 1) / 2;
    if (lattices[middle].first_tile <= tile) low = middle;
    else high = middle - 1;
  }
  return lattices[low];
}

// A block's tile, this thread's point in it, and its part of `order`.
struct Tile { Lattice lattice; Point point; int64_t first; int count; };
SG_FN Tile tile(const Plane& plane, int views, int number) {
  const Lattice lattice = lattice_of_tile(plane.lattices, views, number);
  const int64_t first = plane.starts[number];
  return {lattice, point_of_thread(lattice, number), first, (int)(plane.starts[number + 1] - first)};
}

// Long lists would be the critical path of a small scene, so they are cut into chunks, a block each. The chunks of tile t have
// the numbers from starts[t] / kChunk + t on: known without counting, and some have no entries. Every tile has a first one.
struct Chunk {
  Tile of;
  int64_t base;           // number of the tile's first chunk
  int index, chunks;      // among those of the tile that have entries
  int begin, size;        // its entries in the tile's list
};
SG_FN int64_t first_chunk(const Plane& plane, int tile) { return plane.starts[tile] / kChunk + tile; }
SG_FN Chunk chunk(const Plane& plane, int views, int number) {
  int low = 0, high = plane.tiles - 1;  // the last tile whose chunks begin at or before the number
  while (low < high) {
    const int middle = (low + high + 1) / 2;
    if (first_chunk(plane, middle) <= number) low = middle;
    else high = middle - 1;
  }
  const Tile of = tile(plane, views, low);
  const int64_t base = first_chunk(plane, low);
  const int index = (int)(number - base), begin = index * kChunk, left = of.count - begin;
  return {of, base, index, (of.count + kChunk - 1) / kChunk, begin, left < 0 ? 0 : left < kChunk ? left : kChunk};
}
SG_FN int64_t sum_of(int64_t chunk) { return chunk * kThreads + thread(); }

// An entry of a list in shared memory, and which of a warp's 8 x 4 points it may touch: none, mostly.
struct Staged { Footprint g; float reach[2]; };
SG_FN int32_t stage(const Plane& plane, const Chunk& c, Staged* to) {
  const int32_t j = plane.owners[plane.order[c.of.first + c.begin + thread()]];
  to->g = placed(plane.splats[j].g, c.of.lattice);
  copy(plane.reach + 2 * (int64_t)j, 2, to->reach);
  return j;
}
struct Corner { float x, y; };
SG_FN Corner corner_of_warp(const Point& p) { return {(float)(p.x - lane() % 8), (float)(p.y - lane() / 8)}; }
SG_FN bool near(const Staged& a, const Corner& c) {
  const float x = a.reach[0] + 1e-3f, y = a.reach[1] + 1e-3f;  // as `points`
  return a.g.x + x >= c.x && a.g.x - x <= c.x + 7.0f && a.g.y + y >= c.y && a.g.y - y <= c.y + 3.0f;
}
// Those of the kWarp entries from `begin` on that may touch this warp, as bits.
SG_FN unsigned near_warp(const Staged* staged, int begin, int size, const Corner& corner) {
  const int mine = begin + lane();
  return __ballot_sync(kWholeWarp, mine < size && near(staged[mine], corner));
}

}  // namespace SG_ISA
}  // namespace sarsplat
