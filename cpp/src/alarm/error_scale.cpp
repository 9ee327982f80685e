#include "alarm/error_scale.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

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

}  // namespace tauext
