// A monitor after many hours beside a fresh one: same answers, same memory, no allocation. Exit status 1 where not.
//   monitor_soak [hours 24] [joints 2] [seed 1]
#include <algorithm>
#include <array>
#include <bit>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <new>
#include <random>
#include <string>
#include <vector>

#if defined(__linux__)
#include <fcntl.h>
#include <unistd.h>
#endif

#include "made_bundle.hpp"
#include "tauext/monitor.hpp"

// Every allocation is counted. With glibc at malloc and its relatives, where operator new and the network's aligned
// buffers both end; elsewhere, and under a sanitizer, which has a malloc of its own, at operator new alone.
static std::uint64_t allocations = 0;  // one thread
#if defined(__GLIBC__) && !defined(__SANITIZE_ADDRESS__)
extern "C" {
void* __libc_malloc(std::size_t);
void* __libc_calloc(std::size_t, std::size_t);
void* __libc_realloc(void*, std::size_t);
void* __libc_memalign(std::size_t, std::size_t);
void* malloc(std::size_t size) noexcept { return ++allocations, __libc_malloc(size); }
void* calloc(std::size_t count, std::size_t size) noexcept { return ++allocations, __libc_calloc(count, size); }
void* realloc(void* memory, std::size_t size) noexcept { return ++allocations, __libc_realloc(memory, size); }
void* aligned_alloc(std::size_t to, std::size_t size) noexcept { return ++allocations, __libc_memalign(to, size); }
}
#else
void* operator new(std::size_t size) {
  ++allocations;
  if (void* memory = std::malloc(size ? size : 1)) return memory;
  throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }
#endif

using namespace tauext;

