// Which wide instructions this processor has and this system saves at a change of thread.
//
// Asked of the processor itself: __builtin_cpu_supports answers from a table of the compiler's own library, and the
// library of the compiler that makes the wheels (zig) leaves that table empty.
#pragma once

#if defined(__x86_64__)
#include <cpuid.h>

namespace tauext {

enum class Simd { kSse2, kAvx2, kAvx512 };

/// What lstm_lanes.hpp compiles for, in the order of kKernels (lstm.cpp): x86-64-v3 counts as kAvx2, x86-64-v4 as kAvx512.
inline Simd widest_simd() noexcept {
  unsigned a = 0, b = 0, c = 0, d = 0;
  if (!__get_cpuid(1, &a, &b, &c, &d)) return Simd::kSse2;
  constexpr unsigned kOfVersion3 = bit_FMA | bit_OSXSAVE | bit_AVX | bit_F16C | bit_MOVBE;
  if ((c & kOfVersion3) != kOfVersion3) return Simd::kSse2;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return Simd::kSse2;
  constexpr unsigned kAvx2Bits = bit_AVX2 | bit_BMI | bit_BMI2;
  constexpr unsigned kAvx512Bits = bit_AVX512F | bit_AVX512VL | bit_AVX512BW | bit_AVX512DQ | bit_AVX512CD;
  unsigned saved = 0, high = 0;  // register XCR0: which registers the system saves
  __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
  constexpr unsigned kSavesYmm = 0x06, kSavesZmm = 0xe6;
  if ((b & kAvx2Bits) != kAvx2Bits || (saved & kSavesYmm) != kSavesYmm) return Simd::kSse2;
  return (b & kAvx512Bits) == kAvx512Bits && (saved & kSavesZmm) == kSavesZmm ? Simd::kAvx512 : Simd::kAvx2;
}

}  // namespace tauext
#endif
