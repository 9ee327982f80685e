// Load estimation inside the loop: against the truth of the motion, and against the sums of a recording.
#include "load/weighing.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <span>
#include <string>
#include <vector>

#include "check.hpp"
#include "load/recorded_load.hpp"
#include "made_bundle.hpp"
#include "stages/estimates.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;

namespace {

constexpr int kJoints = 6;
constexpr std::size_t kN = kJoints;
constexpr std::int64_t kMs = 1'000'000;
using Vec3 = std::array<double, 3>;

struct Motion {
  std::vector<std::int64_t> t_ns;
  std::vector<double> q, dq, tau;  // (samples, joints)

  std::int64_t samples() const { return static_cast<std::int64_t>(t_ns.size()); }
  Sample at(std::size_t k) const {
    const auto row = [&](const std::vector<double>& values) { return std::span(values).subspan(k * kN, kN); };
    return {t_ns[k], row(q), row(dq), row(tau)};
  }
  RecordingView view() const { return {samples(), kJoints, t_ns.data(), q.data(), dq.data(), tau.data()}; }
};

Bundle bundle() {
  Bundle b = made::bundle(kJoints, 0, 12, 10, 1);
  for (Level* level : {&b.limits.collision, &b.limits.contact})
    level->sliding_nm = level->near_stiction_nm = std::vector<double>(kN, 0.2);
  b.limits.near_stiction_rad_s = 0.01;
  b.load.link = kJoints - 1;
  b.load.frame = "flange";
  b.load.largest_mass_kg = 5;
  b.load.largest_reach_m = 0.5;
  b.load.refused.clear();
  return b;
}

constexpr double kRubs = 0.1;  // share of what a gear carries, by which its friction grows

Bundle rubbing() {
  Bundle b = bundle();
  for (int j = 0; j < kJoints; ++j) b.prior.terms.push_back({TermKind::load, j, 0, 0, 0, 0.05});
  b.prior.weights.assign(kN * kN, 0.0);
  for (std::size_t j = 0; j < kN; ++j) b.prior.weights[j * kN + j] = -kRubs;
  answer_reference(b);
  return b;
}

struct Push {
  Vec3 base{};  // force at the load frame's origin, along the base's axes, [N]
};

// Torques that hold this arm to a motion, exactly, its gears' friction as the prior has it with the load; a touch of
// noise on them.
Motion motion(const Bundle& b, const Load& load, std::int64_t samples, double speed = 1, const Push& push = {},
              double noise = 0.01) {
  Tree tree(b.links, b.gravity);
  if (load.mass > 0) tree.carry(b.load.link, b.load.in_link(load));
  LoadRegressor forces(tree, {b.load.link, b.load.rotation, b.load.translation});
  Motion m;
  std::vector<double> p, v;
  for (std::int64_t k = 0; k <= samples; ++k) {
    m.t_ns.push_back(k * kMs);
    const double t = 1e-3 * speed * static_cast<double>(k);
    double q[kN], dq[kN], at_p[kN], at_beta[kN];
    for (std::size_t j = 0; j < kN; ++j) {
      const double rate = 1.1 + 0.31 * static_cast<double>(j), phase = 0.9 * static_cast<double>(j);
      q[j] = 0.3 + 0.7 * std::sin(rate * t + phase);
      dq[j] = 0.7 * rate * speed * std::cos(rate * t + phase);
    }
    tree.momentum(q, dq, at_p, at_beta);
    for (std::size_t j = 0; j < kN && !b.prior.empty(); ++j)
      at_beta[j] += kRubs * std::fabs(at_beta[j]) * std::tanh(dq[j] / kSignSpeed);
    forces.compute(q, dq);
    for (std::size_t j = 0; j < kN; ++j) {
      for (std::size_t i = 0; i < 3; ++i) at_beta[j] -= forces.base_forces()[i][j] * push.base[i];
      m.q.push_back(q[j]);
      m.dq.push_back(dq[j]);
      p.push_back(at_p[j]);
      v.push_back(at_beta[j]);
    }
  }
  std::mt19937 random(11);
  std::normal_distribution<double> normal(0, noise);
  for (std::size_t c = 0; c + kN < p.size(); ++c)
    m.tau.push_back((p[c + kN] - p[c]) / 1e-3 + 0.5 * (v[c] + v[c + kN]) + normal(random));
  m.t_ns.pop_back();
  m.q.resize(m.tau.size());
  m.dq.resize(m.tau.size());
  return m;
}

Load ball(double mass, const Vec3& com) {
  const double radius = std::cbrt(3 * mass / (4 * 3.14159265358979 * 2700)), own = 0.4 * mass * radius * radius;
  return {mass, com, {own, own, own, 0, 0, 0}, 0};
}

LoadFound weighed(Monitor& monitor, const Motion& m) {
  monitor.start_weighing();
  for (std::size_t k = 0; k < m.t_ns.size(); ++k) monitor.step(m.at(k));
  return monitor.estimate_load();
}

double apart(const Vec3& a, const Vec3& b) { return std::hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]); }

