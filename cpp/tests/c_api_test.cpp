// The C API equals the C++ monitor to the last bit, and no exception or overrun escapes.
#include "tauext/tauext.h"

#include <array>
#include <cstddef>
#include <cstring>
#include <filesystem>
#include <string>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "tauext/monitor.hpp"
#include "tauext/refit.hpp"
#include "temporary_folder.hpp"

extern "C" int estimates_of_c_program(const void* bundle, size_t bundle_size, size_t samples, const double* q,
                                      const double* dq, const double* tau, double* tau_ext, int32_t* alarms);

namespace {

constexpr int kJoints = 3;
constexpr int kSamples = 4000;

struct Signals {
  double q[kJoints], dq[kJoints], tau[kJoints];
  explicit Signals(std::int64_t k) { made::signal(k, kJoints, q, dq, tau); }
  tauext::Sample sample(std::int64_t t_ns) const { return {t_ns, q, dq, tau}; }
};

const tauext::Bundle& bundle() {
  static const tauext::Bundle made = made::bundle(kJoints, 6, 8, 10, 1);
  return made;
}
const std::vector<char>& bytes() {
  static const std::vector<char> made = tauext::to_bytes(bundle());
  return made;
}

tauext_monitor* open(tauext_network_rate rate = TAUEXT_EVERY_SAMPLE) {
  tauext_monitor* monitor = nullptr;
  char message[256];
  const tauext_status status =
      tauext_monitor_open_bytes(bytes().data(), bytes().size(), rate, &monitor, message, sizeof message);
  if (status != TAUEXT_OK) std::printf("message was: %s\n", message);
  CHECK(status == TAUEXT_OK && monitor && message[0] == '\0');
  return monitor;
}

tauext_estimate fresh() {
  tauext_estimate e;
  std::memset(&e, 0xA5, sizeof e);
  e.size = sizeof e;
  return e;
}

// Bit for bit, NaN and all.
bool same(const tauext_estimate& c, const tauext::Estimate& e) {
  const auto equal = [](const double* a, const tauext::JointVector& b) {
    return std::memcmp(a, b.data(), sizeof b) == 0;
  };
  return c.size == sizeof c && c.t_ns == e.t_ns && c.joints == e.joints && c.health == static_cast<int>(e.health) &&
         c.causes == e.causes && c.cause_joint == e.cause_joint && c.alarm == static_cast<int>(e.alarm) &&
         c.alarm_joint == e.alarm_joint && c.alarm_t_ns == e.alarm_t_ns && c.detection == e.detection &&
         c.near_stiction == e.near_stiction && equal(c.residual, e.residual) && equal(c.uncertainty, e.uncertainty) &&
         equal(c.tau_ext, e.tau_ext) && equal(c.drift, e.drift) &&
         c.drift_saturated == e.drift_saturated && c.unfamiliar == e.unfamiliar && c.unused == 0 && c.load_kg == e.load.mass && c.load_phase == static_cast<int>(e.load_phase) && c.load_found_ns == e.load_found_ns && c.load_error_kg == e.load_error_kg && equal(c.load_nm, e.load_nm) && c.touch == static_cast<int>(e.touch) && equal(c.limit_nm, e.limit_nm) && equal(c.margin_nm, e.margin_nm) &&
         c.alarm_number == e.alarm_number && c.touch_over == e.touch_over && c.touch_t_ns == e.touch_t_ns &&
         c.declared == static_cast<int>(e.declared) && c.declared_contact == e.declared_contact && c.declared_size == e.declared_size &&
         c.declared_sigma == e.declared_sigma && equal(c.declared_nm, e.declared_nm);
}

void estimates_are_those_of_the_cpp_monitor_through_faults_and_alarms() {
  for (const auto rate : {TAUEXT_EVERY_SAMPLE, TAUEXT_NETWORK_PERIOD}) {
    tauext_monitor* c = open(rate);
    tauext::Monitor cpp(bundle(), static_cast<tauext::NetworkRate>(rate));
    CHECK(tauext_monitor_joints(c) == kJoints);
    CHECK(std::strcmp(tauext_monitor_joint_name(c, 1), "joint2") == 0);
    CHECK(tauext_monitor_sample_period_ns(c) == made::kPeriodNs);
    int differ = 0, collisions = 0, faults = 0, healthy = 0;
    for (int k = 0; k < kSamples; ++k) {
      Signals s(k);
      const std::int64_t t_ns = k * made::kPeriodNs;
      tauext_estimate e = fresh();
      if (k == 1200) s.q[1] = NAN;
      if (k == 1800) {
        CHECK(tauext_monitor_no_sample(c, t_ns, &e) == TAUEXT_OK);
        differ += !same(e, cpp.no_sample(t_ns));
        continue;
      }
      if (k == 3000) {
        CHECK(tauext_monitor_acknowledge(c) == TAUEXT_OK);
        cpp.acknowledge();
      }
      if (k == 3100 || k == 3400) {  // of a joint, since the made bundle has no standard errors
        const double sign = k == 3100 ? 0.0 : -1.0;
        tauext_contact_bounds grip = TAUEXT_CONTACT_OF(1);
        grip.axis[0] = sign;
        grip.at_most_nm = 0.5;
        std::int32_t which = 7;
        CHECK(tauext_monitor_expect_contact(c, &grip, 0.3, &which) == TAUEXT_OK && which == (k == 3400));
        tauext::DeclaredContact same_grip;
        same_grip.joint = 1;
        same_grip.axis[0] = sign;
        same_grip.at_most_nm = 0.5;
        CHECK(cpp.expect_contact(same_grip, 0.3) == which);
        CHECK(tauext_monitor_end_contact(c, 5) == TAUEXT_BAD_CONTACT && tauext_monitor_end_contact(nullptr, 0) == TAUEXT_BAD_ARGUMENT);
        grip.at_most_nm = 0;
        char why[100];
        CHECK(tauext_monitor_expect_contact(c, &grip, 0.3, &which) == TAUEXT_BAD_CONTACT && which == -1);
        CHECK(tauext_monitor_why_no_contact(c, &grip, 0.3, why, sizeof why) == TAUEXT_OK && std::strstr(why, "above 0"));
        CHECK(tauext_monitor_unmonitored(c, &grip, why, sizeof why) == TAUEXT_OK && why[0] == 0);
        grip.size = 8;
        CHECK(tauext_monitor_expect_contact(c, &grip, 0.3, &which) == TAUEXT_BAD_ARGUMENT);
        tauext_tool_force tool = {};
        CHECK(tauext_monitor_tool_force(c, TAUEXT_BASE_AXES, &tool) == TAUEXT_BAD_ARGUMENT);
        tool.size = sizeof tool;
        CHECK(tauext_monitor_tool_force(c, TAUEXT_BASE_AXES, &tool) == TAUEXT_OK && tool.declared == 0 && !tool.wrench.known);
      }
      if (k == 3200) {
        CHECK(tauext_monitor_resume(c) == TAUEXT_OK);
        cpp.resume();
      }
      if (k == 2500) {
        const tauext_load load = {1.5, {0.1, 0, 0.05}, {0.01, 0.01, 0.01, 0, 0, 0}, TAUEXT_USUAL_LOAD_ERROR};
        CHECK(tauext_monitor_set_load(c, &load, t_ns - 200'000'000) == TAUEXT_OK);
        CHECK(cpp.set_load({1.5, {0.1, 0, 0.05}, {0.01, 0.01, 0.01, 0, 0, 0}}, t_ns - 200'000'000));
        tauext_load carried;
        CHECK(tauext_monitor_load(c, &carried) == TAUEXT_OK && std::memcmp(&carried, &load, sizeof load) == 0);
      }
      if (k == 2750) {
        CHECK(tauext_monitor_expect_load(c, 0.1, 1.0) == TAUEXT_OK);
        CHECK(cpp.expect_load(0.1, 1.0));
      }
      if (k == 2900) {
        CHECK(tauext_monitor_clear_load(c, TAUEXT_FROM_NOW) == TAUEXT_OK);
        CHECK(cpp.clear_load());
      }
      if (k == 3500) {
        CHECK(tauext_monitor_reset(c) == TAUEXT_OK);
        cpp.reset();
      }
      if (k % 2) {
        CHECK(tauext_monitor_step(c, t_ns, s.q, s.dq, s.tau, &e) == TAUEXT_OK);
      } else {
        CHECK(tauext_monitor_estimate(c, t_ns, s.q, s.dq, s.tau, &e) == TAUEXT_OK);
        CHECK(tauext_monitor_advance(c) == TAUEXT_OK);
      }
      differ += !same(e, cpp.step(s.sample(t_ns)));
      collisions += e.alarm == TAUEXT_COLLISION;
      faults += e.health == TAUEXT_FAULT;
      healthy += e.health == TAUEXT_HEALTHY;
    }
    CHECK(differ == 0);
    CHECK(collisions > 0 && collisions < kSamples);
    CHECK(faults > 0 && healthy > 2000);
    tauext_monitor_close(c);
  }
}

void a_c_program_gets_the_same() {
  std::vector<double> q, dq, tau, expected, got(kSamples * kJoints);
  std::vector<std::int32_t> expected_alarms, alarms(kSamples);
  tauext::Monitor cpp(bundle());
  for (int k = 0; k < kSamples; ++k) {
    const Signals s(k);
    q.insert(q.end(), s.q, s.q + kJoints);
    dq.insert(dq.end(), s.dq, s.dq + kJoints);
    tau.insert(tau.end(), s.tau, s.tau + kJoints);
    const tauext::Estimate& e = cpp.step(s.sample(k * made::kPeriodNs));
    expected.insert(expected.end(), e.tau_ext.begin(), e.tau_ext.begin() + kJoints);
    expected_alarms.push_back(static_cast<std::int32_t>(e.alarm));
  }
  CHECK(estimates_of_c_program(bytes().data(), bytes().size(), kSamples, q.data(), dq.data(), tau.data(), got.data(),
                               alarms.data()) == 0);
  CHECK(std::memcmp(got.data(), expected.data(), sizeof(double) * got.size()) == 0);
  CHECK(alarms == expected_alarms);
}

void a_restored_state_goes_on_as_if_nothing_had_happened() {
  tauext_monitor *whole = open(), *second = open(), *other_rate = open(TAUEXT_NETWORK_PERIOD);
  std::vector<char> state(tauext_monitor_state_bytes(whole));
  tauext_estimate a = fresh(), b = fresh();
  for (int k = 0; k < 3000; ++k) {
    const Signals s(k);
    tauext_monitor_step(whole, k * made::kPeriodNs, s.q, s.dq, s.tau, &a);
    if (k < 2000) continue;
    if (k == 2000) {
      CHECK(tauext_monitor_save_state(whole, state.data(), state.size()) == TAUEXT_OK);
      CHECK(tauext_monitor_restore_state(second, state.data(), state.size()) == TAUEXT_OK);
      continue;
    }
    tauext_monitor_step(second, k * made::kPeriodNs, s.q, s.dq, s.tau, &b);
    CHECK(std::memcmp(&a, &b, sizeof a) == 0);
  }
  CHECK(tauext_monitor_save_state(whole, state.data(), state.size() - 1) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_restore_state(second, state.data(), state.size() - 1) == TAUEXT_BAD_STATE);
  CHECK(tauext_monitor_restore_state(other_rate, state.data(), state.size()) == TAUEXT_BAD_STATE);
  for (std::size_t at = 0; at < state.size(); at += 1 + state.size() / 97) {
    if (at >= 20 && at < 24) continue;  // padding of the head
    state[at] = static_cast<char>(state[at] ^ 0x20);
    CHECK(tauext_monitor_restore_state(second, state.data(), state.size()) == TAUEXT_BAD_STATE);
    state[at] = static_cast<char>(state[at] ^ 0x20);
  }
  for (tauext_monitor* m : {whole, second, other_rate}) tauext_monitor_close(m);
}

void no_more_is_written_than_the_caller_has_room_for() {
  tauext_monitor* m = open();
  const Signals s(0);
  tauext_estimate e = fresh();
  e.size = offsetof(tauext_estimate, tau_ext) + sizeof(double);
  const tauext_estimate untouched = fresh();
  CHECK(tauext_monitor_step(m, 0, s.q, s.dq, s.tau, &e) == TAUEXT_OK);
  CHECK(e.size == offsetof(tauext_estimate, tau_ext) + sizeof(double));
  CHECK(e.joints == kJoints && e.health == TAUEXT_WARMING_UP && std::isnan(e.tau_ext[0]));
  CHECK(std::memcmp(&e.tau_ext[1], &untouched.tau_ext[1], sizeof e - e.size) == 0);
  e = fresh();
  e.size = sizeof e + 8;  // a caller of a later version
  CHECK(tauext_monitor_step(m, made::kPeriodNs, s.q, s.dq, s.tau, &e) == TAUEXT_OK);
  CHECK(e.size == sizeof e + 8 && e.t_ns == made::kPeriodNs);
  e.size = offsetof(tauext_estimate, residual) - 1;
  CHECK(tauext_monitor_step(m, 2 * made::kPeriodNs, s.q, s.dq, s.tau, &e) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_no_sample(m, 2 * made::kPeriodNs, &e) == TAUEXT_BAD_ARGUMENT);
  CHECK(e.t_ns == made::kPeriodNs);
  CHECK(tauext_monitor_step(m, 2 * made::kPeriodNs, s.q, s.dq, s.tau, nullptr) == TAUEXT_OK);
  CHECK(tauext_monitor_no_sample(m, 3 * made::kPeriodNs, nullptr) == TAUEXT_OK);
  tauext_monitor_close(m);
}

void null_pointers_are_bad_arguments() {
  tauext_monitor* m = open();
  const Signals s(0);
  CHECK(tauext_monitor_step(nullptr, 0, s.q, s.dq, s.tau, nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_step(m, 0, nullptr, s.dq, s.tau, nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_estimate(m, 0, s.q, nullptr, s.tau, nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_estimate(m, 0, s.q, s.dq, nullptr, nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_advance(nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_no_sample(nullptr, 0, nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_acknowledge(nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_resume(nullptr) == TAUEXT_BAD_ARGUMENT);
  std::array<double, TAUEXT_MAX_JOINTS> twice, none{};
  twice.fill(2);
  CHECK(tauext_monitor_set_limit_factors(nullptr, twice.data(), twice.data()) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_set_limit_factors(m, twice.data(), nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_set_limit_factors(m, none.data(), twice.data()) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_set_limit_factors(m, twice.data(), twice.data()) == TAUEXT_OK);
  tauext_load heavy = {1e4, {0, 0, 0}, {0, 0, 0, 0, 0, 0}, 0};
  char why[64];
  CHECK(tauext_monitor_set_load(nullptr, &heavy, 0) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_set_load(m, nullptr, 0) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_set_load(m, &heavy, TAUEXT_FROM_NOW) == TAUEXT_BAD_LOAD);
  CHECK(tauext_monitor_clear_load(nullptr, 0) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_load(nullptr, &heavy) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_load(m, nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_why_no_load(nullptr, &heavy, 0, why, sizeof why) == TAUEXT_BAD_ARGUMENT && why[0] == '\0');
  CHECK(tauext_monitor_why_no_load(m, &heavy, 0, why, sizeof why) == TAUEXT_OK && std::strstr(why, "10000 kg"));
  heavy.mass = 1;
  CHECK(tauext_monitor_why_no_load(m, &heavy, 0, why, sizeof why) == TAUEXT_OK && why[0] == '\0');
  CHECK(tauext_monitor_expect_load(nullptr, 1, 1) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_expect_load(m, 0, 1) == TAUEXT_BAD_LOAD);
  CHECK(tauext_monitor_why_not_expected(nullptr, 0, 1, why, sizeof why) == TAUEXT_BAD_ARGUMENT && why[0] == '\0');
  CHECK(tauext_monitor_why_not_expected(m, 0, 1, why, sizeof why) == TAUEXT_OK && std::strstr(why, "60 s"));
  CHECK(std::strstr(tauext_monitor_load_frame(m), "joint3") && !*tauext_monitor_load_frame(nullptr));
  CHECK(tauext_monitor_set_temperature(nullptr, twice.data()) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_set_temperature(m, nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_set_temperature(m, twice.data()) == TAUEXT_OK);  // a bundle that follows none takes no notice
  CHECK(tauext_monitor_reset(nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_save_state(nullptr, nullptr, 0) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_save_state(m, nullptr, tauext_monitor_state_bytes(m)) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_restore_state(m, nullptr, tauext_monitor_state_bytes(m)) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_joints(nullptr) == 0);
  CHECK(tauext_monitor_sample_period_ns(nullptr) == 0);
  CHECK(tauext_monitor_state_bytes(nullptr) == 0);
  CHECK(tauext_monitor_joint_name(nullptr, 0) == nullptr);
  CHECK(tauext_monitor_joint_name(m, -1) == nullptr);
  CHECK(tauext_monitor_joint_name(m, kJoints) == nullptr);
  tauext_monitor_close(m);
  tauext_monitor_close(nullptr);
}

// The monitor's address is made not null beforehand, so that a call which leaves it alone is found out.
tauext_status open_path(const char* path, tauext_network_rate rate, char* message, std::size_t size) {
  auto* monitor = reinterpret_cast<tauext_monitor*>(message);
  const tauext_status status = tauext_monitor_open(path, rate, &monitor, message, size);
  CHECK((status == TAUEXT_OK) == (monitor != nullptr));
  tauext_monitor_close(monitor);
  return status;
}

// A bundle that models the friction of its first joint, and the typical calls of a C loop.
void what_is_weighed_in_c_is_that_of_cpp() {
  const tauext::Bundle bundle = made::bundle(3, 0, 12, 10, 1);
  const std::vector<char> bytes = tauext::to_bytes(bundle);
  tauext_monitor* m = nullptr;
  CHECK(tauext_monitor_open_bytes(bytes.data(), bytes.size(), TAUEXT_EVERY_SAMPLE, &m, nullptr, 0) == TAUEXT_OK);
  tauext::Monitor cpp(bundle);
  tauext_load_found found{};
  CHECK(tauext_monitor_estimate_load(m, &found) == TAUEXT_BAD_ARGUMENT);  // no size
  found.size = sizeof found;
  CHECK(tauext_monitor_estimate_load(m, &found) == TAUEXT_OK && found.verdict == TAUEXT_TOO_LITTLE_MOTION);
  CHECK(tauext_monitor_start_weighing(m, 0) == TAUEXT_BAD_ARGUMENT && tauext_monitor_weighing(m) == 0);
  CHECK(tauext_monitor_start_weighing(m, 0.25) == TAUEXT_OK && tauext_monitor_weighing(m) == 1);
  CHECK(cpp.start_weighing(0.25));
  for (std::int64_t k = 0; k < 3000; ++k) {
    double q[3], dq[3], tau[3];
    made::signal(k, 3, q, dq, tau);
    CHECK(tauext_monitor_step(m, k * made::kPeriodNs, q, dq, tau, nullptr) == TAUEXT_OK);
    cpp.step({k * made::kPeriodNs, q, dq, tau});
  }
  CHECK(tauext_monitor_stop_weighing(m) == TAUEXT_OK && tauext_monitor_weighing(m) == 0);
  CHECK(tauext_monitor_estimate_load(m, &found) == TAUEXT_OK);
  const tauext::LoadFound same = cpp.estimate_load();
  CHECK(found.verdict == static_cast<int>(same.verdict) && found.verdict != TAUEXT_TOO_LITTLE_MOTION);
  CHECK(found.mass_kg == same.mass_kg && found.mass_error_kg == same.mass_error_kg && found.seconds == same.seconds);
  CHECK(found.misfit == same.misfit && found.misfit > 0 && found.load.mass == same.load.mass);
  CHECK(found.mass_seen == same.mass_seen && found.at_bound == same.at_bound && found.unseen_count == same.unseen_count);
  for (std::size_t i = 0; i < 3; ++i) {
    CHECK(found.com_m[i] == same.com_m[i] && found.com_error_m[i] == same.com_error_m[i]);
    CHECK(found.unseen[i] == same.unseen[0][i] && found.load.com[i] == same.load.com[i]);
  }
  for (std::size_t i = 0; i < 9; ++i) CHECK(found.com_covariance[i] == same.com_covariance[i]);
  tauext_load_found shorter{};  // of a caller with an older struct
  shorter.size = offsetof(tauext_load_found, mass_error_kg);
  CHECK(tauext_monitor_estimate_load(m, &shorter) == TAUEXT_OK);
  CHECK(shorter.mass_kg == same.mass_kg && shorter.mass_error_kg == 0 && shorter.seconds == 0);
  tauext_monitor_close(m);
  CHECK(tauext_monitor_start_weighing(nullptr, 0.3) == TAUEXT_BAD_ARGUMENT && tauext_monitor_weighing(nullptr) == 0);
  CHECK(tauext_monitor_stop_weighing(nullptr) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_estimate_load(nullptr, &found) == TAUEXT_BAD_ARGUMENT);
  tauext::Bundle nowhere = bundle;
  nowhere.load = {};
  const std::vector<char> other = tauext::to_bytes(nowhere);
  CHECK(tauext_monitor_open_bytes(other.data(), other.size(), TAUEXT_EVERY_SAMPLE, &m, nullptr, 0) == TAUEXT_OK);
  CHECK(tauext_monitor_start_weighing(m, 0.3) == TAUEXT_BAD_LOAD);
  tauext_monitor_close(m);
}

void a_wrench_in_c_is_that_of_cpp() {
  tauext::Bundle bundle = made::bundle(3, 0, 30, 10, 1);
  bundle.error_scale.features = {tauext::MotionFeature::constant};
  bundle.error_scale.limit_weights = bundle.error_scale.sigma_weights = bundle.error_scale.sigma_near_weights =
      bundle.error_scale.largest = bundle.error_scale.largest_sigma = std::vector<double>(3, 1.0);
  const std::vector<char> bytes = tauext::to_bytes(bundle);
  tauext_monitor* c = nullptr;
  CHECK(tauext_monitor_open_bytes(bytes.data(), bytes.size(), TAUEXT_EVERY_SAMPLE, &c, nullptr, 0) == TAUEXT_OK);
  tauext::Monitor cpp(bundle);
  tauext_wrench told{};
  told.size = sizeof told;
  CHECK(tauext_monitor_wrench(c, 2, TAUEXT_BASE_AXES, &told) == TAUEXT_OK && !told.known && std::isnan(told.force[0]));
  for (int k = 0; k < 1000; ++k) {
    double q[3], dq[3], tau[3];
    made::signal(k, 3, q, dq, tau);
    cpp.step({k * made::kPeriodNs, q, dq, tau});
    tauext_estimate e{};
    e.size = sizeof e;
    tauext_monitor_step(c, k * made::kPeriodNs, q, dq, tau, &e);
  }
  CHECK(tauext_monitor_find_frame(c, "joint3") == 2 && tauext_monitor_find_frame(c, "none") == -1);
  CHECK(!*tauext_monitor_why_no_wrench(c));
  const double point[] = {0.01, 0.02, 0.1};
  for (int alone = 0; alone < 2; ++alone) {
    const tauext::Wrench w = alone ? cpp.force(2, {0.01, 0.02, 0.1}, tauext::WrenchAxes::frame) : cpp.wrench(2);
    CHECK((alone ? tauext_monitor_force(c, 2, point, TAUEXT_FRAME_AXES, &told)
                 : tauext_monitor_wrench(c, 2, TAUEXT_BASE_AXES, &told)) == TAUEXT_OK);
    CHECK(w.known && told.known && told.unknowns == w.unknowns && told.blind_count == w.blind && told.freedom == w.freedom);
    CHECK(std::memcmp(told.force, w.force.data(), sizeof told.force) == 0);
    CHECK(std::memcmp(told.moment, w.moment.data(), sizeof told.moment) == 0);
    CHECK(std::memcmp(told.covariance, w.covariance.data(), sizeof told.covariance) == 0);
    CHECK(std::memcmp(told.blind, w.blind_directions.data(), sizeof told.blind) == 0);
    CHECK(told.consistent == w.consistent && told.chi_square == w.chi_square);
  }
  CHECK(tauext_monitor_wrench(c, 99, TAUEXT_BASE_AXES, &told) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_wrench(c, -1, TAUEXT_BASE_AXES, &told) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_wrench(c, 2, static_cast<tauext_axes>(2), &told) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_force(c, 2, nullptr, TAUEXT_BASE_AXES, &told) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_wrench(nullptr, 2, TAUEXT_BASE_AXES, &told) == TAUEXT_BAD_ARGUMENT);
  tauext_monitor_close(c);
}

void a_refit_in_c_is_that_of_cpp() {
  const TemporaryFolder folder;
  const std::string old_path = folder.file("old.tauext"), new_path = folder.file("new.tauext");
  tauext::Bundle friction = made::bundle(kJoints, 0, 8, 10, 1);
  friction.prior.terms = {{tauext::TermKind::viscous, 0}};
  friction.prior.weights = {-2, 0, 0};
  tauext::answer_reference(friction);
  tauext::save_bundle(friction, old_path);
  char message[256];
  tauext_monitor* m = nullptr;
  CHECK(tauext_monitor_open(old_path.c_str(), TAUEXT_EVERY_SAMPLE, &m, message, sizeof message) == TAUEXT_OK);
  CHECK(tauext_monitor_start_refit(m, 0.4) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_reserve_refit(m, 0) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_reserve_refit(m, 12) == TAUEXT_OK);
  CHECK(tauext_monitor_start_refit(m, 3) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_start_refit(m, 0.4) == TAUEXT_OK && tauext_monitor_refit_full(m) == 0);
  tauext::Monitor same(friction);
  same.reserve_refit(12);
  CHECK(same.start_refit(0.4));
  for (std::int64_t k = 0; k < 12'000; ++k) {
    const Signals s(k);
    CHECK(tauext_monitor_step(m, k * made::kPeriodNs, s.q, s.dq, s.tau, nullptr) == TAUEXT_OK);
    same.step(s.sample(k * made::kPeriodNs));
  }
  CHECK(tauext_monitor_refit_full(m) == 1);
  CHECK(tauext_monitor_finish_refit(m) == TAUEXT_OK && tauext_monitor_refit_full(m) == 0);
  const tauext_status status = tauext_refit(old_path.c_str(), m, new_path.c_str(), message, sizeof message);
  const tauext::RefitSource source{same.finish_refit(), {}};
  try {
    const tauext::Refit found = tauext::refit(friction, {&source, 1});
    CHECK(status == TAUEXT_OK && message[0] == '\0');
    CHECK(tauext::to_bytes(tauext::load_bundle(new_path)) == tauext::to_bytes(found.bundle));
  } catch (const tauext::Error& e) {  // implausible signals: both must refuse
    CHECK(status == TAUEXT_BAD_BUNDLE && std::string(message) == std::string(e.what()).substr(0, sizeof message - 1));
    CHECK(!std::filesystem::exists(new_path));
  }
  CHECK(tauext_refit(nullptr, m, new_path.c_str(), message, sizeof message) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_refit(old_path.c_str(), nullptr, new_path.c_str(), nullptr, 0) == TAUEXT_BAD_ARGUMENT);
  CHECK(tauext_monitor_reserve_refit(nullptr, 1) == TAUEXT_BAD_ARGUMENT && tauext_monitor_refit_full(nullptr) == 0);
  CHECK(tauext_monitor_clock_jumps(nullptr) == 0 && tauext_monitor_clock_jumps(m) == 0);
  for (std::int64_t k = 1; k < 3; ++k) {  // the clock was set back: the first sample is a fault
    const Signals s(k);
    CHECK(tauext_monitor_step(m, k * made::kPeriodNs, s.q, s.dq, s.tau, nullptr) == TAUEXT_OK);
  }
  CHECK(tauext_monitor_clock_jumps(m) == 1);
  CHECK(tauext_monitor_start_refit(nullptr, 0.4) == TAUEXT_BAD_ARGUMENT && tauext_monitor_finish_refit(nullptr) == TAUEXT_BAD_ARGUMENT);
  tauext_monitor_close(m);
  tauext_monitor* empty = open();  // nothing kept
  CHECK(tauext_refit(old_path.c_str(), empty, new_path.c_str(), message, sizeof message) == TAUEXT_BAD_BUNDLE);
  CHECK(std::strlen(message) > 0);
  tauext_monitor_close(empty);
}

void failed_opening_reports_the_cause() {
  char message[256];
  const auto says = [&](const char* part) {
    if (!std::strstr(message, part)) std::printf("message was: %s\n", message);
    return std::strstr(message, part) != nullptr;
  };
  const TemporaryFolder folder;
  const std::string none = folder.file("tauext_there_is_no_such.tauext");
  CHECK(open_path(none.c_str(), TAUEXT_EVERY_SAMPLE, message, sizeof message) == TAUEXT_BAD_BUNDLE);
  CHECK(says("tauext_there_is_no_such.tauext: cannot be opened"));
  CHECK(open_path(nullptr, TAUEXT_EVERY_SAMPLE, message, sizeof message) == TAUEXT_BAD_ARGUMENT);
  CHECK(says("null pointer"));
  CHECK(open_path(none.c_str(), static_cast<tauext_network_rate>(2), message, sizeof message) ==
        TAUEXT_BAD_ARGUMENT);
  CHECK(says("network rate"));
  CHECK(tauext_monitor_open_bytes(bytes().data(), bytes().size(), TAUEXT_EVERY_SAMPLE, nullptr, message,
                                  sizeof message) == TAUEXT_BAD_ARGUMENT);

  std::vector<char> damaged = bytes();
  damaged[damaged.size() / 2] = static_cast<char>(damaged[damaged.size() / 2] ^ 1);
  tauext_monitor* monitor = nullptr;
  const auto open_damaged = [&](char* text, std::size_t size) {
    return tauext_monitor_open_bytes(damaged.data(), damaged.size(), TAUEXT_EVERY_SAMPLE, &monitor, text, size);
  };
  CHECK(open_damaged(message, sizeof message) == TAUEXT_BAD_BUNDLE && !monitor);
  CHECK(says("checksum"));
  const std::string whole = message;
  std::memset(message, 'x', sizeof message);
  CHECK(open_damaged(message, 9) == TAUEXT_BAD_BUNDLE);
  CHECK(message == whole.substr(0, 8) && message[9] == 'x');
  CHECK(open_damaged(message, 1) == TAUEXT_BAD_BUNDLE && message[0] == '\0');
  std::memset(message, 'x', sizeof message);
  CHECK(open_damaged(message, 0) == TAUEXT_BAD_BUNDLE && message[0] == 'x');
  CHECK(open_damaged(nullptr, sizeof message) == TAUEXT_BAD_BUNDLE);
}

void every_code_has_a_name() {
  CHECK(std::strcmp(tauext_version(), TAUEXT_VERSION) == 0);
  CHECK(std::strcmp(tauext_status_name(TAUEXT_BAD_STATE), "bad state") == 0);
  CHECK(*tauext_status_name(TAUEXT_OK) && !*tauext_status_name(static_cast<tauext_status>(7)));
  CHECK(std::strcmp(tauext_status_name(TAUEXT_BAD_LOAD), "bad payload") == 0 && std::strcmp(tauext_status_name(TAUEXT_BAD_CONTACT), "bad contact") == 0);
  CHECK(std::strcmp(tauext_health_name(TAUEXT_HEALTHY), "ok") == 0);
  CHECK(!*tauext_health_name(-1) && !*tauext_health_name(256));
  CHECK(std::strcmp(tauext_alarm_name(TAUEXT_COLLISION), "collision") == 0);
  CHECK(!*tauext_alarm_name(-1) && !*tauext_alarm_name(256));
  for (std::uint32_t bit = 0; bit < tauext::kCauseCount; ++bit) CHECK(*tauext_cause_name(1u << bit));
  CHECK(!*tauext_cause_name(0) && !*tauext_cause_name(3) && !*tauext_cause_name(1u << tauext::kCauseCount));
}

}  // namespace

int main() {
  estimates_are_those_of_the_cpp_monitor_through_faults_and_alarms();
  a_c_program_gets_the_same();
  a_restored_state_goes_on_as_if_nothing_had_happened();
  no_more_is_written_than_the_caller_has_room_for();
  null_pointers_are_bad_arguments();
  what_is_weighed_in_c_is_that_of_cpp();
  a_wrench_in_c_is_that_of_cpp();
  a_refit_in_c_is_that_of_cpp();
  failed_opening_reports_the_cause();
  every_code_has_a_name();
  return check::result();
}
