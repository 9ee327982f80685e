// What a bundle holds for each part of the chain: plain settings that training writes.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// The numbers stand in bundles.
enum class ResidualMethod : std::uint8_t {
  momentum = 0,  // MomentumObserver
  direct = 1,    // the others: ComparisonResidual
  velocity = 2,
  energy = 3,
};

const char* name(ResidualMethod method) noexcept;  // empty where it is none

// What training and monitor must share beside the model.
struct ObserverSettings {
  double gain_per_s = 0;              // K0, [1/s]
  TorqueTiming timing = TorqueTiming::held;  // what a sample of tau means
  std::int64_t sample_period_ns = 0;  // of the recording or the control loop
  int network_stride = 0;             // samples in a network period, the multiple of the sample period nearest 10 ms
  ResidualMethod method = ResidualMethod::momentum;  // what r is
  double high_pass_per_s = 0;         // filters on the residual, [1/s]; 0: none
  double low_pass_per_s = 0;
  // Torque constants, a joint: what is given as tau is multiplied by them before any other step. Empty: tau is in
  // the unit of the answers already.
  std::vector<double> nm_per_unit = {};

  // The slower of K0 and the low-pass: 10 over this after something wrong, r has forgotten it.
  double slowest_per_s() const noexcept {
    return low_pass_per_s > 0 ? std::min(gain_per_s, low_pass_per_s) : gain_per_s;
  }
  // r is the momentum observer's, without filters.
  bool unfiltered_momentum() const noexcept {
    return method == ResidualMethod::momentum && !(high_pass_per_s > 0 || low_pass_per_s > 0);
  }
  // Throws Error where there are torque constants, and not one for each joint or one that is 0 or not finite.
  void validate_constants(int joints) const;
};

// One layer. Parameters are one flat float array, in this order and with these shapes (row-major); gates stand in the
// order i, f, g, o (input, forget, cell, output), H rows each:
//   W_x (4H, inputs) | W_h (4H, H) | b (4H) | W_head (outputs, H) | b_head (outputs)
struct LstmShape {
  int inputs = 0, hidden = 0, outputs = 0;  // H is hidden; 0: no network

  // How many numbers the flat array holds.
  std::size_t parameter_count() const noexcept {
    const auto F = static_cast<std::size_t>(inputs), H = static_cast<std::size_t>(hidden),
               O = static_cast<std::size_t>(outputs);
    return 4 * H * (F + H + 1) + O * (H + 1);
  }
  // Throws Error where a size is not in 1..kMaxLstmInputs, 1..kMaxLstmHidden, 1..kMaxJoints.
  void validate() const;
};
// Largest sizes: what a monitor allocates stays small.
inline constexpr int kMaxLstmInputs = 512;
inline constexpr int kMaxLstmHidden = 256;
inline constexpr int kMaxWindowSteps = 10000;

// Input f of a network step is column `column` of the row `lag` network steps before that step's row.
struct LstmInput {
  int column = 0;  // of the row
  int lag = 0;  // 0 or more network steps
};

// At which rows the network answers.
enum class NetworkRate : std::uint8_t {
  every_sample,    // at every row: `stride` interleaved phases
  network_period,  // at every stride-th row; its last answer is held in between
};

// A regressor. Joints are counted from 0; `speed` is a smoothing of the sign of a speed: tanh(dq / speed), [rad/s].
// All act as a torque but momentum, a generalised momentum of which the observer takes the derivative.
// The numbers stand in bundles: a new kind gets the next one wherever it is listed, and none is ever used again.
enum class TermKind : std::uint8_t {
  constant = 0,         // 1
  viscous = 1,          // dq_a
  coulomb = 2,          // tanh(dq_a / speed)
  presliding = 3,       // state of joint a for width b
  load = 4,             // |beta_a| tanh(dq_a / speed): friction that grows with the load on the gear;
                        // form 0 beta of the estimated model, 1 of the corrected one
  load_presliding = 5,  // |beta_a| times the state of joint a for width b; forms as load
  ripple = 6,           // of motor and gear, b cycles a turn: form 0 sin(b q_a), 1 cos(b q_a)
  gravity = 7,          // form 0 sin a, 1 cos a, 2 sin a sin b, 3 sin a cos b, 4 cos a sin b, 5 cos a cos b;
                        // 6 to 13: a product of three, form - 6 = 4 [cos a] + 2 [cos b] + [cos c], sin where that is 0
  quadratic = 8,        // dq_a dq_b times form 0 sin c, 1 cos c
  momentum = 9,         // dq_a times form 0 1, 1 cos b, 2 sin b
  backlash = 10,        // beta_a (1 - |state of joint a for width b|): what the gear does not carry while it crosses its
                        // play; forms as load
  local_memory = 11,    // Presliding::memory_gap of joint a: its weight is the friction that has local memory, as LuGre's has
};

