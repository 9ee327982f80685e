// Settings of the parts of the chain, as training writes them to a bundle.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "tauext/link.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Bundles store these numbers.
enum class ResidualMethod : std::uint8_t {
  momentum = 0,  // MomentumObserver
  direct = 1,    // the others: ComparisonResidual
  velocity = 2,
  energy = 3,
};

const char* name(ResidualMethod method) noexcept;  // empty for an unknown number

// Settings of the observer that training and monitor share.
struct ObserverSettings {
  double gain_per_s = 0;              // K0, [1/s]
  TorqueTiming timing = TorqueTiming::held;  // meaning of a sample of tau
  std::int64_t sample_period_ns = 0;  // of the recording or the control loop, [ns]
  int network_stride = 0;             // samples in a network period: the multiple of the sample period nearest 10 ms
  ResidualMethod method = ResidualMethod::momentum;  // definition of r
  double high_pass_per_s = 0;         // filters of the residual, [1/s]; 0: none
  double low_pass_per_s = 0;
  // Torque constants, one per joint: factors on the input tau, applied first. Empty: tau is in the unit of the
  // estimates already.
  std::vector<double> nm_per_unit = {};
  // Per joint: 1: its torque constant is unknown. tau and r stay in the input's unit, and r is without the model, whose
  // torque is in N m. Empty: none is.
  std::vector<std::uint8_t> unknown_constant = {};

  // The slower rate of K0 and the low-pass. After ten times its inverse, r has forgotten a faulty sample.
  double slowest_per_s() const noexcept {
    return low_pass_per_s > 0 ? std::min(gain_per_s, low_pass_per_s) : gain_per_s;
  }
  // Whether r is the momentum observer's residual without filters.
  bool unfiltered_momentum() const noexcept {
    return method == ResidualMethod::momentum && !(high_pass_per_s > 0 || low_pass_per_s > 0);
  }
  bool has_unknown_constant(std::size_t joint) const noexcept {
    return joint < unknown_constant.size() && unknown_constant[joint] != 0;
  }
  // Throws Error unless there are no torque constants or one per joint, each finite and not 0, and what is unknown is
  // one of them.
  void validate_constants(int joints) const;
};

// Sizes of one LSTM layer with a linear head. Parameters are one flat float array in this order, row-major; gates are
// in the order i, f, g, o (input, forget, cell, output), H rows each:
//  W_x (4H, inputs) | W_h (4H, H) | b (4H) | W_head (outputs, H) | b_head (outputs)
struct LstmShape {
  int inputs = 0, hidden = 0, outputs = 0;  // H is hidden; 0: no network

