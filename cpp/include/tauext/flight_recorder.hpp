// The last seconds before an alarm or fault, kept for another thread to write down.
#pragma once
#include <atomic>
#include <cstdint>
#include <vector>

#include "tauext/estimate.hpp"
#include "tauext/sample.hpp"

namespace tauext {

// What a flight holds, and what makes one.
struct FlightSettings {
  double before_s = 5;    // kept from before the event, [s]
  double after_s = 1;     // and after it, [s]
  bool contacts = false;  // a contact is an event too
};

// Samples and estimates around one event, oldest first.
struct Flight {
  std::int64_t event_row = 0;  // at which the event is
  std::vector<std::int64_t> t_ns;                                               // (samples)
  std::vector<double> q, dq, tau, residual, prior, network, drift, tau_ext, load_nm, sigma_nm,
      contact_sigma_nm, limit_nm, contact_limit_nm;  // (samples, joints)
  std::vector<std::uint32_t> near_stiction, causes;                         // (samples): bits
  std::vector<std::uint8_t> health, alarm, held_alarm, touch, detection;          // (samples)
  std::vector<Load> load;                                                   // (samples): that the arm was taken to carry
  Estimate event;  // the monitor's estimate at the event
};

// An event is a rise of the alarm (to collision; to contact where requested) or health becoming a fault after it was
// ok or warming up. Two rings are allocated at construction: when the samples after the event are in, the full
// ring changes hands and push() continues in the other. push() never waits: a flight whose predecessor is not taken in
// time is discarded and counted.
class FlightRecorder {
 public:
  // Throws Error where a time is negative, not finite or over ten minutes, or both are 0.
  FlightRecorder(int joints, std::int64_t sample_period_ns, const FlightSettings& settings);

  // The control thread, once a sample, after the monitor. A sample of the wrong size is kept as NaN.
  void push(const Sample& sample, const Estimate& estimate) noexcept;
  // The control thread, at the end: an event still waiting for what comes after it changes hands as it is. False where
  // the flight before it has not been taken yet: to be called again.
  bool finish() noexcept;

  // Another thread: true where a flight was taken, oldest row first; its ring is free again.
  bool take(Flight& flight);
  // Events so far, those within another one's flight among them; and flights that were given up.
  std::uint64_t events() const noexcept { return events_.load(std::memory_order_relaxed); }
  std::uint64_t missed() const noexcept { return missed_.load(std::memory_order_relaxed); }

 private:
  struct Row {
    std::int64_t t_ns;
    std::uint32_t near_stiction, causes;
    std::uint8_t health, alarm, held_alarm, touch, detection;
    Load load;
  };
  struct Ring {
    std::vector<Row> rows;
    std::vector<double> signals;  // (rows, signals, joints)
    std::int64_t next = 0, count = 0;  // row to be written, rows written
    std::int64_t event = -1;           // row count at the event, -1 without one
    Estimate estimate;
  };
  void hand_over() noexcept;

  int joints_;
  std::int64_t capacity_, after_;
  bool contacts_;
  Ring rings_[2];
  int active_ = 0;  // the control thread's ring
  Alarm alarm_ = Alarm::none;
  std::int64_t alarm_t_ns_ = 0;
  Health health_ = Health::warming_up;
  std::atomic<int> handed_{-1};  // ring that waits for take(), -1: none
  std::atomic<std::uint64_t> events_{0}, missed_{0};
};

}  // namespace tauext
