// Second half of the chain: external torque with standard error, drift, unfamiliar motion, limits, alarm.
#pragma once
#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "alarm/alarm.hpp"
#include "alarm/contact_errors.hpp"
#include "alarm/coverage.hpp"
#include "alarm/drift.hpp"
#include "alarm/error_scale.hpp"
#include "load/expected_load.hpp"
#include "stages/observe_stage.hpp"
#include "tauext/estimate.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"
#include "touch/declared_contacts.hpp"
#include "touch/touch_kind.hpp"

namespace tauext {

// Computes the estimate from an observed sample and the network's output.
class JudgeStage {
 public:
  static constexpr double kUnfamiliarWidens = 0.5;  // share of a limit by which wholly unfamiliar motion raises it

  // The bundle must be valid.
  explicit JudgeStage(const Bundle& bundle);

  // network: outputs for the window that ends at this sample, in the network's scale. Empty without a network. Read
  // only if the sample is judged.
  // sample: the observed sample; read only if it entered the chain.
  // expected: the expected load, or null; contacts: the declared contacts, or null. Their torques are subtracted from tau_ext
  // before the limits are checked.
  const Estimate& step(const Observed& observed, const Sample& sample, std::span<const float> network,
                       ExpectedLoad* expected = nullptr, DeclaredContacts* contacts = nullptr) noexcept;

  // Classifies the touch; may run after the estimate was returned. q, dq: of the last sample that entered.
  void advance(std::span<const double> q, std::span<const double> dq) noexcept;

  // See AlarmStage.
  void acknowledge() noexcept;
  void raise(Alarm alarm, int joint) noexcept {
    alarm_.raise(alarm, joint, estimate_.t_ns);
    report_alarm();
  }
  const AlarmStage& alarm() const noexcept { return alarm_; }
  const ContactErrors& contact_errors() const noexcept { return contact_errors_; }
  void count_alarms_from(std::uint32_t number) noexcept {
    alarm_.count_from(number);
    report_alarm();
  }
  void forget_pushes() noexcept { alarm_.forget_pushes(); }
  bool set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept {
    return alarm_.set_factors(collision, contact);
  }
  const LimitFactors& limit_factors() const noexcept { return alarm_.factors(); }
  // Sets the load that the estimate reports from the next sample on.
  void set_load(const Load& load) noexcept {
    estimate_.load = load;
    factors_.forget_strokes();
  }
  // Allocates. From here on keep() stores the state of the drift trackers once per second of sample time.
  void allow_loads() { history_.begin(); }
  void keep(std::int64_t t_ns) noexcept { history_.keep(t_ns, drift_, factors_); }
  // Restores the drift as stored at that time, if the history reaches back so far.
  void take_back_drift(std::int64_t since_ns) noexcept { history_.go_back(since_ns, drift_, factors_); }
  // Raises each joint's limits by at_rest + per_speed |dq|, [N m] and [N m s/rad] >= 0, from the next sample until the
  // next call. Not part of the state.
  void widen_limits(const JointVector& at_rest_nm, const JointVector& per_speed) noexcept {
    widened_at_rest_nm_ = at_rest_nm;
    widened_per_speed_ = per_speed;
  }
  // While true, the drift trackers learn nothing; the learned drift is still subtracted. Not part of the state.
  void hold_drift(bool hold) noexcept { drift_held_ = hold; }
  const Estimate& last() const noexcept { return estimate_; }  // of the last sample
  // Back to the state after construction.
  void reset() noexcept;

  // What a stage of another bundle for the same arm can continue from; see Monitor::carry().
  struct Carried {
    DriftTracker::Terms drift;
    FrictionFactors::Learned factors_of_friction;
    LimitFactors factors;
    AlarmStage::State alarm;
    TouchKind::State touch;
  };
  Carried carried() const noexcept {
    return {drift_.state().coefficients, factors_.learned(), alarm_.factors(), alarm_.state(), touch_.state()};
  }
  void carry_drift(const Carried& carried) noexcept {
    drift_.put_coefficients(carried.drift);
    factors_.put_learned(carried.factors_of_friction);
  }
  void carry_alarm(const Carried& carried) noexcept {
    alarm_.take_over(carried.alarm);
    touch_.restore(carried.touch);
    report_alarm();
  }

  struct State {
    AlarmStage::State alarm;
    LimitFactors factors;
    DriftTracker::State drift;
    FrictionFactors::State factors_of_friction;
    ErrorScale::State scale;
    ContactErrors::State contact_errors;
    Coverage::State coverage;
    TouchKind::State touch;
    bool waits;  // advance() has not processed the last sample yet
    Estimate estimate;
  };
  // Complete state; restore() continues from it in a stage of the same bundle.
  State state() const noexcept {
    return {alarm_.state(),          alarm_.factors(),  drift_.state(), factors_.state(), scale_.state(),
            contact_errors_.state(), coverage_.state(), touch_.state(), waits_,           estimate_};
  }
  void restore(const State& state) noexcept;

 private:
  void judge(const Observed& observed, const Sample& sample, std::span<const float> network, ExpectedLoad* expected,
             DeclaredContacts* contacts) noexcept;
  bool judge_rest(const Observed& observed, const Sample& sample, const JointVector& raised, ExpectedLoad* expected,
                  DeclaredContacts* contacts) noexcept;
  void explain_load(const Observed& observed, const Sample& sample, JointVector& raised, ExpectedLoad& expected) noexcept;
  JointVector undeclared() const noexcept;
  JointVector unexplained() const noexcept;
  void scale_limits(const Observed& observed, const Sample& sample) noexcept;
  void report_unfamiliar(const Unfamiliar& unfamiliar) noexcept;
  void blank(bool also_residual) noexcept;
  void report_alarm() noexcept;
  void forget_explained() noexcept;
  std::span<double> first_joints(JointVector& values) const noexcept {
    return std::span(values).first(static_cast<std::size_t>(estimate_.joints));
  }

  std::vector<double> output_scale_nm_;
  std::uint32_t other_units_ = 0;  // one bit per joint whose torque is not in N m: load torques are unknown there
  AlarmStage alarm_;
  DriftTracker drift_;
  FrictionFactors factors_;
  DriftHistory history_;
  ErrorScale scale_;
  ContactErrors contact_errors_;
  Coverage coverage_;
  TouchKind touch_;
  bool waits_ = false;
  bool explained_ = true;  // load_nm or declared_* of the estimate may not be 0
  Estimate estimate_;
  JointVector widened_at_rest_nm_{}, widened_per_speed_{};
  bool drift_held_ = false;
};

}  // namespace tauext
