// Slow changes of friction and offset, tracked while nothing touches the arm: gears warm up, grease thins, torque
// measurements creep.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/limits.hpp"
#include "tauext/types.hpp"

namespace tauext {

struct DriftSettings {
  double time_constant_s = 0;   // of the tracker, >= 1; 0: there is none, and nothing else here counts
  std::vector<double> size_nm;  // a joint: the most that each coefficient may reach, [N m]
  double rate_share_per_s = 0;  // how much of its size a coefficient may change in a second
  double freeze_share = 0;      // |tau_ext| over this share of the lower limit is a touch; 0: nothing is
  double freeze_s = 0;          // nothing is learned for so long after a touch
  std::vector<double> freeze_floor_nm = {};  // a joint: what is below is no touch, however low its limit, [N m]; empty: 0
  double friction_share = 0;  // the most that friction may be off by at once (friction_factors.hpp); 0: not followed

  bool on() const noexcept { return time_constant_s > 0; }
  bool follows_factors() const noexcept { return on() && friction_share > 0; }
  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
};

// drift_j = b_j . f_j, what r shows beside prior and network: f_j are
//   phi_j = (1, tanh(dq_j / 0.05 rad/s), dq_j / (1 rad/s) clipped to +-1)
// passed through the observer's own filter (mean over a step: trapezoid), so that they stand beside r. The coefficients
// b_j [N m] follow by normalised least mean squares [Haykin2014]:
//   b_j += clip(dt / T * tau_ext_j f_j / max(|f_j|^2, 1), +-rate_share size_j dt),    |b_j| <= size_j.
// Frozen, and still taken off, while the estimate cannot be trusted, while the joint is near stiction and for 3/K0
// afterwards (static friction is no drift, and a push on a standing arm is not to be learned), and for freeze_s after any
// joint's |tau_ext| was over freeze_share of the lower of its limits, but at least over freeze_floor, plus its doubt.
// (Limits that follow the error are low in easy motion: half of one is passed all the time. An alarm that is held below
// the floor freezes nothing.)
class DriftTracker {
 public:
  static constexpr int kTerms = 3;  // constant, Coulomb, viscous
  static constexpr double kCoulombSpeed = 0.05, kViscousSpeed = 1.0;  // [rad/s]
  static constexpr double kForgottenShare = 3;  // times 1/K0 after stiction: so long the observer still shows it

  using Terms = std::array<JointVector, kTerms>;
  struct State {
    bool started = false;
    std::int64_t t_ns = 0, step_ns = 0;  // of the last sample, and since the one before; 0 where it began anew
    std::int64_t touched_ns = 0;         // left of the time to be frozen after a touch
    std::array<std::int64_t, kMaxJoints> stuck_ns{};  // and after stiction
    std::uint32_t saturated = 0;         // a bit a joint
    Terms phi{}, filtered{}, coefficients{};
  };

  // Throws Error where the settings do not fit.
  DriftTracker(const DriftSettings& settings, const Limits& limits, int joints, double gain_per_s);

  // After a gap or a fault: the filters begin anew, coefficients stay, since drift does not vanish with a lost sample.
  void restart() noexcept { state_.started = false; }
  // As newly made.
  void reset() noexcept { state_ = {}; }

  // One sample, later than the last: writes the drift of every joint, [N m], from what was learned before it.
  void step(std::int64_t t_ns, std::span<const double> dq, std::span<double> drift) noexcept;
  // Learns from tau_ext of the sample just stepped, drift taken off; scale and doubt as for the limits, near_stiction a
  // bit a joint. With trusted = false nothing is learned, and the time after a touch stands still: what cannot be seen has
  // not gone.
  void learn(std::span<const double> tau_ext, std::span<const double> scale, std::span<const double> doubt,
             std::uint32_t near_stiction, bool trusted) noexcept;

  // As if so much had been learned until now.
  void put_coefficients(const Terms& coefficients) noexcept { state_.coefficients = coefficients; }

  bool on() const noexcept { return settings_.on(); }
  // A bit a joint: one of its coefficients is at its bound. Training anew is due.
  std::uint32_t saturated() const noexcept { return state_.saturated; }
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  bool touched(std::span<const double> tau_ext, std::span<const double> scale, std::span<const double> doubt,
               std::uint32_t near_stiction) const noexcept;
  void follow(int joint, double error, double dt) noexcept;

  DriftSettings settings_;
  Limits limits_;
  int joints_;
  double gain_per_s_;
  std::int64_t freeze_ns_, forget_ns_;
  State state_;
};

}  // namespace tauext
