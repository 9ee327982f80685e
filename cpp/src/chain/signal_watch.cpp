#include "chain/signal_watch.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "chain/motion.hpp"
#include "tauext/sample.hpp"

namespace tauext {

SignalWatch::SignalWatch(int joints, std::int64_t sample_period_ns, int network_stride, const SignalRanges& ranges,
                         bool behind_gear)
    : joints_(joints),
      sample_period_ns_(static_cast<double>(sample_period_ns)),
      bridged_ns_(sample_period_ns_ * longest_bridged(sample_period_ns, network_stride)),
      ranges_(ranges),
      still_share_(behind_gear ? std::numeric_limits<double>::infinity() : 1.0) {
  ranges.validate(joints);
  constexpr double most = std::numeric_limits<double>::max();
  for (std::size_t j = 0; j < static_cast<std::size_t>(joints); ++j) {
    torque_[j] = std::min(ranges.possible_torque_nm[j], most);
    speed_[j] = std::min(ranges.possible_speed_rad_s[j], most);
  }
}

Impossible SignalWatch::check(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                              std::span<const double> tau, bool follows) const noexcept {
  follows = follows && state_.started;
  // Counts how long a position changed with every sample; explain() covers the other cases.
  const double since_s = follows ? 1e-9 * (static_cast<double>(elapsed_ns(t_ns, state_.t_ns)) + sample_period_ns_)
                                 : std::numeric_limits<double>::infinity();
  const auto within = [](double value, double most) { return static_cast<unsigned>(std::fabs(value) <= most); };
  unsigned possible = 1;
  for (int j = 0; j < joints_; ++j)  // no branches
    possible &= within(q[j], kFarthest) & within(dq[j], speed_[j]) & within(tau[j], torque_[j]) &
                within(q[j] - state_.joints[static_cast<std::size_t>(j)].q, speed_[j] * since_s + kEncoderRad);
  return possible ? Impossible{} : explain(t_ns, q, dq, tau, follows);
}

Impossible SignalWatch::explain(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                                std::span<const double> tau, bool follows) const noexcept {
  for (int j = 0; j < joints_; ++j) {
    const auto found = [&](Cause cause) noexcept { return Impossible{cause, j}; };
    if (!std::isfinite(q[j]) || !std::isfinite(dq[j]) || !std::isfinite(tau[j])) return found(kNotFinite);
    if (std::fabs(tau[j]) > torque_[j]) return found(kImpossibleTorque);
    if (std::fabs(dq[j]) > speed_[j]) return found(kImpossibleVelocity);
    if (std::fabs(q[j]) > kFarthest) return found(kImpossiblePosition);
    if (!follows) continue;
    const State::Joint& last = state_.joints[static_cast<std::size_t>(j)];
    const double held_ns = static_cast<double>(elapsed_ns(t_ns, last.since_ns));
    const double step_ns = static_cast<double>(elapsed_ns(t_ns, state_.t_ns));
    const double time_ns = std::max(step_ns, std::min(held_ns, bridged_ns_)) + sample_period_ns_;
    if (std::fabs(q[j] - last.q) > speed_[j] * (1e-9 * time_ns) + kEncoderRad) return found(kImpossiblePosition);
  }
  return {};
}

// Returns the step since the last sample, [ns], and updates the mean step.
double SignalWatch::take_step(std::int64_t t_ns, std::int64_t ticks) noexcept {
  if (!state_.started) return sample_period_ns_;
  const double step_ns = static_cast<double>(elapsed_ns(t_ns, state_.t_ns));
  state_.t_ns = t_ns;
  double step = step_ns / sample_period_ns_;
  step = ticks >= 2 && step >= kGap ? step / std::round(step) + kLost : std::min(step, 2.0);
  state_.steps += (step - state_.steps) * std::min(sample_period_ns_ * 1e-9, 0.1);
  return step_ns;
}

void SignalWatch::pass(std::int64_t t_ns) noexcept {
  if (state_.started && t_ns > state_.t_ns) take_step(t_ns, 1);
}

SignalWatch::Verdict SignalWatch::step(std::int64_t t_ns, std::int64_t ticks, std::span<const double> q,
                                       std::span<const double> dq, std::span<const double> tau) noexcept {
  Verdict verdict;
  const double step_ns = take_step(t_ns, ticks);
  const bool anew = !state_.started || step_ns > kLongestStep * sample_period_ns_;
  verdict.wrong_rate = std::fabs(state_.steps - 1.0) > ranges_.rate_tolerance;
  for (int j = 0; j < joints_; ++j) {
    if (verdict.saturated_joint < 0 && std::fabs(tau[j]) >= kSaturated * ranges_.torque_limit_nm[j])
      verdict.saturated_joint = j;
    State::Joint& last = state_.joints[static_cast<std::size_t>(j)];
    if (anew || q[j] != last.q) {
      last = {q[j], t_ns, 0, tau[j], tau[j]};
      continue;
    }
    last.travel += dq[j] * step_ns * 1e-9;
    last.tau_low = std::min(last.tau_low, tau[j]);
    last.tau_high = std::max(last.tau_high, tau[j]);
    const bool still = static_cast<double>(elapsed_ns(t_ns, last.since_ns)) >= kStillForS * 1e9;
    if (still && verdict.still_joint < 0 &&
        (std::fabs(last.travel) > kStillTravelRad ||
         last.tau_high - last.tau_low > still_share_ * ranges_.largest_torque_nm[j]))
      verdict.still_joint = j;
  }
  state_.started = true;
  state_.t_ns = t_ns;
  return verdict;
}

}  // namespace tauext
