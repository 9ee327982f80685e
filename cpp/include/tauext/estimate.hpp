// The answer for a sample: external torque and its standard error, alarm, health and what they follow from.
#pragma once
#include <cstdint>

#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Levels of an alarm, each over the one before it.
enum class Alarm : std::uint8_t {
  none,
  contact,    // over the contact limit for its hold time; falls back by itself
  collision,  // over the collision limit for its hold time; stays until acknowledged
};

const char* name(Alarm alarm) noexcept;  // "none", "contact", "collision"

// The part of a motion that never occurred in training.
enum class Unseen : std::uint8_t {
  nothing,
  speed,      // of `joint`
  position,   // of `joint`
  positions,  // of `joint` while `other` was where it was
};
const char* name(Unseen unseen) noexcept;  // "speed", ...

// What kind of touch an alarm is.
enum class Touch : std::uint8_t {
  none,     // no alarm stands
  unknown,  // not decided yet, or none of the others
  impact,   // it came and went within a bounce
  push,     // it yields: the torque has settled though the arm goes on against it, or it moved the arm and has settled
  clamp,    // it does not: the torque grows with the arm's way into it, or grows on and on while the arm stands
  load,     // a weight at the load frame
};

const char* name(Touch touch) noexcept;  // "none", "unknown", ...

// How far the monitor is with a load that is expected.
enum class LoadPhase : std::uint8_t {
  none,       // nothing is expected
  expecting,  // nothing has shown yet
  deciding,   // an alarm is held back: what shows fits a load
  found,      // one was set; more of it is taken until the window ends
  weighing,   // the window is over and nothing is held back; the load is weighed on
};

const char* name(LoadPhase phase) noexcept;  // "none", "expecting", ...

// The chain's estimate at one sample. A torque that does not exist is NaN: tau_ext, sigma, network, uncertainty and margin
// exist where health is ok or stale, or kTorqueSaturated is all that is or was wrong.
struct Estimate {
  std::int64_t t_ns = 0;            // stamp of the sample
  int joints = 0;                   // of the vectors below, so many numbers count
  Health health = Health::warming_up;  // whether torques can be trusted
  std::uint32_t causes = 0;         // bits of Cause
  int cause_joint = -1;             // the first joint that a cause concerns
  Alarm alarm = Alarm::none;        // latched
  Alarm held_alarm = Alarm::none;   // what some joint is over at this sample, its hold time past; no latch
  int alarm_joint = -1;             // that raised the alarm to its level
  std::int64_t alarm_t_ns = 0;      // when it did
  Touch touch = Touch::none;        // what kind of touch the alarm is, as known after the sample before this one
  bool detection = false;           // some |tau_ext| over its collision limit, at this sample
  std::uint32_t near_stiction = 0;  // a bit a joint: which of its limits holds
  std::uint32_t drift_saturated = 0;  // a bit a joint: its drift is at the bound, and the arm must be retrained
  double unfamiliar = 0;            // distance of the motion from all training motion, 0 to 1; 0 without a coverage
  Unseen unseen = Unseen::nothing;  // what of it is farthest, ...
  int unseen_joint = -1, unseen_other = -1;  // ... of this joint, together with the other one where positions are
  JointVector residual{};           // r of the observer, [N m]
  JointVector prior{};              // what physics expects of r in free motion, [N m]
  JointVector network{};            // what the network expects beside it, [N m]; 0 without one
  JointVector drift{};              // what the tracker has learned since, [N m]; 0 without one
  JointVector uncertainty{};        // r expected in free motion: prior + network + drift, [N m]
  JointVector tau_ext{};            // residual - uncertainty, [N m]
  JointVector doubt{};              // how far the prior may be off while presliding states are unknown, and the torques of a
                                    // load because it is not known exactly, [N m]
  JointVector sigma_nm{};           // standard error of tau_ext in free motion, doubt included, [N m]; NaN without an error scale
  JointVector contact_sigma_nm{};   // the same while something touches the arm and after it
  JointVector limit_scale{};        // what the motion multiplies the limits by, unfamiliar motion too; usual is 1
  JointVector limit_nm{};           // that |tau_ext| must exceed for a collision; scale and doubt included
  JointVector contact_limit_nm{};   // the same for a contact
  JointVector margin_nm{};          // limit - |tau_ext - load_nm|
  Load load;                        // what the arm is taken to carry; mass 0: nothing
  LoadPhase load_phase = LoadPhase::none;  // of a load that is expected
  std::int64_t load_found_ns = 0;   // sample at which the last one that was expected was found; 0: none
  double load_error_kg = 0;         // standard error of its mass
  JointVector load_nm{};            // what of tau_ext is taken for a load that is expected, [N m]; 0 while none is

  // The only thing that may be read as "no collision".
  bool clear() const noexcept { return health == Health::ok && alarm == Alarm::none; }
};

}  // namespace tauext