// One term: its kind, and a, b, c, form and speed as TermKind defines them for the kind; those that a kind does not use are 0.
struct Term {
  TermKind kind = TermKind::constant;
  std::int32_t a = 0, b = 0, c = 0, form = 0;
  double speed = 0;
};

// Friction of a joint follows its temperature: factors 1 + share (T - reference) / 10 K of what is Coulomb's and of what is
// viscous in the prior. Lists over the joints; empty: it does not. A joint without a measured temperature has its reference.
struct FrictionTemperature {
  std::vector<double> reference_c;      // [degC]
  std::vector<double> reach_k;          // farther from the reference than this is taken as this
  std::vector<double> coulomb_per_10k;  // shares
  std::vector<double> viscous_per_10k;

  bool on() const noexcept { return !reference_c.empty(); }
  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
};

// The terms of a prior with their weights, and the corrected model.
struct PriorSettings {
  std::vector<double> widths_rad;   // of the presliding states, also the network's
  std::vector<Term> terms;          // empty: no prior
  std::vector<double> weights;      // (joints, terms), [N m], [N m s] ... as the term requires
  // The model as data corrected it, in the order of the bundle's links; empty: not corrected.
  std::vector<Link> corrected_links;
  FrictionTemperature temperature = {};
  // A joint: the most |beta| that its load terms were fitted to, [N m]. They see no more than that; what is beyond, as with
  // a load, adds to the joint's friction by load_friction_shares() of it. Empty: no bound, and no such friction.
  std::vector<double> most_load_nm = {};
  std::vector<double> branches = {};  // (joints, widths): of presliding states with local memory, see Presliding; empty: none

  bool empty() const noexcept { return terms.empty() && corrected_links.empty(); }
  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
};

// What |tau_ext| of a joint must exceed, and for how long, before the alarm rises to a level. Limits of a bundle with an
// error scale hold in usual motion, and are multiplied by it.
struct Level {
  std::vector<double> sliding_nm;        // a joint, [N m]
  std::vector<double> near_stiction_nm;  // a joint, [N m]
  double hold_s = 0;                     // 0: the first sample over the limit raises the alarm
};

// Factors on the limits of a bundle, chosen while the monitor runs: above 1 it takes more to raise an alarm.
struct LimitFactors {
  static constexpr double kLowest = 0.1, kHighest = 10;  // beyond it nothing is left of what calibration promised
  JointVector collision, contact;  // a joint
  // All 1: the limits of the bundle.
  LimitFactors() noexcept {
    collision.fill(1.0);
    contact.fill(1.0);
  }
};

// Limits of both levels, and which joints are near stiction.
struct Limits {
  double near_stiction_rad_s = 0;  // near stiction: |dq| below this,
  int region_width = -1;           // or the presliding state of this width bent; -1: only the speed decides ...
  double near_memory_s = 0;        // ... and for so long afterwards: r still shows how the joint broke away
  Level collision;                 // latched until acknowledged
  Level contact;                   // falls back by itself ...
  double contact_release_s = 0;    // ... when |tau_ext| has been under its limit for so long
  // A push leaves the friction of a joint that is stuck at another level than its motion implies, until it slides: from the
  // moment no joint is over its limit any more, limits of such a joint are multiplied by this until it has slid for
  // kSlidS. 1: they are not.
  static constexpr double kSlidS = 0.5;
  double after_contact_factor = 1;

  // A joint that has slid on by a width has a state of 1 or -1 for it, and one that turns round leaves it at once: a
  // reversal is near stiction from its first sample until the joint slides again, however its speed flickers.
  bool near_stiction(double dq, double state) const noexcept {
    return std::fabs(dq) < near_stiction_rad_s || (region_width >= 0 && std::fabs(state) < kBent);
  }
  static constexpr double kBent = 0.9;  // a smaller |state|: the joint has not slid on
  // That of a joint in its region, [N m].
  double limit_nm(const Level& level, int joint, bool near) const noexcept {
    return near ? level.near_stiction_nm[joint] : level.sliding_nm[joint];
  }
  // Throws Error, naming what does not fit `joints` and `widths` presliding states a joint.
  void validate(int joints, int widths) const;
};

// Tracker of slow changes.
struct DriftSettings {
  double time_constant_s = 0;   // of the tracker, >= 1; 0: there is none, and nothing else here counts
  std::vector<double> size_nm;  // a joint: the most that each coefficient may reach, [N m]
  double rate_share_per_s = 0;  // how much of its size a coefficient may change in a second
  double freeze_share = 0;      // |tau_ext| over this share of the lower limit is a touch; 0: nothing is
  double freeze_s = 0;          // nothing is learned for so long after a touch
  std::vector<double> freeze_floor_nm = {};  // a joint: what is below is no touch, however low its limit, [N m]; empty: 0
  double friction_share = 0;  // the most that friction may be off by at once (FrictionFactors); 0: not followed

