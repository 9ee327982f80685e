#include "alarm/drift.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>

#include "check.hpp"

using namespace tauext;

namespace {

constexpr std::int64_t kMs = 1'000'000;
constexpr double kDt = 1e-3, kTime = 5.0, kGain = 20.0;

Limits wide_limits() {
  Limits limits;
  limits.near_stiction_rad_s = 0.02;
  limits.collision = {{10, 10}, {20, 20}, 0.0};
  limits.contact = {{4, 4}, {8, 8}, 0.0};
  return limits;
}

// Two joints, never frozen by torque unless asked.
DriftSettings settings(double size = 1e3, double rate_share = 1.0, double freeze_share = 0, double freeze_s = 0) {
  return {kTime, {size, size}, rate_share, freeze_share, freeze_s};
}

// A tracker between what r shows and what is left of it.
struct Arm {
  DriftTracker tracker;
  std::int64_t t_ns = 0;
  double drift[2] = {0, 0}, tau_ext[2] = {0, 0}, doubt[2] = {0, 0}, scale[2] = {1, 1};

  explicit Arm(const DriftSettings& s) : tracker(s, wide_limits(), 2, kGain) {}
  void step(double dq_1, double dq_2, double left_1, double left_2, std::uint32_t near = 0, bool trusted = true) {
    const double dq[] = {dq_1, dq_2};
    tracker.step(t_ns += kMs, dq, drift);
    tau_ext[0] = left_1 - drift[0];
    tau_ext[1] = left_2 - drift[1];
    tracker.learn(tau_ext, scale, doubt, near, trusted);
  }
  double b(std::size_t term, std::size_t joint = 0) const { return tracker.state().coefficients[term][joint]; }
};

// At dq = 0 (and not called near stiction) phi = (1, 0, 0), and its filter has come to 1 - 1e-17 after 2 s. From there
// every step leaves 1 - dt/T of the error: a rounding of 1e-16 in each of 20,000 steps.
void a_constant_offset_is_learned_by_the_law_of_lms() {
  Arm arm(settings());
  for (int k = 0; k < 2000; ++k) arm.step(0, 0, 0, 0);
  const double filtered = arm.tracker.state().filtered[0][0];
  CHECK_CLOSE(filtered, 1.0, 1e-12);
  for (int k = 0; k < 20'000; ++k) {
    arm.step(0, 0, 2.0, -0.5);
    CHECK_CLOSE(arm.tau_ext[0], 2.0 * std::pow(1 - kDt / kTime, k), 1e-10);
    CHECK_CLOSE(arm.tau_ext[1], -0.5 * std::pow(1 - kDt / kTime, k), 1e-10);
  }
  CHECK(arm.b(1) == 0 && arm.b(2) == 0);
}

// Friction that has fallen, seen through the observer's filter: each coefficient finds its own share of it.
void changed_friction_is_separated_from_an_offset() {
  DriftSettings fast = settings();
  fast.time_constant_s = 1;
  Arm arm(fast);
  double filtered[3] = {0, 0, 0}, last[3] = {1, 0, 0};
  double left = 0;
  for (int k = 0; k < 600'000; ++k) {
    const double dq = 0.9 * std::sin(2e-3 * k) * std::sin(0.31e-3 * k);
    const double now[3] = {1, std::tanh(dq / 0.05), dq};
    left = 0;
    const double truth[3] = {0.4, 1.5, -0.8};
    for (int m = 0; m < 3; ++m) {
      if (k > 0) filtered[m] += -std::expm1(-kGain * kDt) * (0.5 * (last[m] + now[m]) - filtered[m]);
      last[m] = now[m];
      left += truth[m] * filtered[m];
    }
    arm.step(dq, 0, left, 0);
  }
  // 10 minutes are 600 time constants; the slowest direction, Coulomb against viscous, takes a sixtieth of the gain.
  CHECK_CLOSE(arm.b(0), 0.4, 1e-3);
  CHECK_CLOSE(arm.b(1), 1.5, 1e-3);
  CHECK_CLOSE(arm.b(2), -0.8, 2e-3);
  CHECK_CLOSE(arm.drift[0], left, 1e-3);
}

// Whatever comes, gaps and absurd numbers too: no coefficient leaves its bound or changes faster than it may.
void rate_and_size_are_bounded_under_any_input() {
  constexpr double kSize = 0.7, kShare = 0.05;
  Arm arm(settings(kSize, kShare));
  std::mt19937 random(3);
  std::uniform_real_distribution<double> exponent(-3, 300);
  for (int k = 0; k < 200'000; ++k) {
    const auto wild = [&] { return (random() % 2 ? 1 : -1) * std::pow(10.0, exponent(random)); };
    const DriftTracker::State before = arm.tracker.state();
    if (random() % 100 == 0) arm.t_ns += static_cast<std::int64_t>(random() % 3'000'000'000u);
    if (random() % 1000 == 0) arm.tracker.restart();
    const bool started = arm.tracker.state().started;
    const bool push = random() % 20 != 0;  // mostly one way, so that bounds are reached
    arm.step(push ? 1.0 : wild(), wild(), push ? 1e9 : wild(), wild());
    const DriftTracker::State& after = arm.tracker.state();
    const double dt = started ? 1e-9 * static_cast<double>(after.t_ns - before.t_ns) : 0;
    for (std::size_t m = 0; m < 3; ++m)
      for (std::size_t j = 0; j < 2; ++j) {
        CHECK(std::fabs(after.coefficients[m][j]) <= kSize);
        // Rounding of a sum of numbers below 1.
        CHECK(std::fabs(after.coefficients[m][j] - before.coefficients[m][j]) <= kShare * kSize * dt + 1e-15);
      }
    CHECK(std::fabs(arm.drift[0]) <= 3 * kSize && std::fabs(arm.drift[1]) <= 3 * kSize);
  }
  CHECK(arm.tracker.saturated() != 0);
}

// A push below the share that freezes: at most P t / T of it in the time t, times |f| max(1, 1/|f|) <= sqrt(3), and the
// terms' bounds.
void of_a_push_for_a_minute_no_more_is_learned_than_the_time_constant_allows() {
  for (const double push : {0.1, 1.0, 1.9}) {
    DriftSettings s = settings(1.0, 1.0 / 60, 0.5, 1.0);
    s.time_constant_s = 120;
    Arm arm(s), untouched(s);
    double most = 0;
    for (int k = 0; k < 60'000; ++k) {
      const double dq = std::sin(1.7e-3 * k);
      const std::uint32_t near = std::fabs(dq) < 0.02 ? 1 : 0;
      arm.step(dq, 1, push, 0, near);
      most = std::max(most, std::fabs(arm.drift[0]));
    }
    CHECK(most > 0.05 * push && most <= std::sqrt(3.0) * push * 60 / 120);
  }
}

void nothing_is_learned_while_touched_and_for_a_while_after() {
  Arm arm(settings(1e3, 1.0, 0.5, 0.25));  // a touch is more than 2 Nm, near stiction 4 Nm
  for (int k = 0; k < 2000; ++k) arm.step(1, 1, 0, 0);
  for (int k = 0; k < 500; ++k) arm.step(1, 1, 2.1, 1.0);  // joint 1 is touched: joint 2 learns nothing either
  CHECK(arm.b(0) == 0 && arm.b(0, 1) == 0 && arm.drift[0] == 0);
  for (int k = 0; k < 249; ++k) arm.step(1, 1, 1.0, 1.0);
  CHECK(arm.b(0) == 0 && arm.b(0, 1) == 0);
  arm.step(1, 1, 1.0, 1.0);  // 0.25 s after the last touch
  CHECK(arm.b(0) > 0 && arm.b(0, 1) > 0);
  const double learned = arm.b(0);
  arm.step(1, 1, -2.1 + arm.drift[0], 0);
  CHECK(arm.b(0) == learned && arm.drift[0] != 0);  // frozen, and still taken off
  // Limits that the motion lowers count as what is no touch at least.
  DriftSettings floored = settings(1e3, 1.0, 0.5, 0.25);
  floored.freeze_floor_nm = {1.5, 0};
  for (const double left : {1.4, 1.6}) {
    Arm easy(floored);
    easy.scale[0] = 0.1;
    for (int k = 0; k < 100; ++k) easy.step(1, 1, left + easy.drift[0], 0);
    CHECK((easy.b(0) > 0) == (left < 1.5));
  }
  // Doubt raises what counts as a touch, as it raises the limits.
  Arm doubting(settings(1e3, 1.0, 0.5, 0.25));
  doubting.doubt[0] = 1.0;
  for (int k = 0; k < 100; ++k) doubting.step(1, 1, 2.9, 0);
  CHECK(doubting.b(0) > 0);
}

void time_that_cannot_be_trusted_neither_teaches_nor_counts() {
  Arm arm(settings(1e3, 1.0, 0.5, 0.1));
  for (int k = 0; k < 1000; ++k) arm.step(1, 1, 1, 1, 0, false);
  CHECK(arm.b(0) == 0);
  arm.step(1, 1, 50, 0);
  for (int k = 0; k < 1000; ++k) arm.step(1, 1, std::numeric_limits<double>::quiet_NaN(), 1, 0, false);
  arm.tracker.restart();
  arm.t_ns = 0;  // a clock that was set back
  for (int k = 0; k < 99; ++k) arm.step(1, 1, 1, 1);
  CHECK(arm.b(0) == 0);
  for (int k = 0; k < 10; ++k) arm.step(1, 1, 1, 1);
  CHECK(arm.b(0) > 0);
}

void a_joint_near_stiction_learns_nothing_until_the_observer_has_forgotten() {
  Arm arm(settings());
  for (int k = 0; k < 5000; ++k) arm.step(0.01, 1, 1.5, 1.5, 1);
  CHECK(arm.b(0) == 0 && arm.b(0, 1) > 0);  // the other joint slides
  for (int k = 0; k < 149; ++k) arm.step(1, 1, 1.5, 1.5);
  CHECK(arm.b(0) == 0);
  arm.step(1, 1, 1.5, 1.5);  // 3/K0
  CHECK(arm.b(0) > 0);
}

void a_coefficient_at_its_bound_is_reported_until_it_leaves_the_bound() {
  Arm arm(settings(0.5));
  for (int k = 0; k < 10'000; ++k) arm.step(0, 0, 0.2, 3.0);
  CHECK(arm.tracker.saturated() == 2 && arm.b(0, 1) == 0.5 && arm.drift[1] <= 0.5);
  arm.step(0, 0, 0.2, 0);
  CHECK(arm.tracker.saturated() == 0 && arm.b(0, 1) < 0.5);
  DriftSettings none = settings();
  none.size_nm[1] = 0;
  Arm half(none);
  for (int k = 0; k < 1000; ++k) half.step(1, 1, 3.0, 3.0);
  CHECK(half.tracker.saturated() == 0 && half.drift[0] > 0 && half.drift[1] == 0);  // asked for none, and got none
}

void without_a_time_constant_there_is_no_drift() {
  Arm arm(DriftSettings{});
  for (int k = 0; k < 1000; ++k) arm.step(std::sin(0.01 * k), 5, 3, -3);
  CHECK(arm.drift[0] == 0 && !std::signbit(arm.drift[0]) && arm.tracker.saturated() == 0 && !arm.tracker.on());
}

void a_restored_or_reset_tracker_goes_on_as_it_should() {
  Arm one(settings()), other(settings());
  for (int k = 0; k < 700; ++k) one.step(0.5, -0.3, 1, 1);
  other.tracker.restore(one.tracker.state());
  other.t_ns = one.t_ns;
  for (int k = 0; k < 700; ++k) {
    one.step(0.5, -0.3, 1, 1);
    other.step(0.5, -0.3, 1, 1);
    CHECK(one.drift[0] == other.drift[0] && one.drift[1] == other.drift[1]);
  }
  one.tracker.reset();
  Arm fresh(settings());
  one.t_ns = 0;
  for (int k = 0; k < 700; ++k) {
    one.step(0.5, -0.3, 1, 1);
    fresh.step(0.5, -0.3, 1, 1);
    CHECK(one.drift[0] == fresh.drift[0]);
  }
}

}  // namespace

int main() {
  a_constant_offset_is_learned_by_the_law_of_lms();
  changed_friction_is_separated_from_an_offset();
  rate_and_size_are_bounded_under_any_input();
  of_a_push_for_a_minute_no_more_is_learned_than_the_time_constant_allows();
  nothing_is_learned_while_touched_and_for_a_while_after();
  time_that_cannot_be_trusted_neither_teaches_nor_counts();
  a_joint_near_stiction_learns_nothing_until_the_observer_has_forgotten();
  a_coefficient_at_its_bound_is_reported_until_it_leaves_the_bound();
  without_a_time_constant_there_is_no_drift();
  a_restored_or_reset_tracker_goes_on_as_it_should();
  return check::result();
}
