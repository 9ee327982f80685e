// From tau_ext to an alarm: limits, hold time, latch.
#pragma once
#include <array>
#include <cstdint>
#include <span>

#include "tauext/estimate.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Judges one sample after the other. Health is the caller's input: `trusted` states whether tau_ext is valid.
class AlarmStage {
 public:
  struct State {
    Alarm alarm = Alarm::none;       // latched: a collision stays until it is acknowledged
    Alarm held_alarm = Alarm::none;  // highest level exceeded at this sample, hold time passed; not latched
    int joint = -1;                  // the joint that raised the alarm to its level
    std::int64_t raised_t_ns = 0;    // time of that
    std::uint32_t number = 0;        // of the newest alarm; acknowledge() keeps it
    std::int64_t touch_t_ns = 0;     // last sample at which some joint was over a limit
    bool touch_over = false;         // within all limits, and known, for the release time of a contact
    // Since when a joint has been over its limit; the smallest integer while it is not.
    std::array<std::int64_t, kMaxJoints> collision_since_ns, contact_since_ns;
    std::int64_t contact_seen_ns = 0;  // last sample at which a touch was seen or could not be excluded
    std::uint32_t pushed = 0;          // one bit per joint: pushed while stuck, not slid since; its limits are
                                       // higher ...
    bool touching = false;             // ... unless some joint was over its limit at the last sample
    std::array<std::int64_t, kMaxJoints> stuck_t_ns{};  // last sample at which a pushed joint was stuck
  };

  // Throws Error if the limits do not fit the joints.
  AlarmStage(int joints, int widths, const Limits& limits);

  // Processes one sample. near_stiction has one bit per joint; scale multiplies the limits, doubt [N m] raises them.
  // Writes both limits of every joint [N m] and returns whether some |tau_ext| exceeds its collision limit. If trusted
  // is false, nothing is detected, hold times restart, and an alarm stays. spread_nm: error of what a declared contact
  // explains, independent of that of free motion: limit^2 grows by its square. pressed: such a contact presses the arm; joints
  // that are stuck meanwhile count as pushed once it does not.
  bool step(std::int64_t t_ns, const JointVector& tau_ext, const JointVector& scale, const JointVector& doubt,
            std::uint32_t near_stiction, bool trusted, JointVector& limit_nm, JointVector& contact_limit_nm,
            const JointVector& spread_nm = kNoSpread, bool pressed = false) noexcept;
  static constexpr JointVector kNoSpread{};

  // Clears alarm, hold times and pushed joints.
  void reset() noexcept;
  // Ends any alarm. If the cause persists, the alarm returns after its hold time.
  void acknowledge() noexcept;
  // Raises an alarm that was held back, for this joint; a higher alarm stays.
  void raise(Alarm alarm, int joint, std::int64_t t_ns) noexcept {
    if (alarm <= state_.alarm) return;
    rise(alarm, joint, t_ns);
    state_.contact_seen_ns = state_.touch_t_ns = t_ns;
    state_.touch_over = false;
  }
  // Numbers the next alarm by one more than this.
  void count_from(std::uint32_t number) noexcept { state_.number = number; }
  // Continues another stage's alarm, with the hold times of this one. Its touch is over once this stage has seen it.
  void take_over(const State& other) noexcept {
    const State own = state_;
    state_ = other;
    state_.held_alarm = own.held_alarm;
    state_.collision_since_ns = own.collision_since_ns;
    state_.contact_since_ns = own.contact_since_ns;
    state_.touch_over = false;
  }
  // Resets the limits of joints that were pushed while stuck: the prior's doubt covers them now.
  void forget_pushes() noexcept { state_.pushed = 0; }

  // Multiplies the bundle's limits by these factors from the next sample on. Returns false without a change unless
  // there is one factor per joint, each within LimitFactors' bounds.
  bool set_factors(std::span<const double> collision, std::span<const double> contact) noexcept;
  // Current factors. restore() leaves them unchanged.
  const LimitFactors& factors() const noexcept { return factors_; }
  void restore_factors(const LimitFactors& factors) noexcept { factors_ = factors; }

  // Complete state; restore() continues from it in a stage of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  void rise(Alarm alarm, int joint, std::int64_t t_ns) noexcept {
    state_.number += state_.alarm == Alarm::none;
    state_.alarm = alarm;
    state_.joint = joint;
    state_.raised_t_ns = t_ns;
  }

  int joints_;
  Limits limits_;
  std::uint64_t collision_hold_ns_, contact_hold_ns_, contact_release_ns_;
  LimitFactors factors_;  // kept by acknowledge()
  State state_;
};

}  // namespace tauext
