// Standard error of tau_ext during and after a contact.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/types.hpp"

namespace tauext {

struct Bundle;

// The standard error of tau_ext in free motion, and the errors that a contact brings:
//
//   contact_sigma_j^2 = sigma_j^2 + (hidden_j F_j)^2 + (unsure_j P_j gap_j)^2 + (rubbing_j^2 + constant_j^2) tau_ext_j^2
//                       + (|d tau_ext_j / dt| / K0)^2
//
// F_j is the joint's friction at rest. After a contact, the friction of a resting joint is known only within the share
// hidden_j, until the joint slides again. So is how its presliding friction P_j remembers reversals: local and nonlocal memory
// differ by P_j gap_j (Presliding), of which the share unsure_j is in doubt. Gear friction grows by the share rubbing_j of a
// load; constant_j is the relative error of the torque constant (WrenchSettings). The last term is the lag of the observer,
// whose residual is 1/K0 late. The last two terms count during the contact and fade with 1/K0.
//
// The result is for reports only. Limits, drift trackers and weighing use sigma, which no torque can raise.
class ContactErrors {
 public:
  // Share of F that a resting joint hides: with presliding states that follow its friction, and without any: then it is
  // anything between all of it this way and that, where one end was expected. In between, the share depends on the narrowest
  // state relative to kBuildsUpRad, the travel over which friction builds up. Fitted to simulated arms
  // (docs/results/forces.md).
  static constexpr double kFineShare = 0.12, kCoarseShare = 1.15, kBuildsUpRad = 1e-3;
  // Share of the gap if training found local memory, and if it found none or was undecided.
  static constexpr double kUnsureLocal = 0.05, kUnsureBank = 0.3;
  // Gear friction under a load, as a share of it, where training found none: 2 to 6 % (Bittencourt et al. 2010).
  static constexpr double kUsualRubbing = 0.04;
  static constexpr double kStaysS = 1.0;  // a joint that comes to rest within this time after a contact counts as pressed

  explicit ContactErrors(const Bundle& bundle);

  // touched: some joint is over its contact limit at this sample. near_stiction: a bit a joint. tau_ext, sigma_nm, memory_gap:
  // of this sample, the last one empty where there is none. into: the standard error, NaN where sigma_nm is.
  void step(std::int64_t t_ns, std::uint32_t near_stiction, bool touched, std::span<const double> tau_ext,
            std::span<const double> sigma_nm, std::span<const double> memory_gap, std::span<double> into) noexcept;
  // Variance that a torque on a joint brings, [N m]^2: friction that it may hide if it rests, and errors in proportion.
  double brought(int joint, bool rests, double torque_nm) const noexcept {
    const double hidden = rests ? hidden_nm_[joint] : 0.0, of_torque = of_torque_[joint] * torque_nm;
    return hidden * hidden + of_torque * of_torque;
  }
  // A sample without tau_ext: what changed until the next one is no rate.
  void skip() noexcept { state_.started = false; }
  void reset() noexcept { state_ = {}; }

  struct State {
    std::int64_t t_ns = 0;
    double step_s = -1;           // the last one, ...
    double kept = 0;              // ... and exp(-K0 step)
    double since_s = kStaysS;     // the last touch, cut at kStaysS
    double touched = 0;           // 1 during a contact, fades with 1/K0
    std::uint32_t pressed = 0;    // a bit a joint: it rests since a contact
    bool started = false;
    JointVector tau_ext{}, rate{};
  };
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  int joints_;
  double gain_per_s_;
  JointVector hidden_nm_{}, unsure_nm_{}, of_torque_{};
  State state_;
};

}  // namespace tauext
