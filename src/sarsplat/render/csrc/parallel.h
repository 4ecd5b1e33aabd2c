// parallel.h: run f(i) for i in [0, n) on the host's thread pool, in no particular order.
#pragma once
extern "C" void sg_parallel(int n, void (*f)(void*, int), void* context);

template <class Function> static inline void parallel(int n, Function function) {
  sg_parallel(n, [](void* context, int i) { (*(Function*)context)(i); }, &function);
}
