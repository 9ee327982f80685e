// What a refit refuses, that its weights are the most likely ones by another way, and that a monitor's memory holds what it
// was given. Friction of known size: tests/test_refit.py.
#include "tauext/refit.hpp"

#include <cmath>
#include <random>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "stages/estimates.hpp"
#include "stages/observation.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;

namespace {

constexpr int kSamples = 15'000;

// Two joints with a Coulomb and a viscous term each, and a motion whose torque has `factor` times that friction.
struct Arm {
  Bundle bundle = made::bundle(2, 0, 8, 10, 1);
  std::vector<std::int64_t> t_ns;
  std::vector<double> q, dq, tau;

  explicit Arm(double factor = 1, double noise_nm = 0) {
    PriorSettings& prior = bundle.prior;
    for (int joint = 0; joint < 2; ++joint) {
      prior.terms.push_back({TermKind::coulomb, joint, 0, 0, 0, 0.05});
      prior.terms.push_back({TermKind::viscous, joint});
    }
    prior.weights = {-4, -2, 0, 0, 0, 0, -3, -1};
    answer_reference(bundle);
    for (Level* level : {&bundle.limits.collision, &bundle.limits.contact})
      level->sliding_nm = level->near_stiction_nm = {2, 2};
    Tree tree(bundle.links, bundle.gravity);
    std::mt19937 random(1);
    std::normal_distribution<double> normal(0, noise_nm);
    double p_last[2] = {0, 0}, u_last[2] = {0, 0};
    bundle.observer.timing = TorqueTiming::averaged;
    for (int k = 0; k < kSamples; ++k) {
      double q_k[2], dq_k[2], unused[2], p[2], beta[2];
      made::signal(k, 2, q_k, dq_k, unused);
      tree.momentum(q_k, dq_k, p, beta);
      t_ns.push_back(k * made::kPeriodNs);
      for (int j = 0; j < 2; ++j) {
        const double coulomb = j == 0 ? 4 : 3, viscous = j == 0 ? 2 : 1;
        const double u = beta[j] + factor * (coulomb * std::tanh(dq_k[j] / 0.05) + viscous * dq_k[j]);
        q.push_back(q_k[j]);
        dq.push_back(dq_k[j]);
        tau.push_back((k ? (p[j] - p_last[j]) / 1e-3 + 0.5 * (u + u_last[j]) : u) + (noise_nm > 0 ? normal(random) : 0.0));
        p_last[j] = p[j];
        u_last[j] = u;
      }
    }
    answer_reference(bundle);
  }
  RecordingView view() const { return {kSamples, 2, t_ns.data(), q.data(), dq.data(), tau.data()}; }
  RefitSource source() const { return {view(), {}}; }
};

void friction_of_known_size_is_found() {
  const Arm arm(1.25, 0.05);
  const RefitSource source = arm.source();
  const Refit found = refit(arm.bundle, {&source, 1});
  for (const RefitJoint& joint : found.joints) {
    CHECK_CLOSE(joint.coulomb.value, 1.25, 0.01);
    CHECK_CLOSE(joint.viscous.value, 1.25, 0.02);
    CHECK(joint.coulomb.error > 0 && joint.coulomb.error < 0.02);
    CHECK(joint.limit_factor >= joint.coulomb.value);  // an error that is a share of the friction grows with it
    CHECK(std::isnan(joint.error_ratio));               // the bundle has no sigma
  }
  CHECK_CLOSE(found.bundle.prior.weights[0], -5.0, 0.05);
  CHECK_CLOSE(found.bundle.prior.weights[6], -3.75, 0.05);
  // A weight of another joint's term is none of its own.
  for (const std::size_t other : {2u, 3u, 4u, 5u}) CHECK(found.bundle.prior.weights[other] == 0);
}

// With nothing but the common factor free, and noise so small that it decides nothing: least squares of one unknown.
void one_unknown_is_least_squares() {
  const Arm arm(1.25);
  RefitSettings settings;
  settings.apart = settings.single = settings.constant = settings.ripple = 0;
  const RefitSource source = arm.source();
  const Refit found = refit(arm.bundle, {&source, 1}, settings);
  for (const RefitJoint& joint : found.joints) {
    CHECK_CLOSE(joint.coulomb.value, 1.25, 2e-3);  // what is left is the trapezoid against the true mean of a step
    CHECK_CLOSE(joint.coulomb.value, joint.viscous.value, 1e-12);
  }
  settings.common = 0;  // no unknown at all
  const Refit same = refit(arm.bundle, {&source, 1}, settings);
  CHECK(same.bundle.prior.weights == arm.bundle.prior.weights);
  CHECK(same.joints[0].coulomb.value == 1 && same.joints[0].coulomb.error == 0);
}

// The network learned a share of the old friction and is too small for today's: r is 1.2 times its output.
void a_networks_share_moves_with_the_friction() {
  Arm arm(1);
  Bundle with = made::bundle(2, 6, 8, 10, 1);
  with.observer = arm.bundle.observer;
  with.prior = arm.bundle.prior;
  with.limits = arm.bundle.limits;
  answer_reference(with);
  const Estimates said = estimate(with, arm.view(), 1);
  // r = a r + (1 - a) d, and a torque that is d less makes the residual d more.
  const double a = std::exp(-with.observer.gain_per_s * 1e-3);
  for (std::size_t k = 1; k < kSamples; ++k)
    for (std::size_t j = 0; j < 2; ++j) {
      const double now = said.network[2 * k + j], before = said.network[2 * (k - 1) + j];
      if (std::isfinite(now) && std::isfinite(before)) arm.tau[2 * k + j] -= 1.2 * (now - a * before) / (1 - a);
    }
  const RefitSource source = arm.source();
  const Refit found = refit(with, {&source, 1});
  for (std::size_t j = 0; j < 2; ++j)
    CHECK_CLOSE(found.bundle.output_scale_nm[j] / with.output_scale_nm[j], 1.2, 0.02);
  CHECK_CLOSE(found.joints[0].coulomb.value, 1.0, 0.02);
}

void what_makes_no_sense_is_refused() {
  const Arm arm;
  RefitSource source = arm.source();
  const auto one = std::span<const RefitSource>(&source, 1);
  CHECK_THROWS(refit(made::bundle(2, 0, 8, 10, 1), one), Error);  // no prior
  CHECK_THROWS(refit(arm.bundle, {}), Error);
  RefitSettings settings;
  settings.common = -1;
  CHECK_THROWS(refit(arm.bundle, one, settings), Error);
  settings.common = std::nan("");
  CHECK_THROWS(refit(arm.bundle, one, settings), Error);
  const std::vector<std::uint8_t> few(10, 1), none(kSamples, 0), all(kSamples, 1);
  source.use = few;
  CHECK_THROWS(refit(arm.bundle, one), Error);
  source.use = none;
  CHECK_THROWS(refit(arm.bundle, one), Error);
  source.use = all;
  CHECK(refit(arm.bundle, one).used_s > 14);
}

// Samples that a monitor refuses stay out of the filters.
void a_sample_that_is_no_number_costs_a_warm_up_and_no_more() {
  Arm arm(1.25, 0.05);
  arm.tau[2 * 5000] = std::nan("");
  const RefitSource source = arm.source();
  const Refit found = refit(arm.bundle, {&source, 1});
  CHECK_CLOSE(found.joints[0].coulomb.value, 1.25, 0.01);
  CHECK(found.used_s < 14.2 && found.used_s > 13.5);
}

void a_monitor_keeps_what_it_was_given() {
  const Arm arm(1.25, 0.05);
  Monitor monitor(arm.bundle);
  CHECK(!monitor.start_refit());  // no memory
  monitor.reserve_refit(2.0);
  CHECK(!monitor.start_refit(2.5) && !monitor.start_refit(std::nan("")));
  CHECK(monitor.start_refit());
  for (int k = 0; k < 2500; ++k) monitor.step(arm.view().at(k));
  CHECK(monitor.refit_full());
  const RecordingView kept = monitor.finish_refit();
  CHECK(kept.samples == 2000 && kept.joints == 2 && kept.t_ns[1999] == arm.t_ns[1999]);
  CHECK(kept.tau[3999] == arm.tau[3999] && kept.q[17] == arm.q[17] && kept.dq[18] == arm.dq[18]);
  CHECK(!monitor.refit_full());
  monitor.step(arm.view().at(2500));
  CHECK(monitor.last().limit_nm[0] == 2);
  monitor.start_refit();
  CHECK(monitor.refit_motion().samples == 0);
  Monitor without(made::bundle(2, 0, 8, 10, 1));
  without.reserve_refit(1.0);
  CHECK(!without.start_refit());  // no friction to widen by, none to bring up to date
}

}  // namespace

int main() {
  friction_of_known_size_is_found();
  one_unknown_is_least_squares();
  a_networks_share_moves_with_the_friction();
  what_makes_no_sense_is_refused();
  a_sample_that_is_no_number_costs_a_warm_up_and_no_more();
  a_monitor_keeps_what_it_was_given();
  return check::result();
}
