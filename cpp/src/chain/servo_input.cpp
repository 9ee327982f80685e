#include "tauext/servo_input.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

namespace tauext {
AdaptiveVelocity::AdaptiveVelocity(int steps, std::span<const double> count_rad)
    : steps_(steps), count_rad_(count_rad.begin(), count_rad.end()) {
  if (steps < 1 || steps > kMostSteps)
    throw Error("a velocity's window of " + std::to_string(steps) + " steps must have 1 to " + std::to_string(kMostSteps));
  if (count_rad.empty() || count_rad.size() > static_cast<std::size_t>(kMaxJoints))
    throw Error("velocities are of 1 to " + std::to_string(kMaxJoints) + " joints, not " + std::to_string(count_rad.size()));
  for (double count : count_rad_)
    if (!(count >= 0) || !std::isfinite(count)) throw Error("count_rad = " + to_text(count) + " must be >= 0 and finite");
  t_ns_.resize(static_cast<std::size_t>(steps) + 1);
  q_.resize(t_ns_.size() * count_rad_.size());
}

std::size_t AdaptiveVelocity::place(int back) const noexcept {
  const int size = steps_ + 1, at = newest_ - back;
  return static_cast<std::size_t>(at < 0 ? at + size : at);
}

void AdaptiveVelocity::step(std::int64_t t_ns, std::span<const double> q, std::int64_t gap_ns, std::span<double> dq) noexcept {
  if (filled_ > 0) {
    const std::int64_t last_ns = t_ns_[place(0)];
    if (t_ns <= last_ns || (gap_ns > 0 && elapsed_ns(t_ns, last_ns) > static_cast<std::uint64_t>(gap_ns))) filled_ = 0;
  }
  newest_ = newest_ == steps_ ? 0 : newest_ + 1;
  if (filled_ <= steps_) ++filled_;
  t_ns_[place(0)] = t_ns;
  for (std::size_t j = 0; j < count_rad_.size(); ++j) q_[place(0) * count_rad_.size() + j] = q[j];
  for (std::size_t j = 0; j < count_rad_.size(); ++j) dq[j] = filled_ > 1 ? slope(j) : 0.0;
}

// The longest window whose samples keep to the line between its ends; then the line of least squares through them.
double AdaptiveVelocity::slope(std::size_t joint) const noexcept {
  const std::size_t n = count_rad_.size();
  // A count's width, and what rounding of the positions may add to it.
  const double allowed = count_rad_[joint] * (1 + 1e-6);
  const std::int64_t now_ns = t_ns_[place(0)];
  const double q = q_[place(0) * n + joint];
  std::array<double, kMostSteps + 1> t, y;  // back from the newest sample, [s], [rad]
  t[0] = y[0] = 0;
  double sum_t = 0, sum_y = 0, sum_tt = 0, sum_ty = 0, best = 0;
  for (int i = 1; i < filled_; ++i) {
    const std::size_t at = place(i), k = static_cast<std::size_t>(i);
    t[k] = -elapsed_s(now_ns, t_ns_[at]);
    y[k] = q_[at * n + joint] - q;
    const double line = y[k] / t[k];
    for (std::size_t m = 1; m < k; ++m)
      if (std::fabs(y[m] - line * t[m]) > allowed) return best;
    if (i > 1 && count_rad_[joint] == 0) return best;
    sum_t += t[k];
    sum_y += y[k];
    sum_tt += t[k] * t[k];
    sum_ty += t[k] * y[k];
    const double count = i + 1.0;
    best = (count * sum_ty - sum_t * sum_y) / (count * sum_tt - sum_t * sum_t);
  }
  return best;
}

namespace {

constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();
constexpr double kSignCounts = 2;      // of the encoder, over which the sign of goal - position changes
constexpr double kLeastOff = 1e-9;     // [rad], where nothing is known of the encoder: 0 has no sign
constexpr double kLeastDuty = 1e-3;    // a count of the registers of duty
constexpr double kGapPeriods = 2.5;    // a longer pause restarts the velocity window

// The sign of a value, -1 to 1, that changes over +-width instead of at once.
double gentle_sign(double value, double width) noexcept { return value / std::max(std::fabs(value), width); }

double at(std::span<const double> values, std::size_t joint) noexcept { return joint < values.size() ? values[joint] : kUnknown; }

AdaptiveVelocity velocity(const ServoSettings& settings) {
  settings.validate();
  std::vector<double> counts;
  for (const ServoConstants& joint : settings.joints) counts.push_back(joint.count_rad);
  return AdaptiveVelocity(std::max(settings.velocity_steps, 1), counts);
}

}  // namespace

ServoInput::ServoInput(const ServoSettings& settings)
    : from_(settings.torque_from),
      derives_(settings.velocity_steps > 0),
      gap_ns_(std::llround(kGapPeriods * static_cast<double>(settings.sample_period_ns))),
      joints_(settings.joints),
      velocity_(velocity(settings)),
      delay_ns_(settings.goal_delay_ns) {
  if (delay_ns_ == 0) return;
  goals_ns_.resize(static_cast<std::size_t>(delay_ns_ / settings.sample_period_ns) + 2);
  goals_.resize(goals_ns_.size() * joints_.size());
}

void ServoInput::step(const ServoSample& sample) noexcept {
  const std::size_t n = joints_.size();
  bool finite = sample.q.size() == n;
  for (double q : sample.q) finite = finite && std::isfinite(q);
  if (!finite) {  // nothing of it may stay in a window
    reset();
    for (std::size_t j = 0; j < n; ++j) dq_[j] = tau_[j] = kUnknown;
    return;
  }
  if (derives_)
    velocity_.step(sample.t_ns, sample.q, gap_ns_, std::span(dq_).first(n));
  else
    for (std::size_t j = 0; j < n; ++j) dq_[j] = at(sample.dq, j);
  const std::span<const double> q_des = delay_ns_ > 0 ? delayed(sample) : sample.q_des;
  for (std::size_t j = 0; j < n; ++j) tau_[j] = torque(sample, q_des, j);
}

// The goals of delay_ns_ ago, on the line between two samples; the earliest that is known where none is so old.
std::span<const double> ServoInput::delayed(const ServoSample& sample) noexcept {
  const std::size_t n = joints_.size();
  if (sample.q_des.size() != n) {
    goals_filled_ = 0;
    return {};
  }
  const int size = static_cast<int>(goals_ns_.size());
  const auto place = [&](int back) {
    const int at = goals_newest_ - back;
    return static_cast<std::size_t>(at < 0 ? at + size : at);
  };
  if (goals_filled_ > 0) {
    const std::int64_t last_ns = goals_ns_[place(0)];
    if (sample.t_ns <= last_ns || elapsed_ns(sample.t_ns, last_ns) > static_cast<std::uint64_t>(gap_ns_)) goals_filled_ = 0;
  }
  goals_newest_ = goals_newest_ + 1 == size ? 0 : goals_newest_ + 1;
  goals_filled_ = std::min(goals_filled_ + 1, size);
  goals_ns_[place(0)] = sample.t_ns;
  std::copy(sample.q_des.begin(), sample.q_des.end(), goals_.begin() + static_cast<std::ptrdiff_t>(place(0) * n));
  const auto delay_ns = static_cast<std::uint64_t>(delay_ns_);
  int older = 0;
  while (older + 1 < goals_filled_ && elapsed_ns(sample.t_ns, goals_ns_[place(older)]) < delay_ns) ++older;
  const std::size_t from = place(older), to = place(std::max(older - 1, 0));
  const double age_ns = static_cast<double>(elapsed_ns(sample.t_ns, goals_ns_[from]));
  const double step_ns = static_cast<double>(elapsed_ns(goals_ns_[to], goals_ns_[from]));
  const double share = step_ns > 0 ? std::max(age_ns - static_cast<double>(delay_ns_), 0.0) / step_ns : 0.0;
  for (std::size_t j = 0; j < n; ++j) {
    const double before = goals_[from * n + j], after = goals_[to * n + j];
    goal_[j] = share > 0 ? before + share * (after - before) : before;
  }
  return {goal_.data(), n};
}

double ServoInput::torque(const ServoSample& sample, std::span<const double> q_des, std::size_t j) const noexcept {
  const ServoConstants& motor = joints_[j];
  if (from_ == TorqueFrom::torque) return at(sample.tau, j);
  if (from_ == TorqueFrom::phase_current) return motor.nm_per_ampere * at(sample.current, j);
  const double measured = at(sample.voltage, j), volts = measured > 0 ? measured : motor.volts;
  const double emf = motor.back_emf_v_s * dq_[j], off = at(q_des, j) - sample.q[j];
  double duty = at(sample.duty, j);
  if (from_ == TorqueFrom::goal) duty = std::clamp(motor.duty_per_rad * off, -motor.most_duty, motor.most_duty);
  if (from_ == TorqueFrom::supply_current) {
    const double drawn = std::sqrt(emf * emf + 4 * volts * motor.ohm * std::fabs(at(sample.current, j)));
    const double sign = std::isfinite(duty) ? gentle_sign(duty, kLeastDuty)
                                            : gentle_sign(off, std::max(kSignCounts * motor.count_rad, kLeastOff));
    duty = (emf + sign * drawn) / (2 * volts);
  }
  return motor.nm_per_ampere * (volts * duty - emf) / motor.ohm;
}

}  // namespace tauext
