// First half of the chain: sample -> residual, presliding states and prior, at the sample rate.
#pragma once
#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/comparison_residuals.hpp"
#include "tauext/momentum_observer.hpp"
#include "tauext/presliding.hpp"
#include "tauext/prior.hpp"
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
  ResidualMethod method = ResidualMethod::momentum;
  double high_pass_per_s = 0;         // filters on the residual, [1/s]; 0: none
  double low_pass_per_s = 0;

  // The slower of K0 and the low-pass: 10 over this after something wrong, r has forgotten it.
  double slowest_per_s() const noexcept {
    return low_pass_per_s > 0 ? std::min(gain_per_s, low_pass_per_s) : gain_per_s;
  }
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

// Clock, dynamics, residual with its filters, presliding states and prior together, one sample at a time.
class ResidualStage {
 public:
  // Throws Error where the settings do not fit, or a prior stands beside a residual that is not filtered like it.
  ResidualStage(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior);

  // residual, prior and the prior's doubt [N m; the energy observer's in W] are written; where the tick says restart,
  // all began anew with this sample.
  SampleClock::Tick step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                         std::span<const double> tau, std::span<double> residual, std::span<double> prior,
                         std::span<double> doubt) noexcept;
  const Presliding& presliding() const noexcept { return presliding_; }
  bool warm() const noexcept { return filter_.warm(); }
  // What the motion of a joint told of its static friction holds no longer. Nothing happens where no prior follows from
  // it: there would be no doubt to raise the limits.
  void forget_friction(int joint) noexcept {
    if (!prior_.has_presliding()) return;
    presliding_.forget(joint);
    prior_.forget();
  }
  // The next sample starts anew, whenever it comes.
  void reset() noexcept { clock_.reset(); }

  struct State {
    SampleClock clock;
    MomentumObserver observer;
    ComparisonResidual comparison;
    ResidualFilter filter;
    Presliding::State presliding;
    Prior::State prior;
  };
  State state() const noexcept {
    return {clock_, observer_, comparison_, filter_, presliding_.state(), prior_.state()};
  }
  void restore(const State& state) noexcept;

 private:
  Tree tree_;
  SampleClock clock_;
  ResidualMethod method_;
  MomentumObserver observer_;
  ComparisonResidual comparison_;  // unless the method is momentum
  ResidualFilter filter_;
  Presliding presliding_;
  Prior prior_;
  bool has_prior_;
};

// The residual of a whole recording, and where each sample stands on the regular clock. Row numbers run through the
// recording; bridged ticks have rows of their own, a restart begins a new stretch at the next row.
struct Observation {
  std::vector<double> residual;             // (samples, joints), [N m]
  std::vector<double> prior;                // (samples, joints), [N m]; empty where there is none
  std::vector<double> doubt;                // (samples, joints), [N m]: how far the truth may lie from it; likewise
  std::vector<float> presliding;            // (samples, joints x widths), in [-1, 1]
  std::vector<std::int64_t> row;            // (samples)
  std::vector<std::int64_t> stretch_begin;  // (samples): first row of the stretch that the sample stands in
  std::vector<std::uint8_t> warm;           // (samples): 10/K0 after the stretch began, or later (ResidualStage)
  std::int64_t row_count = 0;
  std::int64_t held_rows = 0;  // ticks without a sample of their own
  int restarts = 0;            // stretches after the first
};

// Throws Error where times do not increase or the joints differ.
Observation observe(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                    const RecordingView& recording);

// The terms of a prior passed through the observer's filter one by one, for the fit: (rows, terms), one row for each of
// `samples`, which rise. The same filter as Prior's: their weighted sum is the prior.
std::vector<double> prior_regressors(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                                     const RecordingView& recording, std::span<const std::int64_t> samples);

// Rows of features on the regular clock: q_1..q_n, dq_1..dq_n and the presliding states, each times its factor, in
// float; (row_count, 2 joints + joints x widths). Bridged ticks hold the sample before.
std::vector<float> feature_rows(const RecordingView& recording, const Observation& observation,
                                std::span<const float> factors);

}  // namespace tauext
