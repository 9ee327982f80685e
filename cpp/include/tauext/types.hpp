// Sizes, enumerations and the error type that every part of the core shares.
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

// One number for each joint; those beyond an arm's joints mean nothing.
using JointVector = std::array<double, kMaxJoints>;

// What a torque sample means; getting it wrong puts a false residual of tenths to whole newton metres into the observer.
// The numbers stand in bundles.
enum class TorqueTiming : std::uint8_t {
  held = 0,      // acts from its stamp to the next one: a commanded torque
  instant = 1,   // a measurement at its stamp
  averaged = 2,  // the mean over the step that ends at its stamp
};

// later - earlier >= 0 for any two stamps: their difference may not fit a signed number.
inline std::uint64_t elapsed_ns(std::int64_t later_ns, std::int64_t earlier_ns) noexcept {
  return static_cast<std::uint64_t>(later_ns) - static_cast<std::uint64_t>(earlier_ns);
}

// A number in a message: %g.
inline std::string to_text(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%g", value);
  return text;
}

// Thrown by constructors and loaders only, never by anything that runs once a sample.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

}  // namespace tauext
