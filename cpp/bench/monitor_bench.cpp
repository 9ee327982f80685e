// Time per sample of the monitor, its network alone and a paced loop; one JSON object on stdout.
//   monitor_bench [joints 2] [steps 1000000] [paced_s 10] [bundle -] [motion -]
#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>
#endif

#include "../tests/made_bundle.hpp"
#include "network/lstm_lanes.hpp"
#include "network/sliding_lstm.hpp"
#include "tauext/monitor.hpp"

using namespace tauext;

namespace {

constexpr char kUsage[] =
    "usage: monitor_bench [joints 2] [steps 1000000] [paced_s 10] [bundle -] [motion -]\n"
    "\n"
    "Prints one JSON object: p50, p99, p99.9 and maximum [ns] of what a sample takes.\n"
    "  joints   1 to 32; with a bundle, the bundle's\n"
    "  steps    samples back to back, after the warm-up\n"
    "  paced_s  seconds of a loop that sleeps until each sample is due; 0: none\n"
    "  bundle   a file; -: made here, H = 20, windows of 100 steps of 10 samples at 1 kHz\n"
    "  motion   float64 rows q, dq, tau of the arm in free motion, at the bundle's sample period; -: sines. With it, the\n"
    "           monitor is also timed while it weighs, expects a load, and during a contact\n";

constexpr int kHidden = 20, kWindowSteps = 100, kStride = 10;
constexpr std::int64_t kWarmUpSamples = 10'000;  // beyond health ok
constexpr int kPriority = 80;                    // of SCHED_FIFO: under the kernel's own threads that must run

std::int64_t now_ns() noexcept {
  using namespace std::chrono;
  return duration_cast<nanoseconds>(steady_clock::now().time_since_epoch()).count();
}

[[gnu::format(printf, 1, 2)]] std::string format(const char* pattern, ...) {
  char text[512];
  va_list values;
  va_start(values, pattern);
  std::vsnprintf(text, sizeof text, pattern, values);
  va_end(values);
  return text;
}

// Real-time settings that the operating system permits. Only existing pages are locked: with MCL_FUTURE and a small limit
// the next allocation would fail.
struct RealTime {
  int core = -1;
  bool locked = true, fifo = false;

  RealTime() {
#if defined(__linux__)
    cpu_set_t allowed, one;
    CPU_ZERO(&one);
    if (sched_getaffinity(0, sizeof allowed, &allowed) == 0)
      for (int cpu = 0; cpu < CPU_SETSIZE; ++cpu)
        if (CPU_ISSET(cpu, &allowed)) core = cpu;
    if (core >= 0) CPU_SET(core, &one);
    if (core >= 0 && sched_setaffinity(0, sizeof one, &one) != 0) core = -1;
    sched_param priority{};
    priority.sched_priority = kPriority;
    fifo = sched_setscheduler(0, SCHED_FIFO, &priority) == 0;
    prctl(PR_SET_TIMERSLACK, 1UL);  // without FIFO the kernel may wake a sleeper 50 us late, to save power
#endif
  }
  void lock_memory() noexcept {
#if defined(__linux__)
    locked = mlockall(MCL_CURRENT) == 0 && locked;
#else
    locked = false;
#endif
  }
};

void sleep_until(std::int64_t t_ns) noexcept {
#if defined(__linux__)
  const timespec until{static_cast<time_t>(t_ns / 1'000'000'000), static_cast<long>(t_ns % 1'000'000'000)};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr) == EINTR) {
  }
#else
  std::this_thread::sleep_until(std::chrono::steady_clock::time_point(std::chrono::nanoseconds(t_ns)));
#endif
}

// The kernel stops a FIFO thread that never sleeps for 50 ms in every second, and others want the core as well.
class Breath {
 public:
  void take(std::int64_t t_ns) noexcept {
    if (t_ns < next_ns_) return;
    if (next_ns_ != 0) sleep_until(t_ns + 5'000'000);
    next_ns_ = now_ns() + 50'000'000;
  }

 private:
  std::int64_t next_ns_ = 0;
};

