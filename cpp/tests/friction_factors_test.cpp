#include "alarm/drift.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <random>
#include <span>

#include "check.hpp"

using namespace tauext;

namespace {

constexpr std::int64_t kMs = 1'000'000;
constexpr double kDt = 1e-3, kGain = 50.0, kSigma = 0.2, kCoulomb = 8.0, kViscous = 6.0, kPeriod = 4.0;
constexpr double kPi = 3.14159265358979323846;

Limits wide_limits() {
  Limits limits;
  limits.near_stiction_rad_s = 0.02;
  limits.collision = limits.contact = {{100, 100}, {100, 100}, 0.0};
  return limits;
}

// Two joints that go to and fro, half a turn in 2 s, as a sine; the second is a quarter of a period behind. What the
// tracker is given is found here by sums of its own: friction through the observer's filter, times what it is off by.
struct Arm {
  FrictionFactors tracker;
  DriftTracker slow;
  std::int64_t t_ns = 0;
  double drift[2] = {0, 0}, tau_ext[2] = {0, 0}, speed[2] = {0, 0};
  double now[2][2] = {}, filtered[2][2] = {};  // joint, part
  std::mt19937 random{7};
  double noise[2] = {0, 0};

  explicit Arm(double share = 1.5, const DriftSettings& settings = {})
      : tracker(share, 2, kGain), slow(settings, settings.on() ? wide_limits() : Limits{}, 2, kGain) {}

