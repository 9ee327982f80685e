// What kind of touch an alarm is: an impact, a push, a clamp or a load, and updated as it goes on.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "load_change.hpp"
#include "load_columns.hpp"
#include "step_share.hpp"
#include "tauext/estimate.hpp"
#include "tauext/types.hpp"

namespace tauext {

struct Bundle;

// What shows is the size S of tau_ext in limits, |tau_ext / limit|, with the limits of when it began. The arm's way x into
// what touches it is the work it does on it over S: dx/dt = -tau_ext . dq / S, dq behind the observer's own filter, so that
// both lag alike. A spring that stays where it is has dS/dx = S/x, whatever its stiffness, link and lever are.
//   impact   S has fallen to kFell of its peak within a bounce: r's own answer to a blow
//   load     what is left of tau_ext by a weight at the load frame is its error
//   and of what remains, where the arm was driven into it: it moved before, and against tau_ext until the alarm
//     push   the arm goes on, and S grows by less than a spring would
//     clamp  else
//   where it moved away from it by itself: push; a clamp is what the arm runs into, or what presses on it while it stands
//   where it stood:
//     push   S has stopped growing, and not because the arm gives way more
//     clamp  S grows on as it has since it began
// In doubt it is a clamp, and stays one; what is neither is unknown. Nor is what nobody saw begin decided at all.
class TouchKind {
 public:
  static constexpr double kBegins = 0.5;       // of a limit: errors reach that rarely; from here on it is followed ...
  static constexpr double kOver_s = 0.2;       // ... and it is over so long after the last time
  static constexpr double kBounce_s = 0.05;    // pi sqrt(m / k) of 5 kg on 20 N/mm: bodies that bounce off part sooner
  static constexpr double kFell = 0.6;         // a push lets go by a third in longer than that
  static constexpr double kBack = 0.72;        // of its peak: what bounced is there again, and goes on
  static constexpr double kStrong = 0.3;       // of the strongest joint: below it the error of tau_ext makes half the work
  static constexpr double kSurely = 1;         // limit, which no error is: joints above it say it however strong others are
  static constexpr double kStands_rad_s = 0.03;  // slower joints do not move; or near_stiction_rad_s
  static constexpr double kBefore_s = 0.3;     // it began: a press of 10 mm/s has not moved the arm yet
  static constexpr double kStuck_rad = 1e-3;   // what stiction lets a joint give way
  static constexpr double kRecent_s = 0.08;    // longer than r takes to answer, shorter than most hands take to rise
  static constexpr double kOnward = 0.85;      // of the speed that it came with
  static constexpr double kSoft = 0.5;         // dS/dx over S/x and over the steepest so far: 1 of a spring, 0 of a hand
  static constexpr double kStopped = 0.3;      // of the speed that it came with: no drive does that by itself so soon,
  static constexpr double kHeld = 0.7;         // while S is at its peak, nearly
  static constexpr double kSettled = 0.65;     // dS/dt over its mean and over the fastest so far, 1 of a steady growth:
  static constexpr double kShows = 0.3;        // a fifth of both is gone, and S shows it by so much of a limit, or ...
  static constexpr double kFlat = 0.25;        // ... half of both is
  static constexpr double kYields = 0.7;       // of the fastest that it moved the arm: one that comes on moves it on
  static constexpr double kGrowing = 0.75;     // sixth parts of both are errors of tau_ext
  static constexpr double kFitNoise = 0.18;    // of a limit: errors of tau_ext are an eighth to a fifth of it
  static constexpr double kFitModel = 0.1;     // of tau_ext: torque constants are off by up to as much
  static constexpr double kReach_m = 0.3;      // of a load's centre of mass from the frame's origin
  static constexpr double kHeaviest_kg = 10;   // where the bundle takes no loads: arms that people touch carry less
  static constexpr double kFirst_s = 0.06;     // since the alarm: nothing but an impact is told sooner,
  static constexpr double kAlong_s = 0.1;      // nor a clamp that has stopped the arm,
  static constexpr double kDriven_s = 0.13;    // nor another one that the arm is driven into,
  static constexpr double kStanding_s = 0.15;  // nor one of an arm that stands
  static constexpr double kSure_s = 0.02;      // it must have looked so for so long
  static constexpr double kDecided_s = 0.2;    // since the alarm: what is known by then stays, but
  static constexpr double kDoubled = 2;        // a push or a load that grows to this times its size is looked at anew

  explicit TouchKind(const Bundle& bundle);

  // One sample that entered the chain, in the order of time; tau_ext without what is taken for a load, NaN where there is
  // none. over: some joint is over a limit, its hold time past; alarm: one stands.
  struct Seen {
    std::int64_t t_ns = 0;
    std::span<const double> q, dq, tau_ext, limit_nm;
    bool over = false, alarm = false;
  };
  void step(const Seen& seen) noexcept;
  // The chain began anew: how what touches now began, nobody knows.
  void restart() noexcept;
  void reset() noexcept { state_ = {}; }
  Touch kind() const noexcept { return state_.kind; }  // none: no alarm stands, or nobody saw it begin

  // Of a block of samples' last one.
  struct Block {
    std::int64_t t_ns = 0;
    double size = 0, way = 0;  // S and x
    double left = 0;           // of S^2, that no load explains
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
  // All that it remembers; restore() goes on from there.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  // Over the recent blocks: by how much S and x have grown in so long.
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
