// Sizes, enumerations and the error type of all parts of the core.
#pragma once
#include <array>
#include <cstdint>
#include <cstdio>
#include <span>
#include <stdexcept>
#include <string>

namespace tauext {

// Largest sizes.
inline constexpr int kMaxJoints = 32;
inline constexpr int kMaxNetworkStride = 10000;  // samples in a network period

// One value per joint; elements beyond the arm's joints are meaningless.
using JointVector = std::array<double, kMaxJoints>;

// Meaning of a torque sample. A wrong setting adds a false residual of tenths to whole newton metres. Bundles store
// these numbers.
enum class TorqueTiming : std::uint8_t {
  held = 0,      // acts from its time stamp to the next one: a commanded torque
  instant = 1,   // measured at its time stamp
  averaged = 2,  // mean over the step that ends at its time stamp
};

// later - earlier, which must be >= 0. Unsigned, since the difference may not fit a signed number.
inline std::uint64_t elapsed_ns(std::int64_t later_ns, std::int64_t earlier_ns) noexcept {
  return static_cast<std::uint64_t>(later_ns) - static_cast<std::uint64_t>(earlier_ns);
}

// The same in seconds.
inline double elapsed_s(std::int64_t later_ns, std::int64_t earlier_ns) noexcept {
  return 1e-9 * static_cast<double>(elapsed_ns(later_ns, earlier_ns));
}

// Formats a number for a message: %g.
inline std::string to_text(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%g", value);
  return text;
}

// Thrown by constructors and loaders only, never by functions that run once per sample.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

}  // namespace tauext
