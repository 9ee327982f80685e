#include "prior/prior.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <random>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "made_signals.hpp"
#include "refused.hpp"
#include "fit/regressors.hpp"
#include "stages/observation.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;
using made::kMs, made::irregular, made::same, made::sampled, made::Signals;

namespace {

constexpr int kSteps = 30, kStride = 10;  // a window of 0.3 s; the observer needs 0.5 s
constexpr double kGain = 20.0;
constexpr std::array<double, 3> kGravity{0, -9.81, 0};

std::vector<std::int64_t> every_ms(int samples) {
  std::vector<std::int64_t> t_ns;
  for (int k = 0; k < samples; ++k) t_ns.push_back(k * kMs);
  return t_ns;
}

// A term of every kind and form for every joint, with random weights, and links that weigh something else.
PriorSettings of_every_kind(const std::vector<Link>& links, unsigned seed) {
  const auto n = static_cast<std::int32_t>(links.size());
  PriorSettings prior;
  prior.widths_rad = {3e-4, 3e-3, 3e-2};
  for (std::int32_t j = 0; j < n; ++j) prior.branches.insert(prior.branches.end(), {0.2, 0.5, 0.3});
  for (std::int32_t j = 0; j < n; ++j) {
    const std::int32_t other = (j + 1) % n;
    prior.terms.push_back({TermKind::constant, j, 0, 0, 0, 0});
    prior.terms.push_back({TermKind::viscous, j, 0, 0, 0, 0});
    prior.terms.push_back({TermKind::coulomb, j, 0, 0, 0, 0.05});
    prior.terms.push_back({TermKind::load, j, 0, 0, 0, 0.1});
    prior.terms.push_back({TermKind::local_memory, j, 0, 0, 0, 0});
    for (std::int32_t width = 0; width < 3; ++width) {
      prior.terms.push_back({TermKind::presliding, j, width, 0, 0, 0});
      prior.terms.push_back({TermKind::load_presliding, j, width, 0, 0, 0});
    }
    for (std::int32_t form = 0; form < 2; ++form) {
      prior.terms.push_back({TermKind::ripple, j, 37, 0, form, 0});
      prior.terms.push_back({TermKind::quadratic, j, other, (j + 2) % n, form, 0});
    }
    for (std::int32_t form = 0; form < 14; ++form) prior.terms.push_back({TermKind::gravity, j, other, (j + 2) % n, form, 0});
    for (std::int32_t form = 0; form < 3; ++form) prior.terms.push_back({TermKind::momentum, j, other, 0, form, 0});
  }
  std::mt19937 random(seed);
  std::normal_distribution<double> normal(0, 0.3);
  for (std::size_t k = 0; k < prior.terms.size() * links.size(); ++k) prior.weights.push_back(normal(random));
  prior.corrected_links = links;
  for (Link& link : prior.corrected_links) {
    link.mass *= 1.3;
    link.com[0] *= 0.7;
    link.rotor_inertia *= 1.1;
  }
  return prior;
}

PriorSettings only(std::vector<Term> terms, std::vector<double> weights) {
  PriorSettings prior;
  prior.terms = std::move(terms);
  prior.weights = std::move(weights);
  return prior;
}

// Steps a prior of one joint through jittering stamps; v or p of its only term is what `dq` makes it.
template <class Speed, class Expected>
void follows(const PriorSettings& settings, Speed&& speed, Expected&& expected) {
  Prior prior(settings, kGravity, 1, kGain);
  const Presliding none(1, {});
  const double zero[1] = {0};
  std::int64_t t_ns = 123456;
  for (int k = 0; k < 1000; ++k) {
    const double t = 1e-9 * static_cast<double>(t_ns - 123456), dq[1] = {speed(t)};
    double out[1], doubt[1];
    prior.step(t_ns, zero, dq, none, zero, zero, out, doubt);
    CHECK_CLOSE(out[0], expected(t), 1e-9);  // rounding of a momentum of 10 N m s over steps of 0.3 ms: 6e-12 a step
    t_ns += 300'000 + 1'400'000 * (k % 3) / 2;
  }
}

// v = 5 Nm from rest: prior(t) = 5 (1 - exp(-K0 t)); P = 3 kg m^2 times a speed of 2 t: the same with 6 Nm. The sign is
// that of the term: what acts as a torque is added to r.
void a_constant_torque_and_a_rising_momentum_give_the_closed_form() {
  const auto still = [](double) { return 0.0; };
  const auto rising = [](double t) { return 2.0 * t; };
  follows(only({{TermKind::constant, 0, 0, 0, 0, 0}}, {5.0}), still,
          [](double t) { return 5.0 * (1 - std::exp(-kGain * t)); });
  follows(only({{TermKind::momentum, 0, 0, 0, 0, 0}}, {3.0}), rising,
          [](double t) { return 6.0 * (1 - std::exp(-kGain * t)); });
  // v = 4 dq with dq = 2 t, whose trapezoid is exact: the response to the ramp 8 t. The recurrence holds the mean of a
  // step, which makes its lag longer than 1/K0 by K0 dt^2 / 12: 8 times that is 1.3e-5.
  Prior prior(only({{TermKind::viscous, 0, 0, 0, 0, 0}}, {4.0}), kGravity, 1, kGain);
  const Presliding none(1, {});
  const double zero[1] = {0};
  for (int k = 0; k <= 1000; ++k) {
    const double t = 1e-3 * k, dq[1] = {2.0 * t};
    double out[1];
    double doubt[1];
    prior.step(k * kMs, zero, dq, none, zero, zero, out, doubt);
    CHECK_CLOSE(out[0], 8.0 * (t - (1 - std::exp(-kGain * t)) / kGain), 2e-5);
  }
}

// A joint that turns back by less than the play carries nothing of what weighs on it, as far as it is inside: beta = 3 Nm,
// play of 2 w = 0.02 rad, from one flank (state 1) to the other. The filter has settled after a second of standing.
void across_the_play_a_gear_carries_no_weight() {
  PriorSettings settings = only({{TermKind::backlash, 0, 0, 0, 0, 0}}, {-1.0});
  settings.widths_rad = {0.01};
  for (double back : {0.0, 0.004, 0.01, 0.016, 0.02}) {
    Prior prior(settings, kGravity, 1, kGain);
    Presliding bank(1, settings.widths_rad);
    const double zero[1] = {0}, beta[1] = {3};
    double out[1], doubt[1];
    for (int k = 0; k <= 2000; ++k) {
      const double q[1] = {k < 300 ? 1e-4 * k : 0.0299 - back * std::min(k - 299, 200) / 200};
      bank.step(q);
      prior.step(k * kMs, q, zero, bank, zero, beta, out, doubt);
    }
    CHECK_CLOSE(out[0], -3.0 * (1 - std::fabs(1 - back / 0.01)), 1e-9);
    CHECK(doubt[0] < 1e-9);
  }
}

// The observer of the estimated model minus the prior of a corrected one is the observer of the corrected model.
void a_corrected_model_turns_r_into_that_of_the_corrected_model() {
  const Bundle b = made::bundle(4, 0, kSteps, kStride, 1);
  PriorSettings prior;
  prior.corrected_links = of_every_kind(b.links, 1).corrected_links;
  std::vector<std::int64_t> t_ns = every_ms(2000);
  for (std::size_t k = 900; k < t_ns.size(); ++k) t_ns[k] += (k < 1500 ? 5 : 80) * kMs;  // bridged, then a restart
  const Signals s = sampled(4, t_ns);
  const Observation estimated = observe(Tree(b.links, b.gravity), b.observer, prior, s.view());
  const Observation corrected = observe(Tree(prior.corrected_links, b.gravity), b.observer, {}, s.view());
  CHECK(estimated.restarts == 1 && estimated.held_rows == 5 && corrected.prior.empty());
  double largest = 0;
  for (std::size_t k = 0; k < estimated.residual.size(); ++k) {
    // Rounding of momenta of some N m s over steps of 1 ms.
    CHECK_CLOSE(estimated.residual[k] - estimated.prior[k], corrected.residual[k], 1e-9);
    largest = std::max(largest, std::fabs(estimated.prior[k]));
  }
  CHECK(largest > 1);
}

void terms_and_corrected_model_add_up() {
  const Bundle b = made::bundle(3, 0, kSteps, kStride, 1);
  const Tree tree(b.links, b.gravity);
  const Signals s = sampled(3, every_ms(1500));
  PriorSettings all = of_every_kind(b.links, 2), terms = all, model = all;
  terms.corrected_links.clear();
  model.terms.clear();
  model.weights.clear();
  const std::vector<double> both = observe(tree, b.observer, all, s.view()).prior,
                            one = observe(tree, b.observer, terms, s.view()).prior,
                            other = observe(tree, b.observer, model, s.view()).prior;
  for (std::size_t k = 0; k < both.size(); ++k) CHECK_CLOSE(both[k], one[k] + other[k], 1e-10);
}

// More than 32 terms, so that several filters share the work, at samples that are not all; across a bridged gap and a
// restart.
// Up to the bound nothing differs. Beyond it the terms stand still, and friction grows by their sum alone, whatever large
// weights of either sign they have.
void load_terms_see_no_more_than_they_were_fitted_to() {
  const auto friction = [](double mass, std::vector<double> most, double dq) {
    Link link;
    link.joint_name = "lift";
    link.rotation = {0, 0, 1, 0, 1, 0, -1, 0, 0};  // z of the joint lies in the horizontal plane
    link.mass = mass;
    link.com = {0.5, 0, 0};
    PriorSettings settings;
    settings.terms = {{TermKind::load, 0, 0, 0, 0, 0.01}, {TermKind::load, 0, 0, 0, 0, 1.0}};
    settings.weights = {-3.0, 2.9};
    settings.most_load_nm = std::move(most);
    const Tree tree({link}, {0, 0, -9.81});
    Prior prior(settings, tree.gravity(), 1, 20);
    Presliding presliding(1, {});
    double p[1], beta[1], said[1], doubt[1], coulomb[1], viscous[1];
    for (int k = 0; k <= 4000; ++k) {
      const double q[] = {std::numbers::pi / 2}, speed[] = {dq};
      tree.momentum(q, speed, p, beta);
      prior.step(k * std::int64_t{1'000'000}, q, speed, presliding, p, beta, said, doubt);
    }
    prior.friction(coulomb, viscous);
    CHECK(std::fabs(coulomb[0] - said[0]) < 1e-9 * std::fabs(said[0]));
    return std::pair(std::fabs(beta[0]), said[0]);
  };
  const double dq = 0.2, shape = -3.0 * std::tanh(dq / 0.01) + 2.9 * std::tanh(dq / 1.0);
  const auto [light, usual] = friction(1, {}, dq);
  CHECK(light > 4 && std::fabs(usual - light * shape) < 1e-9 * light);
  CHECK(friction(1, {1.2 * light}, dq).second == usual);
  const auto [heavy, loaded] = friction(3, {1.2 * light}, dq);
  CHECK(std::fabs(heavy - 3 * light) < 1e-9 * heavy);
  const double expected = 1.2 * light * shape - 0.1 * (heavy - 1.2 * light) * std::tanh(dq / 0.05);
  CHECK(std::fabs(loaded - expected) < 1e-9 * heavy);
  CHECK(std::fabs(friction(3, {1.2 * light}, -dq).second + expected) < 1e-9 * heavy);
}

void the_weighted_regressors_are_the_prior() {
  const Bundle b = made::bundle(3, 0, kSteps, kStride, 1);
  const Tree tree(b.links, b.gravity);
  PriorSettings prior = of_every_kind(b.links, 3);
  prior.corrected_links.clear();
  std::vector<std::int64_t> t_ns = every_ms(1200);
  for (std::size_t k = 500; k < t_ns.size(); ++k) t_ns[k] += (k < 800 ? 10 : 70) * kMs;
  const Signals s = sampled(3, t_ns);
  std::vector<std::int64_t> samples;
  for (std::int64_t k = 0; k < s.samples(); k += k < 490 || k > 820 ? 7 : 1) samples.push_back(k);
  const std::vector<double> expected = observe(tree, b.observer, prior, s.view()).prior,
                            X = prior_regressors(tree, b.observer, prior, s.view(), samples);
  const std::size_t M = prior.terms.size();
  CHECK(M > 2 * kMaxJoints && X.size() == samples.size() * M);
  for (std::size_t i = 0; i < samples.size(); ++i)
    for (std::size_t j = 0; j < 3; ++j) {
      double sum = 0;
      for (std::size_t m = 0; m < M; ++m) sum += prior.weights[j * M + m] * X[i * M + m];
      CHECK_CLOSE(sum, expected[static_cast<std::size_t>(samples[i]) * 3 + j], 1e-9);
    }
}

void regressors_of_samples_that_do_not_rise_or_do_not_exist_are_refused() {
  const Bundle b = made::bundle(2, 0, kSteps, kStride, 1);
  const Tree tree(b.links, b.gravity);
  const PriorSettings prior = only({{TermKind::viscous, 1, 0, 0, 0, 0}}, {0.0, 0.0});
  const Signals s = sampled(2, every_ms(20));
  for (const std::vector<std::int64_t>& samples :
       {std::vector<std::int64_t>{5, 3}, std::vector<std::int64_t>{5, 5}, std::vector<std::int64_t>{20},
        std::vector<std::int64_t>{-1, 4}})
    refused("samples must be ascending", [&] { prior_regressors(tree, b.observer, prior, s.view(), samples); });
  CHECK(prior_regressors(tree, b.observer, prior, s.view(), {}).empty());
  const Signals other = sampled(3, every_ms(20));
  refused("the model has 2 joints, the recording 3",
          [&] { prior_regressors(tree, b.observer, prior, other.view(), {}); });
}

// A gap of more than a network period: from there on all is as if nothing had been before it.
void a_gap_restarts_filter_and_presliding_states() {
  const Bundle b = made::bundle(3, 0, kSteps, kStride, 1);
  const Tree tree(b.links, b.gravity);
  const PriorSettings prior = of_every_kind(b.links, 4);
  std::vector<std::int64_t> t_ns = every_ms(1200);
  constexpr std::int64_t kGap = 700;
  for (std::size_t k = kGap; k < t_ns.size(); ++k) t_ns[k] += (kStride + 1) * kMs;
  const Signals s = sampled(3, t_ns);
  const Observation whole = observe(tree, b.observer, prior, s.view());
  const Observation rest = observe(tree, b.observer, prior, s.from(kGap));
  CHECK(whole.restarts == 1 && rest.restarts == 0);
  CHECK(std::equal(rest.prior.begin(), rest.prior.end(), whole.prior.begin() + 3 * kGap));
  CHECK(std::equal(rest.doubt.begin(), rest.doubt.end(), whole.doubt.begin() + 3 * kGap));
  CHECK(std::equal(rest.presliding.begin(), rest.presliding.end(), whole.presliding.begin() + 9 * kGap));
  CHECK(rest.prior[0] == 0 && rest.presliding[0] == 0 && whole.prior[3 * kGap - 1] != 0);
}

// A gap of a network period: filter and states take one long step, as the observer does, and the rows in between hold
// the states of the sample before it.
void a_bridged_gap_is_one_long_step() {
  const Bundle b = made::bundle(2, 0, kSteps, kStride, 1);
  const Tree tree(b.links, b.gravity);
  PriorSettings prior = of_every_kind(b.links, 5);
  constexpr std::size_t kGap = 600;
  std::vector<std::int64_t> t_ns = every_ms(1000);
  for (std::size_t k = kGap; k < t_ns.size(); ++k) t_ns[k] += kStride * kMs;
  const Signals s = sampled(2, t_ns);
  const Observation o = observe(tree, b.observer, prior, s.view());
  CHECK(o.restarts == 0 && o.held_rows == kStride);

  Presliding presliding(2, prior.widths_rad, prior.branches);
  Prior twin(prior, b.gravity, 2, b.observer.gain_per_s);
  for (std::size_t k = 0; k < t_ns.size(); ++k) {
    const Sample sample = s.at(static_cast<std::int64_t>(k));
    double p[2], beta[2], out[2], doubt[2], states[6];
    tree.momentum(sample.q, sample.dq, p, beta);
    presliding.step(sample.q);
    twin.step(sample.t_ns, sample.q, sample.dq, presliding, p, beta, out, doubt);
    presliding.write(states);
    for (std::size_t j = 0; j < 2; ++j) CHECK(out[j] == o.prior[2 * k + j] && doubt[j] == o.doubt[2 * k + j]);
    for (std::size_t c = 0; c < 6; ++c) CHECK(static_cast<float>(states[c]) == o.presliding[6 * k + c]);
  }
  const std::vector<float> factors{1, 1, 1, 1, 1, 1, 1, 1, 2, 3};
  const std::vector<float> rows = feature_rows(s.view(), o, factors);
  CHECK(rows.size() == static_cast<std::size_t>(o.row_count) * 10);
  for (std::size_t k = 0; k < t_ns.size(); ++k)
    for (std::size_t c = 0; c < 6; ++c)
      CHECK(rows[static_cast<std::size_t>(o.row[k]) * 10 + 4 + c] == o.presliding[6 * k + c] * factors[4 + c]);
  for (std::size_t held = kGap; held < kGap + kStride; ++held)
    for (std::size_t c = 0; c < 10; ++c) CHECK(rows[held * 10 + c] == rows[(kGap - 1) * 10 + c]);
}

void invalid_settings_are_refused_by_name() {
  const std::vector<Link> links = made::bundle(2, 0, kSteps, kStride, 1).links;
  const auto refused_after = [&](const char* part_of_message, const std::function<void(PriorSettings&)>& change) {
    PriorSettings prior = of_every_kind(links, 6);
    prior.validate(2);
    change(prior);
    refused(part_of_message, [&] { Prior(prior, kGravity, 2, kGain); });
  };
  const auto refused_term = [&](const char* part_of_message, Term term) {
    refused_after(part_of_message, [&](PriorSettings& prior) { prior.terms[3] = term; });
  };
  refused_after("prior.most_load_nm has 1 values where 2 belong", [](PriorSettings& p) { p.most_load_nm = {1}; });
  refused_after("prior.most_load_nm = -1 must be >= 0 and finite", [](PriorSettings& p) { p.most_load_nm = {1, -1}; });
  refused_term("prior term 3: its kind is unknown", {static_cast<TermKind>(12), 0, 0, 0, 0, 0});
  refused_after("prior term 4: there is no branch to follow", [](PriorSettings& p) { p.branches.clear(); });
  refused_after("presliding branches are 1 where", [](PriorSettings& p) { p.branches = {1}; });
  for (int kind = 0; kind <= static_cast<int>(TermKind::backlash); ++kind) {
    const auto of = static_cast<TermKind>(kind);
    refused_term("prior term 3: joint a does not exist", {of, 2, 1, 0, 0, 0.1});
    refused_term("prior term 3: joint a does not exist", {of, -1, 1, 0, 0, 0.1});
    refused_term("prior term 3: its form does not exist", {of, 0, 1, 0, -1, 0.1});
    const std::int32_t forms = of == TermKind::gravity ? 14 : of == TermKind::momentum ? 3
                               : of == TermKind::quadratic || of == TermKind::ripple  ? 2
                               : of == TermKind::load || of == TermKind::load_presliding ? 2
                               : of == TermKind::backlash                                ? 2
                                                                                          : 1;
    refused_term("prior term 3: its form does not exist", {of, 0, 1, 0, forms, 0.1});
  }
  for (TermKind of : {TermKind::coulomb, TermKind::load})
    for (double speed : {0.0, -0.1, static_cast<double>(NAN), static_cast<double>(INFINITY)})
      refused_term("prior term 3: its speed must be > 0", {of, 0, 0, 0, 0, speed});
  for (TermKind of : {TermKind::presliding, TermKind::load_presliding, TermKind::backlash})
    for (std::int32_t width : {-1, 3})
      refused_term("prior term 3: its presliding width does not exist", {of, 0, width, 0, 0, 0});
  for (TermKind of : {TermKind::gravity, TermKind::quadratic, TermKind::momentum})
    for (std::int32_t joint : {-1, 2}) refused_term("prior term 3: joint b does not exist", {of, 0, joint, 0, 0, 0});
  for (std::int32_t joint : {-1, 2})
    refused_term("prior term 3: joint c does not exist", {TermKind::quadratic, 0, 0, joint, 0, 0});
  for (std::int32_t cycles : {-1, 0, 10001})
    refused_term("prior term 3: its cycles a turn are not 1 to 10000", {TermKind::ripple, 0, cycles, 0, 0, 0});
  refused_after("prior.weights has 127 values where 128 belong", [](PriorSettings& p) { p.weights.pop_back(); });
  refused_after("prior.weights has 128 values where 0 belong", [](PriorSettings& p) { p.terms.clear(); });
  refused_after("prior.weights holds a value that is not finite", [](PriorSettings& p) { p.weights[7] = NAN; });
  refused_after("prior.weights holds a value that is not finite", [](PriorSettings& p) { p.weights[7] = -INFINITY; });
  refused_after("prior term 3: it asks for the load by the corrected model, and there is none", [](PriorSettings& p) {
    p.terms[3] = {TermKind::load, 0, 0, 0, 1, 0.1};
    p.corrected_links.clear();
  });
  refused_after("the prior's corrected model has 1 links where 2 belong",
                [](PriorSettings& p) { p.corrected_links.pop_back(); });
  refused_after("mass = ", [](PriorSettings& p) { p.corrected_links[1].mass = -1; });
  refused_after("every number of a link must be finite", [](PriorSettings& p) { p.corrected_links[0].com[1] = NAN; });
  refused_after("presliding width", [](PriorSettings& p) { p.widths_rad[1] = p.widths_rad[0]; });
  refused_after("presliding branches are 6 where 4 belong", [](PriorSettings& p) { p.widths_rad.pop_back(); });
  // The bundle refuses the same, and by the same name.
  Bundle b = made::bundle(2, 0, kSteps, kStride, 1);
  b.prior.terms = {{TermKind::viscous, 2, 0, 0, 0, 0}};
  refused("prior term 0: joint a does not exist", [&] { b.validate(); });
}

// A bundle whose network sees the presliding states, and whose limits the motion is over now and then.
Bundle with_everything(int joints, int hidden) {
  Bundle b = made::bundle(joints, hidden, kSteps, kStride, 3);
  b.prior = of_every_kind(b.links, 7);
  b.limits.region_width = 1;
  if (hidden > 0) {
    b.inputs.clear();
    for (int column = 0; column < b.columns(); ++column) b.inputs.push_back({column, 0});
    for (int column = joints; column < 2 * joints; ++column) b.inputs.push_back({column, 1});
    b.input_factors.resize(static_cast<std::size_t>(b.columns()), 0.7f);
    b.shape.inputs = static_cast<int>(b.inputs.size());
    std::mt19937 random(9);
    std::normal_distribution<float> normal(0, 0.4f);
    b.parameters.clear();
    for (std::size_t k = 0; k < b.shape.parameter_count(); ++k) b.parameters.push_back(normal(random));
  }
  answer_reference(b);
  const Signals s = sampled(joints, every_ms(3000));
  const std::vector<double> tau_ext = estimate(b, s.view(), 1).tau_ext;
  const auto n = static_cast<std::size_t>(joints);
  for (std::size_t j = 0; j < n; ++j) {
    double largest = 0;
    for (std::size_t at = j; at < tau_ext.size(); at += n)
      if (std::fabs(tau_ext[at]) > largest) largest = std::fabs(tau_ext[at]);
    for (Level* level : {&b.limits.collision, &b.limits.contact}) {
      level->sliding_nm[j] = 0.5 * largest;
      level->near_stiction_nm[j] = 0.6 * largest;
    }
  }
  return b;
}

void online_equals_offline_to_the_last_bit_with_a_prior_of_every_kind() {
  for (const int joints : {1, 2, 7}) {
    for (const int hidden : {0, 20}) {
      const Bundle bundle = with_everything(joints, hidden);
      const Signals s = irregular(joints, 3500);
      const Estimates offline = estimate(bundle, s.view(), 2);
      Monitor monitor(bundle);
      int near = 0;
      double largest_prior = 0, largest_network = 0;
      const auto also = [&](const Estimate& e, std::size_t j, std::size_t at) {
        CHECK(e.prior[j] == offline.prior[at]);
        CHECK(e.doubt[j] == offline.doubt[at]);
        CHECK(same(e.uncertainty[j], offline.prior[at] + offline.network[at]));
        near += offline.near_stiction[at];
        largest_prior = std::max(largest_prior, std::fabs(e.prior[j]));
        if (e.health == Health::ok) largest_network = std::max(largest_network, std::fabs(offline.network[at]));
      };
      const auto [healthy, detections] = made::online_equals_offline(monitor, s, offline, also);
      CHECK(healthy > 1000 && healthy < 3400 && detections > 0 && near > 0 && near < 3500 * joints);
      CHECK(largest_prior > 1 && (largest_network > 1) == (hidden > 0));
      CHECK(monitor.bridged_ticks() > 0 && monitor.restarts() > 0);
    }
  }
}

// What the network sees of the presliding states matters: else the test above would not notice if it did not.
void the_network_sees_the_presliding_states() {
  Bundle bundle = with_everything(2, 20);
  const Signals s = sampled(2, every_ms(2000));
  const std::vector<double> before = estimate(bundle, s.view(), 1).network;
  bundle.prior.widths_rad[2] *= 3;
  answer_reference(bundle);
  const std::vector<double> after = estimate(bundle, s.view(), 1).network;
  double largest = 0;
  for (std::size_t k = 0; k < before.size(); ++k)
    if (!std::isnan(before[k])) largest = std::max(largest, std::fabs(before[k] - after[k]));
  CHECK(largest > 1e-3);
}

void a_restored_monitor_goes_on_with_prior_and_presliding_states() {
  const Bundle bundle = with_everything(2, 20);
  const Signals s = irregular(2, 3000);
  for (std::int64_t stop : {0, 1, 333, 1777}) {
    Monitor one(bundle), other(bundle);
    for (std::int64_t k = 0; k < stop; ++k) one.step(s.at(k));
    std::vector<std::byte> state(one.state_bytes());
    CHECK(one.save_state(state));
    for (std::int64_t k = 5; k < 99; ++k) other.step(s.at(k));
    CHECK(other.restore_state(state));
    for (std::int64_t k = stop; k < stop + 1000; ++k) {
      const Estimate &a = one.step(s.at(k)), &b = other.step(s.at(k));
      CHECK(a.health == b.health && a.near_stiction == b.near_stiction);
      for (std::size_t j = 0; j < 2; ++j)
        CHECK(a.prior[j] == b.prior[j] && a.doubt[j] == b.doubt[j] && same(a.tau_ext[j], b.tau_ext[j]));
    }
  }
}

// A network uses the presliding states, too; without a prior there is no doubt, and it continues.
void resume_without_a_prior_is_an_acknowledgement() {
  Bundle bundle = with_everything(2, 20);
  bundle.prior.terms.clear();
  bundle.prior.weights.clear();
  bundle.limits.near_stiction_rad_s = 100;  // all joints are, always
  answer_reference(bundle);
  const Signals s = sampled(2, every_ms(2000));
  Monitor one(bundle), other(bundle);
  for (std::int64_t k = 0; k < s.samples(); ++k) {
    const Estimate &a = one.step(s.at(k)), &b = other.step(s.at(k));
    CHECK(a.alarm == b.alarm && a.near_stiction == 3 && b.near_stiction == 3);
    for (std::size_t j = 0; j < 2; ++j) CHECK(same(a.tau_ext[j], b.tau_ext[j]) && same(a.limit_nm[j], b.limit_nm[j]));
    if (k % 300 == 299) one.resume(), other.acknowledge();
  }
}

void a_restored_stage_goes_on_and_a_reset_one_begins_as_a_fresh_one() {
  const Bundle b = made::bundle(2, 0, kSteps, kStride, 1);
  const Tree tree(b.links, b.gravity);
  const PriorSettings settings = of_every_kind(b.links, 8);
  const Signals s = sampled(2, every_ms(800));
  ResidualStage straight(tree, b.observer, settings), other = straight, fresh = straight;
  const auto step = [&](ResidualStage& stage, std::int64_t k) {
    std::vector<double> r(2), prior(2), doubt(2);
    stage.step(s.at(k).t_ns, s.at(k).q, s.at(k).dq, s.at(k).tau, r, prior, doubt);
    r.insert(r.end(), prior.begin(), prior.end());
    r.insert(r.end(), doubt.begin(), doubt.end());
    return r;
  };
  for (std::int64_t k = 0; k < 300; ++k) step(straight, k);
  for (std::int64_t k = 100; k < 150; ++k) step(other, k);
  other.restore(straight.state());
  for (std::int64_t k = 300; k < 600; ++k) CHECK(step(straight, k) == step(other, k));
  straight.reset();
  for (std::int64_t k = 600; k < 800; ++k) CHECK(step(straight, k) == step(fresh, k));
}

void a_saved_bundle_keeps_its_prior() {
  const Bundle b = with_everything(3, 5);
  const std::vector<char> bytes = to_bytes(b);
  const Bundle loaded = from_bytes(bytes);
  CHECK(to_bytes(loaded) == bytes);
  CHECK(loaded.prior.weights == b.prior.weights && loaded.prior.widths_rad == b.prior.widths_rad);
  CHECK(loaded.prior.terms.size() == b.prior.terms.size() && loaded.prior.corrected_links.size() == 3);
  const Signals s = sampled(3, every_ms(1500));
  const Estimates one = estimate(b, s.view(), 1), two = estimate(loaded, s.view(), 1);
  CHECK(one.prior == two.prior);
  Bundle spoilt = b;
  spoilt.reference.prior[1] += 0.1;
  refused("replaying its reference differs", [&] { to_bytes(spoilt); });
}

PriorSettings of_two_widths(std::vector<Term> terms, std::vector<double> weights) {
  PriorSettings settings;
  settings.widths_rad = {1e-3, 3e-3};
  settings.terms = std::move(terms);
  settings.weights = std::move(weights);
  return settings;
}

// At rest from an unknown start: the magnitudes of all that hangs on presliding states, filtered, and nothing else.
void the_doubt_at_rest_has_its_closed_form() {
  const PriorSettings settings = of_two_widths({{TermKind::presliding, 0, 0, 0, 0, 0},
                                                {TermKind::load_presliding, 1, 1, 0, 0, 0},
                                                {TermKind::constant, 0, 0, 0, 0, 0}},
                                               {-4, 0.5, 7, 0, -0.25, 1});
  Presliding presliding(2, settings.widths_rad, settings.branches);
  Prior prior(settings, kGravity, 2, kGain);
  const double zero[2] = {0, 0}, beta[2] = {3, -20};
  for (int k = 0; k < 600; ++k) {
    double out[2], doubt[2];
    presliding.step(zero);
    prior.step(k * kMs, zero, zero, presliding, zero, beta, out, doubt);
    const double grown = 1 - std::exp(-kGain * 1e-3 * k);
    CHECK_CLOSE(doubt[0], (4 + 0.5 * 20) * grown, 1e-11);  // a few hundred roundings of 14 Nm
    CHECK_CLOSE(doubt[1], 0.25 * 20 * grown, 1e-11);
    CHECK_CLOSE(out[0], 7 * grown, 1e-11);  // the mean of what is possible is zero
  }
}

// An arm seen coming to rest, and one first seen at rest that then creeps: the doubt covers the unknown start.
void the_doubt_bounds_the_error_of_an_unknown_start() {
  const PriorSettings settings = of_two_widths({{TermKind::presliding, 0, 0, 0, 0, 0},
                                                {TermKind::presliding, 0, 1, 0, 0, 0},
                                                {TermKind::viscous, 0, 0, 0, 0, 0}},
                                               {-4, 3, -2});
  const std::array<double, 3> gravity{0, 0, 0};
  for (const double before : {0.01, -0.01, 0.002}) {  // where it came from
    Presliding known(1, settings.widths_rad), fresh(1, settings.widths_rad);
    Prior knowing(settings, gravity, 1, 20.0), guessing(settings, gravity, 1, 20.0);
    const double zero[1] = {0};
    const double far[1] = {before > 0 ? -1.0 : 1.0}, from[1] = {0.5 - before};
    known.step(far);
    known.step(from);
    double largest = 0, doubt_at_end = 1;
    for (int k = 0; k < 3000; ++k) {
      const double q[1] = {0.5 + (k < 1000 ? 0.0 : 1e-5 * (k - 1000))}, dq[1] = {k < 1000 ? 0.0 : 0.01};
      known.step(q);
      fresh.step(q);
      double truth[1], guess[1], none[1], doubt[1];
      knowing.step(k * kMs, q, dq, known, zero, zero, truth, none);
      guessing.step(k * kMs, q, dq, fresh, zero, zero, guess, doubt);
      CHECK(none[0] == 0 && std::fabs(guess[0] - truth[0]) <= doubt[0] + 1e-12);
      largest = std::max(largest, std::fabs(guess[0] - truth[0]));
      doubt_at_end = doubt[0];
    }
    CHECK(largest > 0.5 && doubt_at_end < 1e-6);
  }
}

// A joint that came to rest sliding, and of which something then changed the friction unseen: forgotten, its doubt covers
// that from the next sample on, and goes when the joint has travelled.
void the_doubt_after_forgetting_bounds_what_happened_unseen() {
  PriorSettings settings;
  settings.widths_rad = {1e-3, 3e-3};
  settings.terms = {{TermKind::presliding, 0, 0, 0, 0, 0}, {TermKind::presliding, 0, 1, 0, 0, 0}};
  settings.weights = {-4, 3};
  Presliding truly(1, settings.widths_rad), seen(1, settings.widths_rad);
  Prior truth(settings, kGravity, 1, kGain), guess(settings, kGravity, 1, kGain);
  const double zero[1] = {0};
  for (const double q : {-1.0, 0.0}) truly.step(std::span(&q, 1)), seen.step(std::span(&q, 1));
  double is[1], expected[1], none[1], doubt[1], off = 0;
  for (int k = 0; k < 3000; ++k) {
    // From 500 on half a narrow width apart, which is 4/2 + 3/6 Nm less; moving on from 1000.
    const double unseen = k < 500 ? 0.0 : 5e-4, by = k < 1000 ? 0.0 : 1e-5 * (k - 1000);
    const double q[1] = {by}, q_true[1] = {by - unseen};
    truly.step(q_true);
    seen.step(q);
    if (k == 800) {
      seen.forget(0);
      guess.forget();
    }
    truth.step(k * kMs, zero, zero, truly, zero, zero, is, none);
    guess.step(k * kMs, zero, zero, seen, zero, zero, expected, doubt);
    off = std::fabs(expected[0] - is[0]);
    if (k == 799) CHECK(off > 1 && doubt[0] == 0);
    if (k == 800) CHECK_CLOSE(doubt[0], 4 + 3, 1e-12);
    if (k >= 800) CHECK(off <= doubt[0] + 1e-12);
  }
  CHECK(off < 1e-6 && doubt[0] < 1e-6);
}

void without_a_prior_nothing_is_expected() {
  const Bundle b = made::bundle(2, 0, kSteps, kStride, 1);
  const Signals s = sampled(2, every_ms(800));
  PriorSettings widths_alone;
  widths_alone.widths_rad = {1e-3};
  CHECK(PriorSettings{}.empty() && widths_alone.empty() && !of_every_kind(b.links, 1).empty());
  const Tree tree(b.links, b.gravity);
  const Observation o = observe(tree, b.observer, widths_alone, s.view());
  CHECK(o.prior.empty() && o.presliding.size() == 2 * 800);
  CHECK(o.residual == observe(tree, b.observer, {}, s.view()).residual);
  Monitor monitor(b);
  for (std::int64_t k = 0; k < 800; ++k) {
    const Estimate& e = monitor.step(s.at(k));
    CHECK(e.prior[0] == 0 && e.prior[1] == 0);
    if (e.health == Health::ok) CHECK(e.tau_ext[0] == e.residual[0] && e.uncertainty[0] == 0);
  }
}

// A joint that slides and turns back, a thousandth of the narrowest width a step: its presliding states turn the sum of the
// weights, and the rest of its friction turns at once.
void half_of_the_friction_has_turned_after_the_turning_travel() {
  const std::vector<double> widths{1e-4, 3e-4, 1e-3};
  const std::vector<std::vector<double>> fits{{-2, -4, 0}, {-1, -1, -3}, {-14, 9, 0.5}, {-1, 0, -1}, {-0.5, -0.5, -1}};
  for (const std::vector<double>& weights : fits) {
    PriorSettings prior;
    prior.widths_rad = widths;
    prior.terms = {{TermKind::coulomb, 0, 0, 0, 0, 1e-3}};
    prior.weights = {-1};
    for (std::int32_t w = 0; w < 3; ++w) {
      prior.terms.push_back({TermKind::presliding, 0, w, 0, 0, 0});
      prior.weights.push_back(weights[static_cast<std::size_t>(w)]);
    }
    Presliding bank(1, widths);
    double q = 0, back = 0, sum = 0;
    for (; q < 0.1; q += 1e-4) bank.step(std::span(&q, 1));
    do {
      q -= 1e-7;
      back += 1e-7;
      bank.step(std::span(&q, 1));
      sum = 1;  // the Coulomb term, turned
      for (int w = 0; w < 3; ++w) sum += weights[static_cast<std::size_t>(w)] * bank.value(0, w);
    } while (sum < 0);
    CHECK(std::fabs(turning_travel(prior, 0) - back) < 2e-7);
  }
  PriorSettings coulomb;
  coulomb.terms = {{TermKind::coulomb, 0, 0, 0, 0, 1e-3}};
  coulomb.weights = {-1};
  CHECK(turning_travel(coulomb, 0) == 0 && turning_travel({}, 0) == 0);
}

}  // namespace

