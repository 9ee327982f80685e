// Keeps the last seconds before an alarm or fault for another thread to write to a file.
#pragma once
#include <atomic>
#include <cstdint>
#include <vector>

#include "tauext/estimate.hpp"
#include "tauext/sample.hpp"

namespace tauext {

// Content of a flight, and the events that start one.
struct FlightSettings {
  double before_s = 5;    // recorded before the event, [s]
  double after_s = 1;     // recorded after the event, [s]
  bool contacts = false;  // contacts are events, too
};

// Samples and estimates around one event, oldest first.
struct Flight {
  std::int64_t event_row = 0;  // row of the event
  std::vector<std::int64_t> t_ns;                                               // (samples)
  std::vector<double> q, dq, tau, residual, prior, network, drift, tau_ext, load_nm, declared_nm, sigma_nm,
      contact_sigma_nm, limit_nm, contact_limit_nm;  // (samples, joints)
  std::vector<std::uint32_t> near_stiction, causes;                         // (samples): bits
  std::vector<std::uint8_t> health, alarm, held_alarm, touch, detection;          // (samples)
  std::vector<Load> load;                                                   // (samples): payload that the model carries
  Estimate event;  // the monitor's estimate at the event
};

// Keeps the last seconds in two preallocated rings. An event is a rise of the alarm (to collision; on request to
// contact), or a change of health from ok or warming_up to fault. When the samples after the event are complete,
// another thread can take the full ring, and push() continues in the other one. push() never waits: if the previous
// flight was not taken in time, the new one is discarded and counted.
class FlightRecorder {
 public:
  // Throws Error if a time is negative, not finite or above ten minutes, or if both are 0.
  FlightRecorder(int joints, std::int64_t sample_period_ns, const FlightSettings& settings);

  // Control thread: call it once per sample, after the monitor. A sample of the wrong size is stored as NaN.
  void push(const Sample& sample, const Estimate& estimate) noexcept;
  // Control thread: call it at the end. Hands over an event whose later samples are incomplete. Returns false if the
  // previous flight has not been taken yet; call it again then.
  bool finish() noexcept;

  // Other thread: returns true with a flight, oldest row first, and frees its ring; false: none.
  bool take(Flight& flight);
  // Number of events, including those within the flight of another event; number of discarded flights.
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
    std::int64_t next = 0, count = 0;  // row to be written, number of rows written
    std::int64_t event = -1;           // row count at the event; -1: none
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
  std::atomic<int> handed_{-1};  // ring that waits for take(); -1: none
  std::atomic<std::uint64_t> events_{0}, missed_{0};
};

}  // namespace tauext
