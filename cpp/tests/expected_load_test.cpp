// Expected loads: accepted, reported and set; pushes in the same window are not missed.
#include "load/expected_load.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <random>
#include <vector>

#include "check.hpp"
#include "load/load_columns.hpp"
#include "made_bundle.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;

namespace {

constexpr int kJoints = 6;
constexpr double kCommand_s = 1.0, kStep_s = 1.3;  // the gripper's command, and when something happens

Bundle arm() {
  Bundle b = made::bundle(kJoints, 0, 10, 1, 1);
  b.observer.timing = TorqueTiming::averaged;
  b.observer.sample_period_ns = 2'000'000;
  b.limits.near_stiction_rad_s = 0;
  for (Level* level : {&b.limits.collision, &b.limits.contact}) {
    level->sliding_nm = level->near_stiction_nm = {3, 3, 2, 2, 0.8, 0.8};
    level->hold_s = 0;
  }
  b.load.largest_mass_kg = 4;
  answer_reference(b);
  return b;
}

std::array<double, 10> parameters(double m, std::array<double, 3> c) {
  return {m, m * c[0], m * c[1], m * c[2], m * (c[1] * c[1] + c[2] * c[2]), m * (c[0] * c[0] + c[2] * c[2]),
          m * (c[0] * c[0] + c[1] * c[1]), -m * c[0] * c[1], -m * c[0] * c[2], -m * c[1] * c[2]};
}

// An exact arm: the torque that moves it, averaged over each step, with the share of a load that no table holds and a force
// on one link.
struct Scene {
  double mass = 1.5;
  std::array<double, 3> com = {0.03, -0.02, 0.06};
  std::function<double(double)> share = [](double) { return 0.0; };
  int pushed_link = kJoints - 1;
  std::function<std::array<double, 3>(double)> push = [](double) { return std::array<double, 3>{}; };
  double noise = 0.03;  // of a limit
};

class Cell {
 public:
  explicit Cell(const Scene& scene, const Bundle& bundle = arm())
      : scene_(scene),
        bundle_(bundle),
        tree_(bundle.links, bundle.gravity),
        load_(tree_, {bundle.load.link, bundle.load.rotation, bundle.load.translation}),
        pushed_(tree_, {scene.pushed_link, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {0.1, 0, 0}}) {}

  // The next sample, 2 ms after the last one; it lives until the one after.
  Sample next() {
    const std::size_t n = kJoints;
    const double t = time_s();
    for (std::size_t j = 0; j < n; ++j) {
      const double speed = 0.9 + 0.17 * static_cast<double>(j), size = 0.4;
      q_[j] = size * std::sin(speed * t + 0.9 * static_cast<double>(j));
      dq_[j] = size * speed * std::cos(speed * t + 0.9 * static_cast<double>(j));
    }
    std::vector<double> p(n), v(n);
    tree_.momentum(q_, dq_, p, v);
    load_.compute(q_, dq_);
    pushed_.compute(q_, dq_);
    const auto phi = parameters(scene_.mass, scene_.com);
    const double share = scene_.share(t);
    const auto force = scene_.push(t);
    for (std::size_t j = 0; j < n; ++j) {
      double load_p = 0, load_v = 0;
      for (std::size_t k = 0; k < 10; ++k) {
        load_p += load_.momentum()[k][j] * phi[k];
        load_v += load_.beta()[k][j] * phi[k];
      }
      const double load = k_ == 0 ? load_v : (load_p - load_p_[j]) / 2e-3 + 0.5 * (load_v + load_v_[j]);
      load_p_[j] = load_p;
      load_v_[j] = load_v;
      for (std::size_t k = 0; k < 3; ++k) v[j] -= pushed_.base_forces()[k][j] * force[k];
      const double noise = scene_.noise * bundle_.limits.collision.sliding_nm[j] * normal_(random_);
      tau_[j] = (k_ == 0 ? 0 : (p[j] - p_[j]) / 2e-3) + (k_ == 0 ? v[j] : 0.5 * (v[j] + v_[j])) + share * load + noise;
    }
    p_ = p;
    v_ = v;
    ++k_;
    return {(k_ - 1) * 2'000'000, q_, dq_, tau_};
  }
  double time_s() const { return 2e-3 * static_cast<double>(k_); }

