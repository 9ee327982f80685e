// Detects implausible signals: impossible values, a wrong sample rate, a saturated drive, a frozen encoder.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// An impossible sample: the cause and the first joint concerned.
struct Impossible {
  std::uint32_t cause = 0;  // a bit of Cause: kNotFinite or kImpossible...; 0: plausible
  int joint = -1;           // -1: none
};

// Watches the arm's signals, one sample at a time.
class SignalWatch {
 public:
  static constexpr double kGap = 1.75;                  // periods: a step this long may have lost samples
  static constexpr double kLost = 0.2;                  // periods that such a step adds to the mean
  static constexpr double kSaturated = 0.999;           // of the torque limit
  static constexpr double kStillForS = 0.1;  // an encoder may stand still this long, whatever the other signals
  static constexpr double kStillTravelRad = 0.05;       // integral of dq while q does not change

  static constexpr double kLongestStep = 20;    // in sample periods: a longer step restarts the position checks
  static constexpr double kFarthest = 1e6;      // |q| beyond any encoder's range, [rad or m]: 160,000 turns
  static constexpr double kEncoderRad = 0.005;  // step that is not travel: a few counts of a coarse encoder

  struct Verdict {
    bool wrong_rate = false;
    int saturated_joint = -1;  // first one whose |tau_m| is at its limit
    int still_joint = -1;      // first one whose position is constant although velocity or torque change
  };
  struct State {
    bool started = false;
    std::int64_t t_ns = 0;
    double steps = 1.0;  // mean step in sample periods
    struct Joint {
      double q = 0;               // position since since_ns
      std::int64_t since_ns = 0;
      double travel = 0, tau_low = 0, tau_high = 0;  // since then, from dq and tau_m
    };
    std::array<Joint, kMaxJoints> joints{};
  };

  // behind_gear: encoders count whole steps at the joint, as in a servo. A blocked joint then stands still whatever its
  // drive does. Throws Error if the ranges do not fit the joints.
  SignalWatch(int joints, std::int64_t sample_period_ns, int network_stride, const SignalRanges& ranges,
              bool behind_gear = false);

  // Whether a sample is impossible; called before the sample enters the chain.
  // Impossible position: farther from the last one than possible_speed_rad_s reaches since the last change, plus one
  // sample period and kEncoderRad for jitter. Applies for as long as the clock bridges gaps, and only to direct
  // successors of the last step(). After a fault or gap the check restarts, so a moved zero costs one sample.
  Impossible check(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                   std::span<const double> tau, bool follows) const noexcept;

  // Processes one sample with finite values. ticks: of the SampleClock since the last one; 0 after a restart.
  // Rate: the mean step (exponential, one second) differs from the sample period by more than rate_tolerance. A bridged
  // step of n >= kGap periods lost n - 1 samples and counts as step / n + kLost. So one lost sample in ten is accepted,
  // half is not. Other steps count as two at most.
  // Still: q is bit-equal for kStillForS while the integral of dq passes kStillTravelRad, or while tau_m changes by
  // more than training's largest torque. The torque test is off behind a gear. After a step above kLongestStep periods,
  // the check restarts.
  Verdict step(std::int64_t t_ns, std::int64_t ticks, std::span<const double> q, std::span<const double> dq,
               std::span<const double> tau) noexcept;
  // Records the arrival time of a sample whose values are unusable.
  void pass(std::int64_t t_ns) noexcept;
  // Back to the state after construction.
  void reset() noexcept { state_ = {}; }

  // Complete state; restore() continues from it in a watch of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  double take_step(std::int64_t t_ns, std::int64_t ticks) noexcept;
  Impossible explain(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                     std::span<const double> tau, bool follows) const noexcept;

  int joints_;
  double sample_period_ns_, bridged_ns_;
  SignalRanges ranges_;
  double still_share_;  // share of the largest torque by which tau_m may change while a position is constant
  JointVector torque_{}, speed_{};  // possible range, finite: one comparison rejects NaN and infinity too
  State state_;
};

}  // namespace tauext
