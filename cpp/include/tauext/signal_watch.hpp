// Looks for signals that no arm sends: a wrong rate, a drive at its limit, an encoder that stands still.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/types.hpp"

namespace tauext {

// What the watch must know of the arm's signals; a value for each joint.
struct SignalRanges {
  std::vector<double> torque_limit_nm;    // the drive gives no more, [N m]; infinite where unknown
  std::vector<double> largest_torque_nm;  // largest |tau_m| in training, [N m]; > 0

  // Throws Error, naming what does not fit.
  void validate(int joints) const;
};

class SignalWatch {
 public:
  static constexpr double kRateTolerance = 0.05;        // of the sample period, over an exponential second
  static constexpr double kSaturated = 0.999;           // of the torque limit
  static constexpr double kStillForS = 0.1;             // an encoder may stand still for so long whatever else it says
  static constexpr double kStillTravelRad = 0.05;       // travel that dq claims while q does not change

  static constexpr double kLongestStep = 20;

  struct Verdict {
    bool wrong_rate = false;
    int saturated_joint = -1;  // first one whose |tau_m| is at its limit
    int still_joint = -1;      // first one whose position stands still while velocity or torque say otherwise
  };
  struct State {
    bool started = false;
    std::int64_t t_ns = 0;
    double steps = 1.0;  // mean step in sample periods
    JointVector q{};                        // position since ...
    std::array<std::int64_t, kMaxJoints> since_ns{};  // ... then,
    JointVector travel{}, tau_low{}, tau_high{};      // and what dq and tau_m did meanwhile
  };

  // Throws Error where the ranges do not fit the joints.
  SignalWatch(int joints, std::int64_t sample_period_ns, const SignalRanges& ranges);

  // One sample with finite values.
  // Rate: the mean step, over an exponential second, differs from the sample period by more than kRateTolerance; a
  // step counts as two periods at most, so that a bridged gap is no other rate.
  // Still: q has not changed by a bit for kStillForS, while the integral of dq passed kStillTravelRad, or tau_m moved
  // by more than the largest torque of training: no gear is so stiff. A resting arm does neither. After a step of more
  // than kLongestStep sample periods nobody knows what happened meanwhile, and positions begin anew.
  Verdict step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
               std::span<const double> tau) noexcept;
  // A sample whose values cannot be used came in time all the same.
  void pass(std::int64_t t_ns) noexcept;
  void reset() noexcept { state_ = {}; }

  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  double take_step(std::int64_t t_ns) noexcept;

  int joints_;
  double sample_period_ns_;
  SignalRanges ranges_;
  State state_;
};

}  // namespace tauext
