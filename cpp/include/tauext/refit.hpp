// The prior of the arm as it is today: friction of a bundle brought up to date by a minute of ordinary motion.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/bundle.hpp"
#include "tauext/sample.hpp"

namespace tauext {

// With w the old weights of a joint's own terms, those of today are taken to be, with independent standard normal u,
//   friction (Coulomb at every smoothing, presliding, load):  w (1 + common u_0 + apart u_1) + single F / rms(x) u_m
//   viscous:                                                  w (1 + common u_0 + apart u_2) + single F / rms(x) u_m
//   constant, ripple, network:                                w + constant F u_m, w (1 + ripple u_m), w (1 + network u_m)
// and all friction, a minute before the end, w (1 + trend u_3) of what it is at the end, for which the weights are.
// F is the RMS of the joint's friction in today's motion and x the term's filtered value, so that a single weight moves
// by as much as it shows. A joint that has stood for 5 s, or since the recording's begin, shows no friction: what holds it is
// anything up to the static one, so that those rows do not count for it, and a joint that stands throughout stays as it is.
// Terms of the arm (gravity, inertia, corrections of the model) stay as they are: a minute of a
// routine determines them worse than the training did, and what it would move them by is another load.
struct RefitSettings {
  double common = 0.3;     // gears a night older or 30 K colder
  double apart = 0.15;     // grease thins where metal does not
  double single = 0.03;    // of the friction, a term: the curve bends
  double constant = 0.1;   // of the friction: torque measurements creep
  double ripple = 0.1;
  double trend = 0.1;      // of the friction, a minute: it warms up while it is recorded; weights are those at the end
  double network = 0.3;    // it learned what the prior left of the old friction, which moves with that
  // Of each joint, where more is known of today than that: friction by the old one that is expected, instead of 1,
  // and its standard deviation, instead of common (apart stays in proportion). Empty: unknown.
  std::vector<double> expected = {}, expected_error = {};

  // Throws Error, naming what is not 0 to 10, or an expectation that is none of a friction (0.2 to 5, above 0 to 10).
  void validate(int joints) const;
};

// Some motion of today. Samples at which something may touch the arm are not used, and run through the chain all the same.
struct RefitSource {
  RecordingView recording;
  std::span<const std::uint8_t> use = {};  // a sample: 0 is left out; empty: all are used
};

struct RefitFactor {
  double value = 1, error = 0;  // of today's friction by the old one, and its standard error
};

struct RefitJoint {
  RefitFactor coulomb, viscous;      // of all that follows the motion's sign, and of what grows with the speed
  double constant_nm = 0, constant_error_nm = 0;  // by how much the constant moved
  double moved_s = 0;                // faster than Limits::near_stiction_rad_s
  double error_ratio = 0;            // of today's left-out error by sigma: 1 is as training left it; NaN: no sigma
  double error_ratio_upper = 0;      // a standard error more, from how it differs between blocks of the motion
  double largest_share = 0;          // largest left-out error, held for the hold time, by its collision limit
  double limit_factor = 1, sigma_factor = 1;  // by which limits and sigma were raised; never below 1
};

// What no friction explains: left out of the fit.
struct RefitTouch {
  int source = 0, joint = 0;      // the joint that shows it most
  std::int64_t from_ns = 0, to_ns = 0;
  double share = 0;               // of its collision limit, at most
  bool counted = false;           // too many for touches: limits were raised by it
};

// Errors of the fit on held-out motion, a network period apart.
struct RefitErrors {
  std::vector<std::int64_t> t_ns;
  std::vector<std::uint8_t> free;           // no touch is near
  std::vector<double> share;                // (rows, joints): by the old collision limit, held for its hold time
  std::vector<std::uint8_t> near_stiction;  // (rows, joints): whose region's limit that is
};

struct Refit {
  Bundle bundle;
  std::vector<RefitJoint> joints;
  std::vector<RefitTouch> touches;
  RefitErrors left_out;
  double used_s = 0;    // of motion that was fitted
  double memory_s = 0;  // correlation time of the error, the longest of all joints: closer samples add no information
};

inline constexpr double kRefitLeastS = 10;  // of motion

// A bundle like this one with the weights most likely after today's motion, and limits that today's left-out errors
// support. Rows are a network period apart; each counts by the sigma that its motion announces, by how long errors last
// (so many independent ones there are) and robustly (Tukey's weights), so that a second's push is not learned. Limits and
// sigma only grow: see RefitJoint. The bundle's provenance stays as it is.
// Not for a loop: it allocates, and takes some 20 ms a second of motion.
// Throws Error: no prior with friction of its own, sources that do not fit, less than kRefitLeastS of motion that can be
// used, a factor that no friction has (below 0.2 or above 5), or an error of more than 5 times sigma that is left.
Refit refit(const Bundle& bundle, std::span<const RefitSource> sources, const RefitSettings& settings = {},
            int threads = 1);

}  // namespace tauext