void finds_mass_and_centre() {
  const Bundle b = bundle();
  const Load truth = ball(1.6, {0.03, -0.05, 0.08});
  Monitor monitor(b);
  CHECK(monitor.why_no_weighing().empty());
  CHECK(!monitor.weighing());
  CHECK(monitor.estimate_load().verdict == LoadVerdict::too_little);
  const LoadFound found = weighed(monitor, motion(b, truth, 4000));
  CHECK(monitor.weighing());
  CHECK(found.verdict == LoadVerdict::load);
  CHECK(found.mass_seen && found.unseen_count == 0 && !found.at_bound);
  CHECK_CLOSE(found.mass_kg, truth.mass, 0.02);
  CHECK_CLOSE(found.mass_kg, truth.mass, 4 * found.mass_error_kg);
  CHECK(found.mass_error_kg < 0.05);
  CHECK(apart(found.com_m, truth.com) < 0.005);
  for (std::size_t i = 0; i < 3; ++i) CHECK_CLOSE(found.com_m[i], truth.com[i], 4 * found.com_error_m[i]);
  CHECK_CLOSE(found.seconds, 3.5, 0.011);  // 10/K0 is half a second
  CHECK(monitor.load_fault(found.load) == LoadFault::none);
  CHECK_CLOSE(found.load.inertia[0], truth.inertia[0], 0.05 * truth.inertia[0]);
  CHECK(found.load.error_share >= Load::kUsualError && found.load.error_share < 0.1);
  // set, it is gone from r
  CHECK(monitor.set_load(found.load));
  CHECK(monitor.weighing());
  CHECK(monitor.estimate_load().seconds == 0);
}

// The load of a whole recording, as it is weighed where there is no loop; repeated until the gears' loaded side settles.
LoadFound of_recording(const Bundle& b, const Motion& m) {
  const Estimates estimates = estimate(b, m.view(), 1);
  const std::vector<double> worth_of_all = worth_of_samples(m.t_ns, estimates.near_stiction);
  std::vector<std::int64_t> samples;
  std::vector<double> tau_ext, sigma, worth;
  for (std::int64_t k = 0; k < m.samples(); k += b.observer.network_stride) {
    if (estimates.health[static_cast<std::size_t>(k)] != static_cast<std::uint8_t>(Health::ok)) continue;
    samples.push_back(k);
    for (std::size_t at = static_cast<std::size_t>(k) * kN, j = 0; j < kN; ++j, ++at) {
      tau_ext.push_back(estimates.tau_ext[at] + estimates.drift[at]);
      sigma.push_back(kSigmaOfLimit * estimates.limit_nm[at]);
      worth.push_back(worth_of_all[at]);
    }
  }
  const WeighedMotion motion{m.view(), samples, tau_ext, sigma, worth};
  LoadFound found;
  for (int pass = 0; pass < 3; ++pass)
    found = weigh(b, {b.load.link, b.load.rotation, b.load.translation}, {&motion, 1}, kUsualReach_m, found.phi, {});
  return found;
}

