// The way from a frame to the base, link by link.
#pragma once
#include <cmath>

#include "tauext/tree.hpp"
#include "vector3.hpp"

namespace tauext {

// The link that is being passed, seen from a frame that is fixed to a further one: its axes, its origin.
struct LinkSeen {
  Turn axes;
  Vector3 origin;

  // rotation: the frame's link from the frame, row-major; translation: of the frame's origin in that link.
  LinkSeen(const std::array<double, 9>& rotation, const std::array<double, 3>& translation) noexcept {
    const Turn fixed = turn(rotation);
    axes = {fixed.back({1, 0, 0}), fixed.back({0, 1, 0}), fixed.back({0, 0, 1})};
    origin = -1.0 * fixed.back(vector3(translation));
  }

  // On to the parent of this link, whose joint stands at q.
  void pass(const Link& link, double q) noexcept {
    Turn parent = turn(link.rotation);  // of the link at this q, in its parent
    Vector3 shift = vector3(link.translation);
    if (link.type == JointType::revolute) {
      const double c = std::cos(q), s = std::sin(q);
      const Vector3 x = parent.x, y = parent.y;
      parent.x = c * x + s * y;
      parent.y = c * y - s * x;
    } else {
      shift = shift + q * parent.z;
    }
    const auto through = [&](Vector3 v) noexcept { return axes.out(parent.back(v)); };
    axes = {through({1, 0, 0}), through({0, 1, 0}), through({0, 0, 1})};
    origin = origin - axes.out(shift);
  }
};

}  // namespace tauext
