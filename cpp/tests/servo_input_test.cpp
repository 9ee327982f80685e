#include "tauext/servo_input.hpp"

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

#include "check.hpp"

using namespace tauext;

namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kCount = 2 * kPi / 4096;
constexpr std::int64_t kPeriod = 20'000'000;
// A motor of the size of an STS3215's, after its gear.
const ServoConstants kMotor{7.4, 2.75, 1.28, 1.28, 3.0, 0.97, kCount};

double counted(double q) { return kCount * std::round(q / kCount); }

ServoSettings servo(TorqueFrom from, int steps = 0) { return {from, steps, kPeriod, 0, {kMotor}}; }

// tau of one sample: q = 0, speed w, and what is measured.
double torque(TorqueFrom from, double w, std::span<const double> q_des, std::span<const double> current,
              std::span<const double> duty, std::span<const double> voltage = {}) {
  ServoInput input(servo(from));
  const double q[] = {0}, dq[] = {w};
  input.step({0, q, dq, {}, q_des, current, duty, voltage});
  return input.tau()[0];
}

// A motor at duty D and speed w has I = (V D - k_e w)/R and draws D I: each way of measuring gives that I back.
void every_way_gives_the_torque_of_the_motor() {
  std::mt19937 random(1);
  std::uniform_real_distribution<double> uniform(-1, 1);
  for (int trial = 0; trial < 1000; ++trial) {
    const double duty = 0.9 * uniform(random), w = 2 * uniform(random), volts = 7 + uniform(random);
    const double ampere = (volts * duty - kMotor.back_emf_v_s * w) / kMotor.ohm, tau = kMotor.nm_per_ampere * ampere;
    const double d[] = {duty}, i[] = {ampere}, v[] = {volts}, goal[] = {duty / kMotor.duty_per_rad};
    CHECK_CLOSE(torque(TorqueFrom::phase_current, w, {}, i, {}), tau, 1e-12);
    CHECK_CLOSE(torque(TorqueFrom::duty, w, {}, {}, d, v), tau, 1e-12);
    CHECK_CLOSE(torque(TorqueFrom::goal, w, goal, {}, {}, v), tau, 1e-12);
    const double drawn[] = {std::fabs(duty * ampere)};
    if (std::fabs(duty) < 1e-3 || duty * ampere < 0) continue;  // braking: an unsigned current has no direction
    CHECK_CLOSE(torque(TorqueFrom::supply_current, w, {}, drawn, d, v), tau, 1e-9);
    if (std::fabs(goal[0]) < 2 * kCount) continue;
    CHECK_CLOSE(torque(TorqueFrom::supply_current, w, goal, drawn, {}, v), tau, 1e-9);
  }
}

void the_goal_gives_no_more_than_the_largest_duty() {
  const double far[] = {1.0};
  CHECK_CLOSE(torque(TorqueFrom::goal, 0, far, {}, {}), kMotor.nm_per_ampere * 0.97 * kMotor.volts / kMotor.ohm, 1e-12);
}

// Two counts to each side of its goal, the root of an unsigned current would jump from one sign to the other.
void the_sign_of_a_supply_current_does_not_jump() {
  const double drawn[] = {0.0065};
  double last = -2;
  for (int k = -8; k <= 8; ++k) {
    const double goal[] = {0.5 * k * kCount};
    const double tau = torque(TorqueFrom::supply_current, 0, goal, drawn, {});
    if (last > -2) CHECK(tau >= last && tau - last < 0.05);
    last = tau;
  }
}

void what_is_missing_makes_nan() {
  const double zero[] = {0}, unknown[] = {std::nan("")};
  CHECK(std::isnan(torque(TorqueFrom::phase_current, 0, zero, {}, zero)));
  CHECK(std::isnan(torque(TorqueFrom::duty, 0, zero, zero, {})));
  CHECK(std::isnan(torque(TorqueFrom::goal, 0, {}, zero, zero)));
  CHECK(std::isnan(torque(TorqueFrom::supply_current, 0, {}, zero, {})));
  CHECK(std::isnan(torque(TorqueFrom::supply_current, 0, zero, unknown, zero)));
  CHECK(std::isnan(torque(TorqueFrom::duty, std::nan(""), {}, {}, zero)));
  CHECK(torque(TorqueFrom::duty, 0, {}, {}, zero, unknown) == 0);  // a voltage that was not measured is the usual one
  ServoInput input(servo(TorqueFrom::goal, 8));
  input.step({0, unknown, {}, {}, zero});
  CHECK(std::isnan(input.dq()[0]) && std::isnan(input.tau()[0]));
  input.step({kPeriod, zero, {}, {}, zero});
  CHECK(input.dq()[0] == 0 && input.tau()[0] == 0);
}

std::vector<double> velocities(std::span<const double> q, int steps, double count) {
  AdaptiveVelocity velocity(steps, std::span(&count, 1));
  std::vector<double> out;
  for (std::size_t k = 0; k < q.size(); ++k) {
    double dq[1];
    velocity.step(static_cast<std::int64_t>(k) * kPeriod, q.subspan(k, 1), 0, dq);
    out.push_back(dq[0]);
  }
  return out;
}