void loop_and_recording_find_the_same_load() {
  for (const Bundle& b : {bundle(), rubbing()}) {
    const bool rubs = !b.prior.empty();
    const Load truth = ball(2.2, {-0.04, 0.02, 0.06});
    const Motion m = motion(b, truth, 4000, 1.3);
    Monitor monitor(b);
    const LoadFound found = weighed(monitor, m), whole = of_recording(b, m);
    CHECK(found.seconds == whole.seconds);
    // Where the side that gears are loaded on depends on the load, the first tenth of a second does not know it: 0.25 g
    // of 2.2 kg.
    const double near = rubs ? 1e-3 : 1e-9;
    CHECK_CLOSE(found.mass_kg, whole.mass_kg, near);
    for (std::size_t i = 0; i < 3; ++i) CHECK_CLOSE(found.com_m[i], whole.com_m[i], near);
    CHECK_CLOSE(found.mass_error_kg, whole.mass_error_kg, (rubs ? 0.1 : 1e-6) * whole.mass_error_kg);
    CHECK_CLOSE(found.misfit, whole.misfit, rubs ? 0.05 : 1e-9);
  }
}

void adds_to_what_is_set() {
  const Bundle b = bundle();
  for (const double set_kg : {0.5, 1.6, 2.5}) {
    const Load set = ball(set_kg, {0.0, 0.03, 0.05}), truth = together(ball(0.5, {0.0, 0.03, 0.05}), ball(1.1, {0.06, -0.05, 0.1}));
    Monitor monitor(b);
    monitor.set_load(set);
    const LoadFound found = weighed(monitor, motion(b, truth, 5000));
    CHECK(found.verdict == LoadVerdict::load);
    CHECK_CLOSE(found.mass_kg, truth.mass - set_kg, 0.02);
    CHECK_CLOSE(found.load.mass, truth.mass, 0.02);
    CHECK(apart(found.load.com, truth.com) < 0.005);
    CHECK(monitor.load_fault(found.load) == LoadFault::none);
    // no body is left where nothing is held any more
    Monitor emptied(b);
    emptied.set_load(set);
    const LoadFound nothing = weighed(emptied, motion(b, {}, 5000));
    CHECK(nothing.verdict == LoadVerdict::load);
    CHECK_CLOSE(nothing.mass_kg, -set_kg, 0.02);
    CHECK(nothing.load.mass < 0.02);
    CHECK(emptied.load_fault(nothing.load) == LoadFault::none);
    // and what is set already is not found again
    Monitor right(b);
    right.set_load(truth);
    CHECK(weighed(right, motion(b, truth, 5000)).verdict == LoadVerdict::nothing);
  }
}

void two_bodies_are_one() {
  const Bundle b = bundle();
  const Load one{1.2, {0.1, -0.02, 0.03}, {0.01, 0.012, 0.006, 0.001, -0.001, 0.0005}, 0.02}, two = ball(0.7, {-0.05, 0.2, 0.1});
  const Load sum = together(one, two);
  CHECK_CLOSE(sum.mass, 1.9, 1e-12);
  CHECK_CLOSE(sum.error_share, 0.02 * 1.2 / 1.9, 1e-12);
  CHECK(b.load.fault(sum) == LoadFault::none);
  Tree both(b.links, b.gravity), first(b.links, b.gravity), second(b.links, b.gravity), bare(b.links, b.gravity);
  both.carry(b.load.link, b.load.in_link(sum));
  first.carry(b.load.link, b.load.in_link(one));
  second.carry(b.load.link, b.load.in_link(two));
  const double q[kN] = {0.1, -0.5, 0.9, 1.2, -0.3, 0.4}, dq[kN] = {1, -0.8, 0.6, 1.3, -2, 0.5};
  double p[4][kN], v[4][kN];
  both.momentum(q, dq, p[0], v[0]);
  first.momentum(q, dq, p[1], v[1]);
  second.momentum(q, dq, p[2], v[2]);
  bare.momentum(q, dq, p[3], v[3]);
  for (std::size_t j = 0; j < kN; ++j) {
    CHECK_CLOSE(p[0][j], p[1][j] + p[2][j] - p[3][j], 1e-12);
    CHECK_CLOSE(v[0][j], v[1][j] + v[2][j] - v[3][j], 1e-12);
  }
  CHECK(together({}, {}) == Load{});
  CHECK(together(one, {}).mass == one.mass);
}

