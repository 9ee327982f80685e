#include "chain/comparison_residuals.hpp"

#include <cmath>
#include <limits>

#include "bundle/linear.hpp"

namespace tauext {
namespace {

using Matrix = std::array<double, kMaxJoints * kMaxJoints>;  // the first (n, n) of it, row-major

// Column i of M is the momentum of a unit speed of joint i.
void mass_matrix(const Tree& tree, std::span<const double> q, Matrix& mass) noexcept {
  const auto n = static_cast<std::size_t>(tree.size());
  JointVector unit{}, beta;
  for (std::size_t i = 0; i < n; ++i) {
    unit[i] = 1.0;
    tree.momentum(q, std::span(unit).first(n), std::span(mass).subspan(i * n, n), std::span(beta).first(n));
    unit[i] = 0.0;
  }
}

double mean_torque(TorqueTiming timing, double before, double now) noexcept {
  switch (timing) {
    case TorqueTiming::held: return before;
    case TorqueTiming::instant: return 0.5 * (before + now);
    case TorqueTiming::averaged: return now;
  }
  return before;
}

}  // namespace

ComparisonResidual::ComparisonResidual(const Tree& tree, ResidualMethod method, double gain_per_s, TorqueTiming timing)
    : method_(method), timing_(timing), gain_per_s_(gain_per_s) {
  if (method > ResidualMethod::energy)
    throw Error("its residual's method is none of momentum, direct, velocity, energy");
  if (method != ResidualMethod::velocity) return;
  const auto n = static_cast<std::size_t>(tree.size());
  const JointVector zero{};
  start(tree, std::span(zero).first(n));
  for (std::size_t i = 0; i < n; ++i)
    if (!(inertia_[i] > 0))
      throw Error("joint '" + tree.links()[i].joint_name + "': its inertia is " + to_text(inertia_[i]) +
                  " and must be > 0: the velocity observer needs a model");
}

void ComparisonResidual::start(const Tree& tree, std::span<const double> q) noexcept {
  residual_.fill(0.0);
  faded_ = 0.0;
  if (method_ != ResidualMethod::velocity) return;
  Matrix mass;
  mass_matrix(tree, q, mass);
  for (std::size_t i = 0; i < q.size(); ++i) inertia_[i] = mass[i * q.size() + i];
}

// Per joint, the model torque beside tau_m; also the kinetic energy if needed.
double ComparisonResidual::model(const Tree& tree, std::span<const double> q, std::span<const double> dq,
                                 std::span<const double> momentum, std::span<const double> beta,
                                 JointVector& model) const noexcept {
  const std::size_t n = q.size();
  double energy = 0.0;
  for (std::size_t i = 0; i < n; ++i) model[i] = beta[i];
  if (method_ == ResidualMethod::energy) {  // beta is g where nothing moves
    const JointVector rest{};
    JointVector none;
    tree.momentum(q, std::span(rest).first(n), std::span(none).first(n), std::span(model).first(n));
    for (std::size_t i = 0; i < n; ++i) energy += 0.5 * dq[i] * momentum[i];
  }
  return energy;
}

void ComparisonResidual::carry_on(const Tree& tree, std::span<const double> q, std::span<const double> dq,
                                  std::span<const double> momentum, std::span<const double> beta) noexcept {
  energy_ = model(tree, q, dq, momentum, beta, model_);
  for (std::size_t i = 0; i < q.size(); ++i) momentum_[i] = momentum[i];
}

void ComparisonResidual::step(const Tree& tree, std::int64_t t_ns, std::span<const double> q,
                              std::span<const double> dq, std::span<const double> momentum,
                              std::span<const double> beta, std::span<const double> tau_m,
                              std::span<double> residual) noexcept {
  const std::size_t n = q.size();
  const bool of_energy = method_ == ResidualMethod::energy;
  JointVector model;
  const double energy = this->model(tree, q, dq, momentum, beta, model);
  if (!started_) {
    start_ns_ = t_ns;
    start(tree, q);
  } else {
    const double dt = elapsed_s(t_ns, t_ns_);
    JointVector disturbance{};
    double power = (energy - energy_) / dt;
    for (std::size_t i = 0; i < n; ++i) {
      const double known = mean_torque(timing_, tau_m_[i], tau_m[i]) - 0.5 * (model_[i] + model[i]);
      disturbance[i] = (momentum[i] - momentum_[i]) / dt - known;
      power -= 0.5 * (dq_[i] + dq[i]) * known;
    }
    if (method_ == ResidualMethod::velocity) {
      observe_velocity(tree, q, dt, disturbance);
    } else {
      faded_ = gain_per_s_ * elapsed_s(t_ns, start_ns_);
      const double weight = -std::expm1(-gain_per_s_ * dt);
      if (of_energy)
        residual_.fill(residual_[0] + weight * (power - residual_[0]));
      else
        residual_ = disturbance;
    }
  }
  started_ = true;
  t_ns_ = t_ns;
  energy_ = energy;
  for (std::size_t i = 0; i < n; ++i) {
    dq_[i] = dq[i];
    momentum_[i] = momentum[i];
    model_[i] = model[i];
    tau_m_[i] = tau_m[i];
    residual[i] = residual_[i];
  }
}

void ComparisonResidual::observe_velocity(const Tree& tree, std::span<const double> q, double dt,
                                          const JointVector& disturbance) noexcept {
  const std::size_t n = q.size();
  const double a = std::exp(-gain_per_s_ * dt), weight = -std::expm1(-gain_per_s_ * dt);
  Matrix mass, system;
  JointVector error;
  mass_matrix(tree, q, mass);
  double coupling = 0.0;  // bounds the eigenvalues of D^-1/2 M D^-1/2 (Gershgorin), and so the slowest rate
  for (std::size_t i = 0; i < n; ++i) {
    double row = 0.0;
    for (std::size_t j = 0; j < n; ++j) {
      system[i * n + j] = a * mass[i * n + j] + (i == j ? weight * inertia_[i] : 0.0);
      row += std::fabs(mass[i * n + j]) / std::sqrt(inertia_[i] * inertia_[j]);
    }
    coupling = std::fmax(coupling, row);
    error[i] = residual_[i] - disturbance[i];
  }
  faded_ += std::log1p(weight / (a * coupling));
  if (cholesky(std::span(system).first(n * n), n))
    substitute(system, n, error);
  else
    error.fill(std::numeric_limits<double>::quiet_NaN());
  for (std::size_t i = 0; i < n; ++i) {
    residual_[i] = disturbance[i];
    for (std::size_t j = 0; j < n; ++j) residual_[i] += a * mass[i * n + j] * error[j];
  }
}

ResidualFilter::ResidualFilter(int joints, double high_pass_per_s, double low_pass_per_s)
    : joints_(joints), high_pass_per_s_(high_pass_per_s), low_pass_per_s_(low_pass_per_s) {
  const auto expect = [](const char* what, double rate) {
    if (!(rate >= 0) || !std::isfinite(rate))
      throw Error(std::string(what) + " = " + to_text(rate) + " 1/s must be >= 0 (0: no such filter)");
  };
  expect("high_pass_per_s", high_pass_per_s);
  expect("low_pass_per_s", low_pass_per_s);
}

void ResidualFilter::filter(std::int64_t t_ns, bool residual_warm, std::span<double> residual) noexcept {
  if (!started_) {
    start_ns_ = t_ns_ = t_ns;
    low_.fill(0.0);
  }
  const double dt = elapsed_s(t_ns, t_ns_);
  const bool begun = warm_;
  started_ = true;
  t_ns_ = t_ns;
  warm_ = residual_warm && (low_pass_per_s_ == 0.0 || low_pass_per_s_ * elapsed_s(t_ns, start_ns_) >= 10.0);
  if (low_pass_per_s_ > 0.0) {
    const double weight = -std::expm1(-low_pass_per_s_ * dt);
    for (int i = 0; i < joints_; ++i) residual[i] = low_[i] += weight * (residual[i] - low_[i]);
  }
  if (high_pass_per_s_ > 0.0) {
    const double weight = -std::expm1(-high_pass_per_s_ * dt);
    for (int i = 0; i < joints_; ++i) {
      slow_[i] = begun ? slow_[i] + weight * (residual[i] - slow_[i]) : residual[i];
      residual[i] -= slow_[i];
    }
  }
}

}  // namespace tauext