// The line of least squares through positions of a steady speed, rounded to counts, written out over all of the window.
void a_steady_speed_is_the_line_through_the_window() {
  constexpr int kSteps = 10;
  std::vector<double> q;
  for (int k = 0; k < 60; ++k) q.push_back(counted(0.003 + 0.11 * k * 0.02));
  const std::vector<double> got = velocities(q, kSteps, kCount);
  for (std::size_t k = kSteps; k < q.size(); ++k) {
    double t_mean = 0, q_mean = 0, tt = 0, tq = 0;
    for (std::size_t i = 0; i <= kSteps; ++i) {
      t_mean += 0.02 * static_cast<double>(i) / (kSteps + 1);
      q_mean += q[k - i] / (kSteps + 1);
    }
    for (std::size_t i = 0; i <= kSteps; ++i) {
      const double t = 0.02 * static_cast<double>(i) - t_mean;
      tt += t * t;
      tq -= t * (q[k - i] - q_mean);
    }
    CHECK_CLOSE(got[k], tq / tt, 1e-12);
    CHECK_CLOSE(got[k], 0.11, 0.25 * kCount / 0.02);  // a difference is off by up to a whole count a period
  }
}

// A count to and fro is no motion; a count a period would be 0.077 rad/s.
void a_flicker_between_two_counts_has_no_speed() {
  std::mt19937 random(2);
  std::vector<double> q;
  for (int k = 0; k < 500; ++k) q.push_back(random() % 2 ? kCount : 0.0);
  const std::vector<double> got = velocities(q, 16, kCount);
  for (std::size_t k = 16; k < got.size(); ++k) CHECK(std::fabs(got[k]) < 0.2 * kCount / 0.02);
}

// The window shortens as acceleration asks: a T^2/8 <= count, so that the speed is late by no more than T/2, and a step
// of the speed is in it after few samples.
void an_accelerating_joint_is_followed() {
  std::vector<double> q;
  double at = 0;
  for (int k = 0; k < 100; ++k) q.push_back(counted(at += (k < 50 ? 0.0 : 2.0) * 0.02));
  const std::vector<double> got = velocities(q, 16, kCount);
  CHECK_CLOSE(got[49], 0, 1e-12);
  CHECK_CLOSE(got[52], 2.0, 2 * kCount / 0.02);
}

void one_step_is_the_difference_and_so_is_no_count() {
  std::vector<double> q;
  for (int k = 0; k < 50; ++k) q.push_back(std::sin(0.3 * k));
  const std::vector<double> one = velocities(q, 1, kCount), none = velocities(q, 16, 0);
  for (std::size_t k = 1; k < q.size(); ++k) {
    CHECK_CLOSE(one[k], (q[k] - q[k - 1]) / 0.02, 1e-12);
    CHECK(one[k] == none[k]);
  }
  CHECK(one[0] == 0);
}

void a_pause_restarts_the_window() {
  ServoInput input(servo(TorqueFrom::torque, 16));
  const double tau[] = {0.5};
  std::int64_t t_ns = 0;
  double q[] = {0};
  for (int k = 0; k < 20; ++k, t_ns += kPeriod, q[0] += 0.01) input.step({t_ns, q, {}, tau});
  CHECK_CLOSE(input.dq()[0], 0.5, 1e-9);
  CHECK(input.tau()[0] == 0.5);
  t_ns += 2 * kPeriod;
  input.step({t_ns, q, {}, tau});
  CHECK(input.dq()[0] == 0);
}

// A goal that rises by 0.2 rad/s, delayed by two and a half periods: the line between the samples, once they are so old.
void a_goal_acts_after_its_delay() {
  ServoSettings settings = servo(TorqueFrom::goal);
  settings.goal_delay_ns = 5 * kPeriod / 2;
  ServoInput input(settings);
  const double still[] = {0};
  const double nm_per_rad = kMotor.nm_per_ampere * kMotor.volts * kMotor.duty_per_rad / kMotor.ohm;
  for (int k = 0; k < 30; ++k) {
    if (k == 20) input.reset();
    const double goal[] = {0.1 + 0.2e-9 * static_cast<double>(kPeriod) * (k % 20)};
    input.step({k * kPeriod, still, still, {}, goal});
    const double late = 0.1 + 0.004 * std::max(k % 20 - 2.5, 0.0);
    CHECK_CLOSE(input.tau()[0], nm_per_rad * late, 1e-9);
  }
  input.step({30 * kPeriod, still, still});
  CHECK(std::isnan(input.tau()[0]));
  settings.goal_delay_ns = 65 * kPeriod;
  CHECK_THROWS(ServoInput{settings}, Error);
}

void wrong_settings_are_refused() {
  ServoSettings none;
  CHECK(!none.on());
  CHECK_THROWS(ServoInput{none}, Error);
  for (double bad : {0.0, -1.0, std::nan("")}) {
    ServoSettings s = servo(TorqueFrom::goal);
    s.joints[0].ohm = bad;
    CHECK_THROWS(ServoInput{s}, Error);
    s = servo(TorqueFrom::goal);
    s.joints[0].duty_per_rad = bad;
    CHECK_THROWS(ServoInput{s}, Error);
  }
  ServoSettings s = servo(TorqueFrom::goal, AdaptiveVelocity::kMostSteps + 1);
  CHECK_THROWS(ServoInput{s}, Error);
  s = servo(TorqueFrom::goal, 4);
  s.sample_period_ns = 0;
  CHECK_THROWS(ServoInput{s}, Error);
}

}  // namespace

int main() {
  every_way_gives_the_torque_of_the_motor();
  the_goal_gives_no_more_than_the_largest_duty();
  the_sign_of_a_supply_current_does_not_jump();
  what_is_missing_makes_nan();
  a_steady_speed_is_the_line_through_the_window();
  a_flicker_between_two_counts_has_no_speed();
  an_accelerating_joint_is_followed();
  one_step_is_the_difference_and_so_is_no_count();
  a_pause_restarts_the_window();
  a_goal_acts_after_its_delay();
  wrong_settings_are_refused();
  return check::result();
}