void an_empty_hand_is_called_one() {
  const Bundle b = bundle();
  Monitor monitor(b);
  const LoadFound found = weighed(monitor, motion(b, {}, 4000));
  CHECK(found.verdict == LoadVerdict::nothing);
  CHECK(found.mass_kg < 3 * found.mass_error_kg);
}

void one_pose_does_not_determine_all() {
  const Bundle b = bundle();
  Motion m = motion(b, ball(1.5, {0.02, 0.01, 0.06}), 1, 1, {}, 0);
  Motion standing;
  for (std::int64_t k = 0; k < 3000; ++k) {
    standing.t_ns.push_back(k * kMs);
    for (std::size_t j = 0; j < kN; ++j) standing.q.push_back(m.q[j]), standing.dq.push_back(0);
  }
  Tree tree(b.links, b.gravity);
  tree.carry(b.load.link, b.load.in_link(ball(1.5, {0.02, 0.01, 0.06})));
  double p[kN], beta[kN];
  tree.momentum(std::span(standing.q).first(kN), std::span(standing.dq).first(kN), p, beta);
  for (std::int64_t k = 0; k < 3000; ++k) standing.tau.insert(standing.tau.end(), beta, beta + kN);
  Monitor monitor(b);
  const LoadFound found = weighed(monitor, standing);
  CHECK(found.unseen_count > 0);  // along gravity at least
  Vec3 along{};
  for (int i = 0; i < found.unseen_count; ++i) along = found.unseen[static_cast<std::size_t>(i)];
  CHECK_CLOSE(std::hypot(along[0], along[1], along[2]), 1, 1e-9);
}

void a_contact_is_refused() {
  const Bundle b = bundle();
  Monitor monitor(b);
  const LoadFound found = weighed(monitor, motion(b, {}, 4000, 1, {{15, 0, 5}}));
  CHECK(found.verdict == LoadVerdict::contact);
  const LoadFit& force = found.fits[static_cast<std::size_t>(LoadCause::base_force)];
  CHECK_CLOSE(force.values[0], 15, 0.5);
  CHECK_CLOSE(force.values[2], 5, 0.5);
}

void faults_in_between_are_left_out() {
  const Bundle b = bundle();
  const Load truth = ball(1.6, {0.03, -0.05, 0.08});
  Motion m = motion(b, truth, 5000);
  m.tau[1500 * kN + 2] = std::numeric_limits<double>::quiet_NaN();
  for (std::size_t k = 3000; k < m.t_ns.size(); ++k) m.t_ns[k] += 200 * kMs;  // and a hole
  Monitor monitor(b);
  const LoadFound found = weighed(monitor, m);
  CHECK(found.verdict == LoadVerdict::load);
  CHECK_CLOSE(found.mass_kg, truth.mass, 0.02);
  CHECK_CLOSE(found.seconds, 5 - 3 * 0.5, 0.05);
  // a step that lasts wakes no sums: only healthy samples count
  Monitor refused(b);
  refused.start_weighing();
  for (std::size_t k = 0; k < 2000; ++k) {
    Sample s = m.at(k);
    s.q = s.q.first(kN - 1);
    refused.step(s);
  }
  CHECK(refused.estimate_load().seconds == 0);
}

