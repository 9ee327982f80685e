// How far the motion of a sample is from all motion that training saw: its speeds, and its positions alone and in pairs.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/estimate.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// How unfamiliar a sample's motion is, and what of it is most so.
struct Unfamiliar {
  double share = 0;  // 0: training saw the like, 1: clearly nothing like it; never NaN
  Unseen what = Unseen::nothing;
  int joint = -1, other = -1;  // of which joint, and together with which other; -1: none
};

// Holds a motion, sample after sample, against what training saw.
class Coverage {
 public:
  static constexpr int kCells = 64, kPairCells = 32;  // of a joint by itself, and of each joint of a pair
  static constexpr int kMostReach = 16;         // cells: a quarter or half of a turn
  static constexpr int kFartherCells = 2;       // a position beyond its reach by so many is wholly unfamiliar
  static constexpr double kFasterShare = 0.25;  // a speed over the fastest by this share is wholly unfamiliar
  static constexpr double kWorthReporting = 0.5;  // from this share on, motion is called unfamiliar

  struct State {
    std::int64_t t_ns = 0;
    Unfamiliar last;
  };

  // fades_per_s: at which the residual forgets a motion, [1/s]. Throws Error where the settings do not fit.
  Coverage(int joints, const CoverageSettings& settings, double fades_per_s);

  // Of one sample alone, with finite values: the largest of
  //   (|dq_j| / fastest_j - 1) / kFasterShare    and    (d - reach) / kFartherCells,
  // d the cells from the nearest seen one (of a pair the larger of the two ways), both cut to 0 to 1. Of two that are
  // alike it is the one looked at first: speeds, positions, pairs, each in the order of joints.
  Unfamiliar evaluate(std::span<const double> q, std::span<const double> dq) const noexcept;

  // The same with memory: the residual still holds what was, so share never falls faster than exp(-fades_per_s t), and
  // tells what it was meanwhile. Samples in order of time.
  const Unfamiliar& step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq) noexcept;
  bool on() const noexcept { return joints_ > 0; }  // training motion is known
  // The residual began anew.
  void reset() noexcept { state_ = {}; }

  // All that it remembers; restore() goes on from there, in another one of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  struct Axis {
    double per_span, centre, turn, per_fastest;  // turn: 1 where the cells go round, else 0
  };
  using Cells = std::array<int, kMaxJoints>;
  Unfamiliar farthest(std::span<const double> dq, const Cells& cells, const Cells& pair_cells) const noexcept;

  int joints_ = 0;  // 0: nothing is known
  bool pairs_ = false;
  double fades_per_s_;
  std::vector<Axis> axes_;
  std::vector<std::uint8_t> beyond_;           // (joint, cell): cells beyond the reach, at most kFartherCells
  std::vector<std::uint8_t> beyond_together_;  // (pair, cell, cell)
  State state_;
};

}  // namespace tauext
