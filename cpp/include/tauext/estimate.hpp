// The result for one sample: external torque, its standard error, thresholds, alarm and health.
#pragma once
#include <cstdint>

#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Alarm levels, in rising order.
enum class Alarm : std::uint8_t {
  none,
  contact,    // a joint over its contact threshold for the hold time; ends by itself
  collision,  // a joint over its collision threshold for the hold time; latched until acknowledged
};

const char* name(Alarm alarm) noexcept;  // "none", "contact", "collision"

// Part of a motion that did not occur in training.
enum class Unseen : std::uint8_t {
  nothing,
  speed,      // speed of unseen_joint
  position,   // position of unseen_joint
  positions,  // position of unseen_joint together with that of unseen_other
};
const char* name(Unseen unseen) noexcept;  // "speed", ...

// Kind of touch behind an alarm.
enum class Touch : std::uint8_t {
  none,     // no alarm stands
  unknown,  // not decided yet, or none of the others
  impact,   // the torque came and went within a bounce
  push,     // the contact yields: the torque settled while the arm moves against it, or after it moved the arm
  clamp,    // the contact does not yield: the torque grows as the arm moves on, or keeps growing while it stands
  load,     // a weight at the load frame
};

const char* name(Touch touch) noexcept;  // "none", "unknown", ...

// Progress of an expected payload.
enum class LoadPhase : std::uint8_t {
  none,       // nothing is expected
  expecting,  // no payload detected yet
  deciding,   // an alarm is held back: the torque fits a payload
  found,      // a payload was set; more mass is added until the window ends
  weighing,   // the window is over and no alarm is held back; the identification continues
};

const char* name(LoadPhase phase) noexcept;  // "none", "expecting", ...

// What an expected contact explains of a sample.
enum class Declared : std::uint8_t {
  none,    // no expected contact is in effect, or there is no torque
  within,  // in effect; what the bounds admit is explained
  beyond,  // the force or torque is larger than declared by more than two standard errors
  moved,   // the point moved farther along the axis than declared: nothing is explained until the force has gone
};

const char* name(Declared declared) noexcept;  // "none", "within", ...

// Result for one sample. Torques that do not exist are NaN: tau_ext, sigma_nm, network, uncertainty and margin_nm exist
// only while health is ok or stale, or if kTorqueSaturated is the only cause.
struct Estimate {
  std::int64_t t_ns = 0;            // time stamp of the sample, [ns]
  int joints = 0;                   // number of joints; further elements of the vectors are meaningless
  Health health = Health::warming_up;  // whether the torques can be trusted
  std::uint32_t causes = 0;         // bits of Cause
  int cause_joint = -1;             // first joint that a cause concerns; -1: none
  Alarm alarm = Alarm::none;        // the latched alarm
  Alarm held_alarm = Alarm::none;   // level exceeded at this sample, after its hold time; not latched
  int alarm_joint = -1;             // joint that raised the alarm to its level; -1: no alarm
  std::int64_t alarm_t_ns = 0;      // time at which the alarm rose to its level, [ns]
  std::uint32_t alarm_number = 0;   // of the newest alarm, which stands if one does; 0: there was none
  std::int64_t touch_t_ns = 0;      // last sample at which some joint was over a threshold, [ns]; 0: none since the last alarm
  bool touch_over = true;           // no alarm, or within all thresholds, and known, for Limits::contact_release_s
  Touch touch = Touch::none;        // kind of touch behind the alarm, as of the previous sample
  bool detection = false;           // some |tau_ext| exceeds its collision threshold at this sample; no hold time
  std::uint32_t near_stiction = 0;  // a bit per joint: its threshold near stiction applies
  std::uint32_t drift_saturated = 0;  // a bit per joint: its drift has reached the bound; retrain
  double unfamiliar = 0;            // distance of the motion from the training motion, 0 to 1; 0 without a coverage
  Unseen unseen = Unseen::nothing;  // main difference from the training motion
  int unseen_joint = -1, unseen_other = -1;  // joints of `unseen`; -1: none
  JointVector residual{};           // r of the observer, [N m]
  JointVector prior{};              // r that the prior expects in free motion, [N m]
  JointVector network{};            // what the network adds to the prior, [N m]; 0 without a network
  JointVector drift{};              // slow changes since training, [N m]; 0 without a tracker
  JointVector uncertainty{};        // r expected in free motion: prior + network + drift, [N m]
  JointVector tau_ext{};  // residual - uncertainty, [N m]; positive: a push in the joint's positive direction
  JointVector doubt{};  // possible error of prior (unknown presliding states) and payload torques, [N m]
  JointVector sigma_nm{};  // standard error of tau_ext in free motion, doubt included, [N m]; NaN: unknown
  JointVector contact_sigma_nm{};   // standard error of tau_ext during and after a contact, [N m]
  JointVector limit_scale{};        // factor of the motion on the thresholds, unfamiliar motion included; 1 in usual motion
  JointVector limit_nm{};           // collision threshold of |tau_ext|, scale and doubt included, [N m]; infinite: not monitored
  JointVector contact_limit_nm{};   // contact threshold of |tau_ext|, scale and doubt included, [N m]
  JointVector margin_nm{};          // limit_nm - |tau_ext - load_nm - declared_nm|, [N m]
  Load load;                        // payload that the model carries; mass 0: none
  LoadPhase load_phase = LoadPhase::none;  // phase of an expected payload
  std::int64_t load_found_ns = 0;   // sample at which the last expected payload was found, [ns]; 0: none
  double load_error_kg = 0;         // standard error of its mass, with that of the torque constants, [kg]
  JointVector load_nm{};            // part of tau_ext attributed to an expected payload, [N m]; 0 if none is expected
  Declared declared = Declared::none;  // state of the expected contact in effect
  int declared_contact = -1;        // its number: one beyond its bounds, else one at a frame, else one of a joint; -1: none
  double declared_size = 0;         // its force within the cone, however large, [N]; of a joint the torque, in its unit
  double declared_sigma = 0;        // standard error of that
  double declared_moment_nm = 0;    // its moment, [N m]
  double declared_travel_m = 0;     // way of its point along the axis since the contact began, [m]
  JointVector declared_nm{};        // part of tau_ext that expected contacts explain, [N m]; the alarm uses the rest

  // Healthy and no alarm: the only condition that means "no collision".
  bool clear() const noexcept { return health == Health::ok && alarm == Alarm::none; }
};

}  // namespace tauext
