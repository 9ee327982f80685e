#include "stages/estimates.hpp"
#include "tauext/bundle.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>

#include "check.hpp"
#include "made_bundle.hpp"
#include "refused.hpp"
#include "temporary_folder.hpp"

using namespace tauext;

namespace {

const TemporaryFolder folder;

std::vector<char> read(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

void write(const std::string& path, const std::vector<char>& bytes) {
  std::ofstream(path, std::ios::binary).write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

// Two joints, a random network with a window of 5 steps of 10 samples.
Bundle make_bundle() { return made::bundle(2, 7, 5, 10, 1); }

void a_saved_bundle_loads_and_estimates_the_same() {
  const Bundle b = make_bundle();
  const std::string path = folder.file("same.tauext"), again = folder.file("again.tauext");
  save_bundle(b, path);
  const Bundle loaded = load_bundle(path);
  save_bundle(loaded, again);
  CHECK(read(path) == read(again));
  const Reference& r = b.reference;
  const RecordingView view{static_cast<std::int64_t>(r.t_ns.size()), 2, r.t_ns.data(), r.q.data(), r.dq.data(), r.tau.data()};
  const Estimates one = estimate(b, view, 1), two = estimate(loaded, view, 2);
  CHECK(one.residual == two.residual);
  const std::vector<float> outputs = network_outputs(b, view, 2);
  const auto same = [](double x, double y) { return x == y || (std::isnan(x) && std::isnan(y)); };
  CHECK(std::ranges::equal(one.tau_ext, estimate(b, view, 1, outputs).tau_ext, same));
  CHECK_THROWS(estimate(b, view, 1, std::span(outputs).first(outputs.size() - 1)), Error);
  CHECK(!std::filesystem::exists(path + ".part"));
}

void every_truncation_and_every_flipped_byte_is_refused() {
  const std::string path = folder.file("good.tauext"), bad = folder.file("bad.tauext");
  save_bundle(make_bundle(), path);
  const std::vector<char> good = read(path);
  for (std::size_t size = 0; size < good.size(); size += 7) {
    write(bad, {good.begin(), good.begin() + static_cast<std::ptrdiff_t>(size)});
    CHECK_THROWS(load_bundle(bad), Error);
  }
  for (std::size_t at = 0; at < good.size(); at += 11) {
    if (at >= 12 && at < 16) continue;  // the minor version may differ
    std::vector<char> flipped = good;
    flipped[at] = static_cast<char>(flipped[at] ^ 0x10);
    write(bad, flipped);
    CHECK_THROWS(load_bundle(bad), Error);
  }
}

// A good bundle is spoilt by `change`, then written.
template <class Change>
void refused_after(const char* part_of_message, Change change) {
  Bundle b = make_bundle();
  change(b);
  refused(part_of_message, [&] { save_bundle(b, folder.file("refused.tauext")); });
}

void contents_that_do_not_fit_are_refused_by_name() {
  refused_after("parameters", [](Bundle& b) { b.parameters.pop_back(); });
  refused_after("parameters", [](Bundle& b) { b.parameters[3] = NAN; });
  refused_after("parameters", [](Bundle& b) { b.parameters[4] = INFINITY; });
  refused_after("parameters", [](Bundle& b) { b.shape.hidden = 8; });
  refused_after("the network has 5 inputs", [](Bundle& b) {
    b.shape.inputs = 5;
    b.parameters.resize(b.shape.parameter_count());
  });
  refused_after("shape.outputs", [](Bundle& b) {
    b.shape.outputs = 3;
    b.parameters.resize(b.shape.parameter_count());
  });
  refused_after("input_factors", [](Bundle& b) { b.input_factors[0] = 0; });
  refused_after("output_scale_nm", [](Bundle& b) { b.output_scale_nm.push_back(1); });
  refused_after("window_steps = 0", [](Bundle& b) { b.window_steps = 0; });
  refused_after("column 4", [](Bundle& b) { b.inputs[0].column = 4; });
  refused_after("gain", [](Bundle& b) { b.observer.gain_per_s = 0; });
  refused_after("none of momentum, direct", [](Bundle& b) { b.observer.method = static_cast<ResidualMethod>(4); });
  refused_after("high_pass_per_s = -1", [](Bundle& b) { b.observer.high_pass_per_s = -1; });
  refused_after("low_pass_per_s = nan", [](Bundle& b) { b.observer.low_pass_per_s = NAN; });
  refused_after("the velocity observer needs a model", [](Bundle& b) {
    b.observer.method = ResidualMethod::velocity;
    for (Link& link : b.links) link.mass = link.rotor_inertia = 0, link.inertia = {};
  });
  refused_after("a prior is filtered as the momentum observer", [](Bundle& b) {
    b.prior.corrected_links = b.links;
    b.observer.method = ResidualMethod::energy;
  });
  refused_after("a prior is filtered as the momentum observer", [](Bundle& b) {
    b.prior.corrected_links = b.links;
    b.observer.low_pass_per_s = 30;
  });
  refused_after("reference is empty", [](Bundle& b) { b.reference = {}; });
  refused_after("reference.tau", [](Bundle& b) { b.reference.tau.pop_back(); });
  refused_after("replaying its reference", [](Bundle& b) { b.reference.network[0] += 0.1; });
  refused_after("reference holds a value that is not finite", [](Bundle& b) { b.reference.network[0] = NAN; });
  refused_after("reference holds a value that is not finite", [](Bundle& b) { b.reference.residual[1] = INFINITY; });
  refused_after("reference holds a value that is not finite", [](Bundle& b) { b.reference.dq[3] = NAN; });
  refused_after("has gaps", [](Bundle& b) { b.reference.t_ns.back() += 1'000'000'000'000; });
  refused_after("do not increase", [](Bundle& b) { b.reference.t_ns[3] = b.reference.t_ns[2]; });
  refused_after("lag 2147483647", [](Bundle& b) { b.inputs[1].lag = 2147483647; });
  refused_after("sample period", [](Bundle& b) { b.observer.sample_period_ns = 4611686018427387903; });
  refused_after("network period", [](Bundle& b) { b.observer.network_stride = kMaxNetworkStride + 1; });
  for (const char* name : {"a\x1b[31m", "a\n", "a\x7f", "a\xc2\x9b""31m"})
    refused_after("cannot be printed", [name](Bundle& b) { b.links[1].joint_name = name; });
  refused_after("two joints are named", [](Bundle& b) { b.links[1].joint_name = b.links[0].joint_name; });
  refused_after("has no name", [](Bundle& b) { b.links[0].joint_name.clear(); });
  // Another robot than the one the reference was made with.
  refused_after("replaying its reference", [](Bundle& b) { b.links[1].mass *= 1.5; });
}

void limits_and_signals_that_make_no_sense_are_refused_by_name() {
  refused_after("limits.collision.sliding_nm", [](Bundle& b) { b.limits.collision.sliding_nm[1] = -1; });
  refused_after("limits.collision.near_stiction_nm", [](Bundle& b) { b.limits.collision.near_stiction_nm[0] = NAN; });
  refused_after("must all be finite, or all infinite", [](Bundle& b) { b.limits.contact.sliding_nm[0] = INFINITY; });
  refused_after("nothing would be monitored", [](Bundle& b) {
    for (Level* level : {&b.limits.collision, &b.limits.contact})
      for (double& limit : level->sliding_nm) limit = INFINITY;
    b.limits.collision.near_stiction_nm = b.limits.contact.near_stiction_nm = b.limits.collision.sliding_nm;
  });
  refused_after("limits.collision.hold_s", [](Bundle& b) { b.limits.collision.hold_s = -0.001; });
  refused_after("limits.contact.sliding_nm", [](Bundle& b) { b.limits.contact.sliding_nm.pop_back(); });
  refused_after("limits.contact.hold_s", [](Bundle& b) { b.limits.contact.hold_s = NAN; });
  refused_after("limits.contact_release_s", [](Bundle& b) { b.limits.contact_release_s = INFINITY; });
  refused_after("limits.near_stiction_rad_s", [](Bundle& b) { b.limits.near_stiction_rad_s = NAN; });
  refused_after("limits.near_stiction_rad_s", [](Bundle& b) { b.limits.near_stiction_rad_s = INFINITY; });
  refused_after("signals.torque_limit_nm", [](Bundle& b) { b.signals.torque_limit_nm[0] = 0; });
  refused_after("signals.torque_limit_nm", [](Bundle& b) { b.signals.torque_limit_nm[0] = NAN; });
  refused_after("signals.torque_limit_nm", [](Bundle& b) { b.signals.torque_limit_nm.clear(); });
  refused_after("signals.largest_torque_nm", [](Bundle& b) { b.signals.largest_torque_nm[1] = INFINITY; });
  refused_after("signals.possible_torque_nm", [](Bundle& b) { b.signals.possible_torque_nm[1] = NAN; });
  refused_after("signals.possible_torque_nm", [](Bundle& b) { b.signals.possible_torque_nm.pop_back(); });
  refused_after("must be at least largest_torque_nm", [](Bundle& b) { b.signals.possible_torque_nm[0] = 99; });
  refused_after("signals.possible_speed_rad_s", [](Bundle& b) { b.signals.possible_speed_rad_s[0] = 0; });
  refused_after("signals.possible_speed_rad_s", [](Bundle& b) { b.signals.possible_speed_rad_s.clear(); });
  for (double share : {0.049, 0.151, static_cast<double>(NAN)})
    refused_after("signals.rate_tolerance", [share](Bundle& b) { b.signals.rate_tolerance = share; });
}

void other_versions_and_bytes_that_do_not_belong_are_refused_by_name() {
  const std::vector<char> good = to_bytes(make_bundle());
  const auto with_version = [&](std::uint32_t major) {
    std::vector<char> bytes = good;
    std::memcpy(bytes.data() + 8, &major, sizeof major);
    return [bytes] { from_bytes(bytes); };
  };
  refused("version 13, this program reads version 1; it was made by a newer tauext", with_version(13));
  for (std::uint32_t development : {2U, 12U})
    refused("made by a development version before 0.1.0; train it again", with_version(development));
  std::vector<char> bytes = good;
  bytes.push_back(0);
  refused("something appended", [&] { from_bytes(bytes); });
  // The same with a header of the matching size and checksum.
  const std::uint64_t size = bytes.size() - 28;
  const std::uint32_t crc = crc32(std::span(bytes).subspan(28));
  std::memcpy(bytes.data() + 16, &size, sizeof size);
  std::memcpy(bytes.data() + 24, &crc, sizeof crc);
  refused("of a later version", [&] { from_bytes(bytes); });
  refused("not a tauext bundle", [] { from_bytes(std::vector<char>(64, 'x')); });
  refused("cannot be opened", [] { load_bundle(folder.file("none.tauext")); });
}

// Widths alone are not a prior: they select the limit near stiction.
void every_method_and_filter_is_kept_and_widths_go_with_them() {
  for (const ResidualMethod method : {ResidualMethod::direct, ResidualMethod::velocity, ResidualMethod::energy}) {
    Bundle b = made::bundle(2, 0, 5, 10, 1);
    b.observer.method = method;
    b.observer.high_pass_per_s = 2;
    b.observer.low_pass_per_s = 30;
    b.prior.widths_rad = {1e-3, 3e-3};
    b.limits.region_width = 1;
    answer_reference(b);
    const Bundle loaded = from_bytes(to_bytes(b));
    CHECK(loaded.observer.method == method);
    CHECK(loaded.observer.high_pass_per_s == 2 && loaded.observer.low_pass_per_s == 30);
  }
}

Bundle make_tracking_bundle() {
  Bundle b = make_bundle();
  b.drift = {120, {3, 2}, 0.01, 0.5, 1.0};
  return b;
}

void a_drift_tracker_is_saved_and_one_that_makes_no_sense_is_refused_by_name() {
  const Bundle b = make_tracking_bundle(), loaded = from_bytes(to_bytes(b));
  CHECK(loaded.drift.time_constant_s == 120 && loaded.drift.size_nm == b.drift.size_nm);
  CHECK(loaded.drift.rate_share_per_s == 0.01 && loaded.drift.freeze_share == 0.5 && loaded.drift.freeze_s == 1);
  refused_after("drift.time_constant_s = 0.5", [](Bundle& c) { c.drift.time_constant_s = 0.5; });
  refused_after("drift.time_constant_s", [](Bundle& c) { c.drift.time_constant_s = NAN; });
  refused_after("drift.time_constant_s", [](Bundle& c) { c.drift.time_constant_s = -1; });
  const auto spoilt = [](const char* part, void (*change)(DriftSettings&)) {
    refused_after(part, [&](Bundle& c) {
      c = make_tracking_bundle();
      change(c.drift);
    });
  };
  spoilt("drift.size_nm has 1", [](DriftSettings& d) { d.size_nm.pop_back(); });
  spoilt("drift.size_nm = -1", [](DriftSettings& d) { d.size_nm[1] = -1; });
  spoilt("drift.size_nm", [](DriftSettings& d) { d.size_nm[0] = INFINITY; });
  spoilt("drift.rate_share_per_s = 0", [](DriftSettings& d) { d.rate_share_per_s = 0; });
  spoilt("drift.rate_share_per_s", [](DriftSettings& d) { d.rate_share_per_s = NAN; });
  spoilt("drift.freeze_share = 1.1", [](DriftSettings& d) { d.freeze_share = 1.1; });
  spoilt("drift.freeze_share", [](DriftSettings& d) { d.freeze_share = -0.1; });
  spoilt("drift.freeze_s = 61", [](DriftSettings& d) { d.freeze_s = 61; });
}

// Two joints, the second of which slides; one was trained on amperes.
Bundle make_scaled_bundle() {
  Bundle b = make_bundle();
  b.links[1].type = JointType::prismatic;
  b.observer.nm_per_unit = {2.5, -0.5};
  b.units.given = TorqueUnit::ampere;
  answer_reference(b);
  return b;
}

void torque_constants_are_applied_saved_and_refused_by_name() {
  const Bundle b = make_scaled_bundle(), loaded = from_bytes(to_bytes(b));
  CHECK(loaded.observer.nm_per_unit == b.observer.nm_per_unit && loaded.units.given == TorqueUnit::ampere);
  // The same numbers given in N m to a bundle without constants.
  Bundle plain = b;
  plain.observer.nm_per_unit.clear();
  plain.units = {};
  for (std::size_t k = 0; k < plain.reference.tau.size(); ++k) plain.reference.tau[k] *= k % 2 ? -0.5 : 2.5;
  answer_reference(plain);
  CHECK(plain.reference.residual == b.reference.residual && plain.reference.network == b.reference.network);
  const auto view = [](const Reference& r) {
    return RecordingView{static_cast<std::int64_t>(r.t_ns.size()), 2, r.t_ns.data(), r.q.data(), r.dq.data(), r.tau.data()};
  };
  CHECK(estimate(b, view(b.reference), 1).residual == estimate(plain, view(plain.reference), 1).residual);
  const auto spoilt = [](const char* part, void (*change)(Bundle&)) {
    refused_after(part, [&](Bundle& c) {
      c = make_scaled_bundle();
      change(c);
    });
  };
  spoilt("nm_per_unit has 1 values where 2 belong", [](Bundle& c) { c.observer.nm_per_unit.pop_back(); });
  spoilt("nm_per_unit = 0 must be finite and not 0", [](Bundle& c) { c.observer.nm_per_unit[1] = 0; });
  spoilt("nm_per_unit = nan", [](Bundle& c) { c.observer.nm_per_unit[0] = NAN; });
  spoilt("units.given", [](Bundle& c) { c.units.given = static_cast<TorqueUnit>(3); });
  spoilt("units.relative_to = 2", [](Bundle& c) { c.units.relative_to = 2; });
  spoilt("unknown_constant has 1", [](Bundle& c) { c.observer.unknown_constant = {1}; });
  spoilt("unknown_constant = 2", [](Bundle& c) { c.observer.unknown_constant = {0, 2}; });
  spoilt("there are none", [](Bundle& c) {
    c.units.relative_to = 0;
    c.observer.nm_per_unit.clear();
    answer_reference(c);
  });
}

void units_are_reported() {
  const auto told = [](const Bundle& b) {
    return b.torque_unit(0) + "|" + b.torque_unit(1) + "|" + b.estimate_unit(0) + "|" + b.estimate_unit(1);
  };
  Bundle b = make_scaled_bundle();
  CHECK(told(b) == "A|A|N m|N");
  b.observer.unknown_constant = {1, 0};
  CHECK(told(b) == "A|A|A / 2.5|N" && !b.in_newtons(0) && b.in_newtons(1));
  CHECK(b.too_few_in_newtons("so it is") == "only 1 of 2 joints in N m: joint 'joint1' answers in A / 2.5, and so it is");
  b.observer.nm_per_unit[0] = 1;
  CHECK(told(b) == "A|A|A|N");
  b.units.relative_to = 1;
  CHECK(told(b) == "A|A|A|units of joint2");
  b.units.given = TorqueUnit::recorded;
  CHECK(told(b) == "recorded unit|recorded unit|recorded unit|units of joint2");
  b.observer.nm_per_unit.clear();
  b.units = {};
  b.observer.unknown_constant.clear();
  CHECK(told(b) == "N m|N|N m|N");
  b.observer.method = ResidualMethod::energy;
  CHECK(told(b) == "N m|N|W|W");
  b.units.given = TorqueUnit::ampere;  // the product of amperes and speeds has no unit here
  CHECK(told(b) == "A|A|A|A");
}

void numbers_that_would_overflow_the_network_are_refused() {
  refused_after("the network overflows", [](Bundle& b) { b.parameters[0] = 2e37f; });
  refused_after("output_scale_nm = 1e+201 must be 0 to 1e200", [](Bundle& b) { b.output_scale_nm[0] = 1e201; });
}

void the_plain_observer_needs_no_network() {
  Bundle b = make_bundle();
  b.shape = {};
  b.parameters.clear();
  answer_reference(b);
  save_bundle(b, folder.file("observer.tauext"));
  CHECK(!load_bundle(folder.file("observer.tauext")).has_network());
}

}  // namespace

int main() {
  a_saved_bundle_loads_and_estimates_the_same();
  every_truncation_and_every_flipped_byte_is_refused();
  contents_that_do_not_fit_are_refused_by_name();
  limits_and_signals_that_make_no_sense_are_refused_by_name();
  other_versions_and_bytes_that_do_not_belong_are_refused_by_name();
  every_method_and_filter_is_kept_and_widths_go_with_them();
  a_drift_tracker_is_saved_and_one_that_makes_no_sense_is_refused_by_name();
  torque_constants_are_applied_saved_and_refused_by_name();
  units_are_reported();
  numbers_that_would_overflow_the_network_are_refused();
  the_plain_observer_needs_no_network();
  return check::result();
}
