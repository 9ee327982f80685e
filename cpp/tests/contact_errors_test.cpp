#include "alarm/contact_errors.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <random>

#include "check.hpp"
#include "made_bundle.hpp"

using namespace tauext;

namespace {

constexpr std::int64_t kMs = 1'000'000;
constexpr double kSigma[] = {0.3, 0.4};

// Two joints with friction of 6 and 2 N m at rest: all of it Coulomb friction, or bent over two widths. The memory gap is 0.
Bundle rubbing_arm(bool bends) {
  Bundle b = made::bundle(2, 0, 0, 1, 1);
  b.prior.terms = {{TermKind::coulomb, 0, 0, 0, 0, 0.001}, {TermKind::coulomb, 1, 0, 0, 0, 0.001}};
  b.prior.weights = {-6, 0, 0, -2};
  b.wrench.torque_share = {0.06, 0.0};
  b.wrench.common_share = 0.08;
  if (!bends) return b;
  b.prior.widths_rad = {1e-4, 3e-4};
  b.prior.terms = {{TermKind::presliding, 0, 0, 0, 0, 0}, {TermKind::presliding, 0, 1, 0, 0, 0}, {TermKind::presliding, 1, 1, 0, 0, 0}};
  b.prior.weights = {-2, -4, 0, 0, 0, -2};
  return b;
}

struct Arm {
  Bundle bundle;
  ContactErrors errors;
  std::int64_t t_ns = 0;
  double sigma[2] = {0, 0}, gap[2] = {0, 0};
  double expected[2] = {0, 0}, drive[2] = {0, 0};  // friction in the prior, and the drives' torques

