// What a load costs: time of a sample with one set, without, and while it is weighed, in turns, of setting it since an
// earlier time, and of saying what was weighed; one JSON object on stdout.
//   load_bench [joints 7] [steps 200000] [bundle -]
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "../tests/made_bundle.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;

namespace {

std::int64_t now_ns() noexcept {
  using namespace std::chrono;
  return duration_cast<nanoseconds>(steady_clock::now().time_since_epoch()).count();
}

struct Times {
  std::vector<std::int64_t> ns;
  std::int64_t at(double share) {
    std::sort(ns.begin(), ns.end());
    return ns[static_cast<std::size_t>(share * static_cast<double>(ns.size() - 1))];
  }
};

// Estimates and what follows them of one of the two monitors.
struct Turn {
  Monitor monitor;
  Times estimate, advance;
  explicit Turn(const Bundle& b) : monitor(b) {}
  void step(const Sample& sample) {
    const std::int64_t start = now_ns();
    monitor.estimate(sample);
    const std::int64_t middle = now_ns();
    monitor.advance();
    estimate.ns.push_back(middle - start);
    advance.ns.push_back(now_ns() - middle);
  }
};

void measure(const Bundle& b, int steps) {
  Turn without(b), with(b), weighing(b);
  const Load load{std::min(0.5 * b.load.largest_mass_kg, 2.0), {0.02, 0.01, 0.05}, {}};
  if (!with.monitor.set_load(load)) throw Error(with.monitor.why_no_load(load));
  if (!weighing.monitor.start_weighing()) throw Error(weighing.monitor.why_no_weighing());
  const int joints = b.joints();
  const auto n = static_cast<std::size_t>(joints);
  double q[kMaxJoints], dq[kMaxJoints], tau[kMaxJoints];
  for (Turn* turn : {&without, &with, &weighing})
    for (Times* times : {&turn->estimate, &turn->advance}) times->ns.reserve(static_cast<std::size_t>(steps));
  Times whole, now, found;
  const std::int64_t period_ns = b.observer.sample_period_ns;
  for (int k = 0; k < steps; ++k) {
    const std::int64_t t_ns = k * period_ns;
    made::signal(t_ns / made::kPeriodNs, joints, q, dq, tau);
    const Sample sample{t_ns, {q, n}, {dq, n}, {tau, n}};
    Turn *first = &without, *second = &with;
    if (k % 2) std::swap(first, second);
    first->step(sample), second->step(sample), weighing.step(sample);
    if (k % 2000 == 1999) {
      const std::int64_t start = now_ns();
      if (std::isnan(weighing.monitor.estimate_load().misfit)) throw Error("no load was weighed");
      found.ns.push_back(now_ns() - start);
    }
    if (k % 2000 == 1999) {  // the load it has: what it computes stays the same
      const std::int64_t start = now_ns();
      with.monitor.set_load(load, 0);
      const std::int64_t middle = now_ns();
      with.monitor.set_load(load);
      whole.ns.push_back(middle - start), now.ns.push_back(now_ns() - middle);
    }
  }
  std::printf("{\"joints\": %d, \"steps\": %d, \"terms\": %zu, \"hidden\": %d, ", joints, steps, b.prior.terms.size(),
              b.shape.hidden);
  for (const auto& [name, turn] : {std::pair("without", &without), {"with", &with}, {"weighing", &weighing}})
    std::printf("\"%s\": {\"estimate_p50_ns\": %lld, \"estimate_p99_ns\": %lld, \"advance_p50_ns\": %lld, "
                "\"advance_p99_ns\": %lld}, ",
                name, static_cast<long long>(turn->estimate.at(0.5)), static_cast<long long>(turn->estimate.at(0.99)),
                static_cast<long long>(turn->advance.at(0.5)), static_cast<long long>(turn->advance.at(0.99)));
  std::printf("\"estimate_load_us\": %.1f, ", 1e-3 * static_cast<double>(found.at(0.5)));
  const auto p50 = [](Turn& turn) { return static_cast<double>(turn.estimate.at(0.5)); };
  std::printf("\"ratio_of_p50\": %.3f, ", p50(with) / p50(without));
  std::printf("\"set_since_10_over_k0_us\": {\"p50\": %.1f, \"max\": %.1f}, ", 1e-3 * static_cast<double>(whole.at(0.5)),
              1e-3 * static_cast<double>(whole.at(1.0)));
  std::printf("\"set_from_now_us\": {\"p50\": %.2f, \"max\": %.1f}, \"state_bytes\": %zu}\n",
              1e-3 * static_cast<double>(now.at(0.5)), 1e-3 * static_cast<double>(now.at(1.0)), with.monitor.state_bytes());
}

}  // namespace

int main(int argc, char** argv) {
  try {
    const int joints = argc > 1 ? std::atoi(argv[1]) : 7, steps = argc > 2 ? std::atoi(argv[2]) : 200'000;
    if (joints < 1 || joints > kMaxJoints || steps < 2000 || steps > 10'000'000)
      throw Error("usage: load_bench [joints 1 to 32] [steps 2000 to 1e7] [bundle -]");
    const std::string path = argc > 3 ? argv[3] : "-";
    measure(path == "-" ? made::bundle(joints, 20, 100, 10, 1) : load_bundle(path), steps);
  } catch (const Error& e) {
    std::fprintf(stderr, "load_bench: %s\n", e.what());
    return 1;
  }
}