  // Length of the parameter array.
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

// An input of the network: a column of the feature row that lies `lag` network steps before the current one.
struct LstmInput {
  int column = 0;  // of feature_rows()
  int lag = 0;  // network steps, 0 or more
};

// How often the network is evaluated.
enum class NetworkRate : std::uint8_t {
  every_sample,    // at every row: `stride` interleaved phases
  network_period,  // at every stride-th row; the last output is held in between
};

// Regressors of the prior. Joints are counted from 0. `speed` smooths the sign of a velocity: tanh(dq / speed),
// [rad/s]. All terms are torques except momentum, a generalised momentum that the observer differentiates. Bundles
// store these numbers: a new kind gets the next number, wherever it is listed, and no number is reused.
enum class TermKind : std::uint8_t {
  constant = 0,         // 1
  viscous = 1,          // dq_a
  coulomb = 2,          // tanh(dq_a / speed)
  presliding = 3,       // state of joint a for width b
  load = 4,  // |beta_a| tanh(dq_a / speed): friction that grows with the load on the gear; form 0: beta of the
             // estimated model, 1: of the corrected model
  load_presliding = 5,  // |beta_a| times the state of joint a for width b; forms as load
  ripple = 6,           // of motor and gear, b cycles a turn: form 0 sin(b q_a), 1 cos(b q_a)
  gravity = 7,          // form 0 sin a, 1 cos a, 2 sin a sin b, 3 sin a cos b, 4 cos a sin b, 5 cos a cos b;
                        // 6 to 13: a product of three, form - 6 = 4 [cos a] + 2 [cos b] + [cos c], sin where that is 0
  quadratic = 8,        // dq_a dq_b times form 0 sin c, 1 cos c
  momentum = 9,         // dq_a times form 0 1, 1 cos b, 2 sin b
  backlash = 10,  // beta_a (1 - |state of joint a for width b|): torque that the gear does not transmit while it
                  // crosses its play; forms as load
  local_memory = 11,    // Presliding::memory_gap of joint a; its weight is friction with local memory, as in LuGre
};

// One term; TermKind defines a, b, c, form and speed for each kind. Unused ones are 0.
struct Term {
  TermKind kind = TermKind::constant;
  std::int32_t a = 0, b = 0, c = 0, form = 0;
  double speed = 0;
};

// Friction as a function of the joint temperature T: factors 1 + share (T - reference) / 10 K on the prior's Coulomb
// and viscous terms. One value per joint; empty: no dependence. A joint without a temperature has its reference.
struct FrictionTemperature {
  std::vector<double> reference_c;      // [degC]
  std::vector<double> reach_k;          // a larger distance from the reference is clipped to this, [K]
  std::vector<double> coulomb_per_10k;  // shares per 10 K
  std::vector<double> viscous_per_10k;

  bool on() const noexcept { return !reference_c.empty(); }
  // Throws Error with the field that is invalid for this number of joints.
  void validate(int joints) const;
};

// Terms of the prior with their weights, and the corrected model.
struct PriorSettings {
  std::vector<double> widths_rad;   // of the presliding states, which are inputs of the network, too
  std::vector<Term> terms;          // empty: no prior
  std::vector<double> weights;      // (joints, terms), in the unit that the term requires: [N m], [N m s], ...
  // Model corrected by data, in the order of the bundle's links; empty: not corrected.
  std::vector<Link> corrected_links;
  FrictionTemperature temperature = {};
  // Per joint: largest |beta| in the fit of its load terms, [N m]. The terms are clipped there. Torque beyond it, as
  // from a payload, adds to the friction by its load_friction_shares(). Empty: no bound, and no such friction.
  std::vector<double> most_load_nm = {};
  std::vector<double> branches = {};  // (joints, widths): presliding states with local memory, see Presliding; empty:
                                      // none

  bool empty() const noexcept { return terms.empty() && corrected_links.empty(); }
  // Throws Error with the field that is invalid for this number of joints.
  void validate(int joints) const;
};

// Threshold of |tau_ext| per joint, and hold time, of an alarm level. With an error scale, thresholds are those of usual motion
// and are multiplied by the scale. Infinite in both regions and levels: the joint is not monitored.
struct Level {
  std::vector<double> sliding_nm;        // per joint, [N m]
  std::vector<double> near_stiction_nm;  // per joint, [N m]
  double hold_s = 0;                     // [s]; 0: the first sample above the threshold raises the alarm
};

// Factors on the thresholds at run time; above 1 thresholds are higher.
struct LimitFactors {
  static constexpr double kLowest = 0.1, kHighest = 10;  // outside, calibration is meaningless
  JointVector collision, contact;  // per joint
  // All 1.
  LimitFactors() noexcept {
    collision.fill(1.0);
    contact.fill(1.0);
  }
};

// Thresholds of both alarm levels, and the definition of near stiction.
struct Limits {
  double near_stiction_rad_s = 0;  // a joint is near stiction if |dq| is below this, ...
  int region_width = -1;           // ... or the presliding state of this width is bent (-1: speed only), ...
  double near_memory_s = 0;        // ... and for this time afterwards, while r still contains the breakaway
  Level collision;                 // latched until acknowledged
  Level contact;                   // falls back by itself ...
  double contact_release_s = 0;    // a touch is over when all |tau_ext| have been within their thresholds for this time; a contact then ends
  // A push on a stuck joint changes its friction from the level that its motion implies, until the joint slides. From
  // the moment at which no joint exceeds its threshold, thresholds of such a joint are multiplied by after_contact_factor until
  // it has slid for kSlidS. A factor of 1 switches this off.
  static constexpr double kSlidS = 0.5;
  double after_contact_factor = 1;
  // Standard errors by which what an expected contact explains may be wrong (DeclaredContacts).
  double declared_spread = 3;

