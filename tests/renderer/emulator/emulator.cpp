// emulator.cpp: runs the engine's kernels, unmodified, with the threads of a block as fibers. Called from Python.
#include "emulator.h"

#include <setjmp.h>
#include <ucontext.h>

#include <cstdlib>
#include <utility>

#include "kernels.cu"

extern "C" char __start_shared_memory[], __stop_shared_memory[];

namespace emulator {

Index thread, block;

namespace {

constexpr int kWarp = 32, kMaxThreads = 1024, kStack = 128 << 10;

enum Waiting { NOT, FOR_WARP, FOR_BLOCK, DONE };
struct Fiber { jmp_buf at; ucontext_t born; char* stack = nullptr; Waiting waiting = DONE; bool started = false; };
// Two rounds are enough: nobody is more than one collective ahead of the slowest in its group.
struct Group { int arrived = 0, round = 0; Collective what = BLOCK; uint32_t values[2][kMaxThreads]; };

Fiber fibers[kMaxThreads];
Group whole, warps[kMaxThreads / kWarp];
jmp_buf scheduler;
ucontext_t main_context;
int current, threads;
const char* fault;
void (*kernel_body)(void*);
void** kernel_arguments;

void yield(Waiting waiting) {
  fibers[current].waiting = waiting;
  if (!_setjmp(fibers[current].at)) _longjmp(scheduler, 1);
}

void fiber_main() {
  for (;;) {
    kernel_body(kernel_arguments);
    yield(DONE);
  }
}

void resume(int k) {
  Fiber& fiber = fibers[k];
  current = k;
  thread.x = k;
  fiber.waiting = NOT;
  if (_setjmp(scheduler)) return;
  if (fiber.started) _longjmp(fiber.at, 1);
  fiber.started = true;
  if (!fiber.stack) fiber.stack = (char*)std::malloc(kStack);
  getcontext(&fiber.born);
  fiber.born.uc_stack.ss_sp = fiber.stack;
  fiber.born.uc_stack.ss_size = kStack;
  fiber.born.uc_link = nullptr;
  makecontext(&fiber.born, fiber_main, 0);
  swapcontext(&main_context, &fiber.born);
}

bool run_block(const int* order) {
  std::memset(__start_shared_memory, 0xff, __stop_shared_memory - __start_shared_memory);
  whole.arrived = 0;
  for (Group& warp : warps) warp.arrived = 0;
  for (int k = 0; k < threads; k++) fibers[k].waiting = NOT;
  for (;;) {
    bool progress = false, finished = true;
    for (int k = 0; k < threads; k++) {
      const int t = order[k];
      if (fibers[t].waiting == NOT) { resume(t); progress = true; }
      finished = finished && fibers[t].waiting == DONE;
    }
    if (fault) return false;
    if (finished) return true;
    if (!progress) { fault = "threads wait for others that have left or wait elsewhere"; return false; }
  }
}

// ---- calling a kernel by name with the addresses of its arguments -------------------------------------------------------
template <class... A, size_t... K> void call(void (*kernel)(A...), void** arguments, std::index_sequence<K...>) {
  kernel(*(A*)arguments[K]...);
}
template <class... A> void call(void (*kernel)(A...), void** arguments) {
  call(kernel, arguments, std::index_sequence_for<A...>());
}
struct Named { const char* name; void (*run)(void*); };
using namespace sarsplat::cuda;
const Named kernels[] = {
#define KERNEL(name) {#name, [](void* arguments) { call(name, (void**)arguments); }},
#include "kernels.h"
};

}  // namespace

int size(Collective what) { return what == BLOCK ? threads : kWarp; }

const uint32_t* meet(Collective what, uint32_t mine) {
  Group& group = what == BLOCK ? whole : warps[current / kWarp];
  if (group.arrived == 0) group.what = what;
  if (group.what != what) fault = "threads of a warp wait in different places";
  uint32_t* values = group.values[group.round];
  values[what == BLOCK ? current : current % kWarp] = mine;
  if (++group.arrived < size(what)) {
    yield(what == BLOCK ? FOR_BLOCK : FOR_WARP);
    return values;
  }
  group.arrived = 0;
  group.round ^= 1;
  const int first = what == BLOCK ? 0 : current / kWarp * kWarp;
  for (int k = first; k < first + size(what); k++) fibers[k].waiting = NOT;
  return values;
}

}  // namespace emulator

// Null if all went well, or what went wrong. `order`: the numbers of a block's threads in the order they run; blocks run
// backwards if asked.
extern "C" __attribute__((visibility("default"))) const char*
emulate(const char* name, int blocks, int count, const int* order, int backwards, void** arguments) {
  using namespace emulator;
  for (const Named& kernel : kernels) {
    if (std::strcmp(kernel.name, name)) continue;
    threads = count;
    kernel_body = kernel.run;
    kernel_arguments = arguments;
    fault = nullptr;
    for (int b = 0; b < blocks; b++) {
      block.x = backwards ? blocks - 1 - b : b;
      if (run_block(order)) continue;
      for (Fiber& fiber : fibers) fiber.started = false;  // they hang somewhere inside
      return fault;
    }
    return nullptr;
  }
  return "no such kernel";
}
