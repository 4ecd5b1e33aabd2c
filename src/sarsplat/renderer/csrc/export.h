// export.h: what Python may call; everything else stays inside the library.
#pragma once

#if defined(_WIN32)
#define SG_EXPORT extern "C" __declspec(dllexport)
#else
#define SG_EXPORT extern "C" __attribute__((visibility("default")))
#endif

#define SG_TEXT_(a) #a
#define SG_TEXT(a) SG_TEXT_(a)
