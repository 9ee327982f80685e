#include "stages/judge_stage.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "tauext/bundle.hpp"

namespace tauext {
namespace {

// The prior's error is uniform within +-doubt: its standard error is doubt / sqrt(3).
double with_doubt(double sigma_nm, double doubt_nm) noexcept {
  if (!(doubt_nm > 0)) return sigma_nm;
  const double square = sigma_nm * sigma_nm + doubt_nm * doubt_nm / 3;
  return square < 1e300 ? std::sqrt(square) : std::hypot(sigma_nm, doubt_nm / std::sqrt(3.0));  // hypot is slow
}

}  // namespace

JudgeStage::JudgeStage(const Bundle& bundle)
    : output_scale_nm_(bundle.output_scale_nm),
      alarm_(bundle.joints(), static_cast<int>(bundle.prior.widths_rad.size()), bundle.limits),
      drift_(bundle.drift, bundle.limits, bundle.joints(), bundle.observer.gain_per_s),
      factors_(bundle.drift.on() && bundle.error_scale.on() ? bundle.drift.friction_share : 0.0, bundle.joints(), bundle.observer.gain_per_s),
      scale_(bundle.error_scale, bundle.joints(), bundle.observer.gain_per_s),
      contact_errors_(bundle),
      coverage_(bundle.joints(), bundle.coverage, bundle.observer.slowest_per_s()),
      touch_(bundle) {
  estimate_.joints = bundle.joints();
  for (int j = 0; j < bundle.joints(); ++j)
    if (!bundle.in_newtons(j)) other_units_ |= std::uint32_t{1} << j;
  reset();
}

void JudgeStage::reset() noexcept {
  alarm_.reset();
  alarm_.restore_factors({});
  widen_limits({}, {});
  hold_drift(false);
  drift_.reset();
  factors_.reset();
  history_.clear();
  scale_.reset();
  contact_errors_.reset();
  coverage_.reset();
  touch_.reset();
  waits_ = false;
  explained_ = true;
  const int joints = estimate_.joints;
  estimate_ = {};
  estimate_.joints = joints;
  blank(true);
}

void JudgeStage::restore(const State& state) noexcept {
  alarm_.restore(state.alarm);
  alarm_.restore_factors(state.factors);
  drift_.restore(state.drift);
  factors_.restore(state.factors_of_friction);
  history_.clear();
  scale_.restore(state.scale);
  contact_errors_.restore(state.contact_errors);
  coverage_.restore(state.coverage);
  touch_.restore(state.touch);
  waits_ = state.waits;
  explained_ = true;
  estimate_ = state.estimate;
}

void JudgeStage::acknowledge() noexcept {
  alarm_.acknowledge();
  report_alarm();
}

void JudgeStage::report_alarm() noexcept {
  const AlarmStage::State& alarm = alarm_.state();
  estimate_.alarm = alarm.alarm;
  estimate_.held_alarm = alarm.held_alarm;
  estimate_.alarm_joint = alarm.joint;
  estimate_.alarm_t_ns = alarm.raised_t_ns;
  estimate_.alarm_number = alarm.number;
  estimate_.touch_t_ns = alarm.touch_t_ns;
  estimate_.touch_over = alarm.alarm == Alarm::none || alarm.touch_over;
  estimate_.touch = alarm.alarm == Alarm::none          ? Touch::none
                    : touch_.kind() == Touch::none ? Touch::unknown
                                                   : touch_.kind();
}

void JudgeStage::advance(std::span<const double> q, std::span<const double> dq) noexcept {
  if (!waits_) return;
  waits_ = false;
  const auto n = static_cast<std::size_t>(estimate_.joints);
  const JointVector left = unexplained();
  const bool raised = estimate_.alarm != Alarm::none && estimate_.alarm_t_ns == estimate_.t_ns;
  touch_.step({estimate_.t_ns, q, dq, std::span(left).first(n),
               std::span(estimate_.limit_nm).first(n), raised || estimate_.held_alarm != Alarm::none,
               estimate_.alarm != Alarm::none});
}

void JudgeStage::blank(bool also_residual) noexcept {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  Estimate& e = estimate_;
  for (int j = 0; j < e.joints; ++j) {
    e.network[j] = e.uncertainty[j] = e.tau_ext[j] = e.sigma_nm[j] = e.contact_sigma_nm[j] = e.margin_nm[j] = nan;
    if (also_residual) e.residual[j] = e.prior[j] = e.drift[j] = e.limit_scale[j] = e.limit_nm[j] = e.contact_limit_nm[j] = nan;
  }
  forget_explained();
  if (also_residual) e.near_stiction = 0;
  e.detection = false;
}

// No torque is explained by a load or a declared contact.
void JudgeStage::forget_explained() noexcept {
  if (!explained_) return;
  explained_ = false;
  Estimate& e = estimate_;
  std::fill_n(e.load_nm.begin(), e.joints, 0.0);
  std::fill_n(e.declared_nm.begin(), e.joints, 0.0);
  e.declared = Declared::none;
  e.declared_contact = -1;
  e.declared_size = e.declared_sigma = e.declared_moment_nm = e.declared_travel_m = 0;
}

// tau_ext without what declared contacts explain, and without what a load explains either; only the first `joints` entries are
// set.
JointVector JudgeStage::undeclared() const noexcept {
  JointVector left;
  for (int j = 0; j < estimate_.joints; ++j) left[j] = estimate_.tau_ext[j] - estimate_.declared_nm[j];
  return left;
}

JointVector JudgeStage::unexplained() const noexcept {
  JointVector left = undeclared();
  for (int j = 0; j < estimate_.joints; ++j) left[j] -= estimate_.load_nm[j];
  return left;
}

const Estimate& JudgeStage::step(const Observed& o, const Sample& sample, std::span<const float> network,
                                 ExpectedLoad* expected, DeclaredContacts* contacts) noexcept {
  Estimate& e = estimate_;
  e.t_ns = o.t_ns;
  e.health = o.health;
  e.causes = o.causes;
  e.cause_joint = o.cause_joint;
  if (o.passage == Passage::entered) {
    for (std::size_t j = 0; j < o.residual.size(); ++j) {
      e.residual[j] = o.residual[j];
      e.prior[j] = o.prior[j];
      e.doubt[j] = o.doubt[j];
      e.drift[j] = 0;
    }
    if (o.restarted) {
      drift_.restart();
      factors_.restart();
      scale_.restart();
      contact_errors_.reset();
      coverage_.reset();
      touch_.restart();
    }
    if (drift_.on()) drift_.step(o.t_ns, sample.dq, first_joints(e.drift));
    if (factors_.on()) factors_.step(o.t_ns, o.coulomb, o.viscous, first_joints(e.drift));
    judge(o, sample, network, expected, contacts);
  } else {  // the alarm stays unchanged
    e.detection = false;
    e.held_alarm = Alarm::none;
    if (o.passage == Passage::refused) {
      blank(true);
      report_unfamiliar({});
    }
  }
  if (expected) {
    e.load_phase = expected->phase();
    e.load_found_ns = expected->found_ns();
    e.load_error_kg = expected->error_kg();
  }
  return e;
}

// Scales the limits by the motion alone; the torque has no influence.
void JudgeStage::scale_limits(const Observed& o, const Sample& sample) noexcept {
  Estimate& e = estimate_;
  scale_.step(o.t_ns, sample.dq, o.near_stiction, first_joints(e.limit_scale), first_joints(e.sigma_nm));
  if (!coverage_.on()) return;
  report_unfamiliar(coverage_.step(o.t_ns, sample.q, sample.dq));
  for (int j = 0; j < e.joints; ++j) {
    e.limit_scale[j] *= 1 + kUnfamiliarWidens * e.unfamiliar;
    e.sigma_nm[j] *= 1 + kUnfamiliarWidens * e.unfamiliar;
  }
}

void JudgeStage::report_unfamiliar(const Unfamiliar& unfamiliar) noexcept {
  estimate_.unfamiliar = unfamiliar.share;
  estimate_.unseen = unfamiliar.what;
  estimate_.unseen_joint = unfamiliar.joint;
  estimate_.unseen_other = unfamiliar.other;
}

// Checks tau_ext against its limits.
void JudgeStage::judge(const Observed& o, const Sample& sample, std::span<const float> network, ExpectedLoad* expected,
                       DeclaredContacts* contacts) noexcept {
  Estimate& e = estimate_;
  JointVector of_motion;  // standard error by the motion alone; NaN without an estimate
  forget_explained();
  scale_limits(o, sample);
  if (o.judged) {
    for (int j = 0; j < e.joints; ++j) {
      const auto at = static_cast<std::size_t>(j);
      e.network[j] = network.empty() ? 0.0 : network_torque_nm(output_scale_nm_[at], network[at]);
      e.uncertainty[j] = e.prior[j] + e.network[j] + e.drift[j];
      e.tau_ext[j] = e.residual[j] - e.uncertainty[j];
      e.sigma_nm[j] = with_doubt(e.sigma_nm[j], e.doubt[j]);
    }
  } else {
    blank(o.overflowed);
  }
  std::copy_n(e.sigma_nm.begin(), e.joints, of_motion.begin());
  factors_.spread(first_joints(e.sigma_nm));
  JointVector raised;  // only the first `joints` entries are set
  for (int j = 0; j < e.joints; ++j)
    raised[j] = e.doubt[j] + widened_at_rest_nm_[j] + widened_per_speed_[j] * std::fabs(sample.dq[static_cast<std::size_t>(j)]);
  factors_.raise(sample.dq, first_joints(raised));
  e.near_stiction = o.near_stiction;
  const bool expects = expected && expected->on(), declares = contacts && contacts->any();
  bool pressed = false;
  if (expects || declares)
    pressed = judge_rest(o, sample, raised, expects ? expected : nullptr, declares ? contacts : nullptr);
  else
    e.detection = alarm_.step(o.t_ns, e.tau_ext, e.limit_scale, raised, e.near_stiction, o.judged, e.limit_nm,
                              e.contact_limit_nm);
  if (o.judged && scale_.on()) {
    const bool presses = declares && contacts->in_effect();
    const bool touched = pressed || presses || alarm_.state().held_alarm != Alarm::none || e.detection;
    contact_errors_.step(o.t_ns, e.near_stiction, touched, first_joints(e.tau_ext), first_joints(e.sigma_nm), o.memory_gap,
                         {o.coulomb, sample.tau}, first_joints(e.contact_sigma_nm), presses);
  } else {
    std::copy_n(e.sigma_nm.begin(), e.joints, e.contact_sigma_nm.begin());
    contact_errors_.skip();
  }
  // In motion outside the training data, the error comes from the prior and is not drift.
  const bool means = declares && contacts->in_effect();  // a contact that the task means is no free motion either
  const bool teaches = o.teaches && !expects && !means && e.unfamiliar < Coverage::kWorthReporting && !drift_held_;
  // With a load, joints in unknown units learn nothing either, like joints near stiction.
  const std::uint32_t silent = e.near_stiction | (e.load.mass > 0 ? other_units_ : 0);
  if (drift_.on()) drift_.learn(first_joints(e.tau_ext), first_joints(e.limit_scale), first_joints(e.doubt), silent, teaches);
  if (factors_.on()) factors_.learn(sample.dq, first_joints(e.tau_ext), first_joints(of_motion), first_joints(e.doubt), silent, teaches, drift_);
  e.drift_saturated = drift_.saturated() | factors_.saturated();
  for (int j = 0; o.judged && j < e.joints; ++j)
    e.margin_nm[j] = e.limit_nm[j] - std::fabs(e.tau_ext[j] - e.declared_nm[j] - e.load_nm[j]);
  report_alarm();
  waits_ = true;
}

// Checks what is left of tau_ext behind declared contacts and an expected load, each null: none is in effect. Returns whether a
// force acts at the frame of a contact.
bool JudgeStage::judge_rest(const Observed& o, const Sample& sample, const JointVector& raised, ExpectedLoad* expected,
                            DeclaredContacts* contacts) noexcept {
  Estimate& e = estimate_;
  explained_ = true;
  JointVector higher = raised, spread{};
  if (contacts) {
    contact_errors_.find_hidden(e.near_stiction, {o.coulomb, sample.tau});
    contacts->explain_joints(o, sample.q, contact_errors_, e);
  }
  if (expected) explain_load(o, sample, higher, *expected);
  const bool pressed = contacts && contacts->explain_frame(o, sample.q, contact_errors_, !expected, e, spread);
  e.detection = alarm_.step(o.t_ns, unexplained(), e.limit_scale, higher, e.near_stiction, o.judged, e.limit_nm,
                            e.contact_limit_nm, spread, pressed);
  if (expected) expected->follow(o.t_ns, undeclared(), e.limit_scale, raised, e.near_stiction, o.judged, alarm_);
  return pressed;
}

// The part of tau_ext that an expected load explains. Limits rise by the load model's usual relative error.
void JudgeStage::explain_load(const Observed& o, const Sample& sample, JointVector& raised, ExpectedLoad& expected) noexcept {
  Estimate& e = estimate_;
  JointVector higher = raised, left = undeclared();
  expected.explain(sample, o, first_joints(left), first_joints(e.limit_nm), first_joints(e.load_nm), first_joints(higher));
  for (int j = 0; j < e.joints; ++j) raised[j] = higher[j] + Load::kUsualError * std::fabs(e.load_nm[j]);
}

}  // namespace tauext
