// batches.h: the pair loops of the computation plane for vectors of 4 and 8, in batches of blocks: which may be live, their
// optical depths, transmittance, sums, each in a loop of its own.
//
// In one loop (passes.h) a block is a chain of two exponentials: with narrow vectors so few of them are in flight that the
// processor mostly waits, their registers do not hold what the loop needs, and blocks without a live lane, a third of all,
// cost as much as others. Vectors of 16 are faster there, and so are Gaussians of few blocks: ViewState::in_batches.
#pragma once
#include "passes.h"

namespace sarsplat {
namespace SG_ISA {

constexpr int kBatch = 64;        // blocks at most

// Blocks of one Gaussian of the list, up to `end`; whether they are its first, and what is asked of its entry.
struct Member { int32_t place, end; bool first; float h; int64_t slot; };
struct Block {                    // that may have live lanes
  F tau, u, v;                    // tau: at first its logarithm
  int64_t at;
  int32_t member;
};
struct Batch {
  int blocks = 0, members = 0;
  Member member[kBatch];
  Block block[kBatch + 1];        // the last is written and not counted
  F sum[kBatch];

  bool full(int coming) const { return members == kBatch || blocks + smaller(coming, kBatch) > kBatch; }
  void depths(float min_log_tau) {
    for (int i = 0; i < blocks; i++) block[i].tau = optical_depth(block[i].tau, block[i].tau >= min_log_tau);
  }
};

// What both directions have in common: the entries of a list, and where band b writes what it finds of them, `each` numbers.
struct Listed {
  const RayEntry* entries;
  const int32_t* list;
  int n, b, each;
  float* found;
  const RayEntry& entry(int place) const { return entries[list[larger(0, smaller(place, n - 1))]]; }
};

// The list from `begin` on in steps of 1 or -1: touch(footprint, offset, index of the block's first lane, place, block) says
// whether a block may be live; finish(batch).
template <class Touch, class Finish>
SG_FN void in_batches(const Listed& of, const Strips& s, int begin, int step, Touch touch, Finish finish) {
  Batch batch;
  for (int k = 0, place = begin; k < of.n; k++, place += step) {
    __builtin_prefetch(&of.entry(place + 2 * kAhead * step));
    __builtin_prefetch(of.found + of.each * slot_of(of.entry(place + kAhead * step), of.b), 1);
    const RayEntry& e = of.entry(place);
    Walk walk(e, s);
    bool first = true;
    do {
      if (batch.full(walk.left)) {
        finish(batch);
        batch.blocks = batch.members = 0;
      }
      int blocks = batch.blocks;
      walk.next(e.g, kBatch, [&](const Offset<F>& d, int64_t at) {
        Block& block = batch.block[blocks];
        block.at = at;
        block.member = batch.members;
        blocks += touch(e.g, d, at, place, block);
      });
      batch.blocks = blocks;
      batch.sum[batch.members] = splat(0.0f);
      batch.member[batch.members++] = {place, blocks, first, e.h, slot_of(e, of.b)};
      first = false;
    } while (walk.left);
  }
  finish(batch);
}

// As attenuate_band.
static void attenuate_in_batches(const RayEntry* entries, const int32_t* list, int n, const Strips& s, int b, float min_log_tau,
                                 float min_transmittance, float* T, int32_t* stop, float* partial) {
  const F floor = splat(min_transmittance);
  const Listed of{entries, list, n, b, 1, partial};
  auto touch = [&](const Footprint& g, const Offset<F>& d, int64_t at, int, Block& block) {
    block.tau = log_depth(g, d);
    return any((block.tau >= min_log_tau) & (load_anywhere(T + at) >= floor));  // T before the batch: it only falls
  };
  in_batches(of, s, 0, 1, touch, [=](Batch& batch) __attribute__((noinline)) {
    batch.depths(min_log_tau);
    for (int i = 0; i < batch.blocks; i++) {
      const Block& block = batch.block[i];
      const int64_t at = block.at;
      F t = load_anywhere(T + at);
      const I live = (block.tau > 0.0f) & (t >= floor);
      batch.sum[block.member] += attenuate(choose(live, block.tau, splat(0.0f)), t);
      store_anywhere(T + at, t);
      const I stopped = live & (t < floor);  // a minimum, for masked stores are slow
      store_anywhere(stop + at, smaller(load_anywhere(stop + at), choose(stopped, (I)(batch.member[block.member].place), (I)(kNever))));
    }
    for (int m = 0; m < batch.members; m++) {
      float* all = partial + batch.member[m].slot;
      *all = sum(batch.sum[m]) + (batch.member[m].first ? 0.0f : *all);
    }
  });
}

// As attenuate_band_backward.
static void attenuate_in_batches_backward(const RayEntry* entries, const int32_t* list, int n, const Strips& s, int b,
                                          float min_log_tau, float* T, const int32_t* stop, float* B, float* moments) {
  const Listed of{entries, list, n, b, kSums, moments};
  auto touch = [&](const Footprint& g, const Offset<F>& d, int64_t at, int place, Block& block) {
    const F log_tau = log_depth(g, d);
    const I live = (log_tau >= min_log_tau) & (load_anywhere(stop + at) >= place);
    block.tau = choose(live, log_tau, splat(-3e38f));
    block.u = d.u;
    block.v = d.v;
    return any(live);
  };
  in_batches(of, s, n - 1, -1, touch, [=](Batch& batch) __attribute__((noinline)) {
    const F zero = splat(0.0f);
    batch.depths(min_log_tau);
    for (int i = 0; i < batch.blocks; i++) {
      Block& block = batch.block[i];
      const int64_t at = block.at;
      F t = load_anywhere(T + at), suffix = load_anywhere(B + at);
      block.tau = attenuate_backward(block.tau, batch.member[block.member].h, t, suffix);
      store_anywhere(T + at, t);
      store_anywhere(B + at, suffix);
    }
    for (int m = 0, i = 0; m < batch.members; m++) {
      const Member& member = batch.member[m];
      Moments<F> sums{zero, zero, zero, zero, zero, zero};
      for (; i < member.end; i++) sums.add({batch.block[i].u, batch.block[i].v}, batch.block[i].tau);
      float* row = moments + kSums * member.slot;
      store_eight(row, member.first ? sum6(sums) : load_eight(row) + sum6(sums));
    }
  });
}

}  // namespace SG_ISA
}  // namespace sarsplat