  // A joint that has slid by a width has a state of 1 or -1 for it, and a reversal changes the state at once. A
  // reversal is therefore near stiction from its first sample until the joint slides again, however noisy its speed.
  bool near_stiction(double dq, double state) const noexcept {
    return std::fabs(dq) < near_stiction_rad_s || (region_width >= 0 && std::fabs(state) < kBent);
  }
  static constexpr double kBent = 0.9;  // with a smaller |state| the joint does not slide
  // Whether a joint can raise an alarm. One whose thresholds are infinite cannot: it never moved in training.
  bool monitors(int joint) const noexcept { return std::isfinite(collision.sliding_nm[static_cast<std::size_t>(joint)]); }
  // Threshold of a joint in its region, [N m]; infinite if the joint is not monitored.
  double limit_nm(const Level& level, int joint, bool near) const noexcept {
    return near ? level.near_stiction_nm[joint] : level.sliding_nm[joint];
  }
  // Throws Error with the field that is invalid for this number of joints and of presliding states per joint.
  void validate(int joints, int widths) const;
};

// Settings of the tracker of slow changes.
struct DriftSettings {
  double time_constant_s = 0;   // [s], >= 1; 0: no tracker, and the other settings are ignored
  std::vector<double> size_nm;  // per joint: bound on each coefficient, [N m]
  double rate_share_per_s = 0;  // largest change of a coefficient per second, relative to its bound
  double freeze_share = 0;      // |tau_ext| above this share of the lower threshold is a touch; 0: no touches
  double freeze_s = 0;          // learning pauses for this time after a touch, [s]
  std::vector<double> freeze_floor_nm = {};  // per joint: a smaller torque is no touch, however low the threshold, [N m];
                                             // empty: 0
  double friction_share = 0;  // FrictionFactors follow friction of 1 / (1 + this) to 1 + this times the prior's; 0: none

  bool on() const noexcept { return time_constant_s > 0; }
  bool follows_factors() const noexcept { return on() && friction_share > 0; }
  // Throws Error with the field that is invalid for this number of joints.
  void validate(int joints) const;
};

// Features of a joint's motion, or of the whole arm's, with which errors grow; all >= 0. Bundles store these numbers: a
// new kind gets the next number, and no number is reused.
enum class MotionFeature : std::uint8_t {
  constant = 0,          // 1
  speed = 1,             // |dq_j|
  acceleration = 2,      // |ddq_j|, ddq = Ka (dq - LP dq)
  jerk = 3,  // |dddq_j|, dddq = Ka (ddq - LP ddq): torque and velocity are not sampled at exactly the same time
  standstill = 4,        // near 1 while the joint rests or creeps, and for a while afterwards
  arm_speed = 5,         // the corresponding sums over all joints, which are coupled
  arm_acceleration = 6,
  arm_jerk = 7,
};
inline constexpr int kMotionFeatures = 8;  // number of features

// How thresholds and standard error grow with the motion. Weights are >= 0, (joints, features).
struct ErrorScaleSettings {
  std::vector<MotionFeature> features;    // none: no standard error; the constant alone: constant thresholds with one
  std::vector<double> limit_weights;      // of the limits' scale, 1 in usual motion
  std::vector<double> largest;            // per joint: bound on the scale, its largest value in training
  std::vector<double> sigma_weights;      // of the standard error while sliding, [N m] for a feature of 1
  std::vector<double> sigma_near_weights;  // of the standard error near stiction
  std::vector<double> largest_sigma;      // per joint: bound on the standard error, [N m]

