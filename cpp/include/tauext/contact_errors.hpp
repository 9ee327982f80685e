// How wrong tau_ext may be while something touches the arm and after it, where free motion says too little of it.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/types.hpp"

namespace tauext {

struct Bundle;

// The standard error of tau_ext in free motion, and three errors that a contact brings:
//
//   contact_sigma_j^2 = sigma_j^2 + (hidden_j F_j)^2 + (rubbing_j tau_ext_j)^2 + (|d tau_ext_j / dt| / K0)^2
//
// F_j is the joint's friction at rest. From a contact on a joint that rests may hide any of it that its last yielding left
// undetermined, until it slides again. rubbing_j is the share of a load by which gear friction grows. The last term is the
// lag of the observer, whose residual is 1/K0 behind. The last two count during the contact and fade with 1/K0.
//
// It is for reports alone: limits, trackers of drift and weighing use sigma, which no torque can raise.
class ContactErrors {
 public:
  // Share of F that a resting joint hides: where the prior's presliding states follow it, and where the encoder is too
  // coarse for them. In between by the narrowest state beside the way on which friction builds up. Both are root mean
  // squares on the demo's two-axis arm; a reversed push can leave up to 2.
  static constexpr double kFineShare = 0.35, kCoarseShare = 1.2, kBuildsUpRad = 1e-3;
  static constexpr double kStaysS = 1.0;  // what comes to rest so long after a contact does so under what it left

  explicit ContactErrors(const Bundle& bundle);

  // touched: some joint is over its contact limit at this sample. near_stiction: a bit a joint. tau_ext, sigma_nm: of this
  // sample. into: the standard error, NaN where sigma_nm is.
  void step(std::int64_t t_ns, std::uint32_t near_stiction, bool touched, std::span<const double> tau_ext,
            std::span<const double> sigma_nm, std::span<double> into) noexcept;
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
  JointVector hidden_nm_{}, rubbing_{};
  State state_;
};

}  // namespace tauext
