// The limit that |tau_ext| of a joint must exceed, one for sliding and one near stiction.
#pragma once
#include <cmath>
#include <span>
#include <vector>

#include "tauext/types.hpp"

namespace tauext {

struct Limits {
  double near_stiction_rad_s = 0;        // near stiction: |dq| below this
  std::vector<double> sliding_nm;        // a joint, [N m]
  std::vector<double> near_stiction_nm;  // a joint, [N m]

  bool near_stiction(double dq) const noexcept { return std::fabs(dq) < near_stiction_rad_s; }
  double limit_nm(int joint, double dq) const noexcept {
    return near_stiction(dq) ? near_stiction_nm[joint] : sliding_nm[joint];
  }
};

}  // namespace tauext
