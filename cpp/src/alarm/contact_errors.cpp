#include "alarm/contact_errors.hpp"

#include <algorithm>
#include <cmath>

#include "prior/prior.hpp"
#include "tauext/bundle.hpp"

namespace tauext {

ContactErrors::ContactErrors(const Bundle& bundle)
    : joints_(bundle.joints()), gain_per_s_(bundle.observer.gain_per_s) {
  const std::vector<double>& widths = bundle.prior.widths_rad;
  const std::vector<double>& factors = bundle.observer.nm_per_unit;
  const bool found = std::ranges::any_of(bundle.prior.terms, [](const Term& term) { return is_load(term); });
  const std::vector<double> shares = load_friction_shares(bundle.prior, joints_);
  for (int j = 0; j < joints_; ++j) {
    const auto at = static_cast<std::size_t>(j);
    const double travel = turning_travel(bundle.prior, at);
    unseen_[j] = travel > 0 ? std::min(widths.front() / travel, 1.0) : 1.0;
    at_rest_nm_[j] = friction_line(bundle.prior, at).at_rest_nm;
    of_load_[j] = shares[at] * (factors.empty() ? 1.0 : std::fabs(factors[at]));
    of_torque_[j] = std::hypot(found ? shares[at] : kUsualRubbing, bundle.in_newtons(j) ? bundle.wrench.share(at) : 0.0);
    unsure_nm_[j] = kUnsureBank;
  }
  JointVector bent{};  // presliding friction
  for (std::size_t m = 0; m < bundle.prior.terms.size(); ++m) {
    const Term& term = bundle.prior.terms[m];
    const double weight = bundle.prior.weights[static_cast<std::size_t>(term.a) * bundle.prior.terms.size() + m];
    if (term.kind == TermKind::presliding) bent[static_cast<std::size_t>(term.a)] += std::max(-weight, 0.0);
    if (term.kind == TermKind::local_memory) unsure_nm_[static_cast<std::size_t>(term.a)] = kUnsureLocal;
  }
  for (int j = 0; j < joints_; ++j) unsure_nm_[j] *= bent[j];
}

double ContactErrors::hidden(std::size_t joint, const Friction& friction) const noexcept {
  const double largest = at_rest_nm_[joint] + of_load_[joint] * std::fabs(friction.tau[joint]);
  const double expected = friction.coulomb.empty() ? largest : friction.coulomb[joint];
  return unseen_[joint] * unseen_[joint] * (expected * expected + largest * largest / 3);
}

double ContactErrors::slipped(std::size_t joint, const Friction& friction) const noexcept {
  const double expected = friction.coulomb.empty() ? 0.0 : friction.coulomb[joint];
  return (1 - unseen_[joint] * unseen_[joint]) * expected * expected / 3;
}

void ContactErrors::find_hidden(std::uint32_t near_stiction, const Friction& friction) noexcept {
  for (int j = 0; j < joints_; ++j)
    if (near_stiction >> j & 1) hidden_[j] = hidden(static_cast<std::size_t>(j), friction);
}

void ContactErrors::step(std::int64_t t_ns, std::uint32_t near_stiction, bool touched, std::span<const double> tau_ext,
                         std::span<const double> sigma_nm, std::span<const double> memory_gap, const Friction& friction,
                         std::span<double> into, bool presses) noexcept {
  State& s = state_;
  const double dt = s.started ? elapsed_s(t_ns, s.t_ns) : 0.0;
  if (dt != s.step_s) {  // recomputed only if the step changed
    s.step_s = dt;
    s.kept = std::exp(-gain_per_s_ * dt);
  }
  s.t_ns = t_ns;
  s.since_s = touched ? 0.0 : std::min(s.since_s + dt, kStaysS);
  s.touched = touched ? 1.0 : s.kept * s.touched;
  if (s.since_s < kStaysS) s.pressed = ~std::uint32_t{0};
  for (int j = 0; j < joints_; ++j) {
    const auto at = static_cast<std::size_t>(j);
    const double now = dt > 0 ? (tau_ext[at] - s.tau_ext[j]) / dt : 0.0;
    s.rate[j] += (1 - s.kept) * (now - s.rate[j]);
    if (!s.started) s.rate[j] = 0;
    s.tau_ext[j] = tau_ext[at];
    if (std::fabs(tau_ext[at]) > kNoticed * sigma_nm[at]) s.pressed |= std::uint32_t{1} << j;
    const bool pressed = (s.pressed & near_stiction) >> j & 1;
    const double of_rest = pressed ? hidden(at, friction) + (presses ? slipped(at, friction) : 0.0) : 0.0;
    const double unsure = pressed && !memory_gap.empty() ? unsure_nm_[j] * memory_gap[at] : 0.0;
    const double of_torque = s.touched * of_torque_[j] * tau_ext[at], lag = s.touched * s.rate[j] / gain_per_s_;
    into[at] = std::sqrt(sigma_nm[at] * sigma_nm[at] + of_rest + unsure * unsure + of_torque * of_torque + lag * lag);
  }
  s.pressed &= near_stiction;
  s.started = true;
}

}  // namespace tauext
