// Residuals of other published detectors, in the momentum observer's place, so that the one chain runs them all.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// The direct residual and the velocity and energy observers of [Haddadin2017], for steps of any length dt. Their d is
// the momentum observer's, d_k = (p_k - p_{k-1})/dt - mean over the step of (tau_m - beta), and a = exp(-K0 dt):
//   direct    r_k = d_k, that is M ddq + C dq + g - tau_m of the differenced velocity, unfiltered ([Lim2021], Eq. 6).
//   velocity  r = K_O (dq - dq_0 - integral of M^-1 (tau_m - C dq - g + r)), so dr/dt = K_O M^-1 (tau_dist - r), with
//             K_O = K0 D, D = diag M at the sample that starts the stretch: K0 is the bandwidth near that pose.
//             r_k = d_k + a M_k (a M_k + (1 - a) D)^-1 (r_{k-1} - d_k): implicit, first order in dt, exact where
//             M = D. In the norm of D^-1 every step shortens the error, whatever K0 dt and however M changes.
//   energy    r = K0 (T - T_0 - integral of (dq^T (tau_m - g) + r)), T = dq^T p / 2: the external power, a number in W
//             that every joint gets, whichever is touched: limits are in W, and one alarm speaks for the arm.
//             r_k = a r_{k-1} + (1 - a) ((T_k - T_{k-1})/dt - (mean of dq)^T mean of (tau_m - g)).
// Sign: r is positive where the environment pushes the joint in its positive direction, a power where it feeds the arm.
class ComparisonResidual {
 public:
  // gain_per_s: K0, [1/s]. Throws Error if the method does not exist, or needs a model and has none (velocity).
  ComparisonResidual(const Tree& tree, ResidualMethod method, double gain_per_s, TorqueTiming timing);

  // Clears all state: the next sample restarts with r = 0.
  void reset() noexcept { started_ = false; }

  // One sample, later than the last, with its p and beta of `tree`, that of the constructor; residual [N m or W] is
  // written. The first after a reset only starts the method and gives zeros.
  void step(const Tree& tree, std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
            std::span<const double> momentum, std::span<const double> beta, std::span<const double> tau_m,
            std::span<double> residual) noexcept;

  // Continues with another tree. `momentum` and `beta` are the last sample's, computed by the new tree. r keeps its value,
  // and so does the velocity observer's D.
  void carry_on(const Tree& tree, std::span<const double> q, std::span<const double> dq,
                std::span<const double> momentum, std::span<const double> beta) noexcept;

  // Whether what r started from has faded to e^-10: after 10/K0, in the velocity observer later where M couples joints.
  // The direct residual has no memory and waits as long, so that methods are compared on the same samples.
  bool warm() const noexcept { return started_ && faded_ >= 10.0; }

 private:
  void start(const Tree& tree, std::span<const double> q) noexcept;
  double model(const Tree& tree, std::span<const double> q, std::span<const double> dq,
               std::span<const double> momentum, std::span<const double> beta, JointVector& model) const noexcept;
  void observe_velocity(const Tree& tree, std::span<const double> q, double dt,
                        const JointVector& disturbance) noexcept;

  ResidualMethod method_;
  TorqueTiming timing_;
  double gain_per_s_;
  bool started_ = false;
  std::int64_t start_ns_ = 0, t_ns_ = 0;
  double faded_ = 0;                                   // the start's share of r is at most exp(-faded)
  JointVector dq_{}, momentum_{}, model_{}, tau_m_{};  // of the last sample; model: beta, g for the energy observer
  double energy_ = 0;
  JointVector inertia_{};  // D
  JointVector residual_{};
};

// First-order filters on r with exact steps, y_k = y_{k-1} + (1 - exp(-w dt)) (r_k - y_{k-1}): a low-pass gives y, a
// high-pass r - y, both in turn a band-pass.
// The low-pass starts from 0. The high-pass begins at the first sample where r and the low-pass are warm, with y = r
// and so an output of 0 (before it, too): it may remember longer than that and holds no warm-up up. It comes second,
// which matters for that start alone: one noisy sample of r would else stay in y for 1/w.
class ResidualFilter {
 public:
  // Rates w [1/s]; 0: no such filter. Throws Error if one is negative or not finite.
  ResidualFilter(int joints, double high_pass_per_s, double low_pass_per_s);

  // The next sample restarts both filters.
  void reset() noexcept { started_ = warm_ = false; }
  // One sample, later than the last; residual is replaced. residual_warm: r without filters counts as warmed up.
  void step(std::int64_t t_ns, bool residual_warm, std::span<double> residual) noexcept {
    if (high_pass_per_s_ > 0 || low_pass_per_s_ > 0)
      filter(t_ns, residual_warm, residual);
    else
      warm_ = residual_warm;
  }
  // r is warm, and the low-pass 10 over its rate after the start.
  bool warm() const noexcept { return warm_; }

 private:
  void filter(std::int64_t t_ns, bool residual_warm, std::span<double> residual) noexcept;

  int joints_;
  double high_pass_per_s_, low_pass_per_s_;
  bool started_ = false, warm_ = false;
  std::int64_t start_ns_ = 0, t_ns_ = 0;
  JointVector slow_{}, low_{};  // y of the high-pass and of the low-pass
};

}  // namespace tauext
