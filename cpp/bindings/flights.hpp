// Python's FlightRecorder.
#pragma once
#include <cstdint>

#include "tauext/flight_recorder.hpp"

namespace tauext::bindings {

// With the number of joints.
struct Recorder : FlightRecorder {
  std::size_t joints;
  Recorder(int n, std::int64_t period_ns, const FlightSettings& s)
      : FlightRecorder(n, period_ns, s), joints(static_cast<std::size_t>(n)) {}
};

}  // namespace tauext::bindings
