#include "chain/momentum_observer.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {

MomentumObserver::MomentumObserver(int joints, double gain_per_s, TorqueTiming timing)
    : joints_(joints), gain_per_s_(gain_per_s), timing_(timing) {
  if (joints < 1 || joints > kMaxJoints)
    throw Error("an observer has 1 to " + std::to_string(kMaxJoints) + " joints, not " + std::to_string(joints));
  if (!(gain_per_s > 0) || !std::isfinite(gain_per_s))
    throw Error("observer gain = " + to_text(gain_per_s) + " 1/s must be > 0");
}

void MomentumObserver::raise(std::span<const double> least, std::span<double> residual) noexcept {
  for (int i = 0; i < joints_; ++i) residual[i] = residual_[i] = std::max(residual_[i], least[i]);
}

void MomentumObserver::carry_on(std::span<const double> momentum, std::span<const double> beta) noexcept {
  for (int i = 0; i < joints_; ++i) {
    momentum_[i] = momentum[i];
    beta_[i] = beta[i];
  }
}

void MomentumObserver::go_back(std::int64_t t_ns, std::span<const double> momentum, std::span<const double> beta,
                               std::span<const double> tau_m, std::span<const double> residual) noexcept {
  t_ns_ = t_ns;
  carry_on(momentum, beta);
  for (int i = 0; i < joints_; ++i) {
    tau_m_[i] = tau_m[i];
    residual_[i] = residual[i];
  }
}

bool MomentumObserver::step(std::int64_t t_ns, std::span<const double> momentum, std::span<const double> beta,
                            std::span<const double> tau_m, std::span<double> residual) noexcept {
  if (started_ && t_ns <= t_ns_) return false;
  if (!started_) {
    start_ns_ = t_ns;
    residual_.fill(0.0);
  } else {
    const auto step_ns = static_cast<std::int64_t>(elapsed_ns(t_ns, t_ns_));
    const double dt = elapsed_s(t_ns, t_ns_);
    const double weight = share_.of(step_ns, -gain_per_s_ * dt);  // 1 - a
    for (int i = 0; i < joints_; ++i) {
      double mean_tau = tau_m_[i];  // held: the last command acted until now
      if (timing_ == TorqueTiming::instant) mean_tau = 0.5 * (tau_m_[i] + tau_m[i]);
      if (timing_ == TorqueTiming::averaged) mean_tau = tau_m[i];
      const double mean_beta = 0.5 * (beta_[i] + beta[i]);
      const double disturbance = (momentum[i] - momentum_[i]) / dt - (mean_tau - mean_beta);
      residual_[i] += weight * (disturbance - residual_[i]);
    }
  }
  started_ = true;
  t_ns_ = t_ns;
  for (int i = 0; i < joints_; ++i) {
    momentum_[i] = momentum[i];
    beta_[i] = beta[i];
    tau_m_[i] = tau_m[i];
    residual[i] = residual_[i];
  }
  return true;
}

}  // namespace tauext
