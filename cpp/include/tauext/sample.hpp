// One sample of an arm's signals, and the faults that it can have.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/types.hpp"

namespace tauext {

// Input of one control cycle.
struct Sample {
  std::int64_t t_ns = 0;               // time of measurement by a monotonic clock, [ns]
  std::span<const double> q, dq, tau;  // per joint: [rad] without jumps of a turn, [rad/s], tau in the bundle's input unit
  // Per joint, [degC]. Empty, or NaN for a joint: unknown, the last known value remains in effect.
  std::span<const double> temperature = {};
};

// Consecutive samples; q, dq and tau are (samples, joints), row-major. Values are not validated: times may go backwards
// and values may be NaN.
struct RecordingView {
  std::int64_t samples = 0;  // number of samples
  int joints = 0;            // number of joints
  const std::int64_t* t_ns = nullptr;
  const double* q = nullptr;
  const double* dq = nullptr;
  const double* tau = nullptr;
  const double* temperature = nullptr;  // shape of q, [degC]; null: not measured

  // View of sample k, counted from 0.
  Sample at(std::int64_t k) const noexcept {
    const auto n = static_cast<std::size_t>(joints), from = static_cast<std::size_t>(k) * n;
    return {t_ns[k], {q + from, n}, {dq + from, n}, {tau + from, n},
            temperature ? std::span<const double>(temperature + from, n) : std::span<const double>()};
  }
};

// Whether the estimate can be trusted. Separate from the alarm, so that a fault never hides a collision.
enum class Health : std::uint8_t {
  warming_up,  // observer or window not full yet: no estimate
  ok,
  stale,       // no new sample, or an old one: the last estimate is held
  fault,       // the signals are impossible or unusable
};

// Causes of a health that is not ok, or of the current warm-up: one bit each.
enum Cause : std::uint32_t {
  kNotFinite = 1,          // NaN or infinity in q, dq or tau, or values so large that the chain overflows
  kWrongSize = 2,          // q, dq and tau do not have one value per joint
  kLateSample = 4,         // older than the newest sample, by at most a network period (below 300 Hz: three samples)
  kTimeBackwards = 8,      // older by more: the clock was set back
  kMissingSample = 16,     // no_sample(), for at most the same time
  kGap = 32,               // no sample for longer
  kWrongRate = 64,         // the mean step of the samples differs from the bundle's sample period
  kTorqueSaturated = 128,  // a drive at its limit gives another torque than commanded
  kEncoderStill = 256,     // a position does not change while velocity or torque indicate motion
  kImpossibleTorque = 512,     // more than the drive can give, whatever touches the arm (SignalRanges)
  kImpossibleVelocity = 1024,  // faster than the joint can move
  kImpossiblePosition = 2048,  // farther from the last position than the joint can move, or out of range
};
inline constexpr std::uint32_t kCauseCount = 12;  // number of bits

const char* name(Health health) noexcept;  // "warming up", "ok", ...
const char* name(Cause cause) noexcept;  // name of a single bit: "not finite", ...

}  // namespace tauext
