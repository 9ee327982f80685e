// The two ways through the chain, sample by sample and in bulk, on recordings with everything wrong that a recording can
// hold: equal to the last bit, health and causes too.
#include "stages/estimates.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "made_signals.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;
using made::kMs, made::Signals;

namespace {

constexpr int kSteps = 6, kStride = 10, kSamples = 400;
constexpr int kRecordings = check::emulated ? 1500 : 4000;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN(), kInfinity = std::numeric_limits<double>::infinity();

// Equal, or both NaN.
bool same(double a, double b) { return std::memcmp(&a, &b, sizeof a) == 0 || (std::isnan(a) && std::isnan(b)); }

// Observers that are quick to warm up, so that short recordings see all of the chain.
Bundle quick(int joints, int hidden, unsigned seed) {
  Bundle b = made::bundle(joints, hidden, kSteps, kStride, seed);
  b.observer.gain_per_s = 150;
  b.signals.torque_limit_nm.assign(b.links.size(), 40.0);
  b.signals.largest_torque_nm.assign(b.links.size(), 12.0);
  for (Level* level : {&b.limits.collision, &b.limits.contact})
    for (auto* limits : {&level->sliding_nm, &level->near_stiction_nm})
      for (double& limit : *limits) limit *= 1.5;
  b.limits.collision.hold_s = 0.004;
  answer_reference(b);
  return b;
}

// Every kind of chain: with and without network, prior, drift tracker, filters, torque constants, coverage and other
// residuals.
std::vector<Bundle> chains() {
  std::vector<Bundle> all{quick(1, 0, 1), quick(2, 5, 2), quick(7, 8, 3)};
  all[2].error_scale.features = {MotionFeature::constant};  // a contact at a frame needs standard errors
  all[2].error_scale.limit_weights = all[2].error_scale.largest = all[2].error_scale.sigma_weights =
      all[2].error_scale.sigma_near_weights = all[2].error_scale.largest_sigma = std::vector<double>(7, 1.0);
  Bundle prior = quick(2, 6, 4);
  prior.prior.widths_rad = {1e-3, 1e-2};
  prior.prior.terms = {{TermKind::coulomb, 0, 0, 0, 0, 0.05}, {TermKind::presliding, 0, 1, 0, 0, 0},
                       {TermKind::viscous, 1, 0, 0, 0, 0},    {TermKind::momentum, 1, 0, 0, 1, 0}};
  prior.prior.weights = {1.5, -2, 0, 0.1, 0, 0.5, 1, 0.2};
  prior.prior.corrected_links = prior.links;
  prior.prior.corrected_links[1].mass *= 1.1;
  prior.limits.region_width = 0;
  for (int column = 4; column < 8; ++column) {
    prior.input_factors.push_back(1.0f);
    prior.inputs.push_back({column, 0});
  }
  prior.shape.inputs += 4;
  prior.parameters.clear();
  std::mt19937 random(9);
  std::normal_distribution<float> normal(0, 0.4f);
  for (std::size_t k = 0; k < prior.shape.parameter_count(); ++k) prior.parameters.push_back(normal(random));
  prior.drift = {1, {3, 3}, 0.2, 0.8, 0.005, {0.5, 0.1}, 0.4};
  prior.prior.temperature = {{20, 20}, {500, 30}, {-0.1, 0.3}, {0.2, -0.2}};
  prior.limits.after_contact_factor = 2;
  prior.limits.near_memory_s = 0.007;
  prior.error_scale.features = {MotionFeature::constant, MotionFeature::arm_jerk, MotionFeature::standstill};
  prior.error_scale.limit_weights = {0.5, 1e-4, 0.5, 1, 0, 2};
  prior.error_scale.largest = {3, 2};
  prior.error_scale.sigma_weights = {0.1, 1e-3, 0, 0.3, 0, 0.1};
  prior.error_scale.sigma_near_weights = {0, 0, 1, 0, 1e-4, 1};
  prior.error_scale.largest_sigma = {0.6, 0.9};
  prior.coverage = made::half_seen(2);
  answer_reference(prior);
  all.push_back(prior);
  Bundle drifting = quick(2, 0, 5);
  drifting.drift = {1, {50, 50}, 1.0, 0, 0};
  drifting.observer.nm_per_unit = {3.0, -0.25};
  drifting.coverage = made::half_seen(2);
  answer_reference(drifting);
  all.push_back(drifting);
  for (const ResidualMethod method : {ResidualMethod::direct, ResidualMethod::velocity, ResidualMethod::energy}) {
    Bundle other = quick(2, method == ResidualMethod::energy ? 5 : 0, 6);
    other.observer.method = method;
    other.observer.high_pass_per_s = 20;
    other.observer.low_pass_per_s = 300;
    answer_reference(other);
    all.push_back(other);
  }
  // Half of the bundles have ranges of possible signals; the others see what overflows.
  for (const std::size_t k : {1u, 3u, 4u, 6u}) {
    all[k].signals.possible_torque_nm.assign(all[k].links.size(), 90.0);
    all[k].signals.possible_speed_rad_s.assign(all[k].links.size(), 8.0);
  }
  return all;
}

struct Fault {
  const char* name;
  int tried = 0;
};
enum Which {
  kNumber, kHuge, kWide, kJitter, kBridged, kLongGap, kLate, kBackwards, kRepeated, kSlow, kSaturated, kStill, kPush,
  kTorqueSpike, kSpeedSpike, kJump, kCount
};
Fault faults[kCount] = {{"not finite"}, {"overflow"},  {"overflow of the network"}, {"jitter"},    {"bridged gap"},
                        {"long gap"},   {"late"},      {"backwards"},               {"repeated stamp"}, {"other rate"},
                        {"saturated"},  {"still"},     {"push"},
                        {"impossible torque"}, {"impossible velocity"}, {"position jump"}};

// The made motion with up to six faults at random places, of random length.
Signals broken(int joints, std::mt19937_64& random) {
  const auto below = [&](std::uint64_t n) { return static_cast<std::int64_t>(random() % n); };
  std::vector<std::int64_t> step(kSamples, kMs);
  const std::int64_t first_ns = below(3) == 0 ? -below(1'000'000'000'000) : below(1'000'000'000'000);
  struct Hit {
    Which which;
    std::int64_t at, length;
    int joint;
  };
  std::vector<Hit> hits(static_cast<std::size_t>(below(7)));
  for (Hit& hit : hits) {
    hit = {static_cast<Which>(below(kCount)), below(kSamples), 1 + below(below(2) ? 4 : 150), static_cast<int>(below(static_cast<std::uint64_t>(joints)))};
    ++faults[hit.which].tried;
    const std::int64_t end = std::min<std::int64_t>(hit.at + hit.length, kSamples);
    for (std::int64_t k = hit.at; k < end; ++k) {
      std::int64_t& ns = step[static_cast<std::size_t>(k)];
      const bool once = k == hit.at;
      if (hit.which == kJitter) ns = 200'000 + below(1'600'000);
      if (hit.which == kSlow) ns = 3 * kMs / 2;  // no whole number: slow, and not lost
      if (hit.which == kBridged && once) ns = (2 + below(kStride)) * kMs;
      if (hit.which == kLongGap && once) ns = (kStride + 2 + below(500)) * kMs;
      if (hit.which == kLate && k < hit.at + 3) ns = -below(kStride * kMs / 4);
      if (hit.which == kBackwards && once) ns = -(kStride + 1 + below(10'000)) * kMs;
      if (hit.which == kRepeated && once) ns = 0;
    }
  }
  std::vector<std::int64_t> t_ns;
  std::int64_t now = first_ns;
  for (std::int64_t ns : step) t_ns.push_back(now += ns);
  Signals s{joints, t_ns, {}, {}, {}};
  for (std::int64_t k = 0; k < kSamples; ++k) {
    double q[kMaxJoints], dq[kMaxJoints], tau[kMaxJoints];
    made::signal(k, joints, q, dq, tau);
    s.q.insert(s.q.end(), q, q + joints);
    s.dq.insert(s.dq.end(), dq, dq + joints);
    s.tau.insert(s.tau.end(), tau, tau + joints);
  }
  for (const Hit& hit : hits) {
    const std::int64_t end = std::min<std::int64_t>(hit.at + hit.length, kSamples);
    const auto cell = [&](std::int64_t k) { return static_cast<std::size_t>(k * joints + hit.joint); };
    std::vector<double>* signals[] = {&s.q, &s.dq, &s.tau};
    std::vector<double>& one = *signals[below(3)];
    const double bad[] = {kNan, kInfinity, -kInfinity};
    const double huge[] = {1e308, -1e308, 1e200, 1.7e308, 1e155};
    const double which_bad = bad[below(3)], which_huge = huge[below(5)];
    for (std::int64_t k = hit.at; k < end; ++k) {
      if (hit.which == kNumber) one[cell(k)] = which_bad;
      if (hit.which == kHuge) one[cell(k)] = which_huge;
      if (hit.which == kWide) (below(2) ? s.q : s.dq)[cell(k)] = 1e30 * (1 + static_cast<double>(below(1000000000)));
      if (hit.which == kSaturated) s.tau[cell(k)] = k % 2 ? 40 : -41;
      if (hit.which == kStill) s.q[cell(k)] = s.q[cell(hit.at)];
      if (hit.which == kPush) s.tau[cell(k)] -= 25;
      if (hit.which == kTorqueSpike) s.tau[cell(k)] = which_huge < 0 ? -1000 : 1e6;
      if (hit.which == kSpeedSpike) s.dq[cell(k)] = which_huge < 0 ? -8.5 : 1e5;
      if (hit.which == kJump) s.q[cell(k)] += 1.5;  // there and back
    }
  }
  return s;
}

struct Seen {
  int health[4] = {}, alarms = 0, detections = 0;
  std::uint32_t causes = 0, unseen = 0, declared = 0;
};

// A contact at the last link where the bundle can have one, and one of the first joint, each for some time.
std::vector<TimedContact> some_contacts(const Monitor& monitor, const RecordingView& recording) {
  std::vector<TimedContact> contacts;
  DeclaredContact tool, joint;
  tool.frame = monitor.joints() - 1;
  tool.axis = {1, 0.4, 0.2};
  tool.half_angle_rad = monitor.joints() > 3 ? 0.6 : 0.0;
  tool.at_most_n = 4;
  joint.joint = 0;
  joint.at_most_nm = 0.5;
  if (recording.samples < 300) return contacts;
  for (const DeclaredContact& one : {joint, tool})
    if (monitor.contact_fault(one, 0.4) == ContactFault::none)
      contacts.push_back({one, recording.t_ns[contacts.empty() ? 100 : 200], 0.15});
  if (contacts.size() == 2 && contacts[1].from_ns < contacts[0].from_ns) contacts[1].from_ns = contacts[0].from_ns;
  return contacts;
}

// The first difference, in words; empty: none.
std::string difference(const Bundle& bundle, const Signals& s, int threads, Seen& seen) {
  RecordingView recording = s.view();
  recording.temperature = s.tau.data();  // as wild as anything
  Monitor monitor(bundle);
  const std::vector<TimedContact> contacts = some_contacts(monitor, recording);
  const Estimates bulk = estimate(bundle, recording, threads, {}, {}, contacts);
  std::size_t declared = 0;
  for (std::int64_t k = 0; k < s.samples(); ++k) {
    for (; declared < contacts.size() && contacts[declared].from_ns <= recording.t_ns[k]; ++declared)
      monitor.expect_contact(contacts[declared].contact, contacts[declared].seconds);
    const Estimate& e = monitor.step(recording.at(k));
    const auto row = static_cast<std::size_t>(k);
    const auto n = static_cast<std::size_t>(s.joints);
    const std::string here = " at sample " + std::to_string(k);
    seen.health[static_cast<int>(e.health)]++;
    seen.alarms += e.held_alarm != Alarm::none;
    seen.detections += e.detection;
    seen.causes |= e.causes;
    if (static_cast<std::uint8_t>(e.health) != bulk.health[row]) return "health" + here;
    if (e.causes != bulk.causes[row] || e.cause_joint != bulk.cause_joint[row]) return "causes" + here;
    if (static_cast<std::uint8_t>(e.alarm) != bulk.alarm[row] || e.alarm_joint != bulk.alarm_joint[row] ||
        static_cast<std::uint8_t>(e.held_alarm) != bulk.held_alarm[row] || e.detection != (bulk.detection[row] == 1))
      return "alarm" + here;
    if (!same(e.unfamiliar, bulk.unfamiliar[row]) || static_cast<std::uint8_t>(e.unseen) != bulk.unseen[row] ||
        e.unseen_joint != bulk.unseen_joint[row] || e.unseen_other != bulk.unseen_other[row])
      return "unfamiliar" + here;
    if (static_cast<std::uint8_t>(e.declared) != bulk.declared[row] || e.declared_contact != bulk.declared_contact[row] ||
        !same(e.declared_size, bulk.declared_size[row]) || !same(e.declared_sigma, bulk.declared_sigma[row]))
      return "declared contact" + here;
    seen.declared |= 1u << static_cast<unsigned>(e.declared);
    seen.unseen |= 1u << static_cast<unsigned>(e.unseen);
    for (std::size_t j = 0; j < n; ++j) {
      const std::size_t at = row * n + j;
      if (!same(e.residual[j], bulk.residual[at])) return "residual" + here;
      if (!same(e.prior[j], bulk.prior[at])) return "prior" + here;
      if (!same(e.network[j], bulk.network[at])) return "network" + here;
      if (!same(e.drift[j], bulk.drift[at])) return "drift" + here;
      if (!same(e.tau_ext[j], bulk.tau_ext[at])) return "tau_ext" + here;
      if (!same(e.doubt[j], bulk.doubt[at])) return "doubt" + here;
      if (!same(e.sigma_nm[j], bulk.sigma_nm[at])) return "sigma" + here;
      if (!same(e.limit_scale[j], bulk.limit_scale[at])) return "limit scale" + here;
      if (!same(e.limit_nm[j], bulk.limit_nm[at])) return "limit" + here;
      if (!same(e.contact_limit_nm[j], bulk.contact_limit_nm[at])) return "contact limit" + here;
      if (!same(e.declared_nm[j], bulk.declared_nm[at])) return "declared torque" + here;
      if ((e.near_stiction >> j & 1) != bulk.near_stiction[at]) return "near_stiction" + here;
      // No NaN while the health reports an estimate.
      if (e.health == Health::ok && !std::isfinite(e.tau_ext[j])) return "tau_ext that is not finite" + here;
    }
  }
  return "";
}

void batch_and_loop_agree_on_random_mixtures_of_all_faults() {
  const std::vector<Bundle> all = chains();
  std::mt19937_64 random(20260101);
  Seen seen;
  int different = 0, recordings = 0;
  for (; recordings < kRecordings; ++recordings) {
    const Bundle& bundle = all[static_cast<std::size_t>(recordings) % all.size()];
    const Signals s = broken(bundle.joints(), random);
    const std::string what = difference(bundle, s, 1 + recordings % 2, seen);
    if (what.empty() || ++different > 10) continue;
    std::printf("recording %d (chain %zu): %s\n", recordings, static_cast<std::size_t>(recordings) % all.size(), what.c_str());
  }
  CHECK(different == 0);
  // Every kind of fault occurred and was reported.
  int tried = 0;
  for (const Fault& fault : faults) {
    CHECK(fault.tried > kRecordings / 10);
    tried += fault.tried;
  }
  for (const int samples : seen.health) CHECK(samples > kRecordings / 10);  // stale ones are few by their nature
  CHECK(seen.causes == (kNotFinite | kLateSample | kTimeBackwards | kGap | kWrongRate | kTorqueSaturated | kEncoderStill |
                        kImpossibleTorque | kImpossibleVelocity | kImpossiblePosition));
  CHECK(seen.unseen == 0b1111);
  CHECK((seen.declared & 0b111) == 0b111);
  CHECK(seen.alarms > kRecordings && seen.detections > kRecordings);
  std::printf("%d recordings of %d samples with %d faults, both ways, bit for bit: %d differ\n", recordings, kSamples, tried,
              different);
}

// The test above can fail: a bundle that differs in one number gives other results.
void another_chain_is_rejected() {
  const Bundle one = quick(2, 5, 2);
  Bundle other = one;
  other.output_scale_nm[1] *= 1 + 1e-15;
  answer_reference(other);
  const Signals s = made::sampled(2, [] {
    std::vector<std::int64_t> t_ns;
    for (int k = 0; k < kSamples; ++k) t_ns.push_back(k * kMs);
    return t_ns;
  }());
  const Estimates a = estimate(one, s.view(), 1), b = estimate(other, s.view(), 1);
  CHECK(a.residual == b.residual && a.tau_ext.size() == b.tau_ext.size());
  bool differ = false;
  for (std::size_t k = 0; k < a.tau_ext.size(); ++k) differ = differ || !same(a.tau_ext[k], b.tau_ext[k]);
  CHECK(differ);
}

// Beyond what its sums can hold a feature is no number: its network would answer NaN or, worse, something.
void features_that_would_overflow_the_network_are_a_fault() {
  const Bundle bundle = quick(2, 5, 2);
  const float largest = largest_lstm_input(bundle.shape, bundle.parameters);
  for (const double share : {0.999, 1.001}) {
    Monitor monitor(bundle);
    double q[2] = {0, 0}, dq[2] = {0, 0}, tau[2] = {0, 0};
    dq[1] = share * static_cast<double>(largest) / static_cast<double>(bundle.input_factors[3]);
    const Estimate& e = monitor.step({0, q, dq, tau});
    CHECK((e.health == Health::fault) == (share > 1));
    if (share > 1) CHECK(e.causes == kNotFinite && e.cause_joint == 1);
  }
}

void a_recording_of_other_joints_is_refused() {
  const Signals s = made::sampled(3, {0, kMs, 2 * kMs});
  CHECK_THROWS(estimate(quick(2, 0, 1), s.view(), 1), Error);
}

}  // namespace

int main() {
  batch_and_loop_agree_on_random_mixtures_of_all_faults();
  another_chain_is_rejected();
  features_that_would_overflow_the_network_are_a_fault();
  a_recording_of_other_joints_is_refused();
  return check::result();
}
