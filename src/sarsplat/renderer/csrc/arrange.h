// arrange.h: what stands between projection and the pair loops: the lattice, the depth order, and tasks of equal work.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// ---- lattice and depth order -------------------------------------------------------------------------------------------
float lane_min(F x) { float m = x[0]; for (int k = 1; k < kWidth; k++) m = x[k] < m ? x[k] : m; return m; }

bool place_lattice(ViewState& s, int chunks) {
  double low[2], count[2];
  s.rays = {0, 0, 0, 0, nullptr, nullptr};
  for (int axis = 0; axis < 2; axis++) {
    F lowest = splat(3e38f), highest = -lowest;
    for (int i = 0; i < chunks; i++) {
      lowest = smaller(lowest, s.bounds[i].low[axis]);
      highest = larger(highest, s.bounds[i].high[axis]);
    }
    const float first = lane_min(lowest), last = -lane_min(-highest);
    if (!(first <= last)) return true;  // nothing touches a ray
    if (!(first > -kFarthest && last < kFarthest)) return false;
    low[axis] = __builtin_floor(first);
    count[axis] = __builtin_ceil(last) - low[axis];
  }
  if (!(count[0] * count[1] <= (double)kMaxRays)) return false;
  s.rays = {(int)low[0], (int)low[1], larger(1, (int)count[0]), larger(1, (int)count[1]), nullptr, nullptr};
  return true;
}

// stable radix sort by depth: ties keep the order of their indices
void sort_by_depth(ViewState& s, int n) {
  uint32_t start[3][2048] = {};
  uint64_t *from = s.sorting[0], *to = s.sorting[1];  // depth key << 32 | id
  int m = 0;
  for (int i = 0; i < n; i++) {
    const uint32_t key = (uint32_t)s.depth_keys[i];
    if (key == (uint32_t)kNoDepth) continue;
    from[m++] = (uint64_t)key << 32 | (uint32_t)i;
    start[0][key & 2047]++; start[1][key >> 11 & 2047]++; start[2][key >> 22]++;
  }
  s.touching = m;
  for (auto& digit : start)
    for (uint32_t k = 0, at = 0; k < 2048; k++) { const uint32_t count = digit[k]; digit[k] = at; at += count; }
  for (int i = 0; i < m; i++) to[start[0][from[i] >> 32 & 2047]++] = from[i];
  for (int i = 0; i < m; i++) from[start[1][to[i] >> 43 & 2047]++] = to[i];
  for (int i = 0; i < m; i++) s.front_to_back[start[2][from[i] >> 54]++] = (int32_t)(uint32_t)from[i];
}

// ---- the tasks of the pair loops -----------------------------------------------------------------------------------------
// Cuts the lattice into bands of rows with about equal work, and gives every entry its bands and slots.
void cut_rays(ViewState& s, int n, int parts) {
  int64_t* work = s.row_work;     // that begins in a row, less what ended
  const Strips& all = s.rays;
  s.ray_parts = 1;
  while (2 * s.ray_parts <= smaller(parts, all.rows / kRowsPerBand)) s.ray_parts *= 2;  // they divide among threads
  for (int y = 0; y <= all.rows; y++) work[y] = 0;
  for (int i = 0; i < n; i++) {
    RayEntry& e = s.on_rays[i];
    if (e.y1 < e.y0) continue;
    e.x0 = larger(e.x0, all.x0); e.x1 = smaller(e.x1, all.x0 + all.columns - 1);
    e.y0 = larger(e.y0, all.y0); e.y1 = smaller(e.y1, all.y0 + all.rows - 1);
    if (e.x1 < e.x0) e.y1 = e.y0 - 1;
    if (e.y1 < e.y0) continue;
    const int wide = block_of<kBlockX>(e.x1 - all.x0) - block_of<kBlockX>(e.x0 - all.x0) + 1;
    work[e.y0 - all.y0] += wide;
    work[e.y1 - all.y0 + 1] -= wide;
  }
  int64_t total = all.rows, running = 0, done = 0, start = 0;
  for (int y = 0; y < all.rows; y++) total += running += work[y];
  s.ray_blocks = (total - all.rows) / kBlockY;
  running = 0;
  for (int b = 0, y = 0; b < s.ray_parts; b++) {
    const int first = y;
    while (y < all.rows && (b == s.ray_parts - 1 || done * s.ray_parts < total * (b + 1))) {
      done += 1 + (running += work[y]);
      work[y++] = b;
    }
    s.ray_bands[b] = {0, 0, all.part(all.y0 + first, all.y0 + y), start, nullptr};
    start += s.ray_bands[b].strips.size();
  }
  for (int i = 0, slot = 0; i < n; i++) {
    RayEntry& e = s.on_rays[i];
    s.reached[i] = {0, 0};
    if (e.y1 < e.y0) continue;
    e.slot = slot;
    e.first_band = (int)work[e.y0 - all.y0];
    e.last_band = (int)work[e.y1 - all.y0];
    s.reached[i] = {(uint8_t)e.first_band, (uint8_t)(e.last_band + 1)};
    slot += e.last_band - e.first_band + 1;
  }
}

