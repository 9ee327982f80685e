// Estimates a load inside the loop: columns at every sample, sums at the network's rate.
#pragma once
#include <cstdint>
#include <span>

#include "chain/observed.hpp"
#include "load/load_columns.hpp"
#include "load/load_solve.hpp"
#include "tauext/estimate.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"

namespace tauext {

struct Bundle;

// How long each joint has stood, and what its rows are worth: 1 while it slides, (1 + t / kStand_s)^-2 after t. Over a
// standstill of any length that is kStand_s of sliding.
class Standstill {
 public:
  static constexpr double kStand_s = 0.5;

  void restart() noexcept { *this = {}; }
  void step(std::int64_t t_ns, std::uint32_t near_stiction, int joints) noexcept;
  double worth(int joint) const noexcept;

 private:
  bool timed_ = false;
  std::int64_t t_ns_ = 0;
  JointVector stood_s_{};
};

// take() copies what advance() needs. advance() steps the columns, adds a row once per network period and solves every
// kRefreshRows rows, so that the columns match the current load estimate. Rows are healthy samples; the columns need
// 10/K0 after every start or restart.
class Weighing {
 public:
  static constexpr int kRefreshRows = 10;
  static constexpr double kOffsetShare = 0.07, kCoulombShare = 0.2;  // of the most that drift may be: see LoadBefore

  // The bundle names a load's frame, and r is the momentum observer's without filters.
  static bool possible(const Bundle& bundle) noexcept;
  // Throws Error if that is not possible.
  explicit Weighing(const Bundle& bundle);

  // Settings from the bundle.
  static WeighSettings settings_of(const Bundle& bundle);

  // With the next sample, beside this load. reach_m: of the centre of mass, above 0.
  void start(double reach_m, const Load& set) noexcept;
  void stop() noexcept { on_ = pending_ = false; }
  // Back to the state after construction.
  void reset() noexcept;
  bool on() const noexcept { return on_; }
  bool begun() const noexcept { return !row_due_; }  // a sample entered

  // Call with the sample just judged. Only if on().
  void take(const Sample& sample, const Observed& observed, const Estimate& estimate) noexcept;
  // beta: the estimated model's at that sample. Nothing happens where it was done.
  void advance(std::span<const double> beta) noexcept;

  LoadFound found() const noexcept { return weigh(sums_, settings_, set_, phi_); }

  const WeighSettings& settings() const noexcept { return settings_; }

 private:
  void add_row() noexcept;
  void refresh() noexcept;

  int joints_;
  std::int64_t period_ns_, half_sample_ns_;
  LoadSettings loads_;
  bool has_sigma_;
  JointVector counts_{};  // 1 where a joint answers in N m, else 0: it weighs nothing
  JointVector factor_{};  // of the torque of a load, by the known weight
  Limits limits_;
  LoadColumns columns_;
  LoadSums sums_;
  WeighSettings settings_;
  Load set_;
  LoadParameters phi_{};
  LoadNoise noise_ = LoadNoise::unknown();
  Standstill standstill_;
  bool on_ = false, pending_ = false, entered_ = false, restarted_ = false, healthy_ = false;
  bool row_due_ = true;  // whenever it comes
  int unsolved_rows_ = 0;
  std::int64_t t_ns_ = 0, row_ns_ = 0;
  JointVector q_{}, dq_{}, tau_ext_{}, sigma_nm_{};
};

}  // namespace tauext
