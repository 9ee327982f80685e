// The monitor in a 1 kHz control loop:   01_control_loop ARM.tauext [SECONDS]
//
// read the arm -> estimate() -> decide -> send the command -> advance() -> sleep until the next period.
// No arm is attached: a smooth sine of each joint stands in for it, so the torques mean nothing. The two places where
// your arm's own calls belong say YOUR ARM.
#include <sched.h>
#include <sys/mman.h>
#include <time.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "tauext/monitor.hpp"

namespace {

std::int64_t now_ns() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * 1'000'000'000LL + t.tv_nsec;
}

// A loop that may be preempted or whose memory may be paged out cannot promise anything; neither is fatal in a trial.
void ask_for_real_time() {
  sched_param priority{};
  priority.sched_priority = 80;
  if (sched_setscheduler(0, SCHED_FIFO, &priority) != 0) std::printf("no SCHED_FIFO: %s\n", std::strerror(errno));
  if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) std::printf("no mlockall: %s\n", std::strerror(errno));
}

void loop(const char* path, double seconds) {
  tauext::Monitor monitor(tauext::load_bundle(path));  // allocates; nothing below does
  const auto n = static_cast<std::size_t>(monitor.joints());
  const std::int64_t period_ns = monitor.sample_period_ns();
  const auto cycles = static_cast<std::size_t>(std::ceil(seconds * 1e9 / static_cast<double>(period_ns)));
  std::vector<double> q(n), dq(n), tau(n), latency_us(cycles);
  std::size_t missed = 0, stops = 0, clear = 0;
  for (int j = 0; j < monitor.joints(); ++j)  // a controller refuses here what its arm does not send
    std::printf("%s: tau in %s\n", monitor.joint_name(j).c_str(), monitor.torque_unit(j).c_str());
  ask_for_real_time();

  const std::int64_t start_ns = now_ns();
  for (std::size_t k = 0; k < cycles; ++k) {
    const std::int64_t due_ns = start_ns + static_cast<std::int64_t>(k) * period_ns;
    const timespec due{due_ns / 1'000'000'000, due_ns % 1'000'000'000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr);  // absolute, so that delays do not add up

    // YOUR ARM: read q [rad], dq [rad/s], tau in monitor.torque_unit(j) and the time at which they were measured.
    for (std::size_t j = 0; j < n; ++j) {
      const double speed = 1.0 + 0.3 * static_cast<double>(j), t = 1e-9 * static_cast<double>(due_ns - start_ns);
      q[j] = 0.5 * std::sin(speed * t);
      dq[j] = 0.5 * speed * std::cos(speed * t);
      tau[j] = 2.0 * dq[j];
    }
    const std::int64_t before_ns = now_ns();
    const tauext::Estimate& e = monitor.estimate({due_ns, q, dq, tau});
    latency_us[k] = 1e-3 * static_cast<double>(now_ns() - before_ns);

    // Only clear() means "no collision": warming up, stale and fault say that nobody knows, and then the arm moves at
    // most as slowly as it would without a monitor. A collision stops it whatever the health.
    const bool stop = e.alarm == tauext::Alarm::collision || e.health == tauext::Health::fault;
    // YOUR ARM: send the command: a stop where `stop`, the planned one where e.clear(), else a slow one.
    stops += stop;
    clear += e.clear();

    monitor.advance();  // the part of the work that the command need not wait for
    missed += now_ns() > due_ns + period_ns;
  }
  std::sort(latency_us.begin(), latency_us.end());
  std::printf("%zu cycles, %zu deadlines missed; estimate(): median %.2f us, worst %.2f us\n", cycles, missed,
              latency_us[cycles / 2], latency_us.back());
  std::printf("clear in %zu cycles, stop in %zu; at the end health is %s, alarm %s\n", clear, stops,
              tauext::name(monitor.last().health), tauext::name(monitor.last().alarm));
}

}  // namespace

int main(int argc, char** argv) {
  const double seconds = argc > 2 ? std::atof(argv[2]) : 10.0;
  if (argc < 2 || argc > 3 || !(seconds > 0 && seconds <= 86400)) {
    std::fprintf(stderr, "usage: 01_control_loop ARM.tauext [SECONDS, up to 86400]\n");
    return 2;
  }
  try {
    loop(argv[1], seconds);
  } catch (const std::exception& e) {  // a bundle that is missing or damaged
    std::fprintf(stderr, "%s\n", e.what());
    return 2;
  }
}
