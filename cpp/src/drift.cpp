#include "tauext/drift.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {

namespace {
constexpr double kLargestSize = 1e300;  // sums with r and prior stay finite
}

void DriftSettings::validate(int joints) const {
  const auto expect = [](bool ok, const char* what, double value, const char* rule) {
    if (!ok) throw Error("drift." + std::string(what) + " = " + to_text(value) + " must be " + rule);
  };
  expect(time_constant_s == 0 || (time_constant_s >= 1 && time_constant_s <= 1e6), "time_constant_s", time_constant_s,
         "0 (no tracker) or 1 to 1e6");
  if (!on()) return;
  if (static_cast<int>(size_nm.size()) != joints)
    throw Error("drift.size_nm has " + std::to_string(size_nm.size()) + " values where " + std::to_string(joints) +
                " belong");
  for (double size : size_nm) expect(size >= 0 && size <= kLargestSize, "size_nm", size, "0 to 1e300");
  expect(rate_share_per_s > 0 && rate_share_per_s <= 1, "rate_share_per_s", rate_share_per_s, "above 0, at most 1");
  expect(freeze_share >= 0 && freeze_share <= 1, "freeze_share", freeze_share, "0 (never frozen by torque) to 1");
  expect(freeze_s >= 0 && freeze_s <= 60, "freeze_s", freeze_s, "0 to 60");
  if (!freeze_floor_nm.empty() && static_cast<int>(freeze_floor_nm.size()) != joints)
    throw Error("drift.freeze_floor_nm has " + std::to_string(freeze_floor_nm.size()) + " values where " +
                std::to_string(joints) + " or none belong");
  expect(friction_share >= 0 && friction_share <= 1, "friction_share", friction_share, "0 (not followed) to 1");
  for (double floor : freeze_floor_nm)
    expect(floor >= 0 && floor <= kLargestSize, "freeze_floor_nm", floor, "0 to 1e300");
}

DriftTracker::DriftTracker(const DriftSettings& settings, const Limits& limits, int joints, double gain_per_s)
    : settings_(settings), limits_(limits), joints_(joints), gain_per_s_(gain_per_s), freeze_ns_(0), forget_ns_(0) {
  settings.validate(joints);
  if (!on()) return;
  freeze_ns_ = std::llround(1e9 * settings.freeze_s);
  forget_ns_ = std::llround(1e9 * std::min(kForgottenShare / gain_per_s, 60.0));
}

void DriftTracker::step(std::int64_t t_ns, std::span<const double> dq, std::span<double> drift) noexcept {
  if (!on()) {
    std::fill_n(drift.begin(), joints_, 0.0);
    return;
  }
  State& s = state_;
  s.step_ns = s.started ? static_cast<std::int64_t>(elapsed_ns(t_ns, s.t_ns)) : 0;
  const double weight = -std::expm1(-gain_per_s_ * 1e-9 * static_cast<double>(s.step_ns));
  for (int j = 0; j < joints_; ++j) {
    const double now[kTerms] = {1.0, std::tanh(dq[j] / kCoulombSpeed), std::clamp(dq[j] / kViscousSpeed, -1.0, 1.0)};
    double sum = 0;
    for (int m = 0; m < kTerms; ++m) {
      double& filtered = s.filtered[m][j];
      filtered = s.started ? filtered + weight * (0.5 * (s.phi[m][j] + now[m]) - filtered) : 0.0;
      s.phi[m][j] = now[m];
      sum += s.coefficients[m][j] * filtered;
    }
    drift[j] = sum;
  }
  s.started = true;
  s.t_ns = t_ns;
}

bool DriftTracker::touched(std::span<const double> tau_ext, std::span<const double> scale,
                           std::span<const double> doubt, std::uint32_t near_stiction) const noexcept {
  for (int j = 0; settings_.freeze_share > 0 && j < joints_; ++j) {
    const bool near = near_stiction >> j & 1;
    const double limit =
        std::min(limits_.limit_nm(limits_.contact, j, near), limits_.limit_nm(limits_.collision, j, near));
    const double floor = settings_.freeze_floor_nm.empty() ? 0.0 : settings_.freeze_floor_nm[static_cast<std::size_t>(j)];
    if (std::fabs(tau_ext[j]) > std::max(settings_.freeze_share * limit * scale[j], floor) + doubt[j]) return true;
  }
  return false;
}

void DriftTracker::learn(std::span<const double> tau_ext, std::span<const double> scale, std::span<const double> doubt,
                         std::uint32_t near_stiction, bool trusted) noexcept {
  if (!on() || !trusted) return;
  State& s = state_;
  const auto left = [&](std::int64_t& left_ns, bool again, std::int64_t for_ns) noexcept {
    left_ns = again ? for_ns : std::max<std::int64_t>(left_ns - s.step_ns, 0);
    return again || left_ns > 0;
  };
  const bool frozen = left(s.touched_ns, touched(tau_ext, scale, doubt, near_stiction), freeze_ns_);
  for (int j = 0; j < joints_; ++j) {
    const bool stuck = left(s.stuck_ns[j], near_stiction >> j & 1, forget_ns_);
    if (!frozen && !stuck) follow(j, tau_ext[j], 1e-9 * static_cast<double>(s.step_ns));
  }
}

void DriftTracker::follow(int j, double error, double dt) noexcept {
  State& s = state_;
  const double size = settings_.size_nm[j], most = settings_.rate_share_per_s * size * dt;
  double squares = 0;
  for (const JointVector& filtered : s.filtered) squares += filtered[j] * filtered[j];
  const double gain = std::min(dt / settings_.time_constant_s, 1.0) * error / std::max(squares, 1.0);
  bool at_bound = false;
  for (int m = 0; m < kTerms; ++m) {
    double& b = s.coefficients[m][j];
    b = std::clamp(b + std::clamp(gain * s.filtered[m][j], -most, most), -size, size);
    at_bound = at_bound || std::fabs(b) >= size;
  }
  const std::uint32_t bit = std::uint32_t{1} << j;
  s.saturated = at_bound && size > 0 ? s.saturated | bit : s.saturated & ~bit;
}

}  // namespace tauext
