// A whole recording observed, for training: residuals, and the rows of the regular clock that features and targets of a
// network are read from.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "chain/signal_watch.hpp"
#include "network/lstm.hpp"
#include "stages/residual.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"

namespace tauext {

struct Bundle;

// Residuals of a whole recording, and each sample's row on the regular clock. Rows are numbered through the recording.
// Bridged ticks have their own rows; a restart begins a new stretch at the next row.
struct Observation {
  std::vector<double> residual;             // (samples, joints), [N m]
  std::vector<double> prior;                // (samples, joints), [N m]; empty where there is none
  std::vector<double> doubt;                // (samples, joints), [N m]: possible error of the prior; empty like it
  std::vector<float> presliding;            // (samples, joints x widths), in [-1, 1]
  std::vector<std::int64_t> row;            // (samples)
  std::vector<std::int64_t> stretch_begin;  // (samples): first row of the sample's stretch
  std::vector<std::uint8_t> warm;           // (samples): 10/K0 after the stretch began, or later (ResidualStage)
  std::int64_t row_count = 0;  // rows of the clock
  std::int64_t held_rows = 0;  // ticks without a sample of their own
  int restarts = 0;            // stretches after the first
};

// Throws Error if the recording has another number of joints.
void expect_joints(int joints, const RecordingView& recording);

// Throws Error if times do not increase, a number is not finite or the joints differ.
Observation observe(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                    const RecordingView& recording);

// The mean step at each sample that a monitor compares with the sample period, as its share (SignalWatch).
std::vector<double> mean_steps(std::int64_t sample_period_ns, int network_stride, std::span<const std::int64_t> t_ns);

// An impossible sample of a recording.
struct ImpossibleSample {
  std::int64_t sample = 0;  // its index
  Impossible found;         // why
};

// Those that a monitor refuses whose bundle has these ranges, in their order. For training, whose recordings have finite
// numbers and increasing times; settings: period, stride and torque constants. Throws Error if something does not fit.
std::vector<ImpossibleSample> impossible_samples(const ObserverSettings& settings, const SignalRanges& ranges,
                                                 const RecordingView& recording);

// Rows of features on the regular clock: q_1..q_n, dq_1..dq_n and the presliding states, each times its factor, in
// float; (row_count, 2 joints + joints x widths). Bridged ticks hold the sample before.
std::vector<float> feature_rows(const RecordingView& recording, const Observation& observation,
                                std::span<const float> factors);

// The windows of a bundle's network, without the rows that they are read from.
WindowRows windows_of(const Bundle& bundle) noexcept;

// Rows of samples on the regular clock of a recording.
struct RowCount {
  std::int64_t row = -1, stretch_begin = 0;  // of the last sample
  // The next sample, so many ticks later; those of one that restarts do not count.
  void add(bool restarted, std::int64_t ticks) noexcept {
    row += restarted ? 1 : ticks;
    if (restarted) stretch_begin = row;
  }
};

}  // namespace tauext
