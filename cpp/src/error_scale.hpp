// How wrong tau_ext may be just now, as the motion announces it: what limits and the standard error grow with.
#pragma once
#include <algorithm>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// scale_j = min(sum_m w_jm F_m, largest_j), sigma_j likewise with weights and ceiling of its own, with F_m the features passed through the observer's filter,
//   F <- F + (1 - exp(-K0 dt)) (feature - F),
// so that they rise and fade with what they announce in r. From a restart on they stand at the first sample's values.
// ddq and dddq come of first-order filters of a fixed rate Ka, whatever K0, so that noise does not grow with K0; steps
// are as stamped. standstill decays with kMemoryS from the largest 1 / (1 + (dq_j / kCreepRadS)^2); it starts from 1, as
// nobody knows what was before. The torque has no say: a push must not raise its own limit. (It moves the arm, and that
// does, but not beyond `largest`.)
class ErrorScale {
 public:
  static constexpr double kAccelerationPerS = 40;  // Ka, [1/s]
  static constexpr double kMemoryS = 0.15, kCreepRadS = 0.02;  // of standstill, [s] and [rad/s]
  static constexpr double kLargestSpeed = 1e3;  // [rad/s]; what is beyond counts as this, so that sums stay finite

  struct State {
    bool started = false;
    std::int64_t t_ns = 0, step_ns = 0;  // of the last sample, and the step that the shares are for
    double share = 0, slow_share = 0, kept = 0;  // 1 - exp(-K0 dt), 1 - exp(-Ka dt), exp(-dt / kMemoryS)
    JointVector slow_dq{}, slow_ddq{}, standstill{};
    std::array<JointVector, kMotionFeatures> filtered{};
  };

  // Throws Error where the settings do not fit.
  ErrorScale(const ErrorScaleSettings& settings, int joints, double gain_per_s);

  // After a gap or a fault.
  void restart() noexcept { state_.started = false; }
  // As newly made.
  void reset() noexcept { state_ = {}; }
  // One sample of finite speeds, later than the last. Writes both of every joint; 1 and NaN where there are no features.
  // near_stiction: a bit a joint, by which sigma has its weights.
  void step(std::int64_t t_ns, std::span<const double> dq, std::uint32_t near_stiction, std::span<double> scale,
            std::span<double> sigma_nm) noexcept;
  bool on() const noexcept { return settings_.on(); }  // as the settings are
  // F_m of a joint at the last sample, m counted in the settings.
  double feature(int joint, int m) const noexcept;

  // All that it remembers; restore() goes on from there, in another one of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  void take_step(std::int64_t t_ns) noexcept;
  void follow(std::span<const double> dq) noexcept;

  ErrorScaleSettings settings_;
  int joints_;
  double gain_per_s_;
  State state_;
};

}  // namespace tauext
