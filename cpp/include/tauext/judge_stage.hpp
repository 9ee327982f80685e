// A sample after the network has spoken: external torque and its standard error, drift, unfamiliar motion, limits, alarm.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/alarm.hpp"
#include "tauext/contact_errors.hpp"
#include "tauext/coverage.hpp"
#include "tauext/drift.hpp"
#include "tauext/drift_history.hpp"
#include "tauext/error_scale.hpp"
#include "tauext/expected_load.hpp"
#include "tauext/friction_factors.hpp"
#include "tauext/load.hpp"
#include "tauext/observe_stage.hpp"
#include "tauext/sample.hpp"
#include "tauext/touch_kind.hpp"
#include "tauext/types.hpp"

namespace tauext {

// What the chain says of one sample. A torque that does not exist is NaN: tau_ext, sigma, network, uncertainty and margin
// exist where health is ok or stale, or kTorqueSaturated is all that is or was wrong.
struct Estimate {
  std::int64_t t_ns = 0;            // stamp of the sample
  int joints = 0;                   // of the vectors below, so many numbers count
  Health health = Health::warming_up;  // whether torques can be trusted
  std::uint32_t causes = 0;         // bits of Cause
  int cause_joint = -1;             // the first joint that a cause concerns
  Alarm alarm = Alarm::none;        // latched
  Alarm held_alarm = Alarm::none;   // what some joint is over at this sample, its hold time past; no latch
  int alarm_joint = -1;             // that raised the alarm to its level
  std::int64_t alarm_t_ns = 0;      // when it did
  Touch touch = Touch::none;        // what kind of touch the alarm is, as known after the sample before this one
  bool detection = false;           // some |tau_ext| over its collision limit, at this sample
  std::uint32_t near_stiction = 0;  // a bit a joint: which of its limits holds
  std::uint32_t drift_saturated = 0;  // a bit a joint: its drift is at the bound, and training anew is due
  double unfamiliar = 0;            // how far the motion is from all that training saw, 0 to 1; 0 without a coverage
  Unseen unseen = Unseen::nothing;  // what of it is farthest, ...
  int unseen_joint = -1, unseen_other = -1;  // ... of this joint, together with the other one where positions are
  JointVector residual{};           // r of the observer, [N m]
  JointVector prior{};              // what physics expects of r in free motion, [N m]
  JointVector network{};            // what the network expects beside it, [N m]; 0 without one
  JointVector drift{};              // what the tracker has learned since, [N m]; 0 without one
  JointVector uncertainty{};        // r expected in free motion: prior + network + drift, [N m]
  JointVector tau_ext{};            // residual - uncertainty, [N m]
  JointVector doubt{};              // how far the prior may be off while presliding states are unknown, and the torques of a
                                    // load because it is not known exactly, [N m]
  JointVector sigma_nm{};           // standard error of tau_ext in free motion, doubt included, [N m]; NaN without an error scale
  JointVector contact_sigma_nm{};   // the same while something touches the arm and after it (contact_errors.hpp)
  JointVector limit_scale{};        // what the motion multiplies the limits by, unfamiliar motion too; usual is 1
  JointVector limit_nm{};           // that |tau_ext| must exceed for a collision; scale and doubt included
  JointVector contact_limit_nm{};   // the same for a contact
  JointVector margin_nm{};          // limit - |tau_ext - load_nm|
  Load load;                        // what the arm is taken to carry; mass 0: nothing
  LoadPhase load_phase = LoadPhase::none;  // of a load that is expected
  std::int64_t load_found_ns = 0;   // sample at which the last one that was expected was found; 0: none
  double load_error_kg = 0;         // standard error of its mass
  JointVector load_nm{};            // what of tau_ext is taken for a load that is expected, [N m]; 0 while none is

  // The only thing that may be read as "no collision".
  bool clear() const noexcept { return health == Health::ok && alarm == Alarm::none; }
};

// Second half of the chain: from what was observed, and the network's answer, to the estimate.
class JudgeStage {
 public:
  static constexpr double kUnfamiliarWidens = 0.5;  // share of a limit by which wholly unfamiliar motion raises it

  // Of a bundle that holds together.
  explicit JudgeStage(const Bundle& bundle);

