// Distance of a sample's motion from the training motion: speeds, and positions alone and in pairs.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/estimate.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// How unfamiliar a sample's motion is, and its most unfamiliar part.
struct Unfamiliar {
  double share = 0;  // 0: like training, 1: clearly unlike training; never NaN
  Unseen what = Unseen::nothing;
  int joint = -1, other = -1;  // the joint, and the second one of a pair; -1: none
};

// Compares the motion with training, sample by sample.
class Coverage {
 public:
  static constexpr int kFartherCells = 2;       // a position this many cells beyond reach counts as fully unfamiliar
  static constexpr double kFasterShare = 0.25;  // a speed above the fastest by this share counts as fully unfamiliar
  static constexpr double kWorthReporting = 0.5;  // from this share on, motion is reported as unfamiliar

  struct State {
    std::int64_t t_ns = 0;
    Unfamiliar last;
  };

  // fades_per_s: rate at which the residual forgets a motion, [1/s]. Throws Error if the settings do not fit.
  Coverage(int joints, const CoverageSettings& settings, double fades_per_s);

  // For a single sample with finite values, the largest of
  //   (|dq_j| / fastest_j - 1) / kFasterShare    and    (d - reach) / kFartherCells,
  // d: cells to the nearest trained cell (for a pair the larger of both distances). Both terms are clamped to 0 to 1.
  // Ties go to the first in this order: speeds, positions, pairs, each by joint.
  Unfamiliar evaluate(std::span<const double> q, std::span<const double> dq) const noexcept;

  // The same with memory, since the residual contains past motion: share falls no faster than exp(-fades_per_s t) and
  // keeps its cause. Samples in order of time.
  const Unfamiliar& step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq) noexcept;
  bool on() const noexcept { return joints_ > 0; }  // the bundle has training motion
  // Restart of the residual.
  void reset() noexcept { state_ = {}; }

  // Complete state; restore() continues from it in a Coverage of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  struct Axis {
    double per_span, centre, turn, per_fastest;  // turn: 1 if the cells wrap around, else 0
  };
  using Cells = std::array<int, kMaxJoints>;
  Unfamiliar farthest(std::span<const double> dq, const Cells& cells, const Cells& pair_cells) const noexcept;

  int joints_ = 0;  // 0: no training motion
  bool pairs_ = false;
  double fades_per_s_;
  std::vector<Axis> axes_;
  std::vector<std::uint8_t> beyond_;           // (joint, cell): cells beyond the reach, at most kFartherCells
  std::vector<std::uint8_t> beyond_together_;  // (pair, cell, cell)
  State state_;
};

}  // namespace tauext
