#include "tauext/signal_watch.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {

void SignalRanges::validate(int joints) const {
  const auto expect = [&](const char* what, const std::vector<double>& values, bool may_be_infinite) {
    if (static_cast<int>(values.size()) != joints)
      throw Error(std::string("signals.") + what + " has " + std::to_string(values.size()) + " values where " +
                  std::to_string(joints) + " belong");
    for (double value : values)
      if (!(value > 0) || (!may_be_infinite && !std::isfinite(value)))
        throw Error(std::string("signals.") + what + " = " + to_text(value) + " must be > 0");
  };
  expect("torque_limit_nm", torque_limit_nm, true);
  expect("largest_torque_nm", largest_torque_nm, false);
}

SignalWatch::SignalWatch(int joints, std::int64_t sample_period_ns, const SignalRanges& ranges)
    : joints_(joints), sample_period_ns_(static_cast<double>(sample_period_ns)), ranges_(ranges) {
  ranges.validate(joints);
}

// The step since the last sample, [ns]; enters the mean.
double SignalWatch::take_step(std::int64_t t_ns) noexcept {
  if (!state_.started) return sample_period_ns_;
  const double step_ns = static_cast<double>(elapsed_ns(t_ns, state_.t_ns));
  state_.t_ns = t_ns;
  const double step = std::min(step_ns / sample_period_ns_, 2.0);
  state_.steps += (step - state_.steps) * std::min(sample_period_ns_ * 1e-9, 0.1);
  return step_ns;
}

void SignalWatch::pass(std::int64_t t_ns) noexcept {
  if (state_.started && t_ns > state_.t_ns) take_step(t_ns);
}

SignalWatch::Verdict SignalWatch::step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                                       std::span<const double> tau) noexcept {
  Verdict verdict;
  const double step_ns = take_step(t_ns);
  const bool anew = !state_.started || step_ns > kLongestStep * sample_period_ns_;
  verdict.wrong_rate = std::fabs(state_.steps - 1.0) > kRateTolerance;
  for (int j = 0; j < joints_; ++j) {
    if (verdict.saturated_joint < 0 && std::fabs(tau[j]) >= kSaturated * ranges_.torque_limit_nm[j])
      verdict.saturated_joint = j;
    if (anew || q[j] != state_.q[j]) {
      state_.q[j] = q[j];
      state_.since_ns[j] = t_ns;
      state_.travel[j] = 0;
      state_.tau_low[j] = state_.tau_high[j] = tau[j];
      continue;
    }
    state_.travel[j] += dq[j] * step_ns * 1e-9;
    state_.tau_low[j] = std::min(state_.tau_low[j], tau[j]);
    state_.tau_high[j] = std::max(state_.tau_high[j], tau[j]);
    const bool still = static_cast<double>(elapsed_ns(t_ns, state_.since_ns[j])) >= kStillForS * 1e9;
    if (still && verdict.still_joint < 0 &&
        (std::fabs(state_.travel[j]) > kStillTravelRad ||
         state_.tau_high[j] - state_.tau_low[j] > ranges_.largest_torque_nm[j]))
      verdict.still_joint = j;
  }
  state_.started = true;
  state_.t_ns = t_ns;
  return verdict;
}

}  // namespace tauext
