// One sample of an arm's signals, and what can be wrong with it.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/types.hpp"

namespace tauext {

// What a control loop gives once a cycle.
struct Sample {
  std::int64_t t_ns = 0;               // when it was measured, by a monotonic clock
  std::span<const double> q, dq, tau;  // a joint: [rad], [rad/s], tau in the bundle's given unit
  // A joint, [degC]; empty, or NaN for a joint: not known at this sample, and what was known holds.
  std::span<const double> temperature = {};
};

// Samples one after the other; q, dq, tau are (samples, joints), row-major. Values are not validated: times may
// go backwards and numbers be NaN.
struct RecordingView {
  std::int64_t samples = 0;  // how many
  int joints = 0;            // of each
  const std::int64_t* t_ns = nullptr;
  const double* q = nullptr;
  const double* dq = nullptr;
  const double* tau = nullptr;
  const double* temperature = nullptr;  // as q; null: not measured

  // Sample k, counted from 0, where it lies.
  Sample at(std::int64_t k) const noexcept {
    const auto n = static_cast<std::size_t>(joints), from = static_cast<std::size_t>(k) * n;
    return {t_ns[k], {q + from, n}, {dq + from, n}, {tau + from, n},
            temperature ? std::span<const double>(temperature + from, n) : std::span<const double>()};
  }
};

// Whether the estimate can be trusted; apart from the alarm, so that a fault never hides a collision.
enum class Health : std::uint8_t {
  warming_up,  // observer or window not full yet: there is no estimate
  ok,
  stale,       // no new sample, or an old one: the last estimate is held
  fault,       // the signals cannot be true or cannot be used
};

// Why health is not ok, or why it was not when the warm-up began; a bit each.
enum Cause : std::uint32_t {
  kNotFinite = 1,          // NaN or infinity in q, dq or tau, or so large that the chain overflows
  kWrongSize = 2,          // q, dq and tau hold not one value a joint
  kLateSample = 4,         // older than the newest one, by at most what is bridged (longest_bridged): left out
  kTimeBackwards = 8,      // older by more: the clock was set back
  kMissingSample = 16,     // no_sample(): none came for at most what is bridged
  kGap = 32,               // none came for longer
  kWrongRate = 64,         // the samples' mean step is not the bundle's
  kTorqueSaturated = 128,  // a drive at its limit gives another torque than commanded
  kEncoderStill = 256,     // a position stands still while velocity or torque indicate motion
  kImpossibleTorque = 512,     // more than the drive can give, whatever touches the arm (SignalRanges)
  kImpossibleVelocity = 1024,  // faster than the joint can get
  kImpossiblePosition = 2048,  // farther from the last position than the joint can have gone, or from all positions
};
inline constexpr std::uint32_t kCauseCount = 12;  // bits that there are

const char* name(Health health) noexcept;  // "warming up", "ok", ...
const char* name(Cause cause) noexcept;  // of a single bit: "not finite", ...

}  // namespace tauext
