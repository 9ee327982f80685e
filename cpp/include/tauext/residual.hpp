// First half of the chain: sample -> momentum observer, at the sample rate.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/momentum_observer.hpp"
#include "tauext/sample_clock.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// What training and monitor must share beside the model.
struct ObserverSettings {
  double gain_per_s = 0;              // K0, [1/s]
  TorqueTiming timing = TorqueTiming::held;
  std::int64_t sample_period_ns = 0;  // of the recording or the control loop
  int network_stride = 0;             // samples in a network period, the multiple of the sample period nearest 10 ms
};

// Samples in time order; q, dq, tau are (samples, joints), row-major.
struct RecordingView {
  std::int64_t samples = 0;
  int joints = 0;
  const std::int64_t* t_ns = nullptr;
  const double* q = nullptr;
  const double* dq = nullptr;
  const double* tau = nullptr;
};

// Clock, dynamics and observer together, one sample at a time.
class ResidualStage {
 public:
  ResidualStage(const Tree& tree, const ObserverSettings& settings);

  // residual [N m] is written; where the tick says restart, the observer began anew with this sample.
  SampleClock::Tick step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                         std::span<const double> tau, std::span<double> residual) noexcept;
  bool warm() const noexcept { return state_.observer.warm(); }
  // The next sample starts anew, whenever it comes.
  void reset() noexcept { state_.clock.reset(); }

  struct State {
    SampleClock clock;
    MomentumObserver observer;
  };
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  Tree tree_;
  State state_;
};

// The residual of a whole recording, and where each sample stands on the regular clock. Row numbers run through the
// recording; bridged ticks have rows of their own, a restart begins a new stretch at the next row.
struct Observation {
  std::vector<double> residual;             // (samples, joints), [N m]
  std::vector<std::int64_t> row;            // (samples)
  std::vector<std::int64_t> stretch_begin;  // (samples): first row of the stretch that the sample stands in
  std::vector<std::uint8_t> warm;           // (samples): 10/K0 after the stretch began
  std::int64_t row_count = 0;
  std::int64_t held_rows = 0;  // ticks without a sample of their own
  int restarts = 0;            // stretches after the first
};

// Throws Error where times do not increase or the joints differ.
Observation observe(const Tree& tree, const ObserverSettings& settings, const RecordingView& recording);

// Rows of features on the regular clock: q_1..q_n, dq_1..dq_n, each times its factor, in float;
// (row_count, 2 joints). Bridged ticks hold the sample before.
std::vector<float> feature_rows(const RecordingView& recording, const Observation& observation,
                                std::span<const float> factors);

}  // namespace tauext
