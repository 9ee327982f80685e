// The limit that |tau_ext| of a joint must exceed, one for sliding and one near stiction, for each level of the alarm.
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

struct Limits {
  double near_stiction_rad_s = 0;  // near stiction: |dq| below this
  Level collision;                 // latched until acknowledged
  Level contact;                   // falls back by itself ...
  double contact_release_s = 0;    // ... when |tau_ext| has been under its limit for so long

  bool near_stiction(double dq) const noexcept { return std::fabs(dq) < near_stiction_rad_s; }
  double limit_nm(const Level& level, int joint, double dq) const noexcept {
    return near_stiction(dq) ? level.near_stiction_nm[joint] : level.sliding_nm[joint];
  }
  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
};

}  // namespace tauext
