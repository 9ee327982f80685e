// Friction that follows the joints' temperatures.
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <limits>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "made_signals.hpp"
#include "stages/observation.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;
using made::kMs, made::sampled, made::Signals;

namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

// Friction of two joints beside a constant and a ripple that no temperature changes.
PriorSettings friction(double coulomb_times = 1, double viscous_times = 1) {
  PriorSettings prior;
  prior.widths_rad = {3e-3};
  prior.weights.resize(24);
  for (std::int32_t j = 0; j < 2; ++j) {
    prior.terms.push_back({TermKind::constant, j, 0, 0, 0, 0});
    prior.terms.push_back({TermKind::viscous, j, 0, 0, 0, 0});
    prior.terms.push_back({TermKind::coulomb, j, 0, 0, 0, 0.05});
    prior.terms.push_back({TermKind::presliding, j, 0, 0, 0, 0});
    prior.terms.push_back({TermKind::load, j, 0, 0, 0, 0.1});
    prior.terms.push_back({TermKind::ripple, j, 37, 0, 0, 0});
    const double weights[] = {0.7, -2 * viscous_times, -3 * coulomb_times, -1 * coulomb_times, -0.1 * coulomb_times, 0.4};
    std::copy_n(weights, 6, prior.weights.begin() + j * (12 + 6));
  }
  return prior;
}

FrictionTemperature follows() { return {{30, 40}, {20, 20}, {-0.08, -0.08}, {-0.2, -0.2}}; }

Signals motion(int samples) {
  std::vector<std::int64_t> t_ns;
  for (int k = 0; k < samples; ++k) t_ns.push_back(k * kMs);
  return sampled(2, t_ns);
}

Bundle bundle() {
  Bundle b = made::bundle(2, 0, 30, 10, 1);
  b.prior = friction();
  b.prior.temperature = follows();
  answer_reference(b);
  return b;
}

// A prior of fixed weights says the same where the temperature stays: both joints 15 K over their reference, or at the
// end of the reach.
void friction_is_that_of_the_scaled_weights() {
  const Bundle b = made::bundle(2, 0, 30, 10, 1);
  const Tree tree(b.links, b.gravity);
  const Signals s = motion(1500);
  for (const double over : {-10.0, 0.0, 15.0, 400.0}) {
    std::vector<double> celsius;
    for (std::size_t k = 0; k < s.t_ns.size(); ++k) {
      celsius.push_back(k % 3 == 1 ? kNan : 30 + over);  // what is not known holds
      celsius.push_back(k % 3 == 2 ? kNan : 40 + over);
    }
    RecordingView warm = s.view();
    warm.temperature = celsius.data();
    PriorSettings following = friction();
    following.temperature = follows();
    const double tens = std::min(over, 20.0) / 10;
    const auto one = observe(tree, b.observer, following, warm).prior;
    const auto other = observe(tree, b.observer, friction(1 - 0.08 * tens, 1 - 0.2 * tens), s.view()).prior;
    for (std::size_t k = 0; k < one.size(); ++k) CHECK_CLOSE(one[k], other[k], 1e-12);  // rounding of sums of some N m
  }
}

void without_a_temperature_friction_is_that_of_the_reference() {
  Bundle without = bundle();
  without.prior.temperature = {};
  const Signals s = motion(1500);
  const Estimates one = estimate(bundle(), s.view(), 1), other = estimate(without, s.view(), 1);
  CHECK(one.prior == other.prior && one.tau_ext.back() == other.tau_ext.back());
}

// As a recording, by sample, and set beside the samples; a saved state includes the temperature.
void temperatures_in_bulk_by_sample_and_set_separately_agree() {
  const Bundle b = bundle();
  const Signals s = motion(1500);
  std::vector<double> celsius;
  for (std::size_t k = 0; k < s.t_ns.size(); ++k)
    for (const double at : {25 + 0.01 * static_cast<double>(k / 100), k / 100 % 4 == 0 ? kNan : 55.0}) celsius.push_back(at);
  RecordingView warm = s.view();
  warm.temperature = celsius.data();
  const Estimates bulk = estimate(b, warm, 1), cold = estimate(b, s.view(), 1);
  CHECK(bulk.prior != cold.prior);
  Monitor by_sample(b), told(b), restored(b);
  for (std::int64_t k = 0; k < s.samples(); ++k) {
    const auto row = static_cast<std::size_t>(k);
    if (k % 100 == 0) CHECK(told.set_temperature({celsius.data() + 2 * row, 2}));
    if (k == 1000) {
      std::vector<std::byte> state(told.state_bytes());
      CHECK(told.save_state(state) && restored.restore_state(state));
    }
    const Estimate& one = by_sample.step(warm.at(k));
    const Estimate& other = told.step(s.at(k));
    const Estimate& third = k < 1000 ? other : restored.step(s.at(k));  // not set again
    for (std::size_t j = 0; j < 2; ++j) {
      CHECK(one.prior[j] == bulk.prior[2 * row + j] && other.prior[j] == one.prior[j]);
      if (k >= 1000 && k < 1100) CHECK(third.prior[j] == one.prior[j]);
    }
  }
  by_sample.reset();
  CHECK(by_sample.step(s.at(0)).prior[0] == Monitor(b).step(s.at(0)).prior[0]);
  for (std::int64_t k = 1; k < 800; ++k) CHECK(by_sample.step(s.at(k)).prior[1] == cold.prior[2 * static_cast<std::size_t>(k) + 1]);
}

void temperatures_that_are_not_one_a_joint_are_refused() {
  Monitor monitor(bundle());
  const Signals s = motion(1);
  const double one[] = {30};
  Sample sample = s.at(0);
  sample.temperature = one;
  const Estimate& e = monitor.step(sample);
  CHECK(e.health == Health::fault && e.causes == kWrongSize);
  CHECK(!monitor.set_temperature(one));
}

void what_makes_no_sense_is_refused_and_the_rest_is_saved() {
  const Bundle saved = from_bytes(to_bytes(bundle()));
  CHECK(saved.prior.temperature.reference_c == follows().reference_c && saved.prior.temperature.reach_k == follows().reach_k);
  CHECK(saved.prior.temperature.viscous_per_10k == follows().viscous_per_10k);
  const auto refused = [](const char* what, const std::function<void(FrictionTemperature&)>& change) {
    Bundle b = bundle();
    change(b.prior.temperature);
    std::string said;
    try {
      to_bytes(b);
    } catch (const Error& e) {
      said = e.what();
    }
    CHECK(said.find(what) != std::string::npos);
  };
  refused("prior.temperature.reach_k has 1", [](FrictionTemperature& t) { t.reach_k.pop_back(); });
  refused("prior.temperature.reach_k = -1", [](FrictionTemperature& t) { t.reach_k[0] = -1; });
  refused("prior.temperature.reference_c", [](FrictionTemperature& t) { t.reference_c[0] = kNan; });
  refused("prior.temperature.coulomb_per_10k = 11", [](FrictionTemperature& t) { t.coulomb_per_10k[1] = 11; });
}

}  // namespace

int main() {
  friction_is_that_of_the_scaled_weights();
  without_a_temperature_friction_is_that_of_the_reference();
  temperatures_in_bulk_by_sample_and_set_separately_agree();
  temperatures_that_are_not_one_a_joint_are_refused();
  what_makes_no_sense_is_refused_and_the_rest_is_saved();
  return check::result();
}
