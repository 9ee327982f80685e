// A sample after the network has spoken: external torque and its standard error, drift, unfamiliar motion, limits, alarm.
#pragma once
#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "alarm.hpp"
#include "coverage.hpp"
#include "drift.hpp"
#include "error_scale.hpp"
#include "expected_load.hpp"
#include "observe_stage.hpp"
#include "tauext/estimate.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"
#include "touch_kind.hpp"

namespace tauext {

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

  // What need not be done before the answer is out: what kind of touch it is. q, dq: of the last sample that entered.
  void advance(std::span<const double> q, std::span<const double> dq) noexcept;

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

  struct State {
    AlarmStage::State alarm;
    LimitFactors factors;
    DriftTracker::State drift;
    FrictionFactors::State factors_of_friction;
    ErrorScale::State scale;
    ContactErrors::State contact_errors;
    Coverage::State coverage;
    TouchKind::State touch;
    bool waits;  // advance() has not looked at the last sample yet
    Estimate estimate;
  };
  // All that it remembers; restore() goes on from there, in a stage of the same bundle.
  State state() const noexcept {
    return {alarm_.state(),          alarm_.factors(),  drift_.state(), factors_.state(), scale_.state(),
            contact_errors_.state(), coverage_.state(), touch_.state(), waits_,           estimate_};
  }
  void restore(const State& state) noexcept;

 private:
  void judge(const Observed& observed, const Sample& sample, std::span<const float> network, ExpectedLoad* expected) noexcept;
  void hold_alarm(const Observed& observed, const Sample& sample, const JointVector& raised, ExpectedLoad& expected) noexcept;
  void scale_limits(const Observed& observed, const Sample& sample) noexcept;
  void tell(const Unfamiliar& unfamiliar) noexcept;
  void blank(bool also_residual) noexcept;
  void report_alarm() noexcept;
  void forget_load_nm() noexcept { std::fill_n(estimate_.load_nm.begin(), estimate_.joints, 0.0); }
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
  bool waits_ = false;
  Estimate estimate_;
  JointVector widened_at_rest_nm_{}, widened_per_speed_{};
  bool drift_held_ = false;
};

}  // namespace tauext