  bool on() const noexcept { return !features.empty(); }  // there is a standard error
  // Whether thresholds and standard error follow the motion.
  bool follows() const noexcept {
    return std::ranges::any_of(features, [](MotionFeature one) { return one != MotionFeature::constant; });
  }
  // Throws Error with the field that is invalid for this number of joints.
  void validate(int joints) const;
};

// Motion of the training recordings. Positions are sorted into cells; those of a joint without thresholds wrap after a
// turn. Empty: unknown, and all motion is familiar.
struct CoverageSettings {
  std::vector<double> fastest_rad_s;         // per joint: largest |dq| of training, > 0; [m/s] for a prismatic joint
  std::vector<std::uint8_t> turns;           // per joint: 1 if the first cell follows the last one
  std::vector<double> centre_rad, span_rad;  // per joint: middle and length of all its cells; [m] for a prismatic joint
  std::vector<std::uint64_t> seen;           // per joint: bit c is set if training was in its cell c, of kCells
  // Per joint: distance in cells from a seen one within which a position is familiar; 0: this joint's position is not
  // judged alone.
  std::vector<std::uint8_t> reach;
  // Pairs of joints i < j, (0, 1), (0, 2), ... (1, 2), ..., kPairCells words each: bit d of word c is set if training
  // was in cell c of joint i and cell d of joint j at the same time, of kPairCells each.
  std::vector<std::uint32_t> seen_together;  // empty if ...
  std::uint8_t reach_together = 0;           // ... this is 0: pairs are not judged

  bool empty() const noexcept { return fastest_rad_s.empty(); }  // training motion is unknown
  // Throws Error with the field that is invalid.
  void validate(int joints) const;
  static constexpr int kCells = 64, kPairCells = 32;  // for single joints; for each joint of a pair
  static constexpr int kMostReach = 16;               // cells: a quarter or half of a turn
  // Marks the cells of a training sample as seen. The settings must be valid and q finite.
  void see(std::span<const double> q) noexcept;
};

// Plausible ranges of the arm's signals, per joint.
struct SignalRanges {
  std::vector<double> torque_limit_nm;    // limit of the drive, [N m]; infinite if unknown
  std::vector<double> largest_torque_nm;  // largest |tau_m| in training, > 0, [N m]
  // Samples beyond these are faults, whatever touches the arm; infinite if unknown.
  std::vector<double> possible_torque_nm = {};    // of |tau_m|, at least the largest of training, [N m]
  std::vector<double> possible_speed_rad_s = {};  // of |dq| and of the change of q, [rad/s]
  // Largest relative difference between mean step and sample period: the largest in training, within these bounds.
  static constexpr double kLeastRateTolerance = 0.05, kMostRateTolerance = 0.15;
  double rate_tolerance = kLeastRateTolerance;

  // Throws Error with the field that is invalid.
  void validate(int joints) const;
};

// All points within radius_m of the line from start to end, [m] in the link's frame.
struct Capsule {
  std::int32_t link = -1;
  std::array<double, 3> start{}, end{};
  double radius_m = 0;
};

// Throws Error unless each capsule is fixed to one of this number of links, within 1000 m of it, and 0.1 mm to 10 m
// wide.
void validate_capsules(std::span<const Capsule> capsules, int joints);

// A frame fixed to a link, relative to the link's frame.
struct WrenchFrame {
  std::string name;
  std::int32_t link = -1;
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  // link from frame, row-major
  std::array<double, 3> translation{};                        // origin in the link's frame, [m]
};

// Model of the errors of tau_ext across the joints; the estimate's sigma_nm is the size of each.
struct WrenchSettings {
  static constexpr double kUsualTorqueShare = 0.05;  // default: measured torques and makers' constants are off by 5 to
                                                     // 10 %