// A time a sample; all memory is there, and touched, beforehand.
class Times {
 public:
  explicit Times(std::int64_t capacity) : ns_(static_cast<std::size_t>(capacity), 1) {}
  void clear() noexcept { count_ = 0; }
  void add(std::int64_t ns) noexcept {
    constexpr std::int64_t most = std::numeric_limits<std::uint32_t>::max();
    ns_[count_++] = static_cast<std::uint32_t>(std::clamp<std::int64_t>(ns, 0, most));
  }
  std::string json(std::int64_t deadline_ns) {
    const auto end = ns_.begin() + static_cast<std::ptrdiff_t>(count_);
    std::sort(ns_.begin(), end);
    if (count_ == 0) return "null";
    double sum = 0;
    for (auto at = ns_.begin(); at != end; ++at) sum += *at;
    const auto quantile = [&](double p) {
      const auto rank = static_cast<std::size_t>(std::ceil(p * static_cast<double>(count_)));
      return static_cast<unsigned>(ns_[std::max<std::size_t>(rank, 1) - 1]);
    };
    const auto late = end - std::upper_bound(ns_.begin(), end, static_cast<std::uint32_t>(deadline_ns));
    return format("{\"count\": %zu, \"mean_ns\": %.1f, \"p50_ns\": %u, \"p99_ns\": %u, \"p99_9_ns\": %u, "
                  "\"max_ns\": %u, \"over_deadline\": %td}",
                  count_, sum / static_cast<double>(count_), quantile(0.5), quantile(0.99), quantile(0.999),
                  static_cast<unsigned>(ns_[count_ - 1]), late);
  }

 private:
  std::vector<std::uint32_t> ns_;
  std::size_t count_ = 0;
};

// The answer, what follows it, and both from the first reading of the clock to the last.
struct Parts {
  Times answer, rest, both;
  explicit Parts(std::int64_t capacity) : answer(capacity), rest(capacity), both(capacity) {}
  void clear() noexcept { answer.clear(), rest.clear(), both.clear(); }
  void add(std::int64_t start, std::int64_t middle, std::int64_t end) noexcept {
    answer.add(middle - start), rest.add(end - middle), both.add(end - start);
  }
  std::string json(const char* answer_name, std::int64_t deadline_ns) {
    return format("\"%s\": ", answer_name) + answer.json(deadline_ns) + ", \"advance\": " + rest.json(deadline_ns) +
           ", \"both\": " + both.json(deadline_ns);
  }
};

// Rows q, dq, tau of the arm in free motion.
struct Recorded {
  std::vector<double> values;
  std::int64_t rows = 0;
  Recorded(const Bundle& b, const std::string& path) {
    std::FILE* file = std::fopen(path.c_str(), "rb");
    if (!file) throw Error(path + ": cannot be opened");
    std::vector<double> block(1 << 16);
    for (std::size_t got; (got = std::fread(block.data(), sizeof(double), block.size(), file)) > 0;)
      values.insert(values.end(), block.begin(), block.begin() + static_cast<std::ptrdiff_t>(got));
    std::fclose(file);
    const std::size_t width = 3 * b.links.size();
    if (values.empty() || values.size() % width != 0)
      throw Error(path + ": must have rows of " + std::to_string(width) + " float64");
    rows = static_cast<std::int64_t>(values.size() / width);
  }
};

// Sines, or recorded rows again and again. A pause between two rounds restarts the monitor without a fault.
struct Motion {
  static constexpr std::int64_t kPauseNs = 10'000'000'000;
  JointVector q{}, dq{}, tau{};
  int joints;
  std::int64_t period_ns;
  double push_nm = 0;  // added to the torque of the first joint
  const Recorded* recorded;
  Motion(const Bundle& b, const Recorded* from) : joints(b.joints()), period_ns(b.observer.sample_period_ns), recorded(from) {}
  Sample at(std::int64_t k) noexcept {
    std::int64_t round = 0;
    const auto n = static_cast<std::size_t>(joints);
    if (recorded) {
      round = k / recorded->rows;
      const double* row = recorded->values.data() + static_cast<std::size_t>(k % recorded->rows) * 3 * n;
      std::copy_n(row, n, q.begin()), std::copy_n(row + n, n, dq.begin()), std::copy_n(row + 2 * n, n, tau.begin());
    } else {
      made::signal(k, joints, q.data(), dq.data(), tau.data());
    }
    tau[0] += push_nm;
    return {k * period_ns + round * kPauseNs, std::span(q).first(n), std::span(dq).first(n), std::span(tau).first(n)};
  }
  void row(std::int64_t k, const std::vector<float>& factors, float* to) noexcept {
    at(k);
    for (int j = 0; j < joints; ++j) {
      to[j] = static_cast<float>(q[j]) * factors[j];
      to[joints + j] = static_cast<float>(dq[j]) * factors[joints + j];
    }
    for (std::size_t c = 2 * static_cast<std::size_t>(joints); c < factors.size(); ++c)  // presliding states
      to[c] = 0.5f * factors[c];
  }
};

