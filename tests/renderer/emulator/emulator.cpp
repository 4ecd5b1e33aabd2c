// emulator.cpp: runs the engine's kernels, unmodified, with the threads of a block as fibers. Called from Python.
#include "emulator.h"

#include <setjmp.h>
#include <ucontext.h>

#include <cstdlib>
#include <utility>

#include "kernels.cu"

extern "C" char __start_shared_memory[], __stop_shared_memory[];

extern "C" __attribute__((visibility("default"))) struct { const char* file; int line; } left_out = {"", 0};

namespace emulator {

Index thread, block;

namespace {

constexpr int kWarp = 32, kStack = 128 << 10;

#if defined(__x86_64__)  // quicker: the compiler's own pair looks after nothing but registers
typedef void* Place[5];
#define REMEMBER(place) __builtin_setjmp(place)
#define GO_TO(place) __builtin_longjmp(place, 1)
#else
typedef jmp_buf Place;
#define REMEMBER(place) _setjmp(place)
#define GO_TO(place) _longjmp(place, 1)
#endif

enum Waiting : char { NOT, FOR_WARP, FOR_BLOCK, DONE };
struct Fiber { Place at; ucontext_t born; char* stack = nullptr; bool started = false; };
// Two rounds are enough: nobody is more than one collective ahead of the slowest in its group.
struct Group { int arrived = 0, round = 0; Collective what = BLOCK; Met met[2]; };

Fiber fibers[kMaxThreads];
Waiting waiting[kMaxThreads];
Group whole, warps[kMaxThreads / kWarp];
Place scheduler;
ucontext_t main_context;
int current, threads, turn;  // whose turn it is, and where that is in the order
bool running;                // whether it is anyone's
const int* order;
const char* fault;
void (*kernel_body)(void*);
void** kernel_arguments;

// It is the turn of the next thread in order that waits for nothing.
void advance() {
  running = false;
  for (int k = 0; k < threads && !running && !fault; k++) {
    turn = turn + 1 < threads ? turn + 1 : 0;
    thread.x = current = order[turn];
    running = waiting[current] == NOT;
  }
}

void yield(Waiting why) {
  waiting[current] = why;
  if (REMEMBER(fibers[current].at)) return;
  advance();
  if (running && fibers[current].started) GO_TO(fibers[current].at);
  GO_TO(scheduler);
}

void fiber_main() {
  for (;;) {
    kernel_body(kernel_arguments);
    yield(DONE);
  }
}

// Threads hand on to each other, until it is the turn of nobody or of one that has yet to be started.
void run_current() {
  if (REMEMBER(scheduler)) return;
  Fiber& fiber = fibers[current];
  if (fiber.started) GO_TO(fiber.at);
  fiber.started = true;
  if (!fiber.stack) fiber.stack = (char*)std::malloc(kStack);
  getcontext(&fiber.born);
  fiber.born.uc_stack.ss_sp = fiber.stack;
  fiber.born.uc_stack.ss_size = kStack;
  fiber.born.uc_link = nullptr;
  makecontext(&fiber.born, fiber_main, 0);
  swapcontext(&main_context, &fiber.born);
}

bool run_block() {
  std::memset(__start_shared_memory, 0xff, __stop_shared_memory - __start_shared_memory);
  whole.arrived = 0;
  for (Group& warp : warps) warp.arrived = 0;
  for (int k = 0; k < threads; k++) waiting[k] = NOT;
  turn = -1;
  for (advance(); running;) run_current();
  for (int k = 0; k < threads && !fault; k++)
    if (waiting[k] != DONE) fault = "threads wait for others that have left or wait elsewhere";
  return !fault;
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

const Met& meet(Collective what, uint32_t mine) {
  const bool block = what == BLOCK;
  const int first = block ? 0 : current / kWarp * kWarp, size = block ? threads : kWarp;
  Group& group = block ? whole : warps[current / kWarp];
  Met& met = group.met[group.round];
  if (group.arrived == 0) { group.what = what; met.any = 0; }
  if (group.what != what) fault = "threads of a warp wait in different places";
  met.values[current - first] = mine;
  met.any |= mine;
  if (++group.arrived < size) {
    yield(block ? FOR_BLOCK : FOR_WARP);
    return met;
  }
  group.arrived = 0;
  group.round ^= 1;
  std::memset(waiting + first, NOT, size);
  return met;
}

void barrier(const char* file, int line) {
  if (line != left_out.line || !std::strstr(file, left_out.file)) meet(BLOCK, 0);
}

}  // namespace emulator

// Null if all went well, or what went wrong. `turns`: the numbers of a block's threads in the order they run; blocks run
// backwards if asked.
extern "C" __attribute__((visibility("default"))) const char*
emulate(const char* name, int blocks, int count, const int* turns, int backwards, void** arguments) {
  using namespace emulator;
  for (const Named& kernel : kernels) {
    if (std::strcmp(kernel.name, name)) continue;
    threads = count;
    order = turns;
    kernel_body = kernel.run;
    kernel_arguments = arguments;
    fault = nullptr;
    for (int b = 0; b < blocks; b++) {
      block.x = backwards ? blocks - 1 - b : b;
      if (run_block()) continue;
      for (Fiber& fiber : fibers) fiber.started = false;  // they hang somewhere inside
      return fault;
    }
    return nullptr;
  }
  return "no such kernel";
}
