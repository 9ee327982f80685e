#include "tauext/flight_recorder.hpp"

#include <cmath>
#include <thread>

#include "check.hpp"
#include "made_bundle.hpp"

using namespace tauext;

namespace {

constexpr std::int64_t kMs = 1'000'000;

// Sample k: every value identifies its sample.
struct Source {
  double q[2], dq[2], tau[2];
  Estimate e;

  Sample at(std::int64_t k, Alarm alarm = Alarm::none, Health health = Health::ok) {
    const auto x = static_cast<double>(k);
    for (int j = 0; j < 2; ++j) {
      q[j] = x + 0.1 * j, dq[j] = -x, tau[j] = 2 * x;
      e.residual[j] = 3 * x, e.network[j] = 4 * x, e.tau_ext[j] = 5 * x, e.limit_nm[j] = 6 * x, e.contact_limit_nm[j] = 8 * x;
      e.sigma_nm[j] = 7 * x + 0.1 * j;
    }
    e.joints = 2;
    e.t_ns = k * kMs;
    e.alarm = alarm;
    e.health = health;
    e.causes = static_cast<std::uint32_t>(k);
    e.load = {x, {0, x, 0}, {}, 0.5};
    return {k * kMs, q, dq, tau};
  }
};

void check_rows(const Flight& f, std::int64_t first, std::int64_t last) {
  CHECK(f.t_ns.size() == static_cast<std::size_t>(last - first + 1));
  for (std::size_t row = 0; row < f.t_ns.size(); ++row) {
    const auto k = static_cast<double>(first + static_cast<std::int64_t>(row));
    CHECK(f.t_ns[row] == (first + static_cast<std::int64_t>(row)) * kMs);
    CHECK(f.q[2 * row + 1] == k + 0.1 && f.dq[2 * row] == -k && f.tau[2 * row + 1] == 2 * k);
    CHECK(f.residual[2 * row] == 3 * k && f.network[2 * row + 1] == 4 * k && f.tau_ext[2 * row] == 5 * k);
    CHECK(f.contact_limit_nm[2 * row + 1] == 8 * k && f.limit_nm[2 * row + 1] == 6 * k && f.sigma_nm[2 * row + 1] == 7 * k + 0.1);
    CHECK(f.causes[row] == static_cast<std::uint32_t>(k));
    CHECK(f.load[row] == Load({k, {0, k, 0}, {}, 0.5}));
  }
}

void a_flight_holds_what_was_before_and_after_its_event() {
  FlightRecorder recorder(2, kMs, {0.05, 0.02, false});
  Source s;
  Flight f;
  const auto push = [&](std::int64_t k, Alarm alarm = Alarm::none, Health health = Health::ok) {
    const Sample sample = s.at(k, alarm, health);
    recorder.push(sample, s.e);
  };
  for (int k = 0; k < 200; ++k) push(k, k >= 150 ? Alarm::contact : Alarm::none);
  CHECK(recorder.events() == 0 && !recorder.take(f));  // contacts were not asked for
  for (int k = 200; k < 219; ++k) push(k, Alarm::collision);
  CHECK(recorder.events() == 1 && !recorder.take(f));
  push(219, Alarm::collision);
  push(220, Alarm::collision);
  CHECK(recorder.take(f));
  CHECK(f.event_row == 50 && f.event.t_ns == 200 * kMs);
  check_rows(f, 150, 220);
  CHECK(!recorder.take(f));
  // A second event soon after: the other ring holds only what came since.
  push(221, Alarm::collision, Health::fault);
  push(222, Alarm::collision, Health::fault);
  CHECK(recorder.finish());
  CHECK(recorder.take(f) && recorder.events() == 2 && recorder.missed() == 0);
  CHECK(f.event_row == 0);
  check_rows(f, 221, 222);
}

void an_unread_flight_blocks_nothing_and_is_counted() {
  FlightRecorder recorder(2, kMs, {0.01, 0.01, true});
  Source s;
  Flight f;
  for (int k = 0; k < 1000; ++k) {
    const Sample sample = s.at(k, k % 100 < 50 ? Alarm::none : Alarm::contact);
    recorder.push(sample, s.e);
  }
  CHECK(recorder.events() == 10 && recorder.missed() == 9);
  CHECK(recorder.take(f));
  check_rows(f, 40, 60);  // the first one
}

void a_collision_that_rises_again_at_once_is_another_event() {
  FlightRecorder recorder(2, kMs, {0.01, 0, false});
  Source s;
  Flight f;
  for (int k = 0; k < 20; ++k) {
    const Sample sample = s.at(k, k < 10 ? Alarm::none : Alarm::collision);
    s.e.alarm_t_ns = (k < 15 ? 10 : 15) * kMs;  // acknowledged after sample 14, and there again at 15
    recorder.push(sample, s.e);
    CHECK(recorder.take(f) == (k == 10 || k == 15));
  }
  CHECK(recorder.events() == 2);
}

void a_sample_of_another_size_is_kept_as_nan() {
  FlightRecorder recorder(2, kMs, {0.01, 0, false});
  Source s;
  Flight f;
  Sample sample = s.at(1, Alarm::none, Health::fault);
  sample.q = sample.q.first(1);
  recorder.push(sample, s.e);
  CHECK(recorder.take(f) && std::isnan(f.q[0]) && std::isnan(f.q[1]) && f.tau[0] == 2);
}

// One thread pushes, another takes; every flight that arrives is whole. Under the thread sanitizer this is the proof.
void two_threads_hand_flights_over() {
  FlightRecorder recorder(2, kMs, {0.02, 0.005, false});
  std::atomic<bool> done{false};
  int taken = 0;
  std::jthread writer([&] {
    Flight f;
    while (!done.load()) {
      if (!recorder.take(f)) continue;
      ++taken;
      check_rows(f, f.t_ns.front() / kMs, f.t_ns.back() / kMs);
      CHECK(f.alarm[static_cast<std::size_t>(f.event_row)] == 2);
    }
    if (recorder.take(f)) ++taken;
  });
  Source s;
  for (int k = 0; k < 200'000; ++k) {
    const Sample sample = s.at(k, k % 50 < 25 ? Alarm::none : Alarm::collision);
    recorder.push(sample, s.e);
  }
  done = true;
  writer.join();
  CHECK(taken > 0 && recorder.events() == 4000);
  std::printf("%d flights taken, %llu given up\n", taken, static_cast<unsigned long long>(recorder.missed()));
}

void bad_settings_are_refused() {
  CHECK_THROWS(FlightRecorder(0, kMs, {}), Error);
  CHECK_THROWS(FlightRecorder(2, 0, {}), Error);
  CHECK_THROWS(FlightRecorder(2, kMs, {-1, 1, false}), Error);
  CHECK_THROWS(FlightRecorder(2, kMs, {1, 601, false}), Error);
  CHECK_THROWS(FlightRecorder(2, kMs, {NAN, 1, false}), Error);
}

}  // namespace

int main() {
  a_flight_holds_what_was_before_and_after_its_event();
  an_unread_flight_blocks_nothing_and_is_counted();
  a_collision_that_rises_again_at_once_is_another_event();
  a_sample_of_another_size_is_kept_as_nan();
  two_threads_hand_flights_over();
  bad_settings_are_refused();
  return check::result();
}
