// The whole C++ test library: a failed check prints where and what, and the program's exit status counts them.
#pragma once
#include <cmath>
#include <cstdio>

namespace check {
// An emulator takes a hundred times as long for a network: there the longest tests are shorter.
#ifdef TAUEXT_EMULATED
inline constexpr bool emulated = true;
#else
inline constexpr bool emulated = false;
#endif

inline int failures = 0;

inline void that(bool ok, const char* text, const char* file, int line) {
  if (ok) return;
  ++failures;
  std::printf("%s:%d: failed: %s\n", file, line, text);
}

// |a - b| <= tolerance; NaN never passes.
inline void close(double a, double b, double tolerance, const char* text, const char* file, int line) {
  if (std::fabs(a - b) <= tolerance) return;
  ++failures;
  std::printf("%s:%d: failed: %s: %.17g against %.17g, tolerance %g\n", file, line, text, a, b, tolerance);
}

inline int result() {
  if (failures) std::printf("%d checks failed\n", failures);
  return failures ? 1 : 0;
}
}  // namespace check

#define CHECK(x) check::that((x), #x, __FILE__, __LINE__)
#define CHECK_CLOSE(a, b, tolerance) check::close((a), (b), (tolerance), #a " = " #b, __FILE__, __LINE__)
#define CHECK_THROWS(expression, Exception)                                  \
  do {                                                                       \
    bool thrown = false;                                                     \
    try {                                                                    \
      (void)(expression);                                                    \
    } catch (const Exception&) {                                             \
      thrown = true;                                                         \
    }                                                                        \
    check::that(thrown, #expression " throws " #Exception, __FILE__, __LINE__); \
  } while (false)