  bool on() const noexcept { return time_constant_s > 0; }
  bool follows_factors() const noexcept { return on() && friction_share > 0; }
  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
};

// What of a joint's motion, or of the whole arm's, errors grow with; all >= 0.
// The numbers stand in bundles: a new kind gets the next one, and none is ever used again.
enum class MotionFeature : std::uint8_t {
  constant = 0,          // 1
  speed = 1,             // |dq_j|
  acceleration = 2,      // |ddq_j|, ddq = Ka (dq - LP dq)
  jerk = 3,              // |dddq_j|, dddq = Ka (ddq - LP ddq): torque and velocity are never sampled at quite one time
  standstill = 4,        // near 1 while the joint stands or creeps and for a while afterwards
  arm_speed = 5,         // the same summed over all joints, since they are coupled
  arm_acceleration = 6,
  arm_jerk = 7,
};
inline constexpr int kMotionFeatures = 8;  // kinds that there are

// Weights are >= 0 and stand in rows of one joint, (joints, features).
struct ErrorScaleSettings {
  std::vector<MotionFeature> features;    // none: no standard error; the constant alone: constant limits with one
  std::vector<double> limit_weights;      // of the limits' scale; 1 is usual motion
  std::vector<double> largest;            // a joint: the scale never exceeds its largest on training motion
  std::vector<double> sigma_weights;      // of the standard error while sliding, [N m] for a feature of 1
  std::vector<double> sigma_near_weights; // and near stiction
  std::vector<double> largest_sigma;      // a joint: the standard error never exceeds this, [N m]

  bool on() const noexcept { return !features.empty(); }  // there is a standard error
  // Limits and standard error follow the motion.
  bool follows() const noexcept {
    return std::ranges::any_of(features, [](MotionFeature one) { return one != MotionFeature::constant; });
  }
  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
};

// Motion that occurred in training. Positions are sorted into cells; those of a joint that turns wrap after one turn.
// Empty: training motion is unknown, and all motion is familiar.
struct CoverageSettings {
  std::vector<double> fastest_rad_s;         // a joint: largest |dq| of training, > 0; [m/s] of one that slides
  std::vector<std::uint8_t> turns;           // a joint: 1 where the first cell follows on the last one
  std::vector<double> centre_rad, span_rad;  // a joint: middle and length of all its cells together; [m] of one that slides
  std::vector<std::uint64_t> seen;           // a joint: bit c is set where training was in its cell c, of kCells
  // Cells from a seen one within which a position is familiar, a joint; 0: its position by itself is no evidence.
  std::vector<std::uint8_t> reach;
  // Pairs of joints i < j, (0, 1), (0, 2), ... (1, 2), ..., kPairCells words each: bit d of word c is set where training
  // was in cell c of joint i while it was in cell d of joint j, of kPairCells each.
  std::vector<std::uint32_t> seen_together;  // empty where ...
  std::uint8_t reach_together = 0;           // ... this is 0: pairs are no evidence

  bool empty() const noexcept { return fastest_rad_s.empty(); }  // training motion is unknown
  // Throws Error, naming what does not fit.
  void validate(int joints) const;
  // Marks the cells of a sample of training as seen; the settings hold together, and q is finite.
  void see(std::span<const double> q) noexcept;
};

// Ranges of the arm's signals, for the watch; a value for each joint.
struct SignalRanges {
  std::vector<double> torque_limit_nm;    // the drive gives no more, [N m]; infinite where unknown
  std::vector<double> largest_torque_nm;  // largest |tau_m| in training, [N m]; > 0
  // Beyond these nothing is true, whatever touches the arm; infinite where unknown.
  std::vector<double> possible_torque_nm = {};    // of |tau_m|, [N m]; at least the largest of training
  std::vector<double> possible_speed_rad_s = {};  // of |dq|, [rad/s], and of how fast q changes
  // By what share of the sample period the mean step may differ from it: the most in training, within these bounds.
  static constexpr double kLeastRateTolerance = 0.05, kMostRateTolerance = 0.15;
  double rate_tolerance = kLeastRateTolerance;

  // Throws Error, naming what does not fit.
  void validate(int joints) const;
};

// All points within radius_m of the line from start to end, in the link's own frame, [m].
struct Capsule {
  std::int32_t link = -1;
  std::array<double, 3> start{}, end{};
  double radius_m = 0;
};

// Throws Error unless all are fixed to one of so many links, within 1000 m of it, and 0.1 mm to 10 m wide.
void validate_capsules(std::span<const Capsule> capsules, int joints);

}  // namespace tauext