// The next sample's number, once health is ok and kWarmUpSamples are through.
std::int64_t warm_up(Monitor& monitor, Motion& motion, const Bundle& b) {
  const double observer_samples = 20.0 / b.observer.gain_per_s * 1e9 / static_cast<double>(b.observer.sample_period_ns);
  const std::int64_t limit = 2 * static_cast<std::int64_t>(b.window_steps + 1) * b.observer.network_stride +
                             static_cast<std::int64_t>(observer_samples) + 10'000;
  std::int64_t k = 0;
  while (monitor.last().health != Health::ok && k < limit) monitor.step(motion.at(k++));
  if (monitor.last().health != Health::ok) {
    std::string causes;
    for (std::uint32_t cause = 0; cause < kCauseCount; ++cause)
      if (monitor.last().causes >> cause & 1) causes += std::string(" ") + name(static_cast<Cause>(1u << cause)) + ",";
    throw Error("after " + std::to_string(k) + " samples the monitor says: " + name(monitor.last().health) + causes +
                " and nothing can be measured");
  }
  for (const std::int64_t end = k + kWarmUpSamples; k < end; ++k) monitor.step(motion.at(k));
  return k;
}

struct Stepped {
  std::int64_t start_ns, end_ns;
  bool ok;
};

// A sample, its two parts timed apart; only_ok: not added unless its health is ok.
Stepped timed_step(Monitor& monitor, const Sample& sample, Parts& parts, bool only_ok = false) {
  const std::int64_t start = now_ns();
  const Estimate& estimate = monitor.estimate(sample);
  const std::int64_t middle = now_ns();
  monitor.advance();
  const std::int64_t end = now_ns();
  const bool ok = estimate.health == Health::ok;
  if (ok || !only_ok) parts.add(start, middle, end);
  return {start, end, ok};
}

// What goes on while a monitor is timed.
enum class During { free_motion, weighing, expecting, contact };
constexpr double kPushLimits = 3;  // a contact's torque, in the limits of the first joint in free motion

void keep_up(Monitor& monitor, During during) {
  if (during == During::weighing && !monitor.weighing() && !monitor.start_weighing())
    throw Error(monitor.why_no_weighing());
  if (during == During::expecting && monitor.last().load_phase == LoadPhase::none && !monitor.expect_load(60, 1))
    throw Error(monitor.why_not_expected(60, 1));
}

// Samples whose health is ok are timed; sines have no others.
std::string monitor_part(const Bundle& b, const Recorded* recorded, During during, std::int64_t steps, RealTime& real_time,
                         Parts& parts) {
  Monitor monitor(b);
  Motion motion(b, recorded);
  Breath breath;
  parts.clear();
  real_time.lock_memory();
  std::int64_t k = warm_up(monitor, motion, b), not_ok = 0;
  if (during == During::contact) motion.push_nm = kPushLimits * monitor.last().limit_nm[0];
  for (std::int64_t timed = 0; timed < steps; ++k) {
    keep_up(monitor, during);
    const Sample sample = motion.at(k);
    const Stepped one = timed_step(monitor, sample, parts, recorded != nullptr);
    timed += one.ok || !recorded;
    not_ok += !one.ok;
    if (not_ok > 2 * steps + kWarmUpSamples) throw Error("the health is hardly ever ok in this motion");
    breath.take(one.end_ns);
  }
  return "{" + parts.json("estimate", motion.period_ns) + format(", \"samples_not_ok\": %lld}", (long long)not_ok);
}

std::string network_part(const Bundle& b, std::int64_t steps, RealTime& real_time, Parts& parts) {
  if (!b.has_network()) return "null";
  SlidingLstm network(b.shape, b.parameters, b.inputs, b.columns(), b.observer.network_stride, b.window_steps,
                      NetworkRate::every_sample);
  Motion motion(b, nullptr);
  Breath breath;
  std::vector<float> row(static_cast<std::size_t>(b.columns())), out(b.links.size());
  parts.clear();
  real_time.lock_memory();
  std::int64_t k = 0;
  bool answered = false;
  for (std::int64_t left = kWarmUpSamples; left > 0; left -= answered) {
    motion.row(k++, b.input_factors, row.data());
    network.push(row, 1);
    answered = network.answer(out);
    network.advance();
  }
  for (const std::int64_t last = k + steps; k < last; ++k) {
    motion.row(k, b.input_factors, row.data());
    const std::int64_t start = now_ns();
    network.push(row, 1);
    network.answer(out);
    const std::int64_t middle = now_ns();
    network.advance();
    const std::int64_t end = now_ns();
    parts.add(start, middle, end);
    breath.take(end);
  }
  return "{" + parts.json("answer", motion.period_ns) + "}";
}