// Lists front to back who reaches a band; list: room for all.
int list_band(const ViewState& s, int band, int32_t* list) {
  int count = 0;
  for (int k = 0; k < s.touching; k++) {
    const int32_t id = s.front_to_back[k];
    const Reached r = s.reached[id];
    list[count] = id;
    count += (r.first <= band) & (band < r.end);  // no branch: it would be guessed wrong
  }
  return count;
}

// Sorts Gaussians by the image row they begin in and by their shape in blocks, so that a part's rows are few and its
// loops alike, and cuts them into parts of about equal work.
void cut_pixels(ViewState& s, const Strips& image, int n, int parts) {
  int32_t* counts = s.key_counts;
  const int keys = image.rows * kShapes * kShapes + 1;
  for (int k = 0; k < keys; k++) counts[k] = 0;
  for (int i = 0; i < n; i++) counts[s.pixel_keys[i]]++;
  auto tall = [&](int key) { return smaller(kMaxBlocks[key / kShapes % kShapes], (image.rows - 1) / kBlockY + 1); };
  auto wide = [&](int key) { return smaller(kMaxBlocks[key % kShapes], image.count()); };
  auto work = [&](int key) { return 2 + (int64_t)tall(key) * wide(key); };
  int64_t total = 0, done = 0;
  for (int k = 0; k < keys; k++)
    if (counts[k]) total += counts[k] * work(k);  // most keys are nobody's
  s.pixel_parts = 0;
  Part* part = nullptr;
  int at = 0;
  for (int k = 0; k < keys; k++) {
    if (!counts[k]) continue;
    const int64_t each = work(k);
    const int first_row = smaller(k / kShapes / kShapes, image.rows - 1);
    const int last_row = smaller(first_row + tall(k) * kBlockY, image.rows) - 1;
    for (int left = counts[k]; left > 0;) {
      if (!part || done * parts >= total * s.pixel_parts) {  // never after the last part: there done < total
        part = s.pixel_groups + s.pixel_parts++;
        *part = {at, at, image.part(first_row, first_row), 0, nullptr};
      }
      const int64_t room = (total * s.pixel_parts / parts - done) / each + 1;
      const int here = room < 1 ? 1 : room < left ? (int)room : left;  // no room: one alone was more than a part
      part->end = at += here;
      part->strips.rows = larger(part->strips.rows, last_row - part->strips.y0 + 1);
      done += here * each;
      left -= here;
    }
  }
  for (int k = 0, start = 0; k < keys; k++) { const int c = counts[k]; counts[k] = start; start += c; }
  for (int i = 0; i < n; i++) s.pixel_list[counts[s.pixel_keys[i]]++] = i;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
