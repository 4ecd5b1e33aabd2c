// parallel.cpp: torch's own intra-op pool, through its stable C function torch_parallel_for (torch >= 2.10), handed over
// as a plain pointer. A second pool beside it (OpenMP or ours) would fight for the cores.
#include <atomic>
#include <cstdint>

typedef int32_t (*torch_parallel_for_t)(int64_t, int64_t, int64_t, void (*)(int64_t, int64_t, void*), void*);
static torch_parallel_for_t torch_parallel_for = nullptr;
static int threads = 1;

extern "C" __attribute__((visibility("default"))) void sg_use_torch(void* function) {
  torch_parallel_for = (torch_parallel_for_t)function;
}
extern "C" __attribute__((visibility("default"))) void sg_set_threads(int n) { threads = n; }

namespace {
struct Job {
  void (*f)(void*, int);
  void* context;
  int n;
  std::atomic<int> next;
};
}  // namespace

extern "C" void sg_parallel(int n, void (*f)(void*, int), void* context) {
  if (n <= 1 || threads <= 1 || !torch_parallel_for) {
    for (int i = 0; i < n; i++) f(context, i);
    return;
  }
  Job job{f, context, n, {0}};  // as many ranges as threads, each draining one counter: dynamic scheduling
  torch_parallel_for(0, threads < n ? threads : n, 1,
                     [](int64_t, int64_t, void* p) {
                       Job& j = *(Job*)p;
                       for (int i; (i = j.next.fetch_add(1, std::memory_order_relaxed)) < j.n;) j.f(j.context, i);
                     },
                     &job);
}