  // network: its outputs for the window that ends at this sample, in its own scale; empty where there is no network, and
  // not looked at unless the sample is to be judged.
  // sample: the one observed; only that of one that entered is looked at.
  // expected: a load that is, or none; it decides what of tau_ext is looked at.
  const Estimate& step(const Observed& observed, const Sample& sample, std::span<const float> network,
                       ExpectedLoad* expected = nullptr) noexcept;

  // What need not be done before the answer is out: what kind of touch it is.
  void advance() noexcept;

  // As AlarmStage's calls of these names.
  void acknowledge() noexcept;
  void raise(Alarm alarm, int joint) noexcept {
    alarm_.raise(alarm, joint, estimate_.t_ns);
    report_alarm();
  }
  const AlarmStage& alarm() const noexcept { return alarm_; }
  void forget_pushes() noexcept { alarm_.forget_pushes(); }
  bool set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept {
    return alarm_.set_factors(collision, contact);
  }
  const LimitFactors& limit_factors() const noexcept { return alarm_.factors(); }
  // The load that the next sample is seen with.
  void set_load(const Load& load) noexcept {
    estimate_.load = load;
    factors_.forget_strokes();
  }
  // Allocates: from here on keep() keeps what the trackers of drift know, once a second of the samples' time.
  void allow_loads() { history_.begin(); }
  void keep(std::int64_t t_ns) noexcept { history_.keep(t_ns, drift_, factors_); }
  // Drift is what it was then, as far as that is kept.
  void take_back_drift(std::int64_t since_ns) noexcept { history_.go_back(since_ns, drift_, factors_); }
  // Limits are higher by at_rest + per_speed |dq| of each joint, [N m] and [N m s/rad] >= 0, from the next sample on until
  // they are told otherwise. No part of the state.
  void widen_limits(const JointVector& at_rest_nm, const JointVector& per_speed) noexcept {
    widened_at_rest_nm_ = at_rest_nm;
    widened_per_speed_ = per_speed;
  }
  // The trackers of drift learn nothing while this holds; what they know is still taken off. No part of the state.
  void hold_drift(bool hold) noexcept { drift_held_ = hold; }
  const Estimate& last() const noexcept { return estimate_; }  // of the last sample
  const ErrorScale& error_scale() const noexcept { return scale_; }  // as it stands there
  // As newly made.
  void reset() noexcept;

  // Of a sample that advance() has not looked at yet.
  struct Pending {
    bool waits = false;
    JointVector q{}, dq{};
  };
  struct State {
    AlarmStage::State alarm;
    LimitFactors factors;
    DriftTracker::State drift;
    FrictionFactors::State factors_of_friction;
    ErrorScale::State scale;
    ContactErrors::State contact_errors;
    Coverage::State coverage;
    TouchKind::State touch;
    Pending pending;
    Estimate estimate;
  };
  // All that it remembers; restore() goes on from there, in a stage of the same bundle.
  State state() const noexcept {
    return {alarm_.state(),          alarm_.factors(),  drift_.state(), factors_.state(), scale_.state(),
            contact_errors_.state(), coverage_.state(), touch_.state(), pending_,         estimate_};
  }
  void restore(const State& state) noexcept;

 private:
  void judge(const Observed& observed, const Sample& sample, std::span<const float> network, ExpectedLoad* expected) noexcept;
  void hold_alarm(const Observed& observed, const Sample& sample, const JointVector& raised, ExpectedLoad& expected) noexcept;
  void scale_limits(const Observed& observed, const Sample& sample) noexcept;
  void tell(const Unfamiliar& unfamiliar) noexcept;
  void blank(bool also_residual) noexcept;
  void report_alarm() noexcept;
  std::span<double> first_joints(JointVector& values) const noexcept {
    return std::span(values).first(static_cast<std::size_t>(estimate_.joints));
  }

  std::vector<double> output_scale_nm_;
  std::uint32_t other_units_ = 0;  // a bit a joint: it does not answer in N m, and nobody knows what a load shows there
  AlarmStage alarm_;
  DriftTracker drift_;
  FrictionFactors factors_;
  DriftHistory history_;
  ErrorScale scale_;
  ContactErrors contact_errors_;
  Coverage coverage_;
  TouchKind touch_;
  Pending pending_;
  Estimate estimate_;
  JointVector widened_at_rest_nm_{}, widened_per_speed_{};
  bool drift_held_ = false;
};

}  // namespace tauext