 private:
  Scene scene_;
  Bundle bundle_;
  Tree tree_;
  LoadRegressor load_, pushed_;
  std::vector<double> q_ = std::vector<double>(kJoints), dq_ = q_, tau_ = q_, p_ = q_, v_ = q_, load_p_ = q_, load_v_ = q_;
  std::int64_t k_ = 0;
  std::mt19937 random_{3};
  std::normal_distribution<double> normal_{0, 1};
};

double after(double t, double at, double lasts) { return std::clamp((t - at) / lasts, 0.0, 1.0); }

// What became of a scene.
struct Told {
  double alarm_s = -1;  // when the alarm rose
  double held_s = -1;   // when one was first held back
  std::vector<double> masses;  // that were set, one after the other
  double error_kg = 0, found_s = -1;
  LoadPhase phase = LoadPhase::none;  // at the end
  Load load;
};

Told run(const Scene& scene, double seconds, double window_s, double at_most_kg, const Load& carried = {}) {
  Cell cell(scene);
  Monitor monitor(arm());
  Told told;
  if (carried.mass > 0) CHECK(monitor.set_load(carried));
  double mass = carried.mass;
  bool asked = false;
  while (cell.time_s() < seconds) {
    const double t = cell.time_s();
    if (!asked && t >= kCommand_s) CHECK((asked = monitor.expect_load(window_s, at_most_kg)));
    const Estimate& e = monitor.step(cell.next());
    if (e.alarm != Alarm::none && told.alarm_s < 0) told.alarm_s = t;
    if (e.load_phase == LoadPhase::deciding && told.held_s < 0) told.held_s = t;
    if (monitor.load().mass != mass) {
      mass = monitor.load().mass;
      told.masses.push_back(mass);
      if (told.found_s < 0) told.found_s = t;
    }
  }
  told.phase = monitor.last().load_phase;
  told.error_kg = monitor.last().load_error_kg;
  told.load = monitor.load();
  return told;
}

Load known(const Scene& scene) { return {scene.mass, scene.com, {}, Load::kUsualError}; }

Scene pick(double lasts) {
  Scene s;
  s.share = [lasts](double t) { return after(t, kStep_s, lasts); };
  return s;
}

Scene pushed(std::array<double, 3> force, double from, double lasts, int link = kJoints - 1) {
  Scene s;
  s.pushed_link = link;
  s.push = [=](double t) { return t >= from && t < from + lasts ? force : std::array<double, 3>{}; };
  return s;
}

// Sudden or slow, no alarm; mass and centre of mass are found.
void a_load_is_taken_and_set() {
  for (const double lasts : {1e-3, 0.3, 1.0, 1.5}) {
    const Scene scene = pick(lasts);
    const Told told = run(scene, 6, 3, 3);
    CHECK(told.alarm_s < 0);
    CHECK(told.held_s > kStep_s);
    CHECK(!told.masses.empty() && std::fabs(told.load.mass - scene.mass) < 0.05 * scene.mass);
    CHECK(told.error_kg > 0 && told.error_kg < 0.3);
    for (std::size_t i = 0; i < 3; ++i) CHECK(std::fabs(told.load.com[i] - scene.com[i]) < 0.03);
    CHECK(told.phase == LoadPhase::weighing);
    CHECK(told.found_s - kStep_s < lasts + 0.7);  // settled, and decided
  }
  const Told untold = [] {  // the same load without the announcement: the test can fail
    Cell cell(pick(1e-3));
    Monitor monitor(arm());
    Told out;
    while (cell.time_s() < 3) {
      const double t = cell.time_s();
      if (monitor.step(cell.next()).alarm != Alarm::none && out.alarm_s < 0) out.alarm_s = t;
    }
    return out;
  }();
  CHECK(untold.alarm_s > kStep_s && untold.alarm_s < kStep_s + 0.1);
}

void a_light_load_that_raises_nothing_is_set_when_the_window_ends() {
  Scene scene = pick(1e-3);
  scene.mass = 0.15;
  const Told told = run(scene, 6, 3, 3);
  CHECK(told.alarm_s < 0 && told.held_s < 0);
  CHECK(told.found_s > kCommand_s + 3 - 0.01);
  CHECK(std::fabs(told.load.mass - 0.15) < 0.05);
  const Told nothing = run(Scene{}, 6, 3, 3);
  CHECK(nothing.alarm_s < 0 && nothing.masses.empty() && nothing.phase == LoadPhase::none);
}

void a_load_that_is_put_down_goes() {
  for (const double lasts : {1e-3, 0.8}) {
    Scene scene;
    scene.share = [lasts](double t) { return 1 - after(t, kStep_s, lasts); };
    const Told told = run(scene, 5, 3, 0, known(scene));
    CHECK(told.alarm_s < 0);
    CHECK(told.held_s > kStep_s);
    CHECK(told.load.mass == 0);
    CHECK(told.phase == LoadPhase::none);  // nothing left to estimate
  }
}

void half_of_a_load_may_stay() {
  Scene scene;
  scene.mass = 2.4;
  scene.share = [](double t) { return 1 - 0.5 * after(t, kStep_s, 1e-3); };
  const Told told = run(scene, 6, 3, 2, known(scene));
  CHECK(told.alarm_s < 0);
  CHECK(std::fabs(told.load.mass - 1.2) < 0.12);
}

// What passed a limit and is gone again was a contact: the alarm is late by its length at most, and a decision.
void a_push_that_ends_is_an_alarm() {
  for (const double lasts : {0.05, 0.15, 0.25}) {
    const Told told = run(pushed({0, -25, 0}, kStep_s, lasts), 5, 3, 4);  // along this arm's gravity
    CHECK(told.held_s > kStep_s);
    CHECK(told.alarm_s > told.held_s && told.alarm_s < kStep_s + lasts + 0.25);
    CHECK(told.load.mass == 0);
  }
}

// One that lasts is a load to the joints; when it ends, the alarm comes, and the load that was none is off again.
void a_push_down_that_lasts_is_a_load_until_it_ends() {
  const Told told = run(pushed({0, -20, 0}, kStep_s, 1.5), 5, 3, 4);
  CHECK(!told.masses.empty() && told.masses.front() > 1);
  CHECK(told.alarm_s > kStep_s + 1.5 && told.alarm_s < kStep_s + 1.5 + 0.3);
  CHECK(told.load.mass == 0);
}

void a_push_that_fits_no_load_is_an_alarm_at_once() {
  for (const std::array<double, 3> force : {std::array<double, 3>{0, 40, 0}, {40, 0, 0}, {0, 0, 40}}) {
    const Told told = run(pushed(force, kStep_s, 0.5), 5, 3, 4);
    CHECK(told.alarm_s > kStep_s && told.alarm_s < kStep_s + 0.1);
    CHECK(told.load.mass == 0);
  }
  const Told elbow = run(pushed({0, -60, 0}, kStep_s, 0.5, 2), 5, 3, 4);  // farther up: no load reaches there
  CHECK(elbow.alarm_s > kStep_s && elbow.alarm_s < kStep_s + 0.1);
}

void too_heavy_is_an_alarm() {
  Scene scene = pick(1e-3);
  scene.mass = 3.5;
  const Told told = run(scene, 4, 3, 1.5);
  CHECK(told.alarm_s > kStep_s && told.alarm_s < kStep_s + 0.1);
  CHECK(told.load.mass == 0);
}

// A blow at whatever time about the end of the window is an alarm.
void no_blow_is_lost_where_the_window_ends() {
  const double end = kCommand_s + 0.5;
  for (int k = -10; k <= 10; ++k) {
    const Told told = run(pushed({0, -120, 0}, end + 0.01 * k, 0.02), 4, 0.5, 4);
    CHECK(told.alarm_s > end - 0.11 && told.alarm_s < end + 0.01 * k + 0.4);
    CHECK(told.load.mass == 0);
  }
}

// What was held back when the window ended is decided all the same; what comes later is an alarm as ever.
void the_window_ends() {
  const Told late = run(pick(1e-3), 4, kStep_s - kCommand_s + 0.1, 3);
  CHECK(late.alarm_s < 0 && std::fabs(late.load.mass - 1.5) < 0.2);
  const Told after_it = run(pick(1e-3), 4, kStep_s - kCommand_s - 0.1, 3);
  CHECK(after_it.alarm_s > kStep_s && after_it.alarm_s < kStep_s + 0.1 && after_it.load.mass == 0);
  const Told held = run(pushed({0, -25, 0}, kStep_s, 0.2), 4, kStep_s - kCommand_s + 0.1, 4);
  CHECK(held.alarm_s > 0 && held.alarm_s < kStep_s + 0.5);
}

void a_fault_in_the_window_hides_nothing() {
  const auto with_nan = [](const Scene& scene) {
    Cell cell(scene);
    Monitor monitor(arm());
    bool alarm = false;
    while (cell.time_s() < 6) {
      const double t = cell.time_s();
      if (t >= kCommand_s && t < kCommand_s + 1e-3) CHECK(monitor.expect_load(3, 4));
      Sample sample = cell.next();
      std::vector<double> q(sample.q.begin(), sample.q.end());
      if (t >= kStep_s + 0.1 && t < kStep_s + 0.12) q[1] = std::numeric_limits<double>::quiet_NaN(), sample.q = q;
      alarm = monitor.step(sample).alarm != Alarm::none || alarm;
    }
    return std::pair(alarm, monitor.load().mass);
  };
  const auto [none, mass] = with_nan(pick(1e-3));
  CHECK(!none && std::fabs(mass - 1.5) < 0.1);
  const auto [alarm, nothing] = with_nan(pushed({0, -25, 0}, kStep_s, 0.15));
  CHECK(alarm && nothing == 0);
}

// An arm that is pushed after the command raises the alarm, whatever `meanwhile(monitor, time)` does.
template <class Meanwhile>
void swallows_nothing(Meanwhile meanwhile) {
  Cell cell(pushed({0, -25, 0}, kStep_s, 0.2));
  Monitor monitor(arm());
  bool alarm = false;
  while (cell.time_s() < 4) {
    meanwhile(monitor, cell.time_s());
    alarm = monitor.step(cell.next()).alarm != Alarm::none || alarm;
  }
  CHECK(alarm);
}

void acknowledging_loses_no_alarm() {
  swallows_nothing([](Monitor& monitor, double t) {
    if (t >= kCommand_s && t < kCommand_s + 1e-3) CHECK(monitor.expect_load(3, 4));
    if (monitor.last().load_phase == LoadPhase::deciding) monitor.acknowledge();
  });
}

void asking_again_swallows_nothing() {
  swallows_nothing([](Monitor& monitor, double t) {
    if (t >= kCommand_s && t < 2) CHECK(monitor.expect_load(3, 4));
  });
}

// Saved at any time of a window, and gone on with elsewhere.
void a_saved_state_holds_it() {
  for (const double at : {kStep_s - 0.1, kStep_s + 0.1, kStep_s + 1.0, kCommand_s + 3.5}) {
    Cell cell(pick(0.2)), same(pick(0.2));
    Monitor whole(arm()), other(arm()), third(arm());
    bool moved = false;
    while (cell.time_s() < 5) {
      const double t = cell.time_s();
      if (t >= kCommand_s && t < kCommand_s + 1e-3) CHECK(whole.expect_load(3, 3) && other.expect_load(3, 3));
      Monitor& now = moved ? third : other;
      whole.step(cell.next());
      now.step(same.next());
      if (!moved && t >= at) {
        std::vector<std::byte> state(other.state_bytes());
        CHECK(other.save_state(state) && third.restore_state(state));
        moved = true;
      }
      const Estimate &a = whole.last(), &b = (moved ? third : other).last();
      CHECK(a.load_phase == b.load_phase && a.alarm == b.alarm);
      CHECK(std::fabs(a.load.mass - b.load.mass) < 0.02);  // r is found anew from what is known of the time before
    }
  }
}

// A window that nothing happened in leaves nothing: answers are those of a monitor that expected nothing.
void outside_the_window_nothing_changes() {
  Cell cell(Scene{}), same(Scene{});
  Monitor expects(arm()), never(arm());
  while (cell.time_s() < 4) {
    const double t = cell.time_s();
    if (t >= kCommand_s && t < kCommand_s + 1e-3) CHECK(expects.expect_load(1, 3));
    const Estimate &a = expects.step(cell.next()), &b = never.step(same.next());
    const auto equal = [](const JointVector& x, const JointVector& y) {
      return std::memcmp(x.data(), y.data(), kJoints * sizeof(double)) == 0;
    };
    CHECK(equal(a.tau_ext, b.tau_ext));
    const bool inside = t >= kCommand_s && t <= kCommand_s + 1.06;
    if (!inside) CHECK(equal(a.limit_nm, b.limit_nm) && equal(a.margin_nm, b.margin_nm) && equal(a.load_nm, b.load_nm));
    if (!inside) CHECK(a.load_phase == LoadPhase::none && a.alarm == b.alarm);
  }
}

void setting_the_load_ends_it() {
  Cell cell(Scene{});
  Monitor monitor(arm());
  for (int k = 0; k < 600; ++k) monitor.step(cell.next());
  CHECK(monitor.expect_load(3, 3));
  CHECK(monitor.step(cell.next()).load_phase == LoadPhase::expecting);
  CHECK(monitor.set_load({0.01}));
  CHECK(monitor.step(cell.next()).load_phase == LoadPhase::none);
  CHECK(monitor.expect_load(3, 3));
  monitor.step(cell.next());
  monitor.reset();
  CHECK(monitor.step(cell.next()).load_phase == LoadPhase::none);
}

void nonsense_is_refused_in_words() {
  Monitor monitor(arm());
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (const double seconds : {0.0, -1.0, 61.0, nan}) {
    CHECK(!monitor.expect_load(seconds, 1));
    CHECK(monitor.why_not_expected(seconds, 1).find("60 s") != std::string::npos);
  }
  for (const double most : {-0.1, 4.5, nan}) {
    CHECK(!monitor.expect_load(1, most));
    CHECK(monitor.why_not_expected(1, most).find("4 kg") != std::string::npos);
  }
  CHECK(monitor.why_not_expected(1, 1).empty());
  Bundle b = arm();
  b.load.refused = "nobody knows the arm";
  answer_reference(b);
  Monitor without(b);
  CHECK(!without.expect_load(1, 1));
  CHECK(without.why_not_expected(1, 1).find("nobody knows the arm") != std::string::npos);
  b = arm();
  b.observer.low_pass_per_s = 5;
  answer_reference(b);
  Monitor filtered(b);
  CHECK(!filtered.expect_load(1, 1));
  CHECK(filtered.why_not_expected(1, 1).find("earlier time") != std::string::npos);
}

}  // namespace

int main() {
  a_load_is_taken_and_set();
  a_light_load_that_raises_nothing_is_set_when_the_window_ends();
  a_load_that_is_put_down_goes();
  half_of_a_load_may_stay();
  a_push_that_ends_is_an_alarm();
  a_push_down_that_lasts_is_a_load_until_it_ends();
  a_push_that_fits_no_load_is_an_alarm_at_once();
  too_heavy_is_an_alarm();
  the_window_ends();
  no_blow_is_lost_where_the_window_ends();
  a_fault_in_the_window_hides_nothing();
  acknowledging_loses_no_alarm();
  asking_again_swallows_nothing();
  a_saved_state_holds_it();
  outside_the_window_nothing_changes();
  setting_the_load_ends_it();
  nonsense_is_refused_in_words();
  return check::result();
}
