// parallel.cpp: torch's own intra-op pool, through its stable C function torch_parallel_for (torch >= 2.10), handed over
// as a plain pointer. A second pool beside it (OpenMP or ours) would fight for the cores.
//
// Waking a thread takes as long as a stage of a pass. So a pass is one region of the pool: one thread leads through its
// stages, and the others take tasks of whatever stage it has come to. No stage waits for a thread that holds no task: if
// the pool runs them one after the other, the leader does everything itself and the rest finds nothing left to do.
#include "parallel.h"

#include <atomic>
#include <cstdint>
#include <thread>

#include "export.h"

typedef int32_t (*torch_parallel_for_t)(int64_t, int64_t, int64_t, void (*)(int64_t, int64_t, void*), void*);
static torch_parallel_for_t torch_parallel_for = nullptr;
static std::atomic<int> threads{1};

SG_EXPORT void sg_use_torch(void* function) {
  torch_parallel_for = (torch_parallel_for_t)function;
}
SG_EXPORT void sg_set_threads(int n) { threads.store(n, std::memory_order_relaxed); }

namespace {

void pause(int& turns) {  // shortly busy, so as not to sleep; then others go first
  if (++turns % 64) {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
  } else {
    std::this_thread::yield();
  }
}

class Team {
 public:
  void lead(void (*f)(void*), void* context) {
    f(context);
    over_.store(true, std::memory_order_release);
  }
  bool first() { return !led_.exchange(true); }
  void follow() {
    for (int turns = 0; !over_.load(std::memory_order_acquire);)
      if (take_one()) turns = 0;
      else pause(turns);
  }
  void run(int n, void (*f)(void*, int), void* context) {
    f_ = f;
    context_ = context;
    done_.store(0, std::memory_order_relaxed);
    tickets_.store((uint64_t)n << 32, std::memory_order_release);
    while (take_one()) {}
    for (int turns = 0; done_.load(std::memory_order_acquire) < n;) pause(turns);
  }

 private:
  // Tasks of the stage in the upper half, the next of them in the lower: who gets a ticket knows that f_ is the stage's,
  // for the stage is not over before the task is.
  bool take_one() {
    uint64_t ticket = tickets_.load(std::memory_order_acquire);
    do {
      if ((uint32_t)ticket >= ticket >> 32) return false;
    } while (!tickets_.compare_exchange_weak(ticket, ticket + 1, std::memory_order_acq_rel));
    f_(context_, (int)(uint32_t)ticket);
    done_.fetch_add(1, std::memory_order_acq_rel);
    return true;
  }
  void (*f_)(void*, int) = nullptr;
  void* context_ = nullptr;
  std::atomic<uint64_t> tickets_{0};
  std::atomic<int> done_{0};
  std::atomic<bool> led_{false}, over_{false};
};

thread_local Team* team = nullptr;  // which this thread leads
thread_local bool alone = false;    // it has something small to do

}  // namespace

extern "C" void sg_alone(void (*f)(void*), void* context) {
  const bool before = alone;
  alone = true;
  f(context);
  alone = before;
}

extern "C" void sg_together(void (*f)(void*), void* context) {
  if (threads <= 1 || alone || team || !torch_parallel_for) return f(context);
  struct Region { Team team; void (*f)(void*); void* context; } region{{}, f, context};
  torch_parallel_for(0, threads, 1,
                     [](int64_t, int64_t, void* p) {
                       Region& r = *(Region*)p;
                       if (!r.team.first()) return r.team.follow();
                       team = &r.team;
                       r.team.lead(r.f, r.context);
                       team = nullptr;
                     },
                     &region);
}

extern "C" void sg_parallel(int n, void (*f)(void*, int), void* context) {
  if (n > 1 && team) return team->run(n, f, context);
  if (n <= 1 || threads <= 1 || alone || !torch_parallel_for) {
    for (int i = 0; i < n; i++) f(context, i);
    return;
  }
  struct Job { int n; void (*f)(void*, int); void* context; } job{n, f, context};
  sg_together([](void* p) { const Job& j = *(Job*)p; sg_parallel(j.n, j.f, j.context); }, &job);
}
