// The limit that |tau_ext| of a joint must exceed, one for sliding and one near stiction, for each level of the alarm.
// Those of a bundle with an error scale hold in usual motion, and are multiplied by it.
#pragma once
#include <cmath>
#include <string>
#include <vector>

#include "tauext/types.hpp"

namespace tauext {

// What a joint must exceed, and for how long, before the alarm rises to a level.
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
  int region_width = -1;           // or the presliding state of this width bent; -1: only the speed tells ...
  double near_memory_s = 0;        // ... and for so long afterwards: r still shows how the joint broke away
  Level collision;                 // latched until acknowledged
  Level contact;                   // falls back by itself ...
  double contact_release_s = 0;    // ... when |tau_ext| has been under its limit for so long
  // A push leaves the friction of a joint that is stuck at another level than its motion tells, until it slides: from the
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

}  // namespace tauext