  // pushes: what else r shows of each joint, of the time and the joints' speeds.
  using Push = std::function<double(double, int, const double*)>;
  void move(double seconds, double coulomb_off, double viscous_off, const Push& push = {}, bool trusted = true,
            std::uint32_t moving = 3) {
    std::normal_distribution<double> normal;
    for (int k = 0; k < std::lround(seconds / kDt); ++k) {
      t_ns += kMs;
      const double t = 1e-9 * static_cast<double>(t_ns);
      double coulomb[2], viscous[2];
      for (int j = 0; j < 2; ++j) {
        speed[j] = moving >> j & 1 ? 0.8 * std::sin(2 * kPi * t / kPeriod - 0.5 * kPi * j) : 0.0;
        coulomb[j] = -kCoulomb * std::tanh(speed[j] / 0.01);
        viscous[j] = -kViscous * speed[j];
        const double parts[2] = {coulomb[j], viscous[j]};
        for (int m = 0; m < 2; ++m) {
          if (t_ns > kMs) filtered[j][m] += -std::expm1(-kGain * kDt) * (0.5 * (now[j][m] + parts[m]) - filtered[j][m]);
          now[j][m] = parts[m];
        }
        noise[j] += kDt / 0.1 * -noise[j] + std::sqrt(2 * kDt / 0.1) * 0.5 * kSigma * normal(random);  // of 0.1 s
      }
      slow.step(t_ns, speed, drift);  // 0 if it is off
      tracker.step(t_ns, coulomb, viscous, drift);
      std::uint32_t near = 0;
      const double sigma[2] = {kSigma, kSigma}, doubt[2] = {0, 0};
      for (int j = 0; j < 2; ++j) {
        tau_ext[j] = coulomb_off * filtered[j][0] + viscous_off * filtered[j][1] + noise[j] - drift[j];
        if (push) tau_ext[j] += push(t, j, speed);
        if (std::fabs(speed[j]) < 0.02) near |= 1u << j;
      }
      const double scale[2] = {1, 1};
      slow.learn(tau_ext, scale, doubt, near, trusted);
      tracker.learn(speed, tau_ext, sigma, doubt, near, trusted, slow);
    }
  }
  // By how much limits are raised at this speed.
  double raised(double dq) const {
    double limits[2] = {0, 0};
    tracker.raise(std::array<double, 2>{dq, dq}, limits);
    return limits[0];
  }
  double b(std::size_t term) const { return slow.state().coefficients[term][0]; }
  double off(std::size_t part, std::size_t joint = 0) const { return tracker.state().joints[joint].factors[part]; }
  bool learned() const { return off(0) != 0 || off(1) != 0 || off(0, 1) != 0 || off(1, 1) != 0; }
};

// Three strokes of 2 s of each joint, the second of which begins a second later; then a factor glides by 0.2 a second.
void a_step_of_friction_is_followed_within_nine_seconds() {
  for (const double off : {-0.5, -0.3, -0.15, 0.15, 0.3, 1.0}) {
    Arm arm;
    arm.move(std::fabs(off) < 0.4 ? 9 : 12, off, off);
    for (const std::size_t joint : {0u, 1u})
      for (const std::size_t part : {0u, 1u}) CHECK_CLOSE(arm.off(part, joint), off, 0.03);
    CHECK(arm.tracker.saturated() == 0);
    arm.move(20, off, off);
    CHECK(std::fabs(arm.tau_ext[0]) < 4 * kSigma && std::fabs(arm.tau_ext[1]) < 4 * kSigma);
    arm.move(30, 0, 0);  // and back, as it warms up
    CHECK_CLOSE(arm.off(0), 0, 0.03);
  }
}

void parts_that_change_separately_are_separated() {
  Arm arm;
  arm.move(30, 0.3, 0);
  CHECK_CLOSE(arm.off(0), 0.3, 0.03);
  CHECK_CLOSE(arm.off(1), 0, 0.06);
  Arm other;
  other.move(30, 0, -0.3);
  CHECK_CLOSE(other.off(0), 0, 0.03);
  CHECK_CLOSE(other.off(1), -0.3, 0.06);
}

// 0.4 Nm or two standard errors; then 15 % in five minutes, as gears warm up.
void a_change_within_the_usual_error_is_followed() {
  Arm arm;
  arm.move(60, 0.03, 0.03);
  CHECK_CLOSE(arm.off(0), 0.03, 0.012);
  double most = 0;
  for (int k = 1; k <= 30; ++k) {
    arm.move(10, 0.03 - 0.005 * k, 0.03 - 0.005 * k);
    most = std::max(most, std::fabs(arm.off(0) - (0.03 - 0.005 * k)));
  }
  CHECK(most < 0.02);
}

// At rest nothing is doubted: friction that has changed shows once the joint moves.
void limits_are_wide_until_strokes_have_shown_the_friction() {
  using F = FrictionFactors;
  const auto error = [](const Arm& arm) { return arm.tracker.state().joints[0].known.error; };
  const auto friction = [](const Arm& arm) { return std::fabs(arm.filtered[0][0]) + std::fabs(arm.filtered[0][1]); };
  Arm arm;
  arm.move(60, 0, 0, {}, true, 0);
  CHECK(error(arm) == 0 && arm.raised(0) == 0);
  arm.move(1, 0, 0);
  CHECK(error(arm) == F::kStart);
  CHECK_CLOSE(arm.raised(0.8), F::kWide * (F::kStart - F::kUsual) * friction(arm), 1e-9);
  arm.move(8, 0, 0);
  CHECK(error(arm) < F::kUsual && arm.raised(0.8) == 0);
  arm.move(3600, 0, 0, {}, true, 0);
  const F::Joint& joint = arm.tracker.state().joints[0];
  CHECK(joint.stiff < 0.01 && arm.raised(0) < 0.1);
  const double rested = std::sqrt(F::kChanges_s * 3600);
  CHECK(arm.raised(0.01) >= F::kWide * (rested - F::kUsual) * friction(arm));  // it breaks away
  arm.move(0.1, 0, 0);
  CHECK_CLOSE(error(arm), rested, 0.005);
  CHECK(joint.stiff >= F::kStiff * rested);
  arm.move(8, 0, 0);
  CHECK(error(arm) < F::kUsual);
  arm.move(120, 0, 0);
  CHECK(joint.stiff < 0.05);
  Arm pushed;  // a push is neither learned nor does it keep limits wide
  pushed.move(30, 0, 0, [](double, int j, const double*) { return j == 0 ? 4.0 : 0.0; });
  CHECK(std::fabs(pushed.off(0)) < 0.002 && error(pushed) < 0.25);
  pushed.move(30, 0, 0);
  CHECK(error(pushed) < F::kUsual);
}

// None of it for ten minutes, however strong. (Against a tool's velocity, what differs from friction must show beside the
// usual error: a push of 3 to 5 standard errors may not.)
void pushes_are_not_friction() {
  for (const double newton_metres : {0.5, 0.7, 1.0, 2.0, 10.0}) {
    const Arm::Push kinds[] = {
        [=](double, int j, const double*) { return j == 0 ? newton_metres : 0.0; },  // a constant one
        [=](double, int j, const double* dq) { return j == 0 && dq[0] > 0 ? -newton_metres : 0.0; },  // while moving one way
        [=](double t, int, const double*) { return newton_metres * std::sin(0.7 * t); },
        [=](double t, int j, const double* dq) {  // a hand that guides: as the joint goes, and never twice alike
          return newton_metres * std::tanh(dq[j] / 0.05) * (1 + 0.6 * std::sin(1.3 * t + j));
        },
        [=](double t, int j, const double* dq) {  // against the speed of a tool: the Jacobian couples the joints
          const double q = 1.5 * std::sin(0.4 * t);
          const double x[2] = {1.0, 0.6 * std::cos(q)}, y[2] = {0.2, 0.6 * std::sin(q)};
          const double vx = x[0] * dq[0] + x[1] * dq[1], vy = y[0] * dq[0] + y[1] * dq[1];
          return -newton_metres * (x[j] * vx + y[j] * vy) / std::max(std::hypot(vx, vy), 0.02);
        },
    };
    for (const Arm::Push& push : std::span(kinds).first(newton_metres < 2 ? 4 : 5)) {
      Arm arm;
      arm.move(check::emulated ? 240 : 600, 0, 0, push);
      // What a hand adds within four standard errors, as the joint goes, is a change of friction.
      const double most = newton_metres < 4 * kSigma ? 0.1 : 0.002;
      for (const std::size_t joint : {0u, 1u})
        for (const std::size_t part : {0u, 1u}) CHECK(std::fabs(arm.off(part, joint)) <= most);
    }
  }
}

void a_push_on_a_resting_arm_is_not_learned() {
  Arm arm;
  arm.move(120, 0, 0, [](double, int, const double*) { return 3.0; }, true, 0);
  CHECK(!arm.learned());
}

// A force at a constant lever on a joint that moves alone is not distinguishable from friction. At most the share is
// learned, and nothing of a larger force; the joint is then reported as saturated.
void at_most_a_share_of_friction_like_force_is_learned() {
  const double friction = kCoulomb + 0.5 * kViscous;
  const auto against = [](double nm) {
    return [nm](double, int j, const double* dq) { return j == 0 ? -nm * std::tanh(dq[0] / 0.01) : 0.0; };
  };
  Arm little(0.2), much(0.2);
  little.move(30, 0, 0, against(0.15 * friction), true, 1);
  much.move(30, 0, 0, against(0.5 * friction), true, 1);
  CHECK(little.off(0) > 0.1 && little.off(0) <= 0.4 && little.tracker.saturated() == 0);
  CHECK(!much.learned() && much.tracker.saturated() == 1);
}

// A touch now and then spoils a stroke, not the six.
void friction_is_followed_between_touches() {
  const auto touch = [](double t, int j, const double*) { return j == 0 && std::fmod(t, 7.0) < 0.5 ? 5.0 : 0.0; };
  Arm arm;
  arm.move(20, 0, 0);
  for (int k = 1; k <= 30; ++k) arm.move(10, -0.005 * k, -0.005 * k, touch);
  CHECK_CLOSE(arm.off(0), -0.15, 0.03);
  CHECK_CLOSE(arm.off(0, 1), -0.15, 0.03);
}

// A push on another joint shows that the arm is touched.
void nothing_is_learned_while_another_joint_shows_a_push() {
  const auto push = [](double t, int j, const double*) { return j == 1 ? 4.0 * std::sin(0.9 * t) : 0.0; };
  Arm arm;
  arm.move(60, 0.2, 0.2, push);
  CHECK(!arm.learned());
  arm.move(FrictionFactors::kStrokes * kPeriod, 0.2, 0.2);  // until its strokes are free of it
  CHECK_CLOSE(arm.off(0), 0.2, 0.03);
}

void what_cannot_be_trusted_teaches_nothing() {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  Arm arm;
  arm.move(30, 0.3, 0.3, {}, false);
  arm.move(30, 0, 0, [](double, int, const double*) { return nan; }, false);
  CHECK(!arm.learned());
  arm.move(0.9, 0.3, 0.3);
  CHECK(arm.tracker.state().joints[0].open.seconds > 0.5);
  arm.tracker.restart();
  CHECK(arm.tracker.state().joints[0].open.seconds == 0);
  arm.move(9.1, 0.3, 0.3);
  CHECK_CLOSE(arm.off(0), 0.3, 0.03);
  arm.tracker.restart();
  CHECK(arm.off(0) != 0);  // friction does not change with a lost sample
}

void without_a_standard_error_or_a_share_nothing_is_learned() {
  Arm none(0);
  none.move(30, 0.3, 0.3);
  CHECK(!none.learned() && none.drift[0] == 0 && !none.tracker.on());
  FrictionFactors blind(0.4, 1, kGain);
  DriftTracker off({}, {}, 1, kGain);
  for (int k = 1; k < 30'000; ++k) {
    const double dq[] = {std::sin(2e-3 * k)}, coulomb[] = {-8 * std::tanh(dq[0] / 0.01)}, viscous[] = {0};
    const double left[] = {0.3 * coulomb[0]}, sigma[] = {std::numeric_limits<double>::quiet_NaN()}, doubt[] = {0};
    double drift[] = {0};
    blind.step(k * kMs, coulomb, viscous, drift);
    blind.learn(dq, left, sigma, doubt, std::fabs(dq[0]) < 0.02, true, off);
  }
  CHECK(blind.state().joints[0].factors[0] == 0 && blind.state().joints[0].strokes[0].seconds == 0);
}

void strokes_grow_old() {
  Arm arm;
  arm.move(5, 0.3, 0.3);  // two whole strokes
  arm.move(FrictionFactors::kOld_s, 0.3, 0.3, {}, true, 0);
  arm.move(5, -0.3, -0.3);
  arm.move(4, -0.3, -0.3);
  CHECK(arm.off(0) < 0);  // old strokes are ignored
}

void a_restored_or_reset_tracker_goes_on_as_it_should() {
  Arm one, other;
  one.move(9.3, 0.2, 0.2);
  other.tracker.restore(one.tracker.state());
  other.t_ns = one.t_ns;
  std::memcpy(other.now, one.now, sizeof one.now);
  std::memcpy(other.filtered, one.filtered, sizeof one.filtered);
  std::memcpy(other.noise, one.noise, sizeof one.noise);
  other.random = one.random;
  for (int k = 0; k < 200; ++k) {
    one.move(0.05, 0.1, 0.1);
    other.move(0.05, 0.1, 0.1);
    CHECK(one.drift[0] == other.drift[0] && one.drift[1] == other.drift[1]);
  }
  one.tracker.reset();
  CHECK(!one.learned() && one.tracker.state().joints[0].strokes[0].seconds == 0);
}

// Cold gears are off at once and warm up within minutes, day after day: the factors hold all of it, and nothing adds up.
void cold_mornings_do_not_add_up() {
  const DriftSettings settings{30.0, {3.0, 3.0}, 1.0, 0.0, 0.0};
  for (const double warm : {0.0, -0.15}) {  // trained warm, and trained between
    Arm arm(1.5, settings);
    for (int day = 0; day < (check::emulated ? 3 : 5); ++day) {
      for (int minute = 0; minute < 15; ++minute) {
        const double off = warm + 0.2 * std::exp(-minute / 3.0);
        arm.move(60, off, off);
        CHECK(std::fabs(arm.tau_ext[0]) < 5 * kSigma && std::fabs(arm.tau_ext[1]) < 5 * kSigma);
      }
      for (const std::size_t joint : {0u, 1u}) CHECK_CLOSE(arm.off(0, joint), warm, 0.04);
      CHECK_CLOSE(arm.b(1) + arm.b(2) * 0.8, 0, 0.5);
    }
  }
}

// The factors say 0.3 and the slow tracker -0.2: both are right in sum. Their strokes know of both.
void opposite_parts_cancel_without_a_change_of_the_drift() {
  const DriftSettings settings{1e6, {3.0, 3.0}, 1e-9, 0.0, 0.0};  // it learns nothing more
  DriftTracker::Terms known{};
  known[1].fill(0.2 * kCoulomb);  // friction is opposite to the speed
  known[2].fill(0.2 * kViscous);
  FrictionFactors::Learned factors{};
  for (auto& one : factors) one.wanted = {0.3, 0.3};
  Arm arm(1.5, settings), blind(1.5, settings), same(1.5, settings);
  for (Arm* one : {&arm, &blind, &same}) one->tracker.put_learned(factors);
  for (Arm* one : {&arm, &blind}) one->slow.put_coefficients(known);
  for (int k = 0; k < 60; ++k) {
    arm.move(1, 0.1, 0.1);
    if (k > 1) CHECK(std::fabs(arm.tau_ext[0]) < 5 * kSigma && std::fabs(arm.tau_ext[1]) < 5 * kSigma);
  }
  CHECK_CLOSE(arm.off(0), 0.1, 0.02);
  CHECK_CLOSE(arm.b(1), 0, 0.01 * kCoulomb);
  CHECK_CLOSE(arm.b(2), 0, 0.01 * kViscous);
  blind.move(60, 0.1, 0.1, {}, false);  // nothing is trusted
  CHECK(blind.off(0) == 0.3 && blind.b(1) == known[1][0]);
  known[1].fill(-0.02);
  known[2].fill(-0.02);
  same.slow.put_coefficients(known);  // of the same sign: left alone, so that no more is learned than before
  same.move(60, 0.3, 0.3);
  CHECK_CLOSE(same.b(1), -0.02, 1e-6);
  CHECK_CLOSE(same.off(0), 0.3, 0.01);
}

}  // namespace

int main() {
  a_step_of_friction_is_followed_within_nine_seconds();
  parts_that_change_separately_are_separated();
  a_change_within_the_usual_error_is_followed();
  limits_are_wide_until_strokes_have_shown_the_friction();
  pushes_are_not_friction();
  a_push_on_a_resting_arm_is_not_learned();
  at_most_a_share_of_friction_like_force_is_learned();
  friction_is_followed_between_touches();
  nothing_is_learned_while_another_joint_shows_a_push();
  what_cannot_be_trusted_teaches_nothing();
  without_a_standard_error_or_a_share_nothing_is_learned();
  strokes_grow_old();
  a_restored_or_reset_tracker_goes_on_as_it_should();
  cold_mornings_do_not_add_up();
  opposite_parts_cancel_without_a_change_of_the_drift();
  return check::result();
}