  std::vector<WrenchFrame> frames;   // frames of the robot file
  std::vector<double> correlation;   // (joints, joints) in free motion, positive definite; empty: independent
  std::vector<double> torque_share;  // per joint: relative standard error of the torque constant; empty: the default
  double common_share = 0;           // relative standard error of a factor common to all joints
  // After a known weight; empty: 1, and independent errors.
  std::vector<double> torque_factor;       // per joint: torque of a payload or force as measured, over the true one
  std::vector<double> torque_correlation;  // (joints, joints) of the own errors
  // By WrenchKind. radius: factor on the variances of free motion, so that 95 % of its errors lie in the 95 %
  // ellipsoid. residual_radius: factor on the chi-square of the unexplained remainder.
  std::array<double, 2> radius{1, 1}, residual_radius{1, 1};

  // Relative standard error of a joint's torque constant beside the common factor, and with it.
  double own_share(std::size_t joint) const noexcept {
    return torque_share.empty() ? kUsualTorqueShare : torque_share[joint];
  }
  double factor(std::size_t joint) const noexcept { return torque_factor.empty() ? 1.0 : torque_factor[joint]; }
  // Of tau_ext, in which a joint keeps its own factor.
  double share(std::size_t joint) const noexcept { return std::hypot(common_share, own_share(joint), factor(joint) - 1); }
  // Covariance of two joints' relative errors.
  double constants_covariance(std::size_t i, std::size_t j) const noexcept {
    const double alike = torque_correlation.empty() ? (i == j ? 1.0 : 0.0) : torque_correlation[i * torque_factor.size() + j];
    return common_share * common_share + alike * own_share(i) * own_share(j);
  }
  // Throws Error with the field that is invalid for this number of joints.
  void validate(int joints) const;
};

// Signal from which a joint's torque is computed. Bundles store these numbers.
enum class TorqueFrom : std::uint8_t {
  torque = 0,         // reported by the servo; used unchanged
  phase_current = 1,  // current of the windings, signed
  supply_current = 2,  // current that the bridge draws, unsigned: |D I|
  duty = 3,  // share of the supply voltage at the motor, signed (Feetech: Present_Load; Dynamixel: Present PWM)
  goal = 4,           // duty from goal and position, by the gain of the servo's position controller
};

// Constants of a servo at the joint, behind its gear. For a motor with gear ratio N: V, R and N k_t.
struct ServoConstants {
  double volts = 1;          // supply voltage if the samples contain none, > 0, [V]
  double ohm = 1;            // of the windings, > 0, [ohm]
  double back_emf_v_s = 0;   // k_e [V s/rad], >= 0
  double nm_per_ampere = 1;  // k_t, [N m/A]; 1 if unknown: torques are in A
  double duty_per_rad = 0;   // gain of the position controller, >= 0, [1/rad]; used for torque from the goal
  double most_duty = 1;      // largest duty of the controller, 0 to 1
  double count_rad = 0;      // resolution of the encoder, >= 0, [rad]
};

// Computation of dq and tau from servo signals.
struct ServoSettings {
  static constexpr int kMostSteps = 64;  // largest window of the velocity
  static constexpr int kMostDelay = 64;  // largest goal delay, in sample periods

  TorqueFrom torque_from = TorqueFrom::torque;
  int velocity_steps = 0;              // largest window of the velocity, in steps; 0: dq is used unchanged
  std::int64_t sample_period_ns = 0;   // > 0 if velocity_steps is; a pause of over 2.5 periods restarts the window
  std::int64_t goal_delay_ns = 0;      // time after which a goal acts, at most kMostDelay sample periods
  std::vector<ServoConstants> joints;  // empty: these are no servos, and a ServoInput cannot be made

  // False: not servos, and a ServoInput cannot be constructed.
  bool on() const noexcept { return !joints.empty(); }
  // Throws Error with the field and its rule.
  void validate() const;
};

}  // namespace tauext