// As in a control loop: between two samples the core sleeps or does other work, and caches grow cold. A tick that has
// passed when the step ends is left out, and the loop goes on at the next.
std::string paced_part(const Bundle& b, const Recorded* recorded, double paced_s, RealTime& real_time, Parts& parts) {
  if (paced_s <= 0) return "null";
  Monitor monitor(b);
  Motion motion(b, recorded);
  const double periods = paced_s * 1e9 / static_cast<double>(motion.period_ns);
  const std::int64_t ticks = std::max<std::int64_t>(1, std::llround(periods));
  Times lateness(ticks);
  parts.clear();
  real_time.lock_memory();
  std::int64_t k = warm_up(monitor, motion, b), missed = 0, left_out = 0, not_ok = 0;
  std::int64_t due = now_ns() + motion.period_ns;
  for (const std::int64_t last = k + ticks; k < last;) {
    const Sample sample = motion.at(k);
    sleep_until(due);
    const auto [start, end, ok] = timed_step(monitor, sample, parts, recorded != nullptr);
    lateness.add(start - due);
    not_ok += !ok;
    missed += end > due + motion.period_ns;
    for (due += motion.period_ns, ++k; due < end; due += motion.period_ns, ++k) ++left_out;
  }
  return format("{\"seconds\": %.3f, ", paced_s) + parts.json("estimate", motion.period_ns) +
         ", \"wake_up_lateness\": " + lateness.json(motion.period_ns) +
         format(", \"missed_deadlines\": %lld, \"ticks_left_out\": %lld, \"samples_not_ok\": %lld}",
                (long long)missed, (long long)left_out, (long long)not_ok);
}

std::string sizes(const Bundle& b) {
  return format("\"joints\": %d, \"inputs\": %d, \"hidden\": %d, \"outputs\": %d, \"window_steps\": %d, "
                "\"stride\": %d, \"sample_period_ns\": %lld",
                b.joints(), b.shape.inputs, b.shape.hidden, b.shape.outputs, b.window_steps, b.observer.network_stride,
                (long long)b.observer.sample_period_ns);
}

double number(const char* what, const char* text, double least, double largest) {
  char* end = nullptr;
  const double value = std::strtod(text, &end);
  if (end == text || *end != 0 || !(value >= least && value <= largest))
    throw Error(std::string(what) + " = " + text + " must be a number from " + format("%g to %g", least, largest));
  return value;
}

void measure(const Bundle& b, const Recorded* recorded, std::int64_t steps, double paced_s) {
  const double ticks = paced_s * 1e9 / static_cast<double>(b.observer.sample_period_ns);
  Parts parts(std::max(steps, static_cast<std::int64_t>(ticks) + 1));
  RealTime real_time;
  std::string json = "{" + sizes(b);
  json += format(", \"lanes\": %d, \"steps\": %lld", lanes::lane_count(), (long long)steps);
  const auto monitor_in = [&](During during) { return monitor_part(b, recorded, during, steps, real_time, parts); };
  json += ", \"monitor\": " + monitor_in(During::free_motion);
  if (recorded) {
    json += ", \"contact\": " + monitor_in(During::contact);
    const Monitor able(b);
    json += ", \"weighing\": " + (able.can_weigh() ? monitor_in(During::weighing) : "null");
    json += ", \"expecting\": " + (able.why_not_expected(60, 1).empty() ? monitor_in(During::expecting) : "null");
  }
  json += ", \"network\": " + network_part(b, steps, real_time, parts);
  json += ", \"paced\": " + paced_part(b, recorded, paced_s, real_time, parts);
  json += format(", \"core\": %d, \"memory_locked\": %s, \"fifo\": %s}", real_time.core,
                 real_time.locked ? "true" : "false", real_time.fifo ? "true" : "false");
  std::puts(json.c_str());
}

}  // namespace

int main(int argc, char** argv) {
  const auto argument = [&](int at, const char* otherwise) { return argc > at ? argv[at] : otherwise; };
  try {
    if (argc > 6) throw Error("too many arguments");
    const auto steps = static_cast<std::int64_t>(number("steps", argument(2, "1000000"), 1, 1e9));
    const double paced_s = number("paced_s", argument(3, "10"), 0, 3600);
    const char *path = argument(4, "-"), *motion = argument(5, "-");
    const int joints = static_cast<int>(number("joints", argument(1, "2"), 1, kMaxJoints));
    const bool made_here = std::string_view(path) == "-";
    const Bundle bundle = made_here ? made::bundle(joints, kHidden, kWindowSteps, kStride, 1) : load_bundle(path);
    std::optional<Recorded> recorded;
    if (std::string_view(motion) != "-") recorded.emplace(bundle, motion);
    measure(bundle, recorded ? &*recorded : nullptr, steps, paced_s);
  } catch (const std::exception& e) {
    std::fprintf(stderr, "monitor_bench: %s\n\n%s", e.what(), kUsage);
    return 2;
  }
  return 0;
}
