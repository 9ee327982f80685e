#include "touch/touch_kind.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numbers>
#include <set>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;

namespace {

constexpr int kJoints = 4;
constexpr double kGain = 20, kDt = 1e-3, kFrom = 0.3;  // a touch begins at 0.3 s
using Vector = std::array<double, kJoints>;

Bundle make_bundle() { return made::bundle(kJoints, 0, 4, 10, 1); }

// What touches: joint speeds [rad/s] and external torques [limits] at t seconds since it began, t < 0 before.
struct Moment {
  Vector dq{}, tau{};
};
using Touching = std::function<Moment(double)>;

// The kind over time, with r's response dr/dt = K0 (tau - r) and an alarm that stays once |r| exceeded 1.
struct Told {
  std::vector<double> since_s;  // the alarm
  std::vector<Touch> kinds;
  Touch at(double s) const {
    Touch kind = Touch::none;
    for (std::size_t k = 0; k < kinds.size() && since_s[k] <= s; ++k) kind = kinds[k];
    return kind;
  }
  bool ever(Touch kind) const { return std::ranges::find(kinds, kind) != kinds.end(); }
};

struct Run {
  Bundle bundle = make_bundle();
  TouchKind kind{bundle};
  Vector q{0.3, -0.5, 0.8, 0.2}, r{}, limit{2, 2, 2, 2};
  std::int64_t k = 0;
  bool alarm = false;
  double alarm_s = 0;