  explicit Arm(bool bends) : Arm(rubbing_arm(bends)) {}
  explicit Arm(const Bundle& made) : bundle(made), errors(bundle) {}
  void step(std::uint32_t near, bool touched, double tau_1 = 0, double tau_2 = 0, int times = 1) {
    const double tau[] = {tau_1, tau_2};
    for (int k = 0; k < times; ++k) errors.step(t_ns += kMs, near, touched, tau, kSigma, gap, {expected, drive}, sigma);
  }
  bool is(int joint, double hidden) const {
    return std::fabs(sigma[joint] - std::hypot(kSigma[joint], hidden)) < 1e-9;
  }
};

constexpr double kRubbing = 0.04;  // where training found no gear friction under a load
constexpr double kConstant[] = {0.1, 0.08};  // 0.06 and 0 of its own, and the common 0.08

// Half of a reversal's friction has turned after 1.8e-4 rad, where 2 (x / 1e-4 - 1) + 4 (x / 3e-4 - 1) = 0, and after 3e-4 rad.
constexpr double kUnseen[] = {1 / 1.8, 1 / 3.0};
double uniform(double largest) { return largest / std::sqrt(3.0); }

void free_motion_has_its_own_error_alone() {
  Arm arm(true);
  arm.step(3, false, 0, 0, 10);
  arm.step(0, false, 40, -40, 10);  // a torque that touches nothing changes nothing
  CHECK(arm.sigma[0] == kSigma[0] && arm.sigma[1] == kSigma[1]);
}

void a_joint_that_rests_through_a_contact_hides_what_its_positions_do_not_show_until_it_slides() {
  for (bool bends : {true, false}) {
    const double hidden = (bends ? kUnseen[0] : 1) * uniform(6);
    Arm arm(bends);
    arm.step(1, true, 0, 0, 5);
    CHECK(arm.is(0, hidden) && arm.is(1, 0));  // the other one slides
    arm.step(1, false, 0, 0, 5000);            // long after the contact
    CHECK(arm.is(0, hidden));
    arm.step(0, false);
    CHECK(arm.is(0, 0));
    arm.step(1, false);  // it rests again, of itself
    CHECK(arm.is(0, 0));
  }
  Arm both(true);
  both.expected[1] = -1.5;
  both.step(3, true);
  CHECK(both.is(0, kUnseen[0] * uniform(6)) && both.is(1, kUnseen[1] * std::hypot(1.5, uniform(2))));
}

// An uneven force leaves anything between what the prior expects and 0 of the friction that positions show.
void while_an_expected_contact_is_in_effect_the_friction_that_positions_show_may_slip() {
  for (bool presses : {false, true}) {
    Arm arm(true);
    arm.expected[1] = -1.5;
    const double tau[] = {0, 0}, seen = 1 - kUnseen[1] * kUnseen[1];
    arm.errors.step(kMs, 3, true, tau, kSigma, arm.gap, {arm.expected, arm.drive}, arm.sigma, presses);
    const double hidden = kUnseen[1] * std::hypot(1.5, uniform(2)), slipped = presses ? std::sqrt(seen) * uniform(1.5) : 0;
    CHECK(arm.is(0, kUnseen[0] * uniform(6)) && arm.is(1, std::hypot(hidden, slipped)));
  }
}

// A stuck joint's friction is anything that its static friction allows, whatever the prior expects and the gear carries.
void the_truth_is_within_two_standard_errors_where_positions_show_nothing() {
  Bundle b = rubbing_arm(false);
  b.prior.terms.push_back({TermKind::load, 0, 0, 0, 0, 0.001});
  b.prior.weights = {-6, 0, -0.1, 0, -2, 0};
  b.observer.nm_per_unit = {2, 1};
  b.validate();
  for (double drive : {0.0, -20.0}) {  // of twice as many N m, a tenth of which adds to the friction
    const double largest = 6 + 0.2 * std::fabs(drive);
    double least = 10;
    for (int k = -300; k <= 300; ++k) {
      Arm arm(b);
      arm.expected[0] = 0.1 * k;
      arm.drive[0] = drive;
      arm.step(1, true);
      least = std::min(least, 2 * std::sqrt(arm.sigma[0] * arm.sigma[0] - kSigma[0] * kSigma[0]) / (std::fabs(arm.expected[0]) + largest));
    }
    CHECK(least > 1 - 1e-12 && least < 1.001);  // nor is it wider than this needs
  }
  Arm unknown(b);  // without the prior's friction: as if one end were expected
  const double drive[] = {-20, 0}, tau[] = {0, 0};
  unknown.errors.step(kMs, 1, true, tau, kSigma, unknown.gap, {{}, drive}, unknown.sigma);
  CHECK(unknown.is(0, std::hypot(10, uniform(10))));
}

void what_stops_soon_after_a_contact_rests_under_it() {
  Arm soon(true), late(true);
  soon.step(0, true);
  soon.step(0, false, 0, 0, 900);
  soon.step(2, false);
  CHECK(soon.is(1, kUnseen[1] * uniform(2)) && soon.is(0, 0));
  late.step(0, true);
  late.step(0, false, 0, 0, 1100);
  late.step(2, false);
  CHECK(late.is(1, 0));
}

void a_joint_at_rest_is_pressed_from_three_standard_errors_on_though_no_limit_is_exceeded() {
  Arm arm(true);
  arm.step(3, false, 2.9 * kSigma[0], 0);
  CHECK(arm.is(0, 0) && arm.is(1, 0));
  arm.step(3, false, -3.1 * kSigma[0], 0);
  CHECK(arm.is(0, kUnseen[0] * uniform(6)) && arm.is(1, 0));
  arm.step(3, false);
  CHECK(arm.is(0, kUnseen[0] * uniform(6)));
  arm.step(2, false);
  arm.step(3, false);
  CHECK(arm.is(0, 0));
}

// The friction of a joint that slides, or rests and was not touched, has no influence; brought() and step() find the same.
void friction_counts_at_pressed_joints_alone() {
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  std::mt19937 random(5);
  std::normal_distribution<double> normal(0, 1);
  Arm arm(true), without(true);
  int pressed = 0;
  for (int k = 0; k < 20000; ++k) {
    const auto near = static_cast<std::uint32_t>(k / 700 % 4);
    const bool touched = k % 3000 < 50;
    const double tau[] = {0.5 * normal(random), 0.5 * normal(random)};
    for (int j = 0; j < 2; ++j) {
      arm.expected[j] = 3 * normal(random);
      arm.drive[j] = 20 * normal(random);
    }
    arm.step(near, touched, tau[0], tau[1]);
    arm.errors.find_hidden(near, {arm.expected, arm.drive});
    for (int j = 0; j < 2; ++j) {
      const bool counts = arm.errors.state().pressed >> j & 1;  // and rests
      without.expected[j] = counts ? arm.expected[j] : kNan;
      without.drive[j] = counts ? arm.drive[j] : kNan;
    }
    without.step(near, touched, tau[0], tau[1]);
    for (int j = 0; j < 2; ++j) {
      CHECK(std::bit_cast<std::uint64_t>(arm.sigma[j]) == std::bit_cast<std::uint64_t>(without.sigma[j]));
      if (!(arm.errors.state().pressed >> j & 1)) continue;
      ++pressed;
      const double least = kSigma[j] * kSigma[j] + arm.errors.brought(j, true, 0);
      CHECK(arm.sigma[j] * arm.sigma[j] >= least * (1 - 1e-12));
    }
  }
  CHECK(pressed > 1000 && pressed < 30000);
}

// Local and nonlocal memory differ by so much of the presliding friction; where training found local memory, less is unsure.
void the_kind_of_memory_is_in_doubt_while_a_pressed_joint_rests() {
  for (bool found : {false, true}) {
    Bundle b = rubbing_arm(false);
    b.prior.widths_rad = {1e-4};
    b.prior.branches = {1, 1};
    b.prior.terms.push_back({TermKind::presliding, 0, 0, 0, 0, 0});
    b.prior.weights = {-6, 0, -5, 0, -2, 0};
    if (found) {
      b.prior.terms.push_back({TermKind::local_memory, 0, 0, 0, 0, 0});
      b.prior.weights = {-6, 0, -5, -4, 0, -2, 0, 0};
    }
    b.validate();
    ContactErrors errors(b), without(b);
    const double tau[] = {0, 0}, gap[] = {-0.5, 0.5};
    double sigma[2], plain[2];
    errors.step(kMs, 3, true, tau, kSigma, gap, {tau, tau}, sigma);
    without.step(kMs, 3, true, tau, kSigma, {}, {tau, tau}, plain);
    const double unsure = 5 * 0.5 * (found ? 0.05 : 0.3);
    CHECK(std::fabs(sigma[0] - std::hypot(plain[0], unsure)) < 1e-12 && sigma[1] == plain[1]);
    errors.step(2 * kMs, 0, false, tau, kSigma, gap, {tau, tau}, sigma);
    CHECK(sigma[0] == kSigma[0]);
  }
}

// While the torque rises by a constant rate, the observer is 1/K0 of it behind; the rate itself is filtered with K0.
// Gear friction and the torque constant add their shares of the torque.
void the_lag_counts_during_a_contact_and_fades_after_it() {
  Arm arm(true);
  const double gain = arm.bundle.observer.gain_per_s, rate = 100;
  for (int k = 0; k < 2000; ++k) arm.step(0, true, rate * 1e-3 * k);
  CHECK(std::fabs(arm.sigma[0] - std::hypot(kSigma[0], rate / gain, std::hypot(kRubbing, kConstant[0]) * rate * 1.999)) < 1e-6);
  CHECK(arm.sigma[1] == kSigma[1]);
  const double before = arm.sigma[0];
  for (int k = 2000; k < 2000 + static_cast<int>(5000 / gain); ++k) arm.step(0, false, rate * 1e-3 * k);
  CHECK(arm.sigma[0] < 0.1 * before + kSigma[0]);
}

void a_sample_without_a_torque_makes_no_rate() {
  Arm arm(true);
  arm.step(0, true, 0, 0, 3);
  arm.errors.skip();
  arm.step(0, true, 50, 50);
  for (int j = 0; j < 2; ++j) CHECK(arm.is(j, std::hypot(kRubbing, kConstant[j]) * 50));
  ContactErrors other(arm.bundle);
  other.restore(arm.errors.state());
  double here[2], there[2];
  const double tau[] = {51, 49};
  arm.errors.step(arm.t_ns + kMs, 3, false, tau, kSigma, {}, {arm.expected, arm.drive}, here);
  other.step(arm.t_ns + kMs, 3, false, tau, kSigma, {}, {arm.expected, arm.drive}, there);
  CHECK(here[0] == there[0] && here[1] == there[1] && here[0] > 1);
}

}  // namespace

int main() {
  free_motion_has_its_own_error_alone();
  a_joint_that_rests_through_a_contact_hides_what_its_positions_do_not_show_until_it_slides();
  while_an_expected_contact_is_in_effect_the_friction_that_positions_show_may_slip();
  the_truth_is_within_two_standard_errors_where_positions_show_nothing();
  what_stops_soon_after_a_contact_rests_under_it();
  a_joint_at_rest_is_pressed_from_three_standard_errors_on_though_no_limit_is_exceeded();
  friction_counts_at_pressed_joints_alone();
  the_kind_of_memory_is_in_doubt_while_a_pressed_joint_rests();
  the_lag_counts_during_a_contact_and_fades_after_it();
  a_sample_without_a_torque_makes_no_rate();
  return check::result();
}