namespace {

constexpr char kUsage[] =
    "usage: monitor_soak [hours 24] [joints 2] [seed 1]\n"
    "\n"
    "Feeds simulated hours of 1 kHz samples to one monitor at full speed, with jittering stamps, gaps, values that\n"
    "are not finite and one collision, the last ten minutes without; then compares with a monitor that saw only the\n"
    "last three. Status 1 where something differs.\n"
    "  hours   0.2 to 10000; 24 take about four minutes\n"
    "  joints  1 to 32\n"
    "  seed    of what happens, and when\n";

constexpr std::int64_t kSecond = 1000, kMinute = 60 * kSecond, kHour = 60 * kMinute;  // samples
constexpr std::int64_t kCalm = 10 * kMinute, kFresh = 3 * kMinute, kCompared = kMinute;
constexpr std::int64_t kStartNs = 1'700'000'000'000'000'000;  // stamps as of a clock of today, where doubles are coarse
constexpr std::int64_t kBatch = 1000;
constexpr double kResidualToleranceNm = 1e-9;
constexpr long kResidentTolerance = 64 << 10;
// Few units: a day takes four minutes, where 20 take a quarter of an hour, and what a network remembers is of the same kind.
constexpr int kHidden = 4, kWindowSteps = 100, kStride = 10;

double seconds_since(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

// Resident bytes without those of files: pages of the program come in when first used, which is no growth. -1: unknown.
long resident_bytes() {
#if defined(__linux__)
  char text[128] = {};
  const int file = open("/proc/self/statm", O_RDONLY);
  const auto length = file < 0 ? -1 : read(file, text, sizeof text - 1);
  if (file >= 0) close(file);
  long size, resident, shared;
  if (length > 0 && std::sscanf(text, "%ld %ld %ld", &size, &resident, &shared) == 3)
    return (resident - shared) * sysconf(_SC_PAGESIZE);
#endif
  return -1;
}

enum class Event { jitter, short_gap, long_gap, not_finite, collision };
constexpr int kEventCount = 5;

// The samples, and what goes wrong with them before `calm_from`.
class Feed {
 public:
  struct Batch {
    std::int64_t count = 0;
    std::vector<std::int64_t> k, t_ns;
    std::vector<double> q, dq, tau;  // (kBatch, joints)
    std::vector<std::uint8_t> acknowledge;  // before this sample
  };
  struct Counts {
    std::array<std::int64_t, kEventCount> events{};
    std::int64_t samples = 0, not_finite = 0, missing_in_short_gaps = 0;
  };

  Feed(int joints, std::int64_t first, std::int64_t last, std::int64_t calm_from, double push_nm, std::uint64_t seed)
      : joints_(joints), k_(first), last_(last), calm_from_(calm_from), push_nm_(push_nm), random_(seed) {
    batch_.k.resize(kBatch);
    batch_.t_ns.resize(kBatch);
    batch_.q.resize(static_cast<std::size_t>(kBatch) * joints);
    batch_.dq = batch_.tau = batch_.q;
    batch_.acknowledge.resize(kBatch);
    next_event_ = first + 10 * kSecond;
  }

  const Batch& next() noexcept {
    batch_.count = 0;
    while (batch_.count < kBatch && k_ < last_) {
      if (k_ >= next_event_ && k_ + 10 * kSecond < calm_from_) begin();
      sample();
    }
    return batch_;
  }
  const Counts& counts() const noexcept { return counts_; }

 private:
  std::int64_t draw(std::int64_t least, std::int64_t most) noexcept {
    return least + static_cast<std::int64_t>(random_() % static_cast<std::uint64_t>(most - least + 1));
  }

  // Each event once, in order, then those that are no collision at random; health is ok again before the next.
  void begin() noexcept {
    event_ = begun_ < kEventCount ? static_cast<Event>(begun_) : static_cast<Event>(draw(0, kEventCount - 2));
    ++begun_;
    ++counts_.events[static_cast<std::size_t>(event_)];
    std::int64_t lasts = 0;
    switch (event_) {
      case Event::jitter: lasts = 5 * kSecond; break;
      case Event::short_gap: {
        const std::int64_t missing = draw(1, kStride);
        counts_.missing_in_short_gaps += missing;
        k_ += missing;
        break;
      }
      case Event::long_gap: k_ += draw(kStride + 1, 3 * kSecond); break;
      case Event::not_finite: lasts = draw(1, 50); break;
      case Event::collision:
        lasts = kSecond;
        acknowledge_at_ = k_ + 3 * kSecond;
        break;
    }
    event_until_ = k_ + lasts;
    next_event_ = event_until_ + draw(4 * kSecond, 20 * kSecond);
  }

  void sample() noexcept {
    const auto at = static_cast<std::size_t>(batch_.count++);
    double *q = &batch_.q[at * joints_], *dq = &batch_.dq[at * joints_], *tau = &batch_.tau[at * joints_];
    made::signal(k_, joints_, q, dq, tau);
    batch_.k[at] = k_;
    batch_.t_ns[at] = kStartNs + k_ * made::kPeriodNs;
    batch_.acknowledge[at] = k_ == acknowledge_at_;
    ++counts_.samples;
    if (k_ < event_until_) {
      if (event_ == Event::jitter) batch_.t_ns[at] += draw(-300'000, 300'000);
      if (event_ == Event::collision) tau[0] += push_nm_;
      if (event_ == Event::not_finite) {
        constexpr double inf = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
        double* const signals[] = {q, dq, tau};
        signals[draw(0, 2)][draw(0, joints_ - 1)] = draw(0, 1) ? nan : inf;
        ++counts_.not_finite;
      }
    }
    ++k_;
  }

  int joints_;
  std::int64_t k_, last_, calm_from_;
  double push_nm_;
  std::mt19937_64 random_;
  Batch batch_;
  Counts counts_;
  int begun_ = 0;
  Event event_ = Event::jitter;
  std::int64_t next_event_ = 0, event_until_ = 0, acknowledge_at_ = -1;
};

// Results of a monitor for the last samples, and counts over all samples.
struct Answers {
  std::int64_t first;
  std::vector<double> residual, uncertainty;  // (kCompared, joints)
  std::vector<std::uint8_t> health, alarm, detection;
  std::vector<std::uint32_t> causes;
  std::array<std::int64_t, 4> of_health{};
  std::int64_t collisions = 0, collision_after_acknowledge = 0;
  Alarm before = Alarm::none;

  Answers(std::int64_t last, int joints)
      : first(last - kCompared),
        residual(static_cast<std::size_t>(kCompared) * joints, 0.0),
        uncertainty(residual),
        health(kCompared, 0),
        alarm(health),
        detection(health),
        causes(kCompared, 0) {}

  void add(std::int64_t k, const Estimate& e) noexcept {
    ++of_health[static_cast<std::size_t>(e.health)];
    collisions += e.alarm == Alarm::collision && before != Alarm::collision;
    before = e.alarm;
    if (k < first) return;
    const auto at = static_cast<std::size_t>(k - first);
    std::copy_n(e.residual.begin(), e.joints, residual.begin() + static_cast<std::ptrdiff_t>(at) * e.joints);
    std::copy_n(e.uncertainty.begin(), e.joints, uncertainty.begin() + static_cast<std::ptrdiff_t>(at) * e.joints);
    health[at] = static_cast<std::uint8_t>(e.health);
    alarm[at] = static_cast<std::uint8_t>(e.alarm);
    detection[at] = e.detection;
    causes[at] = e.causes;
  }
};

void feed(Monitor& monitor, const Feed::Batch& batch, Answers& answers) noexcept {
  const auto n = static_cast<std::size_t>(monitor.joints());
  for (std::size_t i = 0; i < static_cast<std::size_t>(batch.count); ++i) {
    if (batch.acknowledge[i]) {
      monitor.acknowledge();
      answers.collision_after_acknowledge += monitor.last().alarm != Alarm::none;
    }
    answers.add(batch.k[i], monitor.step({batch.t_ns[i], std::span(&batch.q[i * n], n), std::span(&batch.dq[i * n], n),
                                          std::span(&batch.tau[i * n], n)}));
  }
}

bool passed = true;

void expect(bool holds, const std::string& what) {
  std::printf("%-7s %s\n", holds ? "ok" : "FAILED", what.c_str());
  passed = passed && holds;
}

std::string text(double value) {
  char out[32];
  std::snprintf(out, sizeof out, "%.3g", value);
  return out;
}

void soak(double hours, int joints, std::uint64_t seed) {
  const auto last = static_cast<std::int64_t>(std::llround(hours * kHour));
  Bundle bundle = made::bundle(joints, kHidden, kWindowSteps, kStride, 1);
  // The made motion is over its limits now and then; here nothing but the collision may be, jitter included.
  double largest_nm = 0;
  for (Level* level : {&bundle.limits.collision, &bundle.limits.contact})
    for (auto* limits : {&level->sliding_nm, &level->near_stiction_nm})
      for (double& limit : *limits) largest_nm = std::max(largest_nm, limit *= 5);
  Answers aged(last, joints), fresh(last, joints);
  Feed all(joints, 0, last, last - kCalm, 3 * largest_nm, seed), end(joints, last - kFresh, last, 0, 0, seed);
  Monitor monitor(bundle);
  const std::uint64_t while_made = allocations;

  std::uint64_t in_run = 0;
  long resident_before = -1, k = 0;
  double made_s = 0, fed_s = 0;
  for (int tenth = 0; k < last;) {
    const std::uint64_t before = allocations;
    const auto start = std::chrono::steady_clock::now();
    const Feed::Batch& batch = all.next();
    const auto made = std::chrono::steady_clock::now();
    feed(monitor, batch, aged);
    fed_s += seconds_since(made);
    made_s += std::chrono::duration<double>(made - start).count();
    in_run += allocations - before;
    k = batch.k[static_cast<std::size_t>(batch.count) - 1] + 1;
    if (resident_before < 0 && k >= kMinute) resident_before = resident_bytes();
    if (k * 10 / last > tenth) {
      tenth = static_cast<int>(k * 10 / last);
      std::fprintf(stderr, "%3d %% of %g h: %.0f s\n", 10 * tenth, hours, made_s + fed_s);
    }
  }
  const long resident_after = resident_bytes();
  Monitor young(bundle);
  for (std::int64_t left = kFresh; left > 0; left -= kBatch) feed(young, end.next(), fresh);

  const Feed::Counts& counts = all.counts();
  const auto events = [&](Event event) -> long long { return counts.events[static_cast<std::size_t>(event)]; };
  std::printf("%g h, %d joints, H %d, %d steps of %d samples: %lld samples, %.3f us each (%.1f s; making them took "
              "%.2f s more)\n",
              hours, joints, kHidden, kWindowSteps, kStride, (long long)counts.samples,
              1e6 * fed_s / static_cast<double>(counts.samples), fed_s, made_s);
  std::printf("events: %lld jitter, %lld short gaps, %lld long gaps, %lld values not finite, %lld collision\n",
              events(Event::jitter), events(Event::short_gap), events(Event::long_gap), events(Event::not_finite),
              events(Event::collision));
  std::printf("health: %lld warming up, %lld ok, %lld stale, %lld fault\n", (long long)aged.of_health[0],
              (long long)aged.of_health[1], (long long)aged.of_health[2], (long long)aged.of_health[3]);

  std::size_t other_bits = 0, other_health = 0, not_ok = 0;
  double residual_nm = 0;
  for (std::size_t at = 0; at < aged.residual.size(); ++at) {
    const auto bits = [at](const std::vector<double>& values) { return std::bit_cast<std::uint64_t>(values[at]); };
    other_bits += bits(aged.uncertainty) != bits(fresh.uncertainty);
    const double difference = std::fabs(aged.residual[at] - fresh.residual[at]);
    residual_nm = difference <= residual_nm ? residual_nm : difference;  // keeps NaN
  }
  for (std::size_t at = 0; at < aged.health.size(); ++at) {
    other_health += aged.health[at] != fresh.health[at] || aged.alarm[at] != fresh.alarm[at] ||
                    aged.detection[at] != fresh.detection[at] || aged.causes[at] != fresh.causes[at];
    not_ok += static_cast<Health>(aged.health[at]) != Health::ok || static_cast<Alarm>(aged.alarm[at]) != Alarm::none;
  }
  const std::string last_samples = " in the last " + std::to_string(kCompared) + " samples";
  expect(other_bits == 0, "uncertainty, to the last bit the fresh monitor's: " + std::to_string(other_bits) +
                              " values differ" + last_samples);
  expect(residual_nm <= kResidualToleranceNm, "residual, the fresh monitor's: differs by " + text(residual_nm) +
                                                  " Nm, " + text(kResidualToleranceNm) + " allowed");
  expect(other_health == 0, "health, causes, detection and alarm, the fresh monitor's: " +
                                std::to_string(other_health) + " differ" + last_samples);
  expect(not_ok == 0, "health ok and no alarm: " + std::to_string(not_ok) + " are otherwise" + last_samples);
  expect(aged.collisions == events(Event::collision) && aged.collision_after_acknowledge == 0,
         "collision alarms raised: " + std::to_string(aged.collisions) + ", standing after they were acknowledged: " +
             std::to_string(aged.collision_after_acknowledge));
  expect(static_cast<std::int64_t>(monitor.restarts()) == events(Event::long_gap) + events(Event::not_finite),
         "restarts, one for each long gap and fault: " + std::to_string(monitor.restarts()));
  expect(static_cast<std::int64_t>(monitor.bridged_ticks()) == counts.missing_in_short_gaps,
         "bridged ticks: " + std::to_string(monitor.bridged_ticks()) + ", missing in short gaps: " +
             std::to_string(counts.missing_in_short_gaps));
  expect(aged.of_health[3] == counts.not_finite,
         "faults: " + std::to_string(aged.of_health[3]) + ", samples not finite: " + std::to_string(counts.not_finite));
  expect(while_made > 0 && in_run == 0, "allocations: " + std::to_string(while_made) + " until the monitor was made, " +
                                            std::to_string(in_run) + " in the run");
  if (resident_before < 0 || resident_after < 0)
    std::puts("-       resident memory: not known on this system");
  else
    expect(std::labs(resident_after - resident_before) <= kResidentTolerance,
           "resident memory without files: " + std::to_string(resident_before / 1024) + " KiB after a minute, " +
               std::to_string(resident_after / 1024) + " KiB at the end");
}

double number(const char* what, const char* from, double least, double largest) {
  char* end = nullptr;
  const double value = std::strtod(from, &end);
  if (end == from || *end != 0 || !(value >= least && value <= largest))
    throw Error(std::string(what) + " = " + from + " must be a number from " + text(least) + " to " + text(largest));
  return value;
}

double whole(const char* what, const char* from, double least, double largest) {
  const double value = number(what, from, least, largest);
  if (value != std::floor(value)) throw Error(std::string(what) + " = " + from + " must be a whole number");
  return value;
}

}  // namespace

int main(int argc, char** argv) {
  const auto argument = [&](int at, const char* otherwise) { return argc > at ? argv[at] : otherwise; };
  try {
    if (argc > 4) throw Error("too many arguments");
    const double hours = number("hours", argument(1, "24"), 0.2, 10'000);
    const double joints = whole("joints", argument(2, "2"), 1, kMaxJoints);
    const double seed = whole("seed", argument(3, "1"), 0, 1e9);
    soak(hours, static_cast<int>(joints), static_cast<std::uint64_t>(seed));
  } catch (const std::exception& e) {
    std::fprintf(stderr, "monitor_soak: %s\n\n%s", e.what(), kUsage);
    return 2;
  }
  return passed ? 0 : 1;
}
