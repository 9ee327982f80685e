#include "tauext/flight_recorder.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace tauext {
namespace {
constexpr int kSignals = 14;  // those that push() lists
}

FlightRecorder::FlightRecorder(int joints, std::int64_t sample_period_ns, const FlightSettings& settings)
    : joints_(joints), contacts_(settings.contacts) {
  if (joints < 1 || joints > kMaxJoints)
    throw Error("a flight recorder has 1 to " + std::to_string(kMaxJoints) + " joints, not " + std::to_string(joints));
  if (sample_period_ns < 1)
    throw Error("sample period = " + std::to_string(sample_period_ns) + " ns must be > 0");
  for (double seconds : {settings.before_s, settings.after_s})
    if (!(seconds >= 0 && seconds <= 600))
      throw Error("a flight recorder keeps 0 to 600 s before and after an event, not " + to_text(seconds));
  const double period_s = 1e-9 * static_cast<double>(sample_period_ns);
  after_ = std::llround(settings.after_s / period_s);
  capacity_ = std::llround(settings.before_s / period_s) + 1 + after_;
  const auto rows = static_cast<std::size_t>(capacity_);
  if (rows * static_cast<std::size_t>(joints) > 20'000'000)
    throw Error("a flight recorder cannot keep " + std::to_string(capacity_) + " samples of " +
                std::to_string(joints) + " joints; ask for fewer seconds");
  for (Ring& ring : rings_) {
    ring.rows.resize(rows);
    ring.signals.resize(rows * kSignals * static_cast<std::size_t>(joints));
  }
}

void FlightRecorder::push(const Sample& sample, const Estimate& e) noexcept {
  Ring& ring = rings_[active_];
  const auto row = static_cast<std::size_t>(ring.next);
  const auto n = static_cast<std::size_t>(joints_);
  double* to = ring.signals.data() + row * kSignals * n;
  for (const std::span<const double> signal : {sample.q, sample.dq, sample.tau}) {
    for (std::size_t j = 0; j < n; ++j)
      to[j] = signal.size() == n ? signal[j] : std::numeric_limits<double>::quiet_NaN();
    to += n;
  }
  for (const JointVector* signal : {&e.residual, &e.prior, &e.network, &e.drift, &e.tau_ext, &e.load_nm, &e.declared_nm,
                                    &e.sigma_nm, &e.contact_sigma_nm, &e.limit_nm, &e.contact_limit_nm})
    to = std::copy_n(signal->data(), n, to);
  ring.rows[row] = {sample.t_ns, e.near_stiction, e.causes, static_cast<std::uint8_t>(e.health),
                    static_cast<std::uint8_t>(e.alarm), static_cast<std::uint8_t>(e.held_alarm),
                    static_cast<std::uint8_t>(e.touch), e.detection, e.load};
  ring.next = ring.next + 1 == capacity_ ? 0 : ring.next + 1;
  ++ring.count;

  // An alarm that was acknowledged and returned at the next sample counts as a new event.
  const bool again = e.alarm == alarm_ && e.alarm_t_ns != alarm_t_ns_;
  const bool rises = (e.alarm > alarm_ || again) && (e.alarm == Alarm::collision || (e.alarm == Alarm::contact && contacts_));
  const bool breaks = e.health == Health::fault && health_ != Health::fault;
  alarm_ = e.alarm;
  alarm_t_ns_ = e.alarm_t_ns;
  health_ = e.health;
  if (rises || breaks) {
    events_.fetch_add(1, std::memory_order_relaxed);
    if (ring.event < 0) {  // otherwise it belongs to the previous event's flight
      ring.event = ring.count;
      ring.estimate = e;
    }
  }
  if (ring.event >= 0 && ring.count >= ring.event + after_) hand_over();
}

bool FlightRecorder::finish() noexcept {
  if (rings_[active_].event < 0) return true;
  if (handed_.load(std::memory_order_acquire) >= 0) return false;
  hand_over();
  return true;
}

// A flight not yet fetched keeps its ring. The new flight waits in the active ring and is dropped when its event would
// be overwritten.
void FlightRecorder::hand_over() noexcept {
  Ring& ring = rings_[active_];
  if (handed_.load(std::memory_order_acquire) >= 0) {
    if (ring.count >= ring.event + capacity_ - 1) {
      ring.event = -1;
      missed_.fetch_add(1, std::memory_order_relaxed);
    }
    return;
  }
  const int full = active_;
  active_ = 1 - active_;
  rings_[active_].next = rings_[active_].count = 0;
  rings_[active_].event = -1;
  handed_.store(full, std::memory_order_release);
}

bool FlightRecorder::take(Flight& flight) {
  const int full = handed_.load(std::memory_order_acquire);
  if (full < 0) return false;
  const Ring& ring = rings_[full];
  const auto n = static_cast<std::size_t>(joints_);
  const std::int64_t rows = std::min(ring.count, capacity_);
  const std::int64_t oldest = ring.count - rows;  // relative to the ring's first row
  flight = {};
  flight.event_row = ring.event - 1 - oldest;
  flight.event = ring.estimate;
  std::vector<double>* const signals[kSignals] = {&flight.q,       &flight.dq,      &flight.tau,
                                                  &flight.residual, &flight.prior,   &flight.network,
                                                  &flight.drift,    &flight.tau_ext, &flight.load_nm,
                                                  &flight.declared_nm, &flight.sigma_nm, &flight.contact_sigma_nm,
                                                  &flight.limit_nm, &flight.contact_limit_nm};
  for (std::int64_t k = 0; k < rows; ++k) {
    const auto at = static_cast<std::size_t>((oldest + k) % capacity_);
    const Row& row = ring.rows[at];
    flight.t_ns.push_back(row.t_ns);
    const double* from = ring.signals.data() + at * kSignals * n;
    for (std::vector<double>* signal : signals) {
      signal->insert(signal->end(), from, from + n);
      from += n;
    }
    flight.near_stiction.push_back(row.near_stiction);
    flight.causes.push_back(row.causes);
    flight.health.push_back(row.health);
    flight.alarm.push_back(row.alarm);
    flight.held_alarm.push_back(row.held_alarm);
    flight.touch.push_back(row.touch);
    flight.detection.push_back(row.detection);
    flight.load.push_back(row.load);
  }
  handed_.store(-1, std::memory_order_release);
  return true;
}

}  // namespace tauext
