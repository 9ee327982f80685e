#include "chain/comparison_residuals.hpp"

#include <cmath>
#include <cstring>
#include <random>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "refused.hpp"

using namespace tauext;

namespace {

constexpr double kGain = 20.0, kMass = 2.0, kPush = 5.0;
const double zero[kMaxJoints] = {};

// A mass that slides without gravity: p = m dq, beta = 0.
Tree sliding_mass() {
  Link link;
  link.joint_name = "slide";
  link.type = JointType::prismatic;
  link.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  link.mass = kMass;
  return Tree({link}, {0, 0, 0});
}

Tree arm(int joints) {
  const Bundle b = made::bundle(joints, 0, 1, 1, 1);
  return Tree(b.links, b.gravity);
}

// Feeds a method with states of a tree.
struct Fed {
  Tree tree;
  ComparisonResidual method;
  std::size_t n = static_cast<std::size_t>(tree.size());
  JointVector p{}, beta{}, r{};

  Fed(const Tree& of, ResidualMethod what, double gain_per_s = kGain, TorqueTiming timing = TorqueTiming::held)
      : tree(of), method(of, what, gain_per_s, timing) {}
  void step(std::int64_t t_ns, const double* q, const double* dq, const double* tau) {
    tree.momentum({q, n}, {dq, n}, std::span(p).first(n), std::span(beta).first(n));
    method.step(tree, t_ns, {q, n}, {dq, n}, std::span(p).first(n), std::span(beta).first(n), {tau, n},
                std::span(r).first(n));
  }
};

// Steps of 0.3 to 1.7 ms, and now and then one of a second: K0 dt = 20.
std::int64_t varied_step_ns(int k) { return k % 400 == 399 ? 1'000'000'000 : 300'000 + 700'000 * (k % 3); }

// A mass pushed from rest: r(t) = (1 - exp(-K0 t)) F for the velocity observer, since M = D; F at once, unfiltered.
void a_constant_push_on_one_joint_gives_the_closed_forms() {
  Fed velocity(sliding_mass(), ResidualMethod::velocity), direct(sliding_mass(), ResidualMethod::direct);
  std::int64_t t_ns = 0;
  for (int k = 0; k < 2000; ++k) {
    const double t = 1e-9 * static_cast<double>(t_ns), dq[1] = {kPush / kMass * t};
    velocity.step(t_ns, zero, dq, zero);
    direct.step(t_ns, zero, dq, zero);
    // 1e-8: rounding of p (some N s) divided by a step of 0.3 ms.
    CHECK_CLOSE(velocity.r[0], kPush * (1 - std::exp(-kGain * t)), 1e-8);
    CHECK_CLOSE(direct.r[0], k ? kPush : 0.0, 1e-8);
    t_ns += varied_step_ns(k);
  }
}

// The mass slides at 3 m/s while the motor holds against the push: its power F v, through the filter, exactly.
void power_at_constant_speed_gives_the_closed_form() {
  for (const TorqueTiming timing : {TorqueTiming::held, TorqueTiming::instant, TorqueTiming::averaged}) {
    Fed energy(sliding_mass(), ResidualMethod::energy, kGain, timing);
    const double dq[1] = {3.0}, tau[1] = {-kPush};
    std::int64_t t_ns = 0;
    for (int k = 0; k < 2000; ++k) {
      energy.step(t_ns, zero, dq, tau);
      CHECK_CLOSE(energy.r[0], 3.0 * kPush * (1 - std::exp(-kGain * 1e-9 * static_cast<double>(t_ns))), 1e-9);
      t_ns += varied_step_ns(k);
    }
  }
}

// Pushed from rest, F v rises as a ramp c t, c = F^2/m: r(t) = c (t - (1 - exp(-K0 t))/K0). A step sees its mean power.
void power_of_a_push_from_rest_follows_the_filtered_ramp() {
  Fed energy(sliding_mass(), ResidualMethod::energy);
  const double c = kPush * kPush / kMass, dt = 1e-3;
  for (int k = 0; k < 2000; ++k) {
    const double t = dt * k, dq[1] = {kPush / kMass * t};
    energy.step(k * 1'000'000, zero, dq, zero);
    CHECK_CLOSE(energy.r[0], c * (t + std::expm1(-kGain * t) / kGain), c * kGain * dt * dt);  // O(dt^2)
  }
}

// Every joint of an arm gets the same power, and none at rest, whatever torque holds it.
void power_is_one_number_for_the_arm() {
  Fed energy(arm(3), ResidualMethod::energy);
  double q[kMaxJoints], dq[kMaxJoints], tau[kMaxJoints];
  for (int k = 0; k < 300; ++k) {
    made::signal(k, 3, q, dq, tau);
    energy.step(k * 1'000'000, q, zero, tau);
    CHECK(energy.r[0] == 0.0);
  }
  for (int k = 300; k < 600; ++k) {
    made::signal(k, 3, q, dq, tau);
    energy.step(k * 1'000'000, q, dq, tau);
    CHECK(energy.r[0] == energy.r[1] && energy.r[1] == energy.r[2]);
  }
  CHECK(energy.r[0] != 0.0);
}

// An arm of two joints at rest, held against an external torque: dr/dt = K0 D M^-1 (tau_ext - r). Largest error of r at
// this step against the same equation by Runge and Kutta at a thousandth of it.
double error_of_the_coupled_step(double dt) {
  const double q[2] = {0.4, 1.1}, tau_ext[2] = {3.0, -2.0};
  Fed fed(arm(2), ResidualMethod::velocity);
  JointVector g{};
  double mass[2][2];
  for (std::size_t i = 0; i < 2; ++i) {
    const double unit[2] = {i == 0 ? 1.0 : 0.0, i == 1 ? 1.0 : 0.0};
    fed.tree.momentum({q, 2}, {unit, 2}, {mass[i], 2}, std::span(g).first(2));
  }
  fed.tree.momentum({q, 2}, {zero, 2}, std::span(fed.p).first(2), std::span(g).first(2));
  const double tau[2] = {g[0] - tau_ext[0], g[1] - tau_ext[1]};
  const double determinant = mass[0][0] * mass[1][1] - mass[0][1] * mass[0][1];
  const auto slope = [&](const double* r, double* out) {
    const double e[2] = {tau_ext[0] - r[0], tau_ext[1] - r[1]};
    out[0] = kGain * mass[0][0] * (mass[1][1] * e[0] - mass[0][1] * e[1]) / determinant;
    out[1] = kGain * mass[1][1] * (mass[0][0] * e[1] - mass[0][1] * e[0]) / determinant;
  };
  double exact[2] = {0, 0}, largest = 0;
  for (int k = 0; 1e-9 * k * std::round(dt * 1e9) < 2.0; ++k) {
    fed.step(static_cast<std::int64_t>(k * std::round(dt * 1e9)), q, zero, tau);
    for (int part = 0; k && part < 1000; ++part) {
      const double h = dt / 1000;
      double a[2], b[2], middle[2];
      slope(exact, a);
      for (int i = 0; i < 2; ++i) middle[i] = exact[i] + 0.5 * h * a[i];
      slope(middle, b);
      for (int i = 0; i < 2; ++i) exact[i] += h * b[i];
    }
    for (std::size_t i = 0; i < 2; ++i) largest = std::fmax(largest, std::fabs(fed.r[i] - exact[i]));
  }
  for (std::size_t i = 0; i < 2; ++i) CHECK_CLOSE(fed.r[i], tau_ext[i], 1e-4);
  return largest;
}

void the_velocity_observer_of_coupled_joints_converges_with_its_step() {
  const double coarse = error_of_the_coupled_step(2e-3), fine = error_of_the_coupled_step(1e-3);
  CHECK(coarse < 0.2);  // of 3 N m, with K0 dt = 0.04
  CHECK_CLOSE(coarse / fine, 2.0, 0.2);  // first order
}

// Poses that jump and steps of K0 dt = 0.02 to 2e9: the error shortens in the norm of D^-1 at every step.
void the_velocity_observer_is_stable_for_any_step_and_motion() {
  for (const int joints : {2, 7, kMaxJoints}) {
    Fed fed(arm(joints), ResidualMethod::velocity, kGain, TorqueTiming::averaged);
    std::mt19937 random(7);
    std::uniform_real_distribution<double> angle(-3, 3);
    double q[kMaxJoints], tau[kMaxJoints];
    JointVector d{}, before{};
    double last = INFINITY;
    std::int64_t t_ns = 0;
    for (int k = 0; k < 160; ++k) {
      for (int j = 0; j < joints; ++j) q[j] = angle(random);
      fed.tree.momentum({q, fed.n}, {zero, fed.n}, std::span(fed.p).first(fed.n), std::span(fed.beta).first(fed.n));
      // At rest the disturbance is mean beta - tau: tau_ext = 1 N m at every joint.
      for (std::size_t j = 0; j < fed.n; ++j) tau[j] = 0.5 * (before[j] + fed.beta[j]) - 1.0;
      before = fed.beta;
      fed.step(t_ns, q, zero, tau);
      if (k == 0)
        for (std::size_t j = 0; j < fed.n; ++j) {
          double unit[kMaxJoints] = {};
          unit[j] = 1.0;
          JointVector column, unused;
          fed.tree.momentum({q, fed.n}, {unit, fed.n}, std::span(column).first(fed.n), std::span(unused).first(fed.n));
          d[j] = column[j];
        }
      double norm = 0;
      for (std::size_t j = 0; j < fed.n; ++j) norm += (fed.r[j] - 1.0) * (fed.r[j] - 1.0) / d[j];
      CHECK(norm < last || norm < 1e-20);  // rounding is all that is left
      last = norm;
      t_ns += k < 100 ? 1'000'000 : k < 150 ? 1'000'000'000 : 100'000'000'000'000'000;
    }
    CHECK(last < 1e-20);
  }
}

void all_methods_wait_ten_time_constants_and_coupled_velocities_longer() {
  Fed direct(arm(2), ResidualMethod::direct), energy(arm(2), ResidualMethod::energy);
  Fed velocity(arm(2), ResidualMethod::velocity), single(sliding_mass(), ResidualMethod::velocity);
  int coupled = -1, alone = -1;
  for (int k = 0; k < 2000; ++k) {
    for (Fed* fed : {&direct, &energy, &velocity, &single}) fed->step(k * 1'000'000, zero, zero, zero);
    CHECK(direct.method.warm() == (k >= 500) && energy.method.warm() == (k >= 500));
    if (coupled < 0 && velocity.method.warm()) coupled = k;
    if (alone < 0 && single.method.warm()) alone = k;
  }
  CHECK(alone == 500 || alone == 501);  // a sum of 500 roundings
  CHECK(coupled > 500 && coupled <= 1000 + 10);  // two joints: at most twice as slow
}

void reset_equals_fresh() {
  for (const ResidualMethod what : {ResidualMethod::direct, ResidualMethod::velocity, ResidualMethod::energy}) {
    Fed used(arm(2), what), fresh(arm(2), what);
    double q[2], dq[2], tau[2];
    for (int k = 0; k < 100; ++k) made::signal(k, 2, q, dq, tau), used.step(k * 1'000'000, q, dq, tau);
    used.method.reset();
    CHECK(!used.method.warm());
    for (int k = 50; k < 150; ++k) {
      made::signal(k, 2, q, dq, tau);
      used.step(k * 1'000'000, q, dq, tau);
      fresh.step(k * 1'000'000, q, dq, tau);
      CHECK(used.r[0] == fresh.r[0] && used.r[1] == fresh.r[1]);
      CHECK(k > 50 || (used.r[0] == 0.0 && used.r[1] == 0.0));
    }
  }
}

// Filter output at every sample for x(t) at varied steps, warm from `warm_s` on.
template <class Input>
void filtered(double high_per_s, double low_per_s, double warm_s, Input&& x_then_check) {
  ResidualFilter filter(1, high_per_s, low_per_s);
  std::int64_t t_ns = 7;
  for (int k = 0; k < 4000; ++k) {
    const double t = 1e-9 * static_cast<double>(t_ns - 7);
    x_then_check(t, [&](double x) {
      double r[1] = {x};
      filter.step(t_ns, t >= warm_s, r);
      return r[0];
    }, filter);
    t_ns += 300'000 + 700'000 * (k % 3);
  }
}

void a_low_pass_gives_the_closed_form() {
  const double w = 30.0;
  filtered(0, w, 0.0, [&](double t, auto&& said, const ResidualFilter& filter) {
    CHECK_CLOSE(said(4.0), 4.0 * (1 - std::exp(-w * t)), 1e-12);
    CHECK(filter.warm() == (t >= 10 / w));
  });
}

// A constant before the warm-up ends is nothing to a high-pass; a step after it fades as exp(-w t).
void a_high_pass_begins_in_its_steady_state_and_gives_the_closed_form() {
  const double w = 0.8;
  double last_t = 0, step_t = -1;  // the step acts over the whole sampling step that ends in it
  filtered(w, 0, 0.5, [&](double t, auto&& said, const ResidualFilter& filter) {
    if (t >= 1.5 && step_t < 0) step_t = last_t;
    const double expected = step_t < 0 ? 0.0 : 3.0 * std::exp(-w * (t - step_t));
    CHECK_CLOSE(said(t < 1.5 ? -2.0 : 1.0), expected, 1e-12);
    CHECK(filter.warm() == (t >= 0.5));
    last_t = t;
  });
}

// A step through both: l/(l - h) (exp(-h t) - exp(-l t)), to the order of the sampling step.
void both_are_a_band_pass() {
  const double h = 2.0, l = 40.0;
  double step_t = -1, last_t = 0;
  filtered(h, l, 0.0, [&](double t, auto&& said, const ResidualFilter& filter) {
    if (t >= 1.0 && step_t < 0) step_t = last_t;
    const double since = t - step_t;
    const double expected = step_t < 0 ? 0.0 : l / (l - h) * (std::exp(-h * since) - std::exp(-l * since));
    CHECK_CLOSE(said(t < 1.0 ? 0.0 : 1.0), expected, h * 1.7e-3);  // the slow part sees only the end of a 1.7 ms step
    CHECK(filter.warm() == (t >= 10 / l));
    last_t = t;
  });
}

void bad_settings_are_refused_by_name() {
  Link link = sliding_mass().links()[0];
  link.mass = 0;
  const Tree none({link}, {0, 0, 0});
  const auto make = [](const Tree& tree, ResidualMethod what) { Fed(tree, what); };
  refused("joint 'slide': its inertia is 0 and must be > 0: the velocity observer needs a model",
          [&] { make(none, ResidualMethod::velocity); });
  refused("none of momentum, direct", [&] { make(none, static_cast<ResidualMethod>(4)); });
  make(none, ResidualMethod::direct);
  make(none, ResidualMethod::energy);
  refused("high_pass_per_s = -1 1/s must be >= 0", [] { ResidualFilter(1, -1, 0); });
  refused("low_pass_per_s = nan", [] { ResidualFilter(1, 0, NAN); });
  refused("low_pass_per_s = inf", [] { ResidualFilter(1, 0, INFINITY); });
  CHECK(std::strcmp(name(ResidualMethod::energy), "energy") == 0 && name(static_cast<ResidualMethod>(4))[0] == '\0');
}

}  // namespace

int main() {
  a_constant_push_on_one_joint_gives_the_closed_forms();
  power_at_constant_speed_gives_the_closed_form();
  power_of_a_push_from_rest_follows_the_filtered_ramp();
  power_is_one_number_for_the_arm();
  the_velocity_observer_of_coupled_joints_converges_with_its_step();
  the_velocity_observer_is_stable_for_any_step_and_motion();
  all_methods_wait_ten_time_constants_and_coupled_velocities_longer();
  reset_equals_fresh();
  a_low_pass_gives_the_closed_form();
  a_high_pass_begins_in_its_steady_state_and_gives_the_closed_form();
  both_are_a_band_pass();
  bad_settings_are_refused_by_name();
  return check::result();
}
