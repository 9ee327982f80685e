// Refit: updates the friction of a bundle from a minute of ordinary motion.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/bundle.hpp"
#include "tauext/sample.hpp"

namespace tauext {

// Prior of today's weights. With w the old weights of a joint's own terms and independent standard normal u:
//
//   friction (Coulomb at every smoothing, presliding, load):  w (1 + common u_0 + apart u_1) + single F / rms(x) u_m
//   viscous:                                                  w (1 + common u_0 + apart u_2) + single F / rms(x) u_m
//   constant, ripple, network:                                w + constant F u_m, w (1 + ripple u_m), w (1 + network u_m)
//
// All friction one minute before the end is w (1 + trend u_3), with w the weights at the end. F is the RMS of the
// joint's friction in today's motion and x the filtered value of the term, so that each weight varies in proportion to
// its effect.
// The rows of a joint at rest for 5 s, or since the start of the recording, do not count for this joint: static
// friction can hold any torque. A joint that never moves keeps its weights.
// Terms of the arm (gravity, inertia, corrections of the model) do not change: a minute of motion determines them worse
// than training did, and a difference would be another payload.
struct RefitSettings {
  double common = 0.3;     // all friction together: gears a night older or 30 K colder
  double apart = 0.15;     // Coulomb and viscous friction separately: grease thins, metal does not
  double single = 0.03;    // per term, relative to the friction: the curve bends
  double constant = 0.1;   // relative to the friction: offset of the torque measurement
  double ripple = 0.1;
  double trend = 0.1;      // relative to the friction, per minute: warm-up during the recording
  double network = 0.3;    // the network learned the remainder of the old friction, which scales with it
  // Per joint, if known better: expected friction relative to the old one, instead of 1, and its standard deviation,
  // instead of common (apart scales with it). Empty: unknown.
  std::vector<double> expected = {}, expected_error = {};

  // Throws Error for a value outside 0 to 10, an expectation outside 0.2 to 5, or its deviation outside (0, 10].
  void validate(int joints) const;
};

// A recording of today's motion. Samples with possible touches are not fitted, but run through the chain.
struct RefitSource {
  RecordingView recording;
  std::span<const std::uint8_t> use = {};  // per sample: 0 is left out; empty: all are used
};

// Today's friction divided by the old one, and the standard error of this factor.
struct RefitFactor {
  double value = 1, error = 0;
};

// Result for one joint.
struct RefitJoint {
  RefitFactor coulomb, viscous;  // of friction with the sign of the motion, and of friction proportional to the speed
  double constant_nm = 0, constant_error_nm = 0;  // change of the constant, and its standard error
  double moved_s = 0;                // time above Limits::near_stiction_rad_s, [s]
  double error_ratio = 0;            // held-out error divided by sigma: 1 as after training; NaN: no sigma
  double error_ratio_upper = 0;      // plus one standard error, from the spread between blocks of the motion
  double largest_share = 0;          // largest held-out error over the hold time, divided by the collision threshold
  double limit_factor = 1, sigma_factor = 1;  // factors by which thresholds and sigma were raised; at least 1
};

// Time in which no friction explains the torques; left out of the fit.
struct RefitTouch {
  int source = 0, joint = 0;      // recording, and the joint with the largest share
  std::int64_t from_ns = 0, to_ns = 0;
  double share = 0;               // largest error divided by that joint's collision threshold
  bool counted = false;           // too frequent for touches: thresholds were raised by it
};

// Errors of the fit on held-out motion, one row per network period.
struct RefitErrors {
  std::vector<std::int64_t> t_ns;
  std::vector<std::uint8_t> free;           // no touch nearby
  std::vector<double> share;                // (rows, joints): over the hold time, divided by the old collision threshold
  std::vector<std::uint8_t> near_stiction;  // (rows, joints): which threshold applies
};

// The new bundle and how it differs from the old one.
struct Refit {
  Bundle bundle;
  std::vector<RefitJoint> joints;
  std::vector<RefitTouch> touches;
  RefitErrors left_out;
  double used_s = 0;    // duration of the fitted motion, [s]
  double memory_s = 0;  // longest correlation time of the error, [s]: samples closer together add no information
};

inline constexpr double kRefitLeastS = 10;  // shortest motion, [s]

// Returns a copy of the bundle with the most probable weights for today's motion and with thresholds that the held-out
// errors support. Rows are a network period apart. They are weighted by the sigma of their motion, by the correlation
// time of the errors, and robustly (Tukey's weights), so that a push of a second is not learned. Thresholds and sigma only
// rise, see RefitJoint. Provenance is unchanged.
// Not for a control loop: it allocates and takes about 20 ms per second of motion.
// Throws Error if the prior has no friction, the sources do not fit, less than kRefitLeastS of motion can be used, a
// friction factor is below 0.2 or above 5, or the remaining error exceeds 5 sigma.
Refit refit(const Bundle& bundle, std::span<const RefitSource> sources, const RefitSettings& settings = {},
            int threads = 1);

}  // namespace tauext
