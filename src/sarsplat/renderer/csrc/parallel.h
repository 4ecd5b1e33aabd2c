// parallel.h: independent tasks on the threads that torch has.
#pragma once

extern "C" void sg_parallel(int n, void (*f)(void*, int), void* context);
extern "C" void sg_together(void (*f)(void*), void* context);
extern "C" void sg_alone(void (*f)(void*), void* context);

// f(0) ... f(n - 1), in any order, at the same time
template <class F> static inline void parallel(int n, F f) {
  sg_parallel(n, [](void* p, int i) { (*(F*)p)(i); }, &f);
}

// f(), on one thread; the others stay awake and share in every `parallel` in it, unless that is not worth waking them
template <class F> static inline void together(bool worthwhile, F f) {
  (worthwhile ? sg_together : sg_alone)([](void* p) { (*(F*)p)(); }, &f);
}
