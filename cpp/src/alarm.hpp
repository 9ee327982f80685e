// From tau_ext to an alarm: limits, hold time, latch.
#pragma once
#include <array>
#include <cstdint>
#include <span>

#include "tauext/estimate.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Judges one sample after the other. Knows nothing of health: the caller says whether tau_ext can be trusted.
class AlarmStage {
 public:
  struct State {
    Alarm alarm = Alarm::none;       // latched: a collision stays until it is acknowledged
    Alarm held_alarm = Alarm::none;  // the level that some joint is over at this sample, its hold time past; no latch
    int joint = -1;                  // that raised the alarm to its level
    std::int64_t raised_t_ns = 0;    // when it did
    // A joint over its limit since then; the least number while it is not.
    std::array<std::int64_t, kMaxJoints> collision_since_ns, contact_since_ns;
    std::int64_t contact_seen_ns = 0;  // last sample that showed, or could not rule out, a contact
    std::uint32_t pushed = 0;          // a bit a joint: it was pushed while stuck, and has not slid since; its limits are
                                       // higher ...
    bool touching = false;             // ... unless some joint was over its limit at the last sample
    std::array<std::int64_t, kMaxJoints> stuck_t_ns{};  // last sample at which a pushed joint was stuck
  };

  // Throws Error where the limits do not fit the joints.
  AlarmStage(int joints, int widths, const Limits& limits);

  // One sample; near_stiction holds a bit a joint, scale multiplies the limits and doubt [N m] raises them. Writes the
  // collision and the contact limit of every joint [N m], all of that included, and returns whether some |tau_ext|
  // exceeds its collision limit (a detection). With trusted = false nothing is detected, what was held so far starts
  // anew, and a standing alarm stays: what cannot be seen has not gone.
  bool step(std::int64_t t_ns, const JointVector& tau_ext, const JointVector& scale, const JointVector& doubt,
            std::uint32_t near_stiction, bool trusted, JointVector& limit_nm, JointVector& contact_limit_nm) noexcept;

  // Nothing is over, and no joint has been pushed: as at the start.
  void reset() noexcept;
  // Ends any alarm; one whose cause lasts comes back after its hold time.
  void acknowledge() noexcept;
  // An alarm that was held back and is one after all, by this joint; a higher one stands.
  void raise(Alarm alarm, int joint, std::int64_t t_ns) noexcept {
    if (alarm <= state_.alarm) return;
    state_.alarm = alarm;
    state_.joint = joint;
    state_.raised_t_ns = state_.contact_seen_ns = t_ns;
  }
  // Limits of joints that were pushed while stuck are the usual ones again: what that left is known otherwise.
  void forget_pushes() noexcept { state_.pushed = 0; }

  // Limits are the bundle's times these from the next sample on. false, and nothing changed, unless there is one number
  // a joint, each within LimitFactors' bounds.
  bool set_factors(std::span<const double> collision, std::span<const double> contact) noexcept;
  // Those that hold now, and to go on with them: restore() leaves them alone.
  const LimitFactors& factors() const noexcept { return factors_; }
  void restore_factors(const LimitFactors& factors) noexcept { factors_ = factors; }

  // All that it remembers; restore() goes on from there, in another one of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  int joints_;
  Limits limits_;
  std::uint64_t collision_hold_ns_, contact_hold_ns_, contact_release_ns_;
  LimitFactors factors_;  // outlive acknowledge()
  State state_;
};

}  // namespace tauext
