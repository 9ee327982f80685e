#include "tauext/adaptive_velocity.hpp"

#include <cmath>
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
    t[k] = -1e-9 * static_cast<double>(elapsed_ns(now_ns, t_ns_[at]));
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

}  // namespace tauext
