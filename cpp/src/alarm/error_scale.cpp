#include "alarm/error_scale.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "prior/prior.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

// Features of the whole arm are stored at the first joint.
bool of_arm(MotionFeature feature) noexcept { return feature >= MotionFeature::arm_speed; }

}  // namespace

ErrorScale::ErrorScale(const ErrorScaleSettings& settings, int joints, double gain_per_s)
    : settings_(settings), joints_(joints), gain_per_s_(gain_per_s) {
  settings.validate(joints);
}

double ErrorScale::feature(int joint, int m) const noexcept {
  const MotionFeature kind = settings_.features[static_cast<std::size_t>(m)];
  return state_.filtered[static_cast<std::size_t>(kind)][of_arm(kind) ? 0 : joint];
}

// Exponentials are recomputed only if the step changed.
void ErrorScale::take_step(std::int64_t t_ns) noexcept {
  State& s = state_;
  const auto step_ns = static_cast<std::int64_t>(elapsed_ns(t_ns, s.t_ns));
  s.t_ns = t_ns;
  if (!s.started || step_ns == s.step_ns) return;
  const double dt = 1e-9 * static_cast<double>(step_ns);
  s.step_ns = step_ns;
  s.share = -std::expm1(-gain_per_s_ * dt);
  s.slow_share = -std::expm1(-kAccelerationPerS * dt);
  s.kept = std::exp(-dt / kMemoryS);
}

// Features of this sample, filtered.
void ErrorScale::follow(std::span<const double> dq) noexcept {
  State& s = state_;
  const double share = s.started ? s.share : 1.0, kept = s.started ? s.kept : 1.0;
  const auto filter = [share](double& filtered, double now) noexcept { filtered += share * (now - filtered); };
  double arm_speed = 0, arm_acceleration = 0, arm_jerk = 0;
  const auto at = [&s](MotionFeature kind) noexcept -> JointVector& { return s.filtered[static_cast<std::size_t>(kind)]; };
  for (int j = 0; j < joints_; ++j) {
    const double v = std::clamp(dq[static_cast<std::size_t>(j)], -kLargestSpeed, kLargestSpeed);
    if (!s.started) {
      s.slow_dq[j] = v;
      s.slow_ddq[j] = 0;
      s.standstill[j] = 1;
    }
    s.slow_dq[j] += s.slow_share * (v - s.slow_dq[j]);
    const double ddq = kAccelerationPerS * (v - s.slow_dq[j]);
    s.slow_ddq[j] += s.slow_share * (ddq - s.slow_ddq[j]);
    const double dddq = kAccelerationPerS * (ddq - s.slow_ddq[j]);
    const double creep = v / kCreepRadS;
    s.standstill[j] = std::max(kept * s.standstill[j], 1 / (1 + creep * creep));
    filter(at(MotionFeature::speed)[j], std::fabs(v));
    filter(at(MotionFeature::acceleration)[j], std::fabs(ddq));
    filter(at(MotionFeature::jerk)[j], std::fabs(dddq));
    filter(at(MotionFeature::standstill)[j], s.standstill[j]);
    at(MotionFeature::constant)[j] = 1;
    arm_speed += std::fabs(v);
    arm_acceleration += std::fabs(ddq);
    arm_jerk += std::fabs(dddq);
  }
  filter(at(MotionFeature::arm_speed)[0], arm_speed);
  filter(at(MotionFeature::arm_acceleration)[0], arm_acceleration);
  filter(at(MotionFeature::arm_jerk)[0], arm_jerk);
  s.started = true;
}

void ErrorScale::step(std::int64_t t_ns, std::span<const double> dq, std::uint32_t near_stiction,
                      std::span<double> scale, std::span<double> sigma_nm) noexcept {
  if (!on()) {
    std::fill_n(scale.begin(), joints_, 1.0);
    std::fill_n(sigma_nm.begin(), joints_, std::numeric_limits<double>::quiet_NaN());
    return;
  }
  take_step(t_ns);
  follow(dq);
  const std::size_t features = settings_.features.size();
  for (int j = 0; j < joints_; ++j) {
    const std::size_t row = static_cast<std::size_t>(j) * features;
    const double* of_sigma = &(near_stiction >> j & 1 ? settings_.sigma_near_weights : settings_.sigma_weights)[row];
    const double* of_scale = &settings_.limit_weights[row];
    double sum = 0, sigma = 0;
    for (std::size_t m = 0; m < features; ++m) {
      const double value = feature(j, static_cast<int>(m));
      sum += of_scale[m] * value;
      sigma += of_sigma[m] * value;
    }
    scale[static_cast<std::size_t>(j)] = std::min(sum, settings_.largest[static_cast<std::size_t>(j)]);
    sigma_nm[static_cast<std::size_t>(j)] = std::min(sigma, settings_.largest_sigma[static_cast<std::size_t>(j)]);
  }
}

ContactErrors::ContactErrors(const Bundle& bundle)
    : joints_(bundle.joints()), gain_per_s_(bundle.observer.gain_per_s) {
  const std::vector<double>& widths = bundle.prior.widths_rad;
  const double ratio = widths.empty() ? 0.0 : kBuildsUpRad / widths.front(), coarse = 1 / (1 + ratio * ratio);
  const double share = kFineShare + (kCoarseShare - kFineShare) * coarse;
  const bool found = std::ranges::any_of(bundle.prior.terms, [](const Term& term) { return is_load(term); });
  const std::vector<double> shares = load_friction_shares(bundle.prior, joints_);
  for (int j = 0; j < joints_; ++j) {
    const auto at = static_cast<std::size_t>(j);
    hidden_nm_[j] = share * friction_line(bundle.prior, at).at_rest_nm;
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

void ContactErrors::step(std::int64_t t_ns, std::uint32_t near_stiction, bool touched, std::span<const double> tau_ext,
                         std::span<const double> sigma_nm, std::span<const double> memory_gap,
                         std::span<double> into) noexcept {
  State& s = state_;
  const double dt = s.started ? 1e-9 * static_cast<double>(elapsed_ns(t_ns, s.t_ns)) : 0.0;
  if (dt != s.step_s) {  // recomputed only if the step changed
    s.step_s = dt;
    s.kept = std::exp(-gain_per_s_ * dt);
  }
  s.t_ns = t_ns;
  s.since_s = touched ? 0.0 : std::min(s.since_s + dt, kStaysS);
  s.touched = touched ? 1.0 : s.kept * s.touched;
  s.pressed = near_stiction & (s.since_s < kStaysS ? ~std::uint32_t{0} : s.pressed);
  for (int j = 0; j < joints_; ++j) {
    const auto at = static_cast<std::size_t>(j);
    const double now = dt > 0 ? (tau_ext[at] - s.tau_ext[j]) / dt : 0.0;
    s.rate[j] += (1 - s.kept) * (now - s.rate[j]);
    if (!s.started) s.rate[j] = 0;
    s.tau_ext[j] = tau_ext[at];
    const bool pressed = s.pressed >> j & 1;
    const double hidden = pressed ? hidden_nm_[j] : 0.0;
    const double unsure = pressed && !memory_gap.empty() ? unsure_nm_[j] * memory_gap[at] : 0.0;
    const double of_torque = s.touched * of_torque_[j] * tau_ext[at], lag = s.touched * s.rate[j] / gain_per_s_;
    into[at] = std::sqrt(sigma_nm[at] * sigma_nm[at] + hidden * hidden + unsure * unsure + of_torque * of_torque + lag * lag);
  }
  s.started = true;
}

}  // namespace tauext
