#include "alarm/alarm.hpp"

#include <cmath>

#include "check.hpp"

using namespace tauext;

namespace {

constexpr std::int64_t kMs = 1'000'000;

Limits make_limits() {
  Limits limits;
  limits.near_stiction_rad_s = 0.02;
  limits.collision = {{10, 5}, {20, 10}, 0.005};
  limits.contact = {{4, 2}, {8, 4}, 0.002};
  limits.contact_release_s = 0.05;
  return limits;
}

struct Stage {
  AlarmStage alarm{2, 0, make_limits()};

  explicit Stage(double after_contact_factor = 1) {
    Limits limits = make_limits();
    limits.after_contact_factor = after_contact_factor;
    alarm = AlarmStage(2, 0, limits);
  }
  JointVector limit_nm{}, contact_limit_nm{}, doubt{}, scale{1, 1};
  std::uint32_t near_stiction = 0;
  bool detection = false;

  const AlarmStage::State& step(std::int64_t t_ms, double tau_1, double tau_2, bool trusted = true, double dq = 1.0) {
    const JointVector tau{tau_1, tau_2};
    near_stiction = make_limits().near_stiction(dq, 0) ? 1 : 0;
    detection = alarm.step(t_ms * kMs, tau, scale, doubt, near_stiction, trusted, limit_nm, contact_limit_nm);
    return alarm.state();
  }
};

// tau rises by 1 Nm each millisecond: over 4 Nm from 5 ms on, over 10 Nm from 11 ms on.
void a_ramp_raises_contact_and_collision_after_their_hold_times() {
  Stage s;
  for (int t = 0; t <= 30; ++t) {
    const Alarm alarm = s.step(t, -t, 0).alarm;
    CHECK(alarm == (t >= 16 ? Alarm::collision : t >= 7 ? Alarm::contact : Alarm::none));
    CHECK(s.detection == (t >= 11));
    CHECK(s.alarm.state().held_alarm == alarm);  // the ramp only rises
  }
  CHECK(s.alarm.state().joint == 0 && s.alarm.state().raised_t_ns == 16 * kMs);
}

void a_contact_falls_back_and_a_collision_does_not() {
  Stage s;
  for (int t = 0; t < 10; ++t) s.step(t, 0, 3);
  CHECK(s.alarm.state().alarm == Alarm::contact && s.alarm.state().joint == 1);
  for (int t = 10; t < 59; ++t) CHECK(s.step(t, 0, 0).alarm == Alarm::contact);
  CHECK(s.step(59, 0, 0).alarm == Alarm::none && s.alarm.state().joint == -1);  // 50 ms after the last touch at 9 ms
  for (int t = 60; t < 70; ++t) s.step(t, 0, 7);
  for (int t = 70; t < 1000; ++t) {
    CHECK(s.step(t, 0, 0).alarm == Alarm::collision && s.alarm.state().held_alarm == Alarm::none);
  }
  s.alarm.acknowledge();
  CHECK(s.step(1000, 0, 0).alarm == Alarm::none);
  for (int t = 1001; t < 1005; ++t) s.step(t, 0, 7);
  s.alarm.acknowledge();
  for (int t = 1005; t < 1010; ++t) CHECK(s.step(t, 0, 7).alarm != Alarm::collision);  // its hold time restarts
  CHECK(s.step(1010, 0, 7).alarm == Alarm::collision);
}

// One number from a contact over its collision to the end, and another one for each alarm after it.
void alarms_are_numbered_and_their_touch_ends_as_a_contact_does() {
  Stage s;
  for (int t = 0; t < 10; ++t) s.step(t, 0, 3);
  CHECK(s.alarm.state().number == 1 && s.alarm.state().touch_t_ns == 9 * kMs && !s.alarm.state().touch_over);
  for (int t = 10; t < 20; ++t) s.step(t, 0, 7);
  CHECK(s.alarm.state().alarm == Alarm::collision && s.alarm.state().number == 1);
  for (int t = 20; t < 69; ++t) CHECK(!s.step(t, 0, 0).touch_over);
  CHECK(s.step(69, 0, 0).touch_over && s.alarm.state().touch_t_ns == 19 * kMs);
  CHECK(!s.step(70, 0, 0, false).touch_over && s.alarm.state().touch_t_ns == 19 * kMs);  // unknown, and not seen
  CHECK(!s.step(119, 0, 0).touch_over && s.step(120, 0, 0).touch_over);
  CHECK(!s.step(121, 0, 3).touch_over && s.alarm.state().touch_t_ns == 121 * kMs && s.alarm.state().number == 1);
  const AlarmStage::State carried = s.alarm.state();
  s.alarm.acknowledge();
  CHECK(s.alarm.state().number == 1 && s.alarm.state().touch_t_ns == 0);
  for (int t = 130; t < 140; ++t) s.step(t, 0, 3);
  CHECK(s.alarm.state().number == 2);
  s.alarm.acknowledge();
  s.alarm.count_from(40);
  s.alarm.raise(Alarm::collision, 1, 150 * kMs);
  CHECK(s.alarm.state().number == 41 && s.alarm.state().touch_t_ns == 150 * kMs);
  Stage other;
  other.step(0, 0, 0);
  other.alarm.take_over(carried);
  CHECK(other.alarm.state().number == 1 && !other.alarm.state().touch_over);
}

void one_sample_under_the_limit_restarts_the_hold_time() {
  Stage s;
  for (int t = 0; t < 100; ++t) CHECK(s.step(t, t % 5 == 4 ? 3 : 11, 0).alarm != Alarm::collision);
}

// However large its torque is, and whatever multiplies its limit; the other joint raises the alarm.
void a_joint_with_infinite_limits_raises_none() {
  Limits limits = make_limits();
  limits.after_contact_factor = 2;
  for (Level* level : {&limits.collision, &limits.contact}) level->sliding_nm[0] = level->near_stiction_nm[0] = INFINITY;
  Stage s;
  s.alarm = AlarmStage(2, 0, limits);
  s.doubt = {1, 0};
  for (int t = 0; t < 50; ++t) CHECK(s.step(t, 1e12, 0, true, t % 2).alarm == Alarm::none && !s.detection);
  CHECK(s.limit_nm[0] == INFINITY && s.contact_limit_nm[0] == INFINITY && s.limit_nm[1] == 5);
  for (int t = 50; t < 70; ++t) s.step(t, 1e12, 6);
  CHECK(s.alarm.state().alarm == Alarm::collision && s.alarm.state().joint == 1);
  CHECK(!limits.monitors(0) && limits.monitors(1));
}

void near_stiction_has_its_own_limits() {
  Stage s;
  for (int t = 0; t < 20; ++t) CHECK(s.step(t, 15, 0, true, 0.01).alarm != Alarm::collision);
  CHECK(s.near_stiction == 1 && s.limit_nm[0] == 20 && s.limit_nm[1] == 5);
  CHECK(s.contact_limit_nm[0] == 8 && s.contact_limit_nm[1] == 2);
  CHECK(s.alarm.state().alarm == Alarm::contact);
}

// The ramp of the first test, one joint's limits doubled and halved: the same times at twice and half the torque.
void factors_scale_the_torque_that_raises_an_alarm() {
  for (const double factor : {0.5, 2.0}) {
    Stage s;
    const std::array<double, 2> factors{factor, 1};
    CHECK(s.alarm.set_factors(factors, factors));
    for (int t = 0; t <= 30; ++t) {
      const Alarm alarm = s.step(t, -t * factor, 0).alarm;
      CHECK(alarm == (t >= 16 ? Alarm::collision : t >= 7 ? Alarm::contact : Alarm::none));
      CHECK(s.limit_nm[0] == 10 * factor && s.limit_nm[1] == 5);
    }
    s.alarm.acknowledge();
    CHECK(s.alarm.factors().collision[0] == factor);
  }
}

void a_bent_presliding_state_is_near_stiction_at_any_speed() {
  Limits limits = make_limits();
  CHECK(limits.near_stiction(0.01, 1.0) && !limits.near_stiction(0.03, 0.0));
  limits.region_width = 0;
  CHECK(!limits.near_stiction(0.03, -1.0) && limits.near_stiction(5.0, 0.5) && limits.near_stiction(0.01, 1.0));
}

void doubt_raises_both_limits() {
  Stage s;
  s.doubt[0] = 7;
  for (int t = 0; t < 20; ++t) CHECK(s.step(t, 16.9, 0).alarm == (t >= 2 ? Alarm::contact : Alarm::none));
  CHECK(s.limit_nm[0] == 17 && s.limit_nm[1] == 5);
}

// The ramp of the first test at limits that the motion triples: the same times at three times the torque.
void the_error_scale_multiplies_limits_and_not_the_doubt() {
  Stage s;
  s.scale[0] = 3;
  for (int t = 0; t <= 30; ++t) {
    const Alarm alarm = s.step(t, -3 * t, 0).alarm;
    CHECK(alarm == (t >= 16 ? Alarm::collision : t >= 7 ? Alarm::contact : Alarm::none));
    CHECK(s.limit_nm[0] == 30 && s.limit_nm[1] == 5);
  }
  s.doubt[0] = 7;
  s.step(31, 0, 0);
  CHECK(s.limit_nm[0] == 37);
}

// Joint 1 is pushed while stuck (limits 20 and 8) and reported at its usual limit. The friction left by the push exceeds
// that limit, but raises no alarm until the joint slides.
void limits_of_a_joint_that_was_pushed_while_stuck_are_raised_until_it_slides() {
  Stage s(2);
  for (int t = 0; t < 20; ++t) s.step(t, 25, 0, true, 0);
  CHECK(s.alarm.state().alarm == Alarm::collision && s.limit_nm[0] == 20);
  s.step(20, 0, 0, true, 0);
  CHECK(s.limit_nm[0] == 20);  // the sample that shows the end
  s.alarm.acknowledge();
  for (int t = 21; t < 60; ++t) CHECK(s.step(t, 15, 0, true, 0).alarm == Alarm::none);
  CHECK(s.limit_nm[0] == 40 && s.limit_nm[1] == 5);
  // A harder push is one; while it lasts the limit is the usual one, so that the alarm does not flicker.
  for (int t = 60; t < 70; ++t) s.step(t, 41, 0, true, 0);
  CHECK(s.alarm.state().alarm == Alarm::collision && s.limit_nm[0] == 20 && s.detection);
  s.step(70, 7, 0, true, 0);
  s.step(71, 7, 0, true, 0);
  CHECK(s.limit_nm[0] == 40);
  for (int t = 72; t < 571; ++t) s.step(t, 7, 0, true, 1.0);  // slides: what is left of r fades
  CHECK(s.limit_nm[0] == 20);
  s.step(571, 0, 0, true, 1.0);
  CHECK(s.limit_nm[0] == 10);
  s.step(572, 0, 0, true, 0);
  CHECK(s.limit_nm[0] == 20);  // at rest again, with modelled friction
}

void what_cannot_be_trusted_neither_raises_nor_ends_an_alarm() {
  Stage s;
  for (int t = 0; t < 100; ++t) CHECK(s.step(t, 50, 50, false).alarm == Alarm::none && !s.detection);
  for (int t = 100; t < 104; ++t) s.step(t, 5, 0);
  CHECK(s.alarm.state().alarm == Alarm::contact);
  for (int t = 104; t < 500; ++t) CHECK(s.step(t, NAN, NAN, false).alarm == Alarm::contact);
  for (int t = 500; t < 549; ++t) CHECK(s.step(t, 0, 0).alarm == Alarm::contact);  // 50 ms of evidence
  CHECK(s.step(549, 0, 0).alarm == Alarm::none);
}

void the_joint_furthest_over_its_limit_is_named() {
  Stage s;
  for (int t = 0; t < 10; ++t) s.step(t, 12, 9);
  CHECK(s.alarm.state().alarm == Alarm::collision && s.alarm.state().joint == 1);
}

void bad_limits_are_refused() {
  Limits limits = make_limits();
  CHECK_THROWS(AlarmStage(3, 0, limits), Error);
  limits.contact.near_stiction_nm[1] = 0;
  CHECK_THROWS(AlarmStage(2, 0, limits), Error);
  limits = make_limits();
  limits.collision.hold_s = NAN;
  CHECK_THROWS(AlarmStage(2, 0, limits), Error);
  limits = make_limits();
  limits.contact_release_s = 61;
  CHECK_THROWS(AlarmStage(2, 0, limits), Error);
  limits = make_limits();
  limits.after_contact_factor = 0.5;
  CHECK_THROWS(AlarmStage(2, 0, limits), Error);
  limits = make_limits();
  limits.region_width = 1;  // of one width, 0
  CHECK_THROWS(AlarmStage(2, 1, limits), Error);
}

}  // namespace

int main() {
  a_ramp_raises_contact_and_collision_after_their_hold_times();
  a_contact_falls_back_and_a_collision_does_not();
  alarms_are_numbered_and_their_touch_ends_as_a_contact_does();
  one_sample_under_the_limit_restarts_the_hold_time();
  a_joint_with_infinite_limits_raises_none();
  near_stiction_has_its_own_limits();
  factors_scale_the_torque_that_raises_an_alarm();
  a_bent_presliding_state_is_near_stiction_at_any_speed();
  doubt_raises_both_limits();
  the_error_scale_multiplies_limits_and_not_the_doubt();
  limits_of_a_joint_that_was_pushed_while_stuck_are_raised_until_it_slides();
  what_cannot_be_trusted_neither_raises_nor_ends_an_alarm();
  the_joint_furthest_over_its_limit_is_named();
  bad_limits_are_refused();
  return check::result();
}
