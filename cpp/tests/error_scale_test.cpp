#include "alarm/error_scale.hpp"

#include <cmath>
#include <limits>
#include <vector>

#include "check.hpp"

using namespace tauext;

namespace {

constexpr std::int64_t kMs = 1'000'000;
constexpr double kGain = 20, kKa = ErrorScale::kAccelerationPerS;

// One joint's scale is one feature, the other's another, and sigma is a hundred of each.
ErrorScaleSettings of(MotionFeature first, MotionFeature second) {
  ErrorScaleSettings s;
  s.features = {first, second};
  s.limit_weights = {1, 0, 0, 1};
  s.largest = {1e6, 1e6};
  s.sigma_weights = {100, 0, 0, 100};
  s.sigma_near_weights = {7, 0, 0, 7};
  s.largest_sigma = {1e6, 1e6};
  return s;
}

struct Scale {
  ErrorScale stage;
  std::int64_t t_ns = 0;
  double scale[2] = {0, 0}, sigma[2] = {0, 0};

  explicit Scale(const ErrorScaleSettings& settings) : stage(settings, 2, kGain) {}
  void step(double dq_1, double dq_2, std::int64_t ns = kMs, std::uint32_t near = 0) {
    const double dq[] = {dq_1, dq_2};
    stage.step(t_ns += ns, dq, near, scale, sigma);
  }
};

// After a step of the speed from 0 to v ddq = Ka v exp(-Ka t), exactly in steps of any length; the filter behind it sums
// a geometric series: F_k = (1 - a) sum_i a^(k - i) Ka v b^i with a = exp(-K0 dt), b = exp(-Ka dt).
void a_speed_step_follows_the_filters() {
  for (const std::int64_t ns : {kMs, 10 * kMs}) {
    Scale s(of(MotionFeature::acceleration, MotionFeature::arm_acceleration));
    const double dt = 1e-9 * static_cast<double>(ns), v = 0.7, a = std::exp(-kGain * dt), b = std::exp(-kKa * dt);
    s.step(0, 0, ns);
    CHECK(s.scale[0] == 0 && s.scale[1] == 0);
    for (int k = 1; k <= 50; ++k) {
      s.step(-v, 0, ns);
      const double expected = (1 - a) * kKa * v * b * (std::pow(a, k) - std::pow(b, k)) / (a - b);
      CHECK_CLOSE(s.scale[0], expected, 1e-12 * kKa);
      CHECK_CLOSE(s.scale[1], expected, 1e-12 * kKa);  // the feature of the whole arm, from another joint
      CHECK_CLOSE(s.sigma[0], 100 * expected, 1e-9);
    }
  }
}

// A steady acceleration from rest: what lags it is exact in the end, and has no jerk; stamps that jitter change nothing
// but by the step of the speed within a sample.
void a_ramp_of_the_speed_is_an_acceleration_without_jerk() {
  Scale s(of(MotionFeature::acceleration, MotionFeature::arm_jerk));
  double v = 0;
  for (int k = 0; k < 3000; ++k) {
    const std::int64_t ns = k % 3 == 0 ? kMs / 2 : kMs + kMs / 4;
    v += 1.5 * 1e-9 * static_cast<double>(ns);
    s.step(v, -v, ns);
  }
  // The filtered speed lags by v_dot/Ka less half a step: Ka dt/2 of it, 2 % at 1 ms, which the ripple of the steps adds to.
  CHECK_CLOSE(s.scale[0], 1.5, 0.05);
  CHECK(s.scale[1] < 2 * 0.05 * kKa * 1.5);
}

void standstill_is_remembered_and_fades() {
  Scale s({{MotionFeature::standstill}, {1, 1}, {9, 9}, {1, 1}, {1, 1}, {9, 9}});
  s.step(2.0, 0.0);
  CHECK_CLOSE(s.scale[0], 1.0, 1e-12);  // the previous motion is unknown
  for (int k = 0; k < 5000; ++k) s.step(2.0, ErrorScale::kCreepRadS);
  CHECK_CLOSE(s.scale[0], 1e-4, 1e-6);
  CHECK_CLOSE(s.scale[1], 0.5, 1e-9);
  for (int k = 0; k < 5000; ++k) s.step(0.0, 0.0);
  CHECK_CLOSE(s.scale[0], 1.0, 1e-12);
  // Behind the filter the memory of 0.15 s, m = exp(-t/T), shows as (m - exp(-K0 t)) / (1 - 1/(K0 T)) + exp(-K0 t).
  for (int k = 0; k < 300; ++k) s.step(2.0, 0.0);
  const double m = std::exp(-0.3 / ErrorScale::kMemoryS), e = std::exp(-kGain * 0.3);
  CHECK_CLOSE(s.scale[0], (m - e) / (1 - 1 / (kGain * ErrorScale::kMemoryS)) + e, 2e-3);
}

void the_scale_has_a_ceiling_and_regions_their_own_sigma() {
  ErrorScaleSettings settings = of(MotionFeature::constant, MotionFeature::speed);
  settings.largest[1] = 3;
  Scale s(settings);
  for (int k = 0; k < 1000; ++k) s.step(9, 9, kMs, 2);
  CHECK(s.scale[0] == 1 && s.scale[1] == 3);
  CHECK_CLOSE(s.sigma[0], 100, 1e-12);
  CHECK_CLOSE(s.sigma[1], 7 * 9, 1e-9);
  settings.largest_sigma[1] = 50;
  Scale bounded(settings);
  bounded.step(9, 9, kMs, 2);
  CHECK(bounded.sigma[1] == 50);
}

void a_restart_forgets_the_motion_before() {
  Scale s(of(MotionFeature::acceleration, MotionFeature::arm_jerk)), fresh(s);
  for (int k = 0; k < 200; ++k) s.step(std::sin(0.1 * k), std::cos(0.3 * k));
  s.stage.restart();
  for (int k = 0; k < 200; ++k) {
    s.step(std::cos(0.2 * k), 0.1 * k);
    fresh.step(std::cos(0.2 * k), 0.1 * k);
    CHECK(s.scale[0] == fresh.scale[0] && s.scale[1] == fresh.scale[1] && s.sigma[1] == fresh.sigma[1]);
  }
}

void without_features_limits_are_constant_and_sigma_is_unknown() {
  Scale s({});
  s.step(3, 4);
  CHECK(s.scale[0] == 1 && s.scale[1] == 1 && std::isnan(s.sigma[0]) && std::isnan(s.sigma[1]));
}

void speeds_that_no_arm_has_stay_finite() {
  Scale s(of(MotionFeature::acceleration, MotionFeature::arm_jerk));
  for (int k = 0; k < 100; ++k) {
    s.step(k % 2 ? 1e308 : -1e308, 1e308, 1);
    CHECK(std::isfinite(s.scale[0]) && std::isfinite(s.scale[1]) && std::isfinite(s.sigma[0]));
  }
}

void bad_settings_are_refused() {
  const auto refused = [](auto change) {
    ErrorScaleSettings s = of(MotionFeature::constant, MotionFeature::speed);
    s.validate(2);
    change(s);
    CHECK_THROWS(s.validate(2), Error);
  };
  refused([](ErrorScaleSettings& s) { s.features[1] = MotionFeature::constant; });
  refused([](ErrorScaleSettings& s) { s.features[1] = static_cast<MotionFeature>(kMotionFeatures); });
  refused([](ErrorScaleSettings& s) { s.limit_weights[1] = -1e-9; });
  refused([](ErrorScaleSettings& s) { s.limit_weights = {1, 0, 0, 0}; });  // no limit at all at joint 2
  refused([](ErrorScaleSettings& s) { s.sigma_weights[0] = NAN; });
  refused([](ErrorScaleSettings& s) { s.sigma_near_weights.pop_back(); });
  refused([](ErrorScaleSettings& s) { s.largest[0] = 0; });
  refused([](ErrorScaleSettings& s) { s.largest_sigma.pop_back(); });
  refused([](ErrorScaleSettings& s) { s.largest[1] = std::numeric_limits<double>::infinity(); });
  refused([](ErrorScaleSettings& s) { s.features.clear(); });
}

}  // namespace

int main() {
  a_speed_step_follows_the_filters();
  a_ramp_of_the_speed_is_an_acceleration_without_jerk();
  standstill_is_remembered_and_fades();
  the_scale_has_a_ceiling_and_regions_their_own_sigma();
  a_restart_forgets_the_motion_before();
  without_features_limits_are_constant_and_sigma_is_unknown();
  speeds_that_no_arm_has_stay_finite();
  bad_settings_are_refused();
  return check::result();
}