int main() {
  a_constant_torque_and_a_rising_momentum_give_the_closed_form();
  across_the_play_a_gear_carries_no_weight();
  a_corrected_model_turns_r_into_that_of_the_corrected_model();
  terms_and_corrected_model_add_up();
  load_terms_see_no_more_than_they_were_fitted_to();
  the_weighted_regressors_are_the_prior();
  regressors_of_samples_that_do_not_rise_or_do_not_exist_are_refused();
  a_gap_restarts_filter_and_presliding_states();
  a_bridged_gap_is_one_long_step();
  invalid_settings_are_refused_by_name();
  online_equals_offline_to_the_last_bit_with_a_prior_of_every_kind();
  the_network_sees_the_presliding_states();
  a_restored_monitor_goes_on_with_prior_and_presliding_states();
  resume_without_a_prior_is_an_acknowledgement();
  a_restored_stage_goes_on_and_a_reset_one_begins_as_a_fresh_one();
  a_saved_bundle_keeps_its_prior();
  the_doubt_at_rest_has_its_closed_form();
  the_doubt_bounds_the_error_of_an_unknown_start();
  the_doubt_after_forgetting_bounds_what_happened_unseen();
  without_a_prior_nothing_is_expected();
  half_of_the_friction_has_turned_after_the_turning_travel();
  return check::result();
}
