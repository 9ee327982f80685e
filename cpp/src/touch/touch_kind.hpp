// Classifies the touch behind an alarm: impact, push, clamp or load. Updated while the touch lasts.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "chain/step_share.hpp"
#include "load/load_change.hpp"
#include "chain/load_regressor.hpp"
#include "tauext/estimate.hpp"
#include "tauext/types.hpp"

namespace tauext {

struct Bundle;

// S is the size of tau_ext in limits, |tau_ext / limit|, with the limits at the start. x is the arm's travel into the
// contact, from work over S: dx/dt = -tau_ext . dq / S. dq is filtered as by the observer, so that both have the same
// lag. A fixed spring has dS/dx = S/x for any stiffness, link and lever.
//   impact   S fell to kFell of its peak within a bounce: r's response to a blow
//   load     a weight at the load frame explains tau_ext up to its error
//   otherwise, if the arm was driven into it (it moved before, against tau_ext until the alarm):
//     push   the arm goes on, and S grows by less than against a spring
//     clamp  else
//   if the arm moved away from it by itself: push; a clamp stops the arm or presses on it at rest
//   if the arm stood still:
//     push   S stopped growing, and not because the arm yields more
//     clamp  S keeps growing as since its start
// In doubt the touch is a clamp, and stays one. Without a fitting class or an observed start it is unknown.
class TouchKind {
 public:
  static constexpr double kBegins = 0.5;       // of a limit: rarely reached by errors; tracking starts here ...
  static constexpr double kOver_s = 0.2;       // ... and ends this long after the last time
  static constexpr double kBounce_s = 0.05;    // pi sqrt(m / k) of 5 kg on 20 N/mm: bodies that bounce off part sooner
  static constexpr double kFell = 0.6;         // a push is released by a third in longer than that
  static constexpr double kBack = 0.72;        // of its peak: the contact has returned, and lasts
  static constexpr double kStrong = 0.3;       // of the strongest joint: below it errors of tau_ext make half the work
  static constexpr double kSurely = 1;         // limit, above all errors: such joints count however strong others are
  static constexpr double kStands_rad_s = 0.03;  // slower joints count as at rest; or near_stiction_rad_s
  static constexpr double kBefore_s = 0.3;     // it began: a press of 10 mm/s has not moved the arm yet
  static constexpr double kStuck_rad = 1e-3;   // travel within stiction
  static constexpr double kRecent_s = 0.08;    // longer than r's response, shorter than the rise of most hand forces
  static constexpr double kOnward = 0.85;      // of the approach speed
  static constexpr double kSoft = 0.5;  // dS/dx over S/x and over the steepest so far: 1 for a spring, 0 for a hand
  static constexpr double kStopped = 0.3;      // of the approach speed: no drive stops by itself so soon,
  static constexpr double kHeld = 0.7;         // while S is near its peak
  static constexpr double kSettled = 0.65;     // dS/dt over its mean and over the fastest so far, 1 for steady growth:
  static constexpr double kShows = 0.3;        // a fifth of both is gone, and S shows this much of a limit, or ...
  static constexpr double kFlat = 0.25;        // ... half of both is
  static constexpr double kYields = 0.7;       // of the fastest motion of the arm: an approaching body keeps moving it
  static constexpr double kGrowing = 0.75;     // sixth parts of both are errors of tau_ext
  static constexpr double kFitNoise = 0.18;    // of a limit: errors of tau_ext are an eighth to a fifth of it
  static constexpr double kFitModel = 0.1;     // of tau_ext: torque constants are off by up to as much
  static constexpr double kReach_m = 0.3;      // of a load's centre of mass from the frame's origin
  static constexpr double kHeaviest_kg = 10;  // without load settings: a large payload
  static constexpr double kFirst_s = 0.06;     // since the alarm: only an impact is reported sooner,
  static constexpr double kAlong_s = 0.1;      // nor a clamp that has stopped the arm,
  static constexpr double kDriven_s = 0.13;    // nor another clamp that the arm is driven into,
  static constexpr double kStanding_s = 0.15;  // nor one of an arm at rest
  static constexpr double kSure_s = 0.02;      // a class must persist for this long
  static constexpr double kDecided_s = 0.2;    // since the alarm: the class stays from then on, but
  static constexpr double kDoubled = 2;        // a push or load that grows to this multiple is classified again

