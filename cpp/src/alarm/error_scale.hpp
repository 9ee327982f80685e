// Expected size of tau_ext's error from the motion; scales the limits and the standard error.
#pragma once
#include <algorithm>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// scale_j = min(sum_m w_jm F_m, largest_j); sigma_j has its own weights and ceiling. F_m are filtered features:
//   F <- F + (1 - exp(-K0 dt)) (feature - F),
// so that they rise and decay with the errors in r. A restart sets them to the first sample's values. ddq and dddq come
// from first-order filters of fixed rate Ka, so that noise does not grow with K0. standstill decays with kMemoryS from
// the largest 1 / (1 + (dq_j / kCreepRadS)^2) and starts at 1. The torque is not used: a push must not raise its own
// limit. (It moves the arm, but the scale is at most `largest`.)
class ErrorScale {
 public:
  static constexpr double kAccelerationPerS = 40;  // Ka, [1/s]
  static constexpr double kMemoryS = 0.15, kCreepRadS = 0.02;  // of standstill, [s] and [rad/s]
  static constexpr double kLargestSpeed = 1e3;  // [rad/s]; larger speeds are clamped, so that sums stay finite

  struct State {
    bool started = false;
    std::int64_t t_ns = 0, step_ns = 0;  // of the last sample, and the step that the shares are for
    double share = 0, slow_share = 0, kept = 0;  // 1 - exp(-K0 dt), 1 - exp(-Ka dt), exp(-dt / kMemoryS)
    JointVector slow_dq{}, slow_ddq{}, standstill{};
    std::array<JointVector, kMotionFeatures> filtered{};
  };

  // Throws Error if the settings do not fit.
  ErrorScale(const ErrorScaleSettings& settings, int joints, double gain_per_s);

  // After a gap or a fault.
  void restart() noexcept { state_.started = false; }
  // Back to the state after construction.
  void reset() noexcept { state_ = {}; }
  // Processes one sample of finite speeds. Writes both scales of every joint; 1 and NaN without features.
  // near_stiction: one bit per joint; selects the weights of sigma.
  void step(std::int64_t t_ns, std::span<const double> dq, std::uint32_t near_stiction, std::span<double> scale,
            std::span<double> sigma_nm) noexcept;
  bool on() const noexcept { return settings_.on(); }  // as the settings are
  // F_m of a joint at the last sample, m counted in the settings.
  double feature(int joint, int m) const noexcept;

  // Complete state; restore() continues from it in a scale of the same settings.
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