  Touch step(const Touching& touching, bool lose = false) {
    const double t = static_cast<double>(k) * kDt - kFrom;
    const Moment now = touching(t);
    bool over = false;
    for (std::size_t j = 0; j < kJoints; ++j) {
      r[j] += -std::expm1(-kGain * kDt) * (limit[j] * now.tau[j] - r[j]);
      over = over || std::fabs(r[j]) > limit[j];
    }
    if (over && !alarm) alarm_s = t;
    alarm = alarm || over;
    Vector shown = r;
    if (lose) shown.fill(NAN);
    kind.step({k * 1'000'000, q, now.dq, shown, limit, over, alarm});
    ++k;
    return kind.kind();
  }
  Told go(const Touching& touching, double seconds) {
    Told told;
    const auto end = static_cast<std::int64_t>((kFrom + seconds) / kDt);
    while (k < end) {
      const Touch now = step(touching);
      if (!alarm) CHECK(now == Touch::none);
      if (!alarm) continue;
      told.since_s.push_back(static_cast<double>(k - 1) * kDt - kFrom - alarm_s);
      told.kinds.push_back(now);
    }
    return told;
  }
};

double cosine_rise(double t, double rise_s) { return 0.5 * (1 - std::cos(std::numbers::pi * std::clamp(t / rise_s, 0.0, 1.0))); }

// Joint 1 goes at v0 and slows down with a time constant once it runs into a spring, or never.
Touching spring(double v0, double limits_per_rad, double slows_s) {
  return [=](double t) {
    const double v = t < 0 ? v0 : v0 * std::exp(-t / slows_s), x = t < 0 ? 0 : v0 * slows_s * -std::expm1(-t / slows_s);
    return Moment{{0.1, v, 0, 0}, {0, -limits_per_rad * x, 0, 0}};
  };
}

void a_spring_that_the_arm_is_driven_into_is_a_clamp_and_never_a_push() {
  for (const double v0 : {0.1, 0.3, 1.0, -0.4})
    for (const double stiff : {30.0, 100.0, 1000.0})
      for (const double slows_s : {0.05, 0.3, 1e6}) {
        const double most = stiff * std::fabs(v0) * std::min(slows_s, 0.5);
        if (most < 3) continue;  // it hardly shows
        const Told told = Run{}.go(spring(v0, stiff, slows_s), 1.2);
        CHECK(told.at(0.2) == Touch::clamp);
        CHECK(!told.ever(Touch::push) && !told.ever(Touch::load));
      }
}

void a_torque_that_grows_on_while_the_arm_stands_is_a_clamp_and_never_a_push() {
  for (const double per_s : {8.0, 20.0, 60.0}) {
    const Told told = Run{}.go(
        [=](double t) {
          const double tau = std::max(t, 0.0) * per_s, yields = t > 0 ? 0.02 : 0;
          return Moment{{0, yields, 0, 0}, {0, tau, 0.3 * tau, 0}};
        },
        1.0);
    CHECK(told.at(0.2) == Touch::clamp && !told.ever(Touch::push));
  }
}

void a_torque_that_settles_is_a_push() {
  for (const double rise_s : {0.05, 0.1, 0.2})
    for (const double size : {2.0, 4.0}) {
      const Told standing = Run{}.go(
          [=](double t) {
            const double share = cosine_rise(t, rise_s), rate = t > 0 && t < rise_s ? 0.05 : 0;
            return Moment{{0, rate, 0, 0}, {0, size * share, 0, -0.4 * size * share}};
          },
          1.0);
      CHECK(standing.at(0.2) == Touch::push && !standing.ever(Touch::clamp));
      // Against the motion, which goes on.
      const Told moving = Run{}.go([=](double t) { return Moment{{0, 0.5, 0, 0}, {0, -size * cosine_rise(t, rise_s), 0, 0}}; }, 1.0);
      // A strong contact that settles late looks like an obstacle that the arm slips off: not a push.
      CHECK(moving.at(0.3) == (size < 3 || rise_s < 0.07 ? Touch::push : Touch::clamp));
    }
}

// It goes on as a press does, but the arm moves away from it by itself.
void what_the_arm_moves_away_from_is_a_push_at_once() {
  const auto told = [](double v) {
    return Run{}.go([=](double t) { return Moment{{0, v, 0, 0}, {0, std::max(t, 0.0) * 20, 0, 0}}; }, 1.0);
  };
  CHECK(told(0.4).at(0.1) == Touch::push && !told(0.4).ever(Touch::clamp));
  CHECK(told(0).at(0.2) == Touch::clamp && told(-0.4).at(0.2) == Touch::clamp);
}

void a_blow_is_an_impact() {
  for (const double length_s : {0.005, 0.02, 0.04}) {
    const Told told = Run{}.go(
        [=](double t) {
          const double share = t > 0 && t < length_s ? std::sin(std::numbers::pi * t / length_s) : 0;
          return Moment{{}, {0, 0.15 / length_s * share, 0, 0}};
        },
        0.8);
    CHECK(told.at(0.15) == Touch::impact && !told.ever(Touch::push) && !told.ever(Touch::clamp));
  }
}

// A blow that is followed by a torque that grows: what came back is no impact any more.
void what_bounces_and_then_holds_is_a_clamp() {
  const Told told = Run{}.go(
      [](double t) {
        if (t < 0) return Moment{{0, 1.0, 0, 0}, {}};
        const double blow = t < 0.01 ? 15 : 0, holds = t > 0.1 ? -40 * (t - 0.1) : 0;
        return Moment{{0, t < 0.01 ? 0.2 : 0.1, 0, 0}, {0, -blow + holds, 0, 0}};
      },
      1.0);
  CHECK(told.at(0.08) == Touch::impact && told.kinds.back() == Touch::clamp && !told.ever(Touch::push));
}

void a_weight_at_the_load_frame_is_a_load() {
  const Bundle bundle = make_bundle();
  const Vector q = Run{}.q, still{};
  // Its torques, as the difference of two trees' gravity: with 3 kg more on the last link, and without.
  Tree bare(bundle.links, bundle.gravity);
  std::vector<Link> heavier = bundle.links;
  Link& last = heavier.back();
  const double more = 3, sum = last.mass + more;
  const std::array<double, 3> at{0.05, 0.02, 0.1};
  for (std::size_t i = 0; i < 3; ++i) last.com[i] = (last.mass * last.com[i] + more * at[i]) / sum;
  last.mass = sum;
  Tree loaded(heavier, bundle.gravity);
  Vector p, without, with;
  bare.momentum(q, still, p, without);
  loaded.momentum(q, still, p, with);
  Vector share;
  double most = 0;
  for (std::size_t j = 0; j < kJoints; ++j) most = std::max(most, std::fabs(without[j] - with[j]));
  for (std::size_t j = 0; j < kJoints; ++j) share[j] = 3 * (without[j] - with[j]) / most;
  const auto weight = [&](double sign) {
    return Run{}.go(
        [&, sign](double t) {
          Moment now;
          for (std::size_t j = 0; j < kJoints; ++j) now.tau[j] = sign * share[j] * cosine_rise(t, 0.1);
          return now;
        },
        0.8);
  };
  CHECK(weight(1).at(0.2) == Touch::load);
  CHECK(weight(-1).at(0.2) == Touch::push);  // nothing is lighter than nothing
}

void a_touch_without_an_observed_start_is_unknown() {
  const Touching steady = [](double) { return Moment{{0, 0.3, 0, 0}, {0, -3, 0, 0}}; };
  Run run;
  run.r = {0, -6, 0, 0};
  run.kind.restart();
  for (int k = 0; k < 1000; ++k) run.step(steady);
  CHECK(run.kind.kind() == Touch::none);
  // Nor what went on while there was no estimate.
  Run gap;
  const Touching push = [](double t) { return Moment{{}, {0, 3 * cosine_rise(t, 0.3), 0, 0}}; };
  for (int k = 0; k < 1000; ++k) gap.step(push, k > 380 && k < 600);
  CHECK(gap.kind.kind() == Touch::none && gap.alarm);
}

void samples_without_an_estimate_change_nothing() {
  Run with, without;
  const Touching push = [](double t) { return Moment{{}, {0, 3 * cosine_rise(t, 0.1), 0, 0}}; };
  for (int k = 0; k < 800; ++k) {
    const Touch kind = with.step(push, k % 50 == 7);
    CHECK(kind == without.step(push) || k % 50 == 7);
  }
  CHECK(with.kind.kind() == Touch::push);
}

void a_state_goes_on_in_another() {
  const Touching touching = spring(0.4, 60, 0.2);
  for (const int stop : {250, 350, 420, 600}) {
    Run one;
    for (int k = 0; k < stop; ++k) one.step(touching);
    Run other;
    other.kind.restore(one.kind.state());
    other.r = one.r, other.k = one.k, other.alarm = one.alarm, other.alarm_s = one.alarm_s;
    for (int k = 0; k < 400; ++k) CHECK(one.step(touching) == other.step(touching));
  }
}

void an_alarm_that_ends_takes_its_kind_along() {
  Run run;
  run.go([](double t) { return Moment{{}, {0, 3 * cosine_rise(t, 0.1), 0, 0}}; }, 0.5);
  CHECK(run.kind.kind() == Touch::push);
  run.alarm = false;
  run.r = {};
  run.step([](double) { return Moment{}; });
  CHECK(run.kind.kind() == Touch::none);
}

// The monitor reports the kind with the next answer, offline as online; names are reported.
void the_chain_reports_it() {
  Bundle bundle = make_bundle();
  const std::size_t samples = 3000;
  std::vector<std::int64_t> t_ns(samples);
  std::vector<double> q(samples * kJoints), dq(q), tau(q);
  for (std::size_t k = 0; k < samples; ++k) {
    t_ns[k] = static_cast<std::int64_t>(k) * 1'000'000;
    made::signal(static_cast<std::int64_t>(k), kJoints, &q[k * kJoints], &dq[k * kJoints], &tau[k * kJoints]);
    if (k > 1500) tau[k * kJoints + 1] += 60;
  }
  const RecordingView view{static_cast<std::int64_t>(samples), kJoints, t_ns.data(), q.data(), dq.data(), tau.data()};
  const Estimates offline = estimate(bundle, view, 1);
  Monitor monitor(bundle);
  std::set<Touch> seen;
  for (std::size_t k = 0; k < samples; ++k) {
    const Estimate& e = monitor.step(view.at(static_cast<std::int64_t>(k)));
    CHECK(offline.touch[k] == static_cast<std::uint8_t>(e.touch));
    CHECK((e.touch == Touch::none) == (e.alarm == Alarm::none));
    seen.insert(e.touch);
  }
  CHECK(seen.contains(Touch::none) && seen.contains(Touch::unknown));
  CHECK(std::string(name(Touch::clamp)) == "clamp" && std::string(name(Touch::none)) == "none");
  CHECK(*name(static_cast<Touch>(6)) == 0);
}

}  // namespace

int main() {
  a_spring_that_the_arm_is_driven_into_is_a_clamp_and_never_a_push();
  a_torque_that_grows_on_while_the_arm_stands_is_a_clamp_and_never_a_push();
  a_torque_that_settles_is_a_push();
  what_the_arm_moves_away_from_is_a_push_at_once();
  a_blow_is_an_impact();
  what_bounces_and_then_holds_is_a_clamp();
  a_weight_at_the_load_frame_is_a_load();
  a_touch_without_an_observed_start_is_unknown();
  samples_without_an_estimate_change_nothing();
  a_state_goes_on_in_another();
  an_alarm_that_ends_takes_its_kind_along();
  the_chain_reports_it();
  return check::result();
}
