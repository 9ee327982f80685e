// First-order momentum observer: the disturbance torque on every joint without measuring acceleration.
#pragma once
#include <cstdint>
#include <span>

#include "chain/step_share.hpp"
#include "tauext/types.hpp"

namespace tauext {

// dr/dt = K0 (tau_dist - r) [DeLuca2003], for steps of any length dt:
//   d_k = (p_k - p_{k-1})/dt - mean over the step of (tau_m - beta),  a = exp(-K0 dt),  r_k = a r_{k-1} + (1 - a) d_k.
// The mean of tau_m depends on the meaning of a torque sample (TorqueTiming); that of beta is the trapezoid.
// Sign: r is positive where the environment pushes the joint in its positive direction; friction and modelling error
// of the estimated model are part of it, with their own signs.
// A constant push from rest gives r(t) = (1 - exp(-K0 t)) tau_ext at every sample, whatever the steps.
class MomentumObserver {
 public:
  // gain_per_s: K0 > 0, [1/s]. Throws Error otherwise, or if joints is not 1 to kMaxJoints.
  MomentumObserver(int joints, double gain_per_s, TorqueTiming timing);

  // Clears all state: the next sample restarts with r = 0.
  void reset() noexcept { started_ = false; }

  // Processes one sample; writes residual [N m]. The first sample after a reset starts the observer and gives zeros.
  // Returns false without a change if t_ns is not later than the last sample.
  bool step(std::int64_t t_ns, std::span<const double> momentum, std::span<const double> beta,
            std::span<const double> tau_m, std::span<double> residual) noexcept;

  // Replaces momentum and beta of the last sample after a model change; r continues. No effect before the first sample.
  void carry_on(std::span<const double> momentum, std::span<const double> beta) noexcept;
  // Goes back to this earlier sample of the same stretch, with the r of that time.
  void go_back(std::int64_t t_ns, std::span<const double> momentum, std::span<const double> beta,
               std::span<const double> tau_m, std::span<const double> residual) noexcept;

  // Raises r of every joint to at least this, as after a long constant push; writes residual.
  void raise(std::span<const double> least, std::span<double> residual) noexcept;

  // Time since the start, [s]; r counts as warmed up after 10/K0.
  double age_s() const noexcept { return started_ ? elapsed_s(t_ns_, start_ns_) : 0.0; }
  bool started() const noexcept { return started_; }
  // Of the last sample, one value per joint.
  std::span<const double> tau_m() const noexcept { return {tau_m_.data(), static_cast<std::size_t>(joints_)}; }
  std::span<const double> residual() const noexcept { return {residual_.data(), static_cast<std::size_t>(joints_)}; }
  bool warm() const noexcept { return started_ && age_s() * gain_per_s_ >= 10.0; }

 private:
  int joints_;
  double gain_per_s_;
  TorqueTiming timing_;
  bool started_ = false;
  std::int64_t start_ns_ = 0, t_ns_ = 0;
  StepShare share_;
  JointVector momentum_{}, beta_{}, tau_m_{}, residual_{};
};

}  // namespace tauext
