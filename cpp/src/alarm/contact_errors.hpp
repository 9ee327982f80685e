// Standard error of tau_ext during and after a contact.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/types.hpp"

namespace tauext {

struct Bundle;

// The standard error of tau_ext in free motion, and the errors that a contact brings:
//
//   contact_sigma_j^2 = sigma_j^2 + hidden_j^2 + (unsure_j P_j gap_j)^2 + (rubbing_j^2 + constant_j^2) tau_ext_j^2
//                       + (|d tau_ext_j / dt| / K0)^2,    hidden_j^2 = unseen_j^2 (p_j^2 + F_j^2 / 3) + (1 - unseen_j^2) p_j^2 / 3
//
// The friction of a stuck joint is anything within +-F_j: its friction at rest, and the share of the drive's torque by which gear
// friction grows with the load. The prior expects p_j. Where positions show nothing of the friction, 2 sqrt(p^2 + F^2 / 3) >=
// |p| + F covers every truth. unseen_j, the share that positions do not show, is the narrowest presliding width over the turning
// travel, at most 1. While the arm presses for seconds, an uneven force leaves anything between p and 0 of what they show, since
// bristles slip a little under any force (LuGre): the last part of hidden_j counts while an expected contact is in effect. Local
// and nonlocal memory of the presliding friction P_j differ by P_j gap_j (Presliding), of which the share unsure_j is in doubt.
// These terms count for a joint that rests since a contact, or at rest exceeds kNoticed sigma, until it slides. Gear friction
// grows by the share rubbing_j of a load; constant_j is the relative error of the torque constant (WrenchSettings). The last term
// is the lag of the observer, whose residual is 1/K0 late. The last two terms count during the contact and fade with 1/K0.
//
// The result is for reports only. Limits, drift trackers and weighing use sigma, which no torque can raise.
class ContactErrors {
 public:
  // Standard errors of tau_ext from which on a joint at rest counts as pressed, though no limit is exceeded.
  static constexpr double kNoticed = 3;
  // Share of the gap if training found local memory, and if it found none or was undecided.
  static constexpr double kUnsureLocal = 0.05, kUnsureBank = 0.3;
  // Gear friction under a load, as a share of it, where training found none: 2 to 6 % (Bittencourt et al. 2010).
  static constexpr double kUsualRubbing = 0.04;
  static constexpr double kStaysS = 1.0;  // a joint that comes to rest within this time after a contact counts as pressed

  explicit ContactErrors(const Bundle& bundle);

  // Friction of joints at rest at a sample. coulomb: in the prior, [N m], empty where unknown; tau: of the drives, in the input's
  // unit.
  struct Friction {
    std::span<const double> coulomb, tau;
  };

  // Finds what joints near stiction hide at this sample, for brought(); step() finds it where it counts.
  void find_hidden(std::uint32_t near_stiction, const Friction& friction) noexcept;
  // touched: some joint is over its contact limit at this sample. presses: an expected contact is in effect. near_stiction: a bit
  // a joint. tau_ext, sigma_nm, memory_gap:
  // of this sample, the last one empty where there is none. into: the standard error, NaN where sigma_nm is.
  void step(std::int64_t t_ns, std::uint32_t near_stiction, bool touched, std::span<const double> tau_ext,
            std::span<const double> sigma_nm, std::span<const double> memory_gap, const Friction& friction,
            std::span<double> into, bool presses = false) noexcept;
  // Variance that a torque on a joint brings, [N m]^2: friction that it may hide if it rests (after find_hidden() at this sample),
  // and errors in proportion.
  double brought(int joint, bool rests, double torque_nm) const noexcept {
    const double of_torque = of_torque_[joint] * torque_nm;
    return (rests ? hidden_[joint] : 0.0) + of_torque * of_torque;
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
    std::uint32_t pressed = 0;    // a bit a joint: it rests since a contact or since it was noticed
    bool started = false;
    JointVector tau_ext{}, rate{};
  };
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  double hidden(std::size_t joint, const Friction& friction) const noexcept;  // variance, [N m]^2
  double slipped(std::size_t joint, const Friction& friction) const noexcept;  // the part of an uneven force, [N m]^2

  int joints_;
  double gain_per_s_;
  JointVector unseen_{}, at_rest_nm_{}, of_load_{}, unsure_nm_{}, of_torque_{};
  JointVector hidden_{};  // of find_hidden(), [N m]^2
  State state_;
};

}  // namespace tauext