void drift_does_not_learn_the_load() {
  Bundle b = bundle();
  b.drift = {5, std::vector<double>(kN, 5.0), 0.5, 0, 0.1};
  const Load truth = ball(1.2, {0.03, -0.05, 0.08});
  const Motion before = motion(b, {}, 4000), m = motion(b, truth, 8000);
  Monitor monitor(b), learning(b);
  const LoadFound found = weighed(monitor, m);
  CHECK_CLOSE(found.mass_kg, truth.mass, 0.02);
  for (std::size_t k = 0; k < m.t_ns.size(); ++k) learning.step(m.at(k));
  double largest = 0;
  for (std::size_t j = 0; j < kN; ++j) {
    CHECK(monitor.last().drift[j] == 0);
    largest = std::max(largest, std::fabs(learning.last().drift[j]));
  }
  CHECK(largest > 0.5);
  monitor.stop_weighing();
  CHECK(!monitor.weighing());
  CHECK(monitor.estimate_load().mass_kg == found.mass_kg);  // what was found stays
  for (std::size_t k = 0; k < m.t_ns.size(); ++k) {
    Sample s = m.at(k);
    s.t_ns += 8000 * kMs;
    monitor.step(s);
  }
  double learned = 0;
  for (std::size_t j = 0; j < kN; ++j) learned = std::max(learned, std::fabs(monitor.last().drift[j]));
  CHECK(learned > 0.5);
  CHECK(monitor.estimate_load().mass_kg == found.mass_kg);
}

// Answers are the same to the last bit, whether it is weighed or not.
void weighing_changes_no_answer() {
  const Bundle b = bundle();
  const Motion m = motion(b, ball(1, {0, 0, 0.1}), 2000);
  Monitor plain(b), weighing(b);
  weighing.start_weighing();
  for (std::size_t k = 0; k < m.t_ns.size(); ++k) {
    const Estimate &one = plain.step(m.at(k)), &other = weighing.step(m.at(k));
    CHECK(std::memcmp(&one.residual, &other.residual, sizeof one.residual) == 0);
    CHECK(std::memcmp(&one.tau_ext, &other.tau_ext, sizeof one.tau_ext) == 0);
    CHECK(std::memcmp(&one.limit_nm, &other.limit_nm, sizeof one.limit_nm) == 0);
  }
  // and neither does when advance() is called
  Monitor late(b);
  late.start_weighing();
  for (std::size_t k = 0; k < m.t_ns.size(); ++k) late.estimate(m.at(k));
  late.advance();
  CHECK(late.estimate_load().mass_kg == weighing.estimate_load().mass_kg);
}

void states_end_it() {
  const Bundle b = bundle();
  const Motion m = motion(b, ball(1, {0, 0, 0.1}), 2000);
  Monitor monitor(b);
  std::vector<std::byte> state(monitor.state_bytes());
  weighed(monitor, m);
  CHECK(monitor.save_state(state));
  CHECK(monitor.weighing());
  CHECK(monitor.restore_state(state));
  CHECK(!monitor.weighing());
  CHECK(monitor.estimate_load().verdict == LoadVerdict::too_little);
  monitor.start_weighing();
  monitor.reset();
  CHECK(!monitor.weighing());
  CHECK(weighed(monitor, m).verdict == LoadVerdict::load);
}

void what_cannot_be_weighed_is_refused() {
  Bundle b = bundle();
  Monitor monitor(b);
  for (const double reach : {0.0, -1.0, std::nan(""), std::numeric_limits<double>::infinity()})
    CHECK(!monitor.start_weighing(reach));
  CHECK(!monitor.weighing());
  b.load = {};
  Monitor nowhere(b);
  CHECK(!nowhere.start_weighing());
  CHECK(nowhere.why_no_weighing().find("names no frame") != std::string::npos);
  CHECK(nowhere.estimate_load().verdict == LoadVerdict::too_little);
  CHECK_THROWS(Weighing(b), Error);
  b = bundle();
  b.observer.method = ResidualMethod::energy;
  CHECK(!Weighing::possible(b));
  b = bundle();
  b.observer.low_pass_per_s = 50;
  CHECK(!Weighing::possible(b));
}

