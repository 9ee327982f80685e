#include "tauext/monitor.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <random>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "made_signals.hpp"

using namespace tauext;
using made::irregular, made::kMs, made::sampled, made::Signals;

namespace {

constexpr int kSteps = 30, kStride = 10;  // a window of 0.3 s; the observer needs 0.5 s

Signals regular(int joints, int samples, std::int64_t first_ms = 0) {
  std::vector<std::int64_t> t_ns;
  for (int k = 0; k < samples; ++k) t_ns.push_back((first_ms + k) * kMs);
  return sampled(joints, t_ns);
}

Bundle tracking(Bundle bundle) {
  bundle.drift = {5, std::vector<double>(bundle.links.size(), 3.0), 0.05, 0.8, 0.02};
  return bundle;
}

// Most of the motion is unfamiliar to it.
Bundle covered(Bundle bundle) {
  bundle.coverage = made::half_seen(bundle.joints());
  return bundle;
}

using made::same;

bool same(const Estimate& a, const Estimate& b) {
  bool equal = a.t_ns == b.t_ns && a.health == b.health && a.causes == b.causes && a.cause_joint == b.cause_joint &&
               a.alarm == b.alarm && a.alarm_joint == b.alarm_joint && a.alarm_t_ns == b.alarm_t_ns &&
               a.detection == b.detection && a.near_stiction == b.near_stiction &&
               a.drift_saturated == b.drift_saturated && same(a.unfamiliar, b.unfamiliar) && a.unseen == b.unseen &&
               a.unseen_joint == b.unseen_joint && a.unseen_other == b.unseen_other;
  for (int j = 0; j < a.joints; ++j)
    equal = equal && same(a.residual[j], b.residual[j]) && same(a.uncertainty[j], b.uncertainty[j]) &&
            same(a.tau_ext[j], b.tau_ext[j]) && same(a.drift[j], b.drift[j]) && same(a.limit_nm[j], b.limit_nm[j]) &&
            same(a.margin_nm[j], b.margin_nm[j]);
  return equal;
}

void online_equals_offline(const Bundle& bundle) {
  const int joints = bundle.joints();
  const Signals s = irregular(joints, 3500);
  const Estimates offline = estimate(bundle, s.view(), 2);
  Monitor monitor(bundle);
  double largest_drift = 0;
  const auto also = [&](const Estimate& e, std::size_t j, std::size_t at) {
    CHECK(same(e.uncertainty[j], offline.network[at] + offline.drift[at]));
    CHECK(e.drift[j] == offline.drift[at]);
    largest_drift = std::max(largest_drift, std::fabs(e.drift[j]));
    CHECK(same(e.margin_nm[j], e.limit_nm[j] - std::fabs(e.tau_ext[j])));
  };
  const auto [healthy, detections] = made::online_equals_offline(monitor, s, offline, also);
  CHECK(healthy > 1000 && healthy < 3400 && detections > 0);
  CHECK(bundle.drift.on() ? largest_drift > 0.01 : largest_drift == 0);
  CHECK(monitor.samples() == 3500 && monitor.bridged_ticks() > 0 && monitor.restarts() > 0);
}

void online_equals_offline_to_the_last_bit() {
  for (const int joints : {1, 2, 7})
    for (const int hidden : {0, 20}) {
      if (check::emulated && hidden > 0 && joints != 2) continue;
      const Bundle bundle = made::bundle(joints, hidden, kSteps, kStride, 3);
      online_equals_offline(bundle);
      // Without a network r is over the limits most of the time, and teaches the tracker nothing.
      if (hidden > 0) online_equals_offline(tracking(bundle));
    }
}

// The same limits for contacts and collisions, whatever the speed.
void limit(Bundle& bundle, const std::vector<double>& limit_nm) {
  for (Level* level : {&bundle.limits.collision, &bundle.limits.contact})
    level->sliding_nm = level->near_stiction_nm = limit_nm;
}

// The made bundle of two joints with another residual and both filters; its limits are low enough to be crossed.
Bundle compared(ResidualMethod method, int hidden) {
  Bundle bundle = made::bundle(2, hidden, kSteps, kStride, 3);
  bundle.observer.method = method;
  bundle.observer.high_pass_per_s = 2;
  bundle.observer.low_pass_per_s = 40;
  limit(bundle, {0.5, 0.5});
  answer_reference(bundle);
  return bundle;
}
constexpr ResidualMethod kMethods[] = {ResidualMethod::momentum, ResidualMethod::direct, ResidualMethod::velocity,
                                       ResidualMethod::energy};

void online_equals_offline_for_every_method() {
  for (const ResidualMethod method : kMethods)
    for (const int hidden : {0, 20})
      if (!check::emulated || hidden == 0 || method == ResidualMethod::velocity)
        online_equals_offline(compared(method, hidden));
}

void the_network_at_its_own_rate_holds_its_last_value() {
  const Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  const Signals s = regular(2, 2000);
  Monitor every(bundle), own(bundle, NetworkRate::network_period);
  double held[2] = {NAN, NAN};
  for (std::int64_t k = 0; k < s.samples(); ++k) {
    const Estimate& a = every.step(s.at(k));
    const Estimate& b = own.step(s.at(k));
    CHECK(a.health == b.health);
    for (int j = 0; j < 2; ++j) {
      if (k % kStride == 0) held[j] = a.uncertainty[j];
      if (b.health == Health::ok && !std::isnan(held[j])) CHECK(b.uncertainty[j] == held[j]);
      CHECK(a.residual[j] == b.residual[j]);
    }
  }
}

// Feeds samples [from, to) and returns the last estimate.
Estimate feed(Monitor& monitor, const Signals& s, std::int64_t from, std::int64_t to) {
  Estimate last;
  for (std::int64_t k = from; k < to; ++k) last = monitor.step(s.at(k));
  return last;
}

constexpr int kWarm = 700;  // samples after which observer and window are full

// After any restart the monitor reports a fault, recovers, and then equals a new monitor.
template <class Break>
void comes_back(std::uint32_t cause, Break&& broken, std::int64_t resumes_at_ms, const Bundle* of = nullptr) {
  const Bundle bundle = of ? *of : made::bundle(2, 20, kSteps, kStride, 3);
  Monitor monitor(bundle);
  CHECK(feed(monitor, regular(2, kWarm), 0, kWarm).health == Health::ok);
  const Estimate fault = broken(monitor);
  CHECK(fault.health == Health::fault && fault.causes == cause && !fault.clear() && !fault.detection);
  CHECK(std::isnan(fault.tau_ext[0]) && std::isnan(fault.margin_nm[1]));
  const Signals after = regular(2, 1500, resumes_at_ms);
  Monitor fresh(bundle);
  for (std::int64_t k = 0; k < after.samples(); ++k) {
    const Estimate a = monitor.step(after.at(k)), b = fresh.step(after.at(k));
    CHECK(a.health == b.health);
    CHECK(a.health == (k < 500 ? Health::warming_up : Health::ok));
    CHECK(a.causes == (a.health == Health::ok ? 0 : cause));  // why it is warming up
    for (int j = 0; j < 2; ++j) CHECK(a.residual[j] == b.residual[j] && same(a.tau_ext[j], b.tau_ext[j]));
  }
}

void broken_signals_are_faults_and_the_monitor_comes_back() {
  for (const double bad : {static_cast<double>(NAN), static_cast<double>(INFINITY), -static_cast<double>(INFINITY)})
    for (int which = 0; which < 3; ++which)
      comes_back(
          kNotFinite,
          [&](Monitor& m) {
            Signals s = regular(2, 1, kWarm);
            (which == 0 ? s.q : which == 1 ? s.dq : s.tau)[1] = bad;
            const Estimate e = m.step(s.at(0));
            CHECK(e.cause_joint == 1);
            return e;
          },
          kWarm + 1);
  comes_back(kNotFinite, [](Monitor& m) {
    Signals s = regular(2, 1, kWarm);
    s.tau[0] = 1e308;  // finite, but the observer overflows
    m.step(s.at(0));
    s = regular(2, 1, kWarm + 1);
    s.tau[0] = -1e308;
    s.dq[0] = 1e200;
    return m.step(s.at(0));
  }, kWarm + 2);
  comes_back(kWrongSize, [](Monitor& m) {
    const double one[1] = {0};
    return m.step({kWarm * kMs, one, one, one});
  }, kWarm + 1);
  comes_back(kTimeBackwards, [](Monitor& m) { return m.step(regular(2, 1, kWarm - 100).at(0)); }, kWarm - 99);
  comes_back(kGap, [](Monitor& m) { return m.no_sample((kWarm + 50) * kMs); }, kWarm + 60);
}

// A bundle with ranges of possible signals.
Bundle bounded() {
  Bundle b = made::bundle(2, 20, kSteps, kStride, 3);
  b.signals.torque_limit_nm = {150, 60};
  b.signals.possible_torque_nm = {300, 120};
  b.signals.possible_speed_rad_s = {10, 10};
  return b;
}

void what_no_arm_sends_is_a_fault_of_its_own_and_costs_no_more_than_a_nan() {
  const Bundle bundle = bounded();
  struct Case {
    std::uint32_t cause;
    std::vector<double> Signals::*signal;
    double value;
  };
  const Case cases[] = {{kImpossibleTorque, &Signals::tau, 120.5},   {kImpossibleTorque, &Signals::tau, -1e300},
                        {kImpossibleVelocity, &Signals::dq, -10.01}, {kImpossibleVelocity, &Signals::dq, 1e300},
                        {kImpossiblePosition, &Signals::q, 3.0},     {kImpossiblePosition, &Signals::q, -1e300},
                        {kNotFinite, &Signals::tau, NAN},            {kNotFinite, &Signals::q, -INFINITY}};
  for (const Case& one : cases)
    comes_back(
        one.cause,
        [&](Monitor& m) {
          Signals s = regular(2, 1, kWarm);
          (s.*one.signal)[1] = one.value;
          const Estimate e = m.step(s.at(0));
          CHECK(e.cause_joint == 1 && e.causes == one.cause);
          return e;
        },
        kWarm + 1, &bundle);
}

// A drive at its limit, whatever sign, and what touches the arm however hard is judged.
void what_a_collision_can_cause_is_judged() {
  const Bundle bundle = bounded();
  Monitor monitor(bundle);
  Signals s = regular(2, 3000);
  for (std::size_t k = 1000; k < 1100; ++k) s.tau[2 * k] = k % 2 ? 150 : -155, s.tau[2 * k + 1] = 119;
  for (std::size_t k = 1050; k < 1100; ++k) s.dq[2 * k] = 9.9;
  for (std::int64_t k = 0; k < 3000; ++k) {
    const Estimate& e = monitor.step(s.at(k));
    CHECK((e.causes & (kImpossibleTorque | kImpossibleVelocity | kImpossiblePosition | kNotFinite)) == 0);
    if (k >= 1000 && k < 1100) CHECK(e.causes == kTorqueSaturated && !std::isnan(e.tau_ext[1]));
    if (k == 1099) CHECK(e.alarm == Alarm::collision);
  }
}

void a_position_that_jumps_is_a_fault_once_wherever_it_stays() {
  const Bundle bundle = bounded();
  // A zero that was moved, then a spike of five samples: a fault where it jumps, nowhere else.
  Signals s = regular(2, 4000);
  for (std::size_t k = 1500; k < 4000; ++k) s.q[2 * k + 1] += 0.5;
  for (std::size_t k = 2500; k < 2505; ++k) s.q[2 * k] -= 1.0;
  Monitor monitor(bundle);
  int faults = 0;
  for (std::int64_t k = 0; k < 4000; ++k) {
    const Estimate& e = monitor.step(s.at(k));
    const bool jumps = k == 1500 || k == 2500 || k == 2505;
    CHECK((e.health == Health::fault) == jumps);
    if (jumps) ++faults, CHECK(e.causes == kImpossiblePosition && e.cause_joint == (k == 1500 ? 1 : 0));
  }
  CHECK(faults == 3 && monitor.last().health == Health::ok);
  // A position that goes to and fro with every sample is never ok.
  s = regular(2, 2000);
  for (std::size_t k = 1000; k < 2000; k += 2) s.q[2 * k] += 1.0;
  Monitor torn(bundle);
  for (std::int64_t k = 0; k < 2000; ++k) CHECK(torn.step(s.at(k)).health != Health::ok || k < 1000);
  // Where samples are missing the joint has gone on; over a gap it may be anywhere.
  s = regular(2, 3000);
  Monitor gaps(bundle);
  for (std::int64_t k = 0; k < 3000; ++k) {
    if (k % 500 < 9) continue;
    if (k == 1600) k += 600;
    CHECK((gaps.step(s.at(k)).causes & kImpossiblePosition) == 0);
  }
}

// A bus that brings every eighth position only, at nearly the speed that is possible, with stamps that jitter.
void positions_that_are_held_and_stamps_that_jitter_are_no_jumps() {
  const Bundle bundle = bounded();
  Monitor monitor(bundle);
  double q[2] = {0, 0}, dq[2] = {9, 0};
  const double tau[2] = {0, 0};
  for (std::int64_t k = 0; k < 2000; ++k) {
    if (k % 8 == 0) q[0] = 9e-3 * static_cast<double>(k);
    const std::int64_t jitter = k % 3 == 0 ? 900'000 : 0;
    CHECK((monitor.step({k * kMs + jitter, q, dq, tau}).causes & kImpossiblePosition) == 0);
  }
  // The same as one step of a position that came with every sample is none.
  q[1] += 0.072;
  CHECK(monitor.step({2000 * kMs, q, dq, tau}).causes == 0);  // joint 2 stood still for long: 10 ms count
  q[1] += 0.072;
  const Estimate& e = monitor.step({2001 * kMs, q, dq, tau});
  CHECK(e.causes == kImpossiblePosition && e.cause_joint == 1);
}

void a_gap_restarts_the_warm_up_and_reports_the_cause() {
  const Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  Monitor monitor(bundle);
  feed(monitor, regular(2, kWarm), 0, kWarm);
  const Estimate e = monitor.step(regular(2, 1, kWarm + 100).at(0));
  CHECK(e.health == Health::warming_up && e.causes == kGap);
  CHECK(feed(monitor, regular(2, kWarm, kWarm + 101), 0, kWarm).health == Health::ok);
  CHECK(monitor.restarts() == 1);
}

void late_and_missing_samples_are_stale_and_change_nothing() {
  const Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  const Signals s = regular(2, 1000);
  Monitor monitor(bundle), undisturbed(bundle);
  const Estimate before = feed(monitor, s, 0, 800);
  feed(undisturbed, s, 0, 800);
  for (const std::int64_t late : {799, 798, 790}) {
    const Estimate e = monitor.step(s.at(late));
    CHECK(e.health == Health::stale && e.causes == kLateSample && !e.clear() && e.tau_ext[0] == before.tau_ext[0]);
  }
  Estimate e = monitor.no_sample(805 * kMs);
  CHECK(e.health == Health::stale && e.causes == kMissingSample && e.tau_ext[1] == before.tau_ext[1]);
  e = monitor.step(s.at(805));
  CHECK(e.health == Health::ok && same(e, undisturbed.step(s.at(805))));
  for (const std::int64_t silent : {810, 820, 900}) e = monitor.no_sample(silent * kMs);
  CHECK(e.health == Health::fault && e.causes == kGap && std::isnan(e.tau_ext[0]));
  for (std::int64_t k = 806; k < 1000; ++k) {  // only late: nothing is lost
    e = monitor.step(s.at(k));
    CHECK(e.health == Health::ok && same(e, undisturbed.step(s.at(k))));
  }
  Monitor unstarted(bundle);
  CHECK(unstarted.no_sample(0).health == Health::warming_up);
  CHECK(unstarted.step(s.at(0)).causes == 0);
}

void another_rate_is_refused_and_the_right_one_taken_up_again() {
  const Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  for (const double period_ms : {2.0, 0.5, 1.1, 0.9}) {
    Monitor monitor(bundle);
    feed(monitor, regular(2, kWarm), 0, kWarm);
    std::vector<std::int64_t> t_ns;
    for (int k = 1; k <= 3000; ++k) t_ns.push_back(kWarm * kMs + static_cast<std::int64_t>(k * period_ms * 1e6));
    const Signals wrong = sampled(2, t_ns);
    const Estimate e = feed(monitor, wrong, 0, 3000);
    CHECK(e.health == Health::fault && (e.causes & kWrongRate) != 0);
    const Signals right = regular(2, 5000, t_ns.back() / kMs + 1);
    CHECK(feed(monitor, right, 0, 5000).health == Health::ok);
  }
  // Samples that cannot be used came in time: a cable that fails every second sample is no other rate.
  Monitor failing(bundle);
  Signals halves = regular(2, 4000);
  for (std::size_t k = 1000; k < 2000; k += 2) halves.q[2 * k] = NAN;
  for (std::int64_t k = 0; k < 4000; ++k) {
    const Estimate& e = failing.step(halves.at(k));
    CHECK((e.causes & kWrongRate) == 0);
    if (k >= 2500) CHECK(e.health == Health::ok);  // half a second after the last bad one
  }
  // Every third step a fifth longer or every tenth half as long again, at the mean rate, or one sample in ten lost.
  const auto steps_of = [](double usual, double other, int every) {
    std::vector<std::int64_t> at{0};
    for (int k = 1; k < 6000; ++k) at.push_back(at.back() + static_cast<std::int64_t>((k % every ? usual : other) * kMs));
    return at;
  };
  for (const auto& at : {steps_of(0.9375, 1.125, 3), steps_of(1 / 1.05, 1.5 / 1.05, 10), steps_of(1, 2, 10)}) {
    Monitor uneven(bundle);
    const Signals s = sampled(2, at);
    for (std::int64_t k = 0; k < s.samples(); ++k) {
      const Estimate& e = uneven.step(s.at(k));
      CHECK(k < 1000 || e.health == Health::ok);
    }
  }
  // A gap now and then, or jitter of a third of a period, is no other rate.
  Monitor monitor(bundle);
  std::mt19937 random(1);
  std::vector<std::int64_t> t_ns;
  for (int k = 0; k < 6000; ++k)
    if (k % 1000 >= 10) t_ns.push_back(k * kMs + static_cast<std::int64_t>(random() % 600'000));
  const Signals s = sampled(2, t_ns);
  for (std::int64_t k = 0; k < s.samples(); ++k) CHECK((monitor.step(s.at(k)).causes & kWrongRate) == 0);
}

void a_saturated_drive_is_a_fault_that_hides_no_collision() {
  Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  bundle.signals.torque_limit_nm = {150, 60};
  Monitor monitor(bundle);
  Signals s = regular(2, 3000);
  for (std::int64_t k = 1000; k < 1100; ++k) s.tau[static_cast<std::size_t>(2 * k + 1)] = -60;
  for (std::int64_t k = 0; k < 3000; ++k) {
    const Estimate& e = monitor.step(s.at(k));
    if (k >= 1000 && k < 1100) CHECK(e.health == Health::fault && e.causes == kTorqueSaturated && e.cause_joint == 1);
    if (k >= 1100 && k < 1590) CHECK(e.health == Health::warming_up && e.causes == kTorqueSaturated);
    if (k >= 1601) CHECK(e.health == Health::ok && e.causes == 0);
    if (k == 1099) CHECK(e.alarm == Alarm::collision && e.alarm_joint == 1 && !std::isnan(e.tau_ext[1]));
    if (k > 1100) CHECK(e.alarm == Alarm::collision && !e.clear());  // latched through fault, warm-up and health
  }
  monitor.acknowledge();
  CHECK(monitor.last().alarm == Alarm::none && monitor.last().clear());
}

void a_frozen_encoder_is_a_fault_and_a_resting_arm_is_not() {
  const Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  // Joint 2's position freezes while its velocity goes on.
  Signals s = regular(2, 6000);
  for (std::size_t k = 2000; k < 3000; ++k) s.q[2 * k + 1] = s.q[2 * 2000 + 1];
  Monitor moving(bundle);
  bool seen = false;
  for (std::int64_t k = 0; k < 6000; ++k) {
    const Estimate& e = moving.step(s.at(k));
    if ((e.causes & kEncoderStill) != 0 && k < 3000) seen = true, CHECK(e.cause_joint == 1 && k > 2099);
    if (k == 2999) CHECK(e.health == Health::fault && e.causes == kEncoderStill);
  }
  CHECK(seen && moving.last().health == Health::ok);
  // Both freeze while the torque swings by more than it ever did in training (100 Nm).
  s = regular(2, 3000);
  for (std::size_t k = 2000; k < 3000; ++k) {
    s.q[2 * k] = s.q[2 * 2000];
    s.dq[2 * k] = 0;
    s.tau[2 * k] = 60 * std::sin(0.02 * static_cast<double>(k));
  }
  Monitor driven(bundle);
  CHECK((feed(driven, s, 0, 3000).causes & kEncoderStill) != 0);
  // A servo counts behind its gear: a blocked joint does not move, and its torque must be reported.
  Bundle servo = bundle;
  servo.servo = {TorqueFrom::duty, 8, servo.observer.sample_period_ns, 0, {{}, {}}};
  Monitor blocked(servo);
  const Estimate& told = feed(blocked, s, 0, 3000);
  CHECK(told.causes == 0 && told.health == Health::ok);
  // Everything rests; the torque wanders as stiction lets it.
  for (std::size_t k = 0; k < 3000; ++k)
    for (std::size_t j = 0; j < 2; ++j) {
      s.q[2 * k + j] = 0.3;
      s.dq[2 * k + j] = 0;
      s.tau[2 * k + j] = 5 * std::sin(0.01 * static_cast<double>(k));
    }
  Monitor resting(bundle);
  for (std::int64_t k = 0; k < 3000; ++k) CHECK(resting.step(s.at(k)).causes == 0);
}

void reset_equals_fresh_and_acknowledge_ends_the_alarm_alone() {
  const Bundle bundle = covered(tracking(made::bundle(2, 20, kSteps, kStride, 3)));
  const Signals s = regular(2, 2000);
  Monitor used(bundle), fresh(bundle);
  feed(used, s, 0, 1234);
  used.reset();
  CHECK(used.samples() == 0);
  for (std::int64_t k = 0; k < 2000; ++k) CHECK(same(used.step(s.at(k)), fresh.step(s.at(k))));
}

// `other` takes over the state of `one` after so many samples, and gives the same estimates from there on.
void takes_over(Monitor& one, Monitor& other, const Signals& s, std::int64_t stop) {
  one.reset();
  feed(one, s, 0, stop);
  std::vector<std::byte> state(one.state_bytes());
  CHECK(one.save_state(state));
  feed(other, s, 5, 99);
  CHECK(other.restore_state(state));
  for (std::int64_t k = stop; k < stop + 1000; ++k) CHECK(same(one.step(s.at(k)), other.step(s.at(k))));
}

void a_restored_monitor_goes_on_as_if_nothing_had_been() {
  for (const NetworkRate rate : {NetworkRate::every_sample, NetworkRate::network_period}) {
    const Bundle bundle = covered(tracking(made::bundle(2, 20, kSteps, kStride, 3)));
    const Signals s = regular(2, 3000);
    Monitor one(bundle, rate), other(bundle, rate);
    for (std::int64_t stop : {0, 1, 333, 1777}) takes_over(one, other, s, stop);
    std::vector<std::byte> state(one.state_bytes());
    CHECK(one.save_state(state));
    const Estimate before = other.last();
    for (std::size_t at : {std::size_t{0}, std::size_t{5}, std::size_t{9}, state.size() / 2, state.size() - 1}) {
      std::vector<std::byte> damaged = state;
      damaged[at] ^= std::byte{1};
      CHECK(!other.restore_state(damaged));
    }
    CHECK(!other.restore_state(std::span(state).first(state.size() - 1)));
    CHECK(!one.save_state(std::span(state).first(10)));
    Monitor foreign(made::bundle(2, 20, kSteps, kStride, 4), rate);  // other weights
    CHECK(!foreign.restore_state(state));
    CHECK(same(before, other.last()));
  }
}

void a_restored_monitor_goes_on_with_every_method() {
  const Signals s = regular(2, 2000);
  for (const ResidualMethod method : kMethods) {
    Monitor one(compared(method, 0)), other(compared(method, 0));
    for (std::int64_t stop : {1, 333, 777}) {
      takes_over(one, other, s, stop);
      CHECK(one.last().health == Health::ok);
    }
    std::vector<std::byte> state(one.state_bytes());
    CHECK(one.save_state(state));
    Monitor foreign(made::bundle(2, 0, kSteps, kStride, 3));  // of the plain momentum observer
    CHECK(!foreign.restore_state(state));
  }
}

// What was learned is not lost with samples, nor unlearned by a fault; a saturated drive teaches nothing.
void drift_outlives_gaps_and_faults() {
  Bundle bundle = tracking(made::bundle(2, 0, kSteps, kStride, 3));
  bundle.signals.torque_limit_nm = {150, 60};
  Monitor monitor(bundle);
  feed(monitor, regular(2, 3000), 0, 3000);
  const Estimate before = feed(monitor, regular(2, 1, 3100), 0, 1);  // a gap: the filters restarted
  CHECK(before.health == Health::warming_up && before.drift[0] == 0 && std::isnan(before.tau_ext[0]));
  monitor.no_sample(9'000 * kMs);
  CHECK(std::isnan(monitor.last().drift[0]));
  Monitor fresh(bundle);
  const Signals after = regular(2, 500, 9'100);
  const Estimate learned = feed(monitor, after, 0, 500), none = feed(fresh, after, 0, 500);
  CHECK(none.drift[0] == 0 && std::fabs(learned.drift[0]) > 0.01);
  // A saturated drive gives another torque than commanded: tau_ext is judged, but not learned from.
  Signals s = regular(2, 2000);
  for (std::size_t k = 0; k < 2000; ++k) s.tau[2 * k + 1] = -60;
  fresh.reset();
  for (std::int64_t k = 0; k < 2000; ++k) {
    const Estimate& e = fresh.step(s.at(k));
    CHECK(e.causes == kTorqueSaturated && e.drift[0] == 0 && (k < 1000 || !std::isnan(e.tau_ext[0])));
  }
}

void a_left_out_advance_is_made_up_for() {
  const Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  const Signals s = regular(2, 1500);
  Monitor stepping(bundle), estimating(bundle);
  for (std::int64_t k = 0; k < 1500; ++k) CHECK(same(stepping.step(s.at(k)), estimating.estimate(s.at(k))));
}

// Limits change at the next sample, apart from doubt; all other results stay equal to the bit.
void limit_factors_scale_the_limits_and_nothing_else() {
  const Bundle bundle = tracking(made::bundle(2, 20, kSteps, kStride, 3));
  const Signals s = regular(2, 2000);
  Monitor plain(bundle), ones(bundle), scaled(bundle);
  const std::vector<double> one{1, 1}, collision{2, 0.5}, contact{10, 3};
  CHECK(ones.set_limit_factors(one, one) && scaled.set_limit_factors(collision, contact));
  for (std::int64_t k = 0; k < 2000; ++k) {
    const Estimate e = plain.step(s.at(k)), f = scaled.step(s.at(k));
    CHECK(same(e, ones.step(s.at(k))));
    for (int j = 0; j < 2; ++j) {
      CHECK(same(e.residual[j], f.residual[j]) && same(e.tau_ext[j], f.tau_ext[j]) && same(e.drift[j], f.drift[j]));
      // Factors of two are exact; doubt is the same on both sides, and its rounding is not.
      const double expected = collision[static_cast<std::size_t>(j)] * (e.limit_nm[j] - e.doubt[j]) + f.doubt[j];
      CHECK(std::fabs(f.limit_nm[j] - expected) <= 1e-12 * expected);
    }
  }
}

// A contact of 0.6 of its limit is one at a factor of 0.5; the factor outlives an acknowledgement and a saved state.
void limit_factors_are_part_of_the_state() {
  const Bundle bundle = made::bundle(2, 0, kSteps, kStride, 3);
  const Signals s = regular(2, 1000);
  Monitor one(bundle), other(bundle);
  CHECK(one.set_limit_factors(std::vector{0.25, 4.0}, std::vector{0.5, 2.0}));
  feed(one, s, 0, 500);
  one.acknowledge();
  std::vector<std::byte> state(one.state_bytes());
  CHECK(one.save_state(state) && other.restore_state(state));
  CHECK(other.limit_factors().collision[0] == 0.25 && other.limit_factors().contact[1] == 2.0);
  for (std::int64_t k = 500; k < 1000; ++k) CHECK(same(one.step(s.at(k)), other.step(s.at(k))));
  const std::vector<double> ones{1, 1}, low{1, 0.0999}, high{10.001, 1}, nan{NAN, 1}, three{1, 1, 1};
  for (const std::vector<double>& bad : {low, high, nan, three, {}})
    CHECK(!one.set_limit_factors(bad, ones) && !one.set_limit_factors(ones, bad));
  CHECK(one.limit_factors().collision[0] == 0.25 && one.limit_factors().contact[0] == 0.5);
  one.reset();
  CHECK(one.limit_factors().collision[0] == 1 && one.limit_factors().contact[1] == 1);
}

// Two joints without gravity of which the first has 5 Nm of static friction, and what a drive gives to hold or move it.
struct StickyArm {
  Monitor monitor;
  double q = 0;
  std::int64_t t_ms = 0;

  static Bundle bundle() {
    Bundle b = made::bundle(2, 0, kSteps, kStride, 3);
    b.gravity = {0, 0, 0};
    b.prior.widths_rad = {1e-3};
    b.prior.terms = {{TermKind::presliding, 0, 0, 0, 0, 0}};
    b.prior.weights = {-5, 0};
    b.limits.near_stiction_rad_s = 0.01;
    b.limits.region_width = 0;
    limit(b, {2, 2});
    answer_reference(b);
    return b;
  }
  // For so long at a speed, with this torque on the first joint; the highest alarm meanwhile.
  Alarm go(int samples, double speed, double torque) {
    Alarm highest = Alarm::none;
    for (int k = 0; k < samples; ++k) {
      q += 1e-3 * speed;
      const double at[2] = {q, 0.3}, dq[2] = {speed, 0}, tau[2] = {torque, 0};
      highest = std::max(highest, monitor.step({++t_ms * kMs, at, dq, tau}).alarm);
    }
    return highest;
  }
};

void what_a_push_left_in_static_friction_is_no_collision_after_resume() {
  const Bundle bundle = StickyArm::bundle();
  StickyArm arm{Monitor(bundle)};
  CHECK(arm.go(1000, 0.02, 5) == Alarm::none && arm.monitor.last().doubt[0] < 1e-6);
  CHECK(arm.go(500, 0, 5) == Alarm::none);
  // After a push, 1 Nm holds the joint where it took 5 before; its position does not show that.
  CHECK(arm.go(500, 0, 1) == Alarm::collision);
  CHECK_CLOSE(arm.monitor.last().tau_ext[0], 4, 1e-3);  // 10/K0 later
  arm.monitor.acknowledge();
  CHECK(arm.monitor.last().alarm == Alarm::none && arm.go(500, 0, 1) == Alarm::collision);
  arm.monitor.resume();
  CHECK(arm.monitor.last().alarm == Alarm::none && arm.go(1, 0, 1) == Alarm::none);
  CHECK_CLOSE(arm.monitor.last().limit_nm[0], 2 + 5, 1e-9);
  CHECK(arm.monitor.last().limit_nm[1] == 2);
  CHECK(arm.go(500, 0, 1) == Alarm::none);
  // A push beyond all friction is found at once, and the limit is back when the joint has slid.
  std::vector<std::byte> state(arm.monitor.state_bytes());
  CHECK(arm.monitor.save_state(state));
  CHECK(arm.go(200, 0, -8) == Alarm::collision);
  CHECK(arm.monitor.restore_state(state));
  CHECK(arm.go(50, 0.02, 3) == Alarm::none && arm.go(500, 0.02, 5) == Alarm::none);
  CHECK_CLOSE(arm.monitor.last().limit_nm[0], 2, 1e-3);
  CHECK_CLOSE(arm.monitor.last().tau_ext[0], 0, 1e-2);
  CHECK(arm.go(200, 0.02, 2) == Alarm::collision);
}

// Limits near stiction persist for the bundle's time after a joint started to slide.
void a_joint_that_breaks_away_keeps_its_limit_for_a_while() {
  Bundle bundle = StickyArm::bundle();
  bundle.limits.collision.near_stiction_nm = {7, 7};
  bundle.limits.near_memory_s = 0.05;
  StickyArm arm{Monitor(bundle)};
  const auto near = [&] { return (arm.monitor.last().near_stiction & 1) != 0; };
  arm.go(1000, 0.02, 5);
  CHECK(!near());
  arm.go(1, 0.005, 5);
  CHECK(near());
  arm.go(49, 0.02, 5);
  CHECK(near());
  CHECK_CLOSE(arm.monitor.last().limit_nm[0], 7, 1e-6);
  std::vector<std::byte> state(arm.monitor.state_bytes());
  CHECK(arm.monitor.save_state(state) && arm.monitor.restore_state(state));
  arm.go(1, 0.02, 5);
  CHECK(!near());
  CHECK_CLOSE(arm.monitor.last().limit_nm[0], 2, 1e-6);
}

// The same signals, all of them known or none: what is unknown teaches the drift tracker nothing.
void drift_is_not_learned_from_motion_that_training_never_saw() {
  Bundle known = tracking(made::bundle(2, 0, kSteps, kStride, 7)), unknown = known;
  limit(known, {1e3, 1e3});
  unknown.limits = known.limits;
  known.coverage = unknown.coverage = made::half_seen(2);
  for (CoverageSettings* coverage : {&known.coverage, &unknown.coverage}) {  // by the speed alone
    coverage->reach = {0, 0};
    coverage->reach_together = 0;
    coverage->seen_together.clear();
  }
  known.coverage.fastest_rad_s = {1e3, 1e3};
  unknown.coverage.fastest_rad_s = {1e-3, 1e-3};
  Monitor familiar(known), lost(unknown);
  const Signals s = regular(2, 3000);
  for (int k = 0; k < 3000; ++k) {
    const Sample sample = s.at(k);
    familiar.step(sample);
    lost.step(sample);
  }
  CHECK(familiar.last().health == Health::ok && familiar.last().unfamiliar == 0 && lost.last().unfamiliar == 1);
  CHECK(familiar.last().drift[0] != 0 && lost.last().drift[0] == 0 && lost.last().drift[1] == 0);
}

// The doubt after resume() replaces the factor after a contact; they do not multiply.
void resume_ends_what_a_contact_raised() {
  Bundle bundle = StickyArm::bundle();
  bundle.limits.after_contact_factor = 3;
  StickyArm arm{Monitor(bundle)};
  CHECK(arm.go(1000, 0.02, 5) == Alarm::none && arm.go(500, 0, 5) == Alarm::none);
  CHECK(arm.go(300, 0, 1) == Alarm::collision && arm.go(500, 0, 5) == Alarm::collision);
  CHECK_CLOSE(arm.monitor.last().limit_nm[0], 3 * 2, 1e-6);  // pushed, and let go
  arm.monitor.acknowledge();
  CHECK(arm.go(300, 0, 1) == Alarm::none);  // 4 Nm
  arm.monitor.resume();
  arm.go(1, 0, 1);
  CHECK_CLOSE(arm.monitor.last().limit_nm[0], 2 + 5, 1e-6);
}

void resume_of_joints_that_slide_is_an_acknowledgement() {
  const Bundle bundle = StickyArm::bundle();
  StickyArm one{Monitor(bundle)}, other{Monitor(bundle)};
  for (StickyArm* arm : {&one, &other}) {
    arm->go(1000, 0.02, 5);
    CHECK(arm->go(200, 0.02, 0) == Alarm::collision);
  }
  one.monitor.resume();
  other.monitor.acknowledge();
  for (int k = 0; k < 1000; ++k) {
    one.go(1, 0.02, 5);
    other.go(1, 0.02, 5);
    CHECK(same(one.monitor.last(), other.monitor.last()));
    CHECK(one.monitor.last().doubt[0] == other.monitor.last().doubt[0]);
  }
}

std::vector<std::byte> carried_by(const Monitor& monitor) {
  std::vector<std::byte> carried(Monitor::carried_bytes());
  CHECK(monitor.save_carried(carried) && !monitor.save_carried(std::span(carried).first(9)));
  return carried;
}

// Another bundle of the same model goes on with the drift, one of another model with none; factors go to both.
void what_was_learned_is_carried_to_a_bundle_of_the_same_model() {
  const Bundle bundle = tracking(made::bundle(2, 20, kSteps, kStride, 3));
  Bundle limits = bundle, bounds = bundle, model = tracking(made::bundle(2, 20, kSteps, kStride, 4));
  limit(limits, {7, 8});
  limits.name = "other limits";
  bounds.drift.size_nm = {1e-3, 1e-3};
  CHECK(model_digest(bundle) == model_digest(limits) && model_digest(bundle) == model_digest(bounds));
  CHECK(model_digest(bundle) != model_digest(model));
  const Signals s = regular(2, 4000);
  Monitor one(bundle), fresh(bundle), same_model(limits), bounded(bounds), other(model), alone(model);
  feed(one, s, 0, 2000);
  CHECK(one.set_limit_factors(std::vector<double>{2, 0.5}, std::vector<double>{3, 1}));
  const std::vector<std::byte> carried = carried_by(one);
  for (Monitor* each : {&same_model, &bounded, &other}) {
    CHECK(each->carry(carried) && each->limit_factors().collision[0] == 2 && each->limit_factors().contact[0] == 3);
    feed(*each, s, 2000, 3000);
  }
  CHECK(alone.set_limit_factors(std::vector<double>{2, 0.5}, std::vector<double>{3, 1}));
  feed(alone, s, 2000, 3000);
  CHECK(same(alone.last(), other.last()));
  feed(one, s, 2000, 3000);
  feed(fresh, s, 2000, 3000);
  const auto apart = [&](const Monitor& from) { return std::fabs(from.last().drift[0] - one.last().drift[0]); };
  CHECK(apart(fresh) > 0.01 && apart(same_model) < 0.1 * apart(fresh));
  CHECK(std::fabs(bounded.last().drift[0]) < 3e-3);
  // Damaged, or of another arm: refused without a change.
  Monitor three(made::bundle(3, 0, kSteps, kStride, 3)), untouched(bundle), reference(bundle);
  CHECK(!three.carry(carried) && !three.carry_alarm(carried));
  for (std::size_t at = 0; at < carried.size(); at += 97) {
    std::vector<std::byte> damaged = carried;
    damaged[at] ^= std::byte{4};
    CHECK(!untouched.carry(damaged) && !untouched.carry_alarm(damaged));
  }
  CHECK(!untouched.carry(std::span(carried).first(carried.size() - 1)));
  feed(untouched, s, 0, 2000);
  feed(reference, s, 0, 2000);
  CHECK(same(untouched.last(), reference.last()));
}

// An alarm is the old monitor's: what the new one raised in the samples that it was told of ends.
void an_alarm_is_carried_and_one_of_the_new_monitor_ends() {
  Bundle high = StickyArm::bundle();
  limit(high, {20, 20});
  StickyArm pushed{Monitor(StickyArm::bundle())}, quiet{Monitor(high)};
  for (StickyArm* arm : {&pushed, &quiet}) arm->go(1000, 0.02, 5), arm->go(500, 0, 5), arm->go(500, 0, 1);
  const Estimate alarm = pushed.monitor.last(), none = quiet.monitor.last();
  CHECK(alarm.alarm == Alarm::collision && none.alarm == Alarm::none);
  const std::vector<std::byte> of_pushed = carried_by(pushed.monitor), of_quiet = carried_by(quiet.monitor);
  CHECK(quiet.monitor.carry_alarm(of_pushed) && pushed.monitor.carry_alarm(of_quiet));
  const Estimate& now = quiet.monitor.last();
  CHECK(now.alarm == Alarm::collision && now.alarm_joint == 0 && now.alarm_t_ns == alarm.alarm_t_ns && now.touch == alarm.touch);
  CHECK(same(now.tau_ext[0], none.tau_ext[0]) && pushed.monitor.last().alarm == Alarm::none);
  CHECK(quiet.go(1, 0, 5) == Alarm::collision);
  CHECK(pushed.go(1, 0, 1) == Alarm::collision);  // the hold time of a cause that lasts is over
}

void names_are_reported() {
  for (std::uint32_t k = 0; k < kCauseCount; ++k) CHECK(name(static_cast<Cause>(1u << k))[0] != '\0');
  CHECK(name(static_cast<Cause>(1u << kCauseCount))[0] == '\0');
  CHECK(std::string(name(Health::warming_up)) == "warming up" && std::string(name(Alarm::collision)) == "collision");
}

void a_bundle_that_does_not_hold_together_makes_no_monitor() {
  Bundle bundle = made::bundle(2, 20, kSteps, kStride, 3);
  bundle.signals.largest_torque_nm[0] = NAN;
  CHECK_THROWS(Monitor(bundle), Error);
  bundle = made::bundle(2, 20, kSteps, kStride, 3);
  bundle.limits.contact.hold_s = -1;
  CHECK_THROWS(Monitor(bundle), Error);
}

}  // namespace

int main() {
  online_equals_offline_to_the_last_bit();
  online_equals_offline_for_every_method();
  the_network_at_its_own_rate_holds_its_last_value();
  reset_equals_fresh_and_acknowledge_ends_the_alarm_alone();
  if (check::emulated) return check::result();  // the rest takes five minutes there
  broken_signals_are_faults_and_the_monitor_comes_back();
  what_no_arm_sends_is_a_fault_of_its_own_and_costs_no_more_than_a_nan();
  what_a_collision_can_cause_is_judged();
  a_position_that_jumps_is_a_fault_once_wherever_it_stays();
  positions_that_are_held_and_stamps_that_jitter_are_no_jumps();
  a_gap_restarts_the_warm_up_and_reports_the_cause();
  late_and_missing_samples_are_stale_and_change_nothing();
  another_rate_is_refused_and_the_right_one_taken_up_again();
  a_saturated_drive_is_a_fault_that_hides_no_collision();
  a_frozen_encoder_is_a_fault_and_a_resting_arm_is_not();
  a_restored_monitor_goes_on_as_if_nothing_had_been();
  a_restored_monitor_goes_on_with_every_method();
  drift_outlives_gaps_and_faults();
  a_left_out_advance_is_made_up_for();
  limit_factors_scale_the_limits_and_nothing_else();
  limit_factors_are_part_of_the_state();
  what_a_push_left_in_static_friction_is_no_collision_after_resume();
  a_joint_that_breaks_away_keeps_its_limit_for_a_while();
  drift_is_not_learned_from_motion_that_training_never_saw();
  resume_ends_what_a_contact_raised();
  resume_of_joints_that_slide_is_an_acknowledgement();
  what_was_learned_is_carried_to_a_bundle_of_the_same_model();
  an_alarm_is_carried_and_one_of_the_new_monitor_ends();
  names_are_reported();
  a_bundle_that_does_not_hold_together_makes_no_monitor();
  return check::result();
}
