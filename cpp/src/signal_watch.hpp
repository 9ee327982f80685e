// Looks for signals that no arm sends: values beyond all that joints and drives can do, a wrong rate, a drive at its
// limit, an encoder that stands still.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// A sample that no arm sends: why, and the first joint that shows it.
struct Impossible {
  std::uint32_t cause = 0;  // a bit of Cause: kNotFinite or kImpossible...; 0: it may be true
  int joint = -1;           // -1: none
};

// Watches the signals of an arm, sample after sample.
class SignalWatch {
 public:
  static constexpr double kGap = 1.75;                  // periods: a step so long may have lost samples
  static constexpr double kLost = 0.2;                  // periods that such a step adds to the mean
  static constexpr double kSaturated = 0.999;           // of the torque limit
  static constexpr double kStillForS = 0.1;             // an encoder may stand still for so long whatever else it says
  static constexpr double kStillTravelRad = 0.05;       // travel that dq claims while q does not change

  static constexpr double kLongestStep = 20;    // in sample periods: after a longer one positions begin anew
  static constexpr double kFarthest = 1e6;      // |q| that no encoder counts to, [rad or m]: 160,000 turns
  static constexpr double kEncoderRad = 0.005;  // of a step that is no travel: a few counts of a coarse encoder

  struct Verdict {
    bool wrong_rate = false;
    int saturated_joint = -1;  // first one whose |tau_m| is at its limit
    int still_joint = -1;      // first one whose position stands still while velocity or torque say otherwise
  };
  struct State {
    bool started = false;
    std::int64_t t_ns = 0;
    double steps = 1.0;  // mean step in sample periods
    struct Joint {
      double q = 0;               // position since ...
      std::int64_t since_ns = 0;  // ... then,
      double travel = 0, tau_low = 0, tau_high = 0;  // and what dq and tau_m did meanwhile
    };
    std::array<Joint, kMaxJoints> joints{};
  };

  // behind_gear: encoders count whole steps of the joints themselves, as a servo's does: one that something blocks stands
  // still whatever its drive does. Throws Error where the ranges do not fit the joints.
  SignalWatch(int joints, std::int64_t sample_period_ns, int network_stride, const SignalRanges& ranges,
              bool behind_gear = false);

  // Whether a sample cannot be true; looked at before it enters anything.
  // Position: it lies farther from the last one than possible_speed_rad_s goes in the time since that one changed, and a
  // sample period and kEncoderRad more: stamps jitter. A position may have been held so for as long as the clock bridges, as
  // samples that are missing are. Only where the sample follows the last one that step() saw: after a fault or a gap
  // positions begin anew, so that a zero that was moved costs one sample.
  Impossible look(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                  std::span<const double> tau, bool follows) const noexcept;

  // One sample with finite values; ticks of the SampleClock since the last one, 0 where the chain began anew.
  // Rate: the mean step, over an exponential second, differs from the sample period by more than rate_tolerance. A step of
  // kGap periods or more that the clock bridged, n of them, lost n - 1 samples; it counts as an nth of itself and kLost
  // more, so that one lost sample in ten is no other rate and half of them are. Any other step counts as two at most.
  // Still: q has not changed by a bit for kStillForS, while the integral of dq passed kStillTravelRad, or tau_m moved
  // by more than the largest torque of training: no gear is so stiff, but behind it. A resting arm does neither. After a step of more
  // than kLongestStep sample periods nobody knows what happened meanwhile, and positions begin anew.
  Verdict step(std::int64_t t_ns, std::int64_t ticks, std::span<const double> q, std::span<const double> dq,
               std::span<const double> tau) noexcept;
  // A sample whose values cannot be used came in time all the same.
  void pass(std::int64_t t_ns) noexcept;
  // As newly made.
  void reset() noexcept { state_ = {}; }

  // All that it remembers; restore() goes on from there, in another one of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  double take_step(std::int64_t t_ns, std::int64_t ticks) noexcept;
  Impossible explain(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                     std::span<const double> tau, bool follows) const noexcept;

  int joints_;
  double sample_period_ns_, bridged_ns_;
  SignalRanges ranges_;
  double still_share_;  // of the largest torque, that tau_m may move by while a position stands still
  JointVector torque_{}, speed_{};  // what is possible, finite: so that one comparison finds NaN and infinity too
  State state_;
};

}  // namespace tauext