// The sums of rows and of blocks, computed again by their definition.
void sums_are_those_of_their_rows() {
  LoadSums sums(1);
  const double sigma[] = {0.5}, worth[] = {0.8};
  std::mt19937 random(2);
  std::normal_distribution<double> normal;
  std::vector<LoadSums::Row> kept;
  for (int k = 0; k < 150; ++k) {
    LoadSums::Row row;
    for (double& value : row) value = normal(random);
    kept.push_back(row);
    sums.add({&row, 1}, sigma, worth);
  }
  LoadSums::Row theta{};
  theta[3] = 1.5, theta[LoadSums::kTauExt] = -1;
  double single = 0, blocks = 0, block = 0;
  for (std::size_t k = 0; k < kept.size(); ++k) {
    const double z = (1.5 * kept[k][3] - kept[k][LoadSums::kTauExt]) / 0.5;
    single += 0.8 * z * z;
    block += 0.8 * z;
    if (k == 99) blocks += block * block, block = 0;
  }
  blocks += block * block;
  CHECK_CLOSE(sums.square(0, theta), single, 1e-9 * single);
  CHECK_CLOSE(sums.block_square(0, theta), blocks, 1e-9 * blocks);
  CHECK_CLOSE(sums.joint(0).worth, 0.8 * 150, 1e-9);
  CHECK(sums.rows() == 150);
  double product = 0;
  for (std::size_t b = 0; b < LoadSums::kColumns; ++b) {
    const std::size_t at = std::min<std::size_t>(b, 3) * LoadSums::kColumns + std::max<std::size_t>(b, 3);
    product += sums.joint(0).whole[at] * theta[b];
  }
  CHECK_CLOSE(LoadSums::product(sums.joint(0).whole, 3, theta), product, 1e-12 * std::fabs(product));
  sums.clear();
  CHECK(sums.rows() == 0 && sums.square(0, theta) == 0);
}

void a_stand_is_worth_half_a_second_however_long() {
  std::vector<std::int64_t> t_ns;
  for (std::int64_t k = 0; k < 100'000; ++k) t_ns.push_back(k * kMs);
  std::vector<std::uint8_t> near;
  for (std::size_t k = 0; k < t_ns.size(); ++k) near.insert(near.end(), {1, 0});  // one joint stands, the other slides
  const std::vector<double> worth = worth_of_samples(t_ns, near);
  double seconds = 0;
  for (std::size_t k = 0; k < t_ns.size(); ++k) {
    seconds += 1e-3 * worth[2 * k];
    CHECK(worth[2 * k + 1] == 1);
  }
  CHECK_CLOSE(seconds, 0.5, 0.01);
}

void axes_of_a_symmetric_matrix() {
  const double matrix[] = {4, 1, 0.5, 1, 3, -0.2, 0.5, -0.2, 1};
  const SymmetricAxes found = symmetric_axes(matrix, 3);
  CHECK(found.values[0] <= found.values[1] && found.values[1] <= found.values[2]);
  for (std::size_t m = 0; m < 3; ++m)
    for (std::size_t i = 0; i < 3; ++i) {
      double sum = 0;
      for (std::size_t k = 0; k < 3; ++k) sum += matrix[3 * i + k] * found.axes[m][k];
      CHECK_CLOSE(sum, found.values[m] * found.axes[m][i], 1e-12);
    }
}

}  // namespace

int main() {
  finds_mass_and_centre();
  loop_and_recording_find_the_same_load();
  adds_to_what_is_set();
  two_bodies_are_one();
  an_empty_hand_is_called_one();
  one_pose_does_not_determine_all();
  a_contact_is_refused();
  faults_in_between_are_left_out();
  drift_does_not_learn_the_load();
  weighing_changes_no_answer();
  states_end_it();
  what_cannot_be_weighed_is_refused();
  sums_are_those_of_their_rows();
  a_stand_is_worth_half_a_second_however_long();
  axes_of_a_symmetric_matrix();
  return check::result();
}