  explicit TouchKind(const Bundle& bundle);

  // Processes one entered sample, in order of time. tau_ext without expected load torques, NaN if unavailable. over:
  // some joint is over a limit, hold time passed; alarm: an alarm is active.
  struct Seen {
    std::int64_t t_ns = 0;
    std::span<const double> q, dq, tau_ext, limit_nm;
    bool over = false, alarm = false;
  };
  void step(const Seen& seen) noexcept;
  // The chain restarted: the start of the current touch was not observed.
  void restart() noexcept;
  void reset() noexcept { state_ = {}; }
  Touch kind() const noexcept { return state_.kind; }  // none: no alarm, or its start was not observed

  // Of a block of samples' last one.
  struct Block {
    std::int64_t t_ns = 0;
    double size = 0, way = 0;  // S and x
    double left = 0;           // of S^2, not explained by a load
  };
  static constexpr std::size_t kBlocks = 24, kPast = 9;
  struct State {
    Touch kind = Touch::none, candidate = Touch::none;
    bool timed = false, touching = false, lost = false, alarmed = false, bounced = false;
    int strongest = -1;
    std::int64_t t_ns = 0, begin_ns = 0, alarm_ns = 0, peak_ns = 0, over_ns = 0, candidate_ns = 0;
    double dt_s = 0;
    StepShare share;
    double base = 0, size = 0, peak = 0, way = 0, came = 0;  // came: dx/dt until the alarm
    double fastest = 0, steepest = 0, yields = 0, decided_size = 0;  // most dS/dt, dS/dx, -dx/dt
    JointVector speed{}, place{};  // behind the observer's filter; place since it began
    JointVector limit_nm{}, speed_at{}, speed_before{};  // of when it began, and before
    LoadChange load{};
    std::array<Block, kBlocks> blocks{};
    std::size_t count = 0, next = 0;
    std::array<JointVector, kPast> past{};  // speeds, kBefore_s / (kPast - 1) apart
    std::size_t past_next = 0;
    std::int64_t past_ns = 0;
  };
  // Complete state; restore() continues from it.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  // Over the recent blocks: growth of S and x, and their duration.
  struct Stretch {
    double grown, gone, s;
  };
  bool follow(const Seen& seen) noexcept;
  void begin(const Seen& seen) noexcept;
  void update(const Seen& seen) noexcept;
  void measure(const Seen& seen) noexcept;
  void close_block(const Seen& seen) noexcept;
  bool bounces(bool over) noexcept;
  Stretch recent_blocks() const noexcept;
  void decide(const Stretch& recent, const Seen& seen) noexcept;
  Touch classify(const Stretch& recent, const Seen& seen) noexcept;
  Touch driven_into(const Stretch& recent, double since_s) noexcept;
  Touch standing(const Stretch& recent, const Seen& seen, double since_s) const noexcept;
  bool fits_load() const noexcept;
  double left_by_load(const Seen& seen) noexcept;
  bool moves(const JointVector& speed, const Seen& seen) const noexcept;
  double against(const JointVector& speed, const Seen& seen) const noexcept;
  bool strong(const Seen& seen, std::size_t joint) const noexcept;
  const Block& before(std::int64_t t_ns) const noexcept;

  std::size_t joints_;
  bool possible_;
  double gain_per_s_, stands_rad_s_;
  std::int64_t block_ns_;
  LoadRegressor weight_;
  LoadBounds bounds_;
  State state_;
};

}  // namespace tauext
