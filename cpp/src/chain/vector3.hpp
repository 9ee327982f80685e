// Vectors and rotations of space, and the way from a frame to the base, link by link.
#pragma once
#include <array>
#include <cmath>

#include "tauext/link.hpp"

namespace tauext {

// Without initial values: the sweep of the tree fills arrays of them.
struct Vector3 {
  double x, y, z;
};

inline Vector3 operator+(Vector3 a, Vector3 b) noexcept { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector3 operator-(Vector3 a, Vector3 b) noexcept { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vector3 operator*(double s, Vector3 a) noexcept { return {s * a.x, s * a.y, s * a.z}; }
inline Vector3 cross(Vector3 a, Vector3 b) noexcept {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double dot(Vector3 a, Vector3 b) noexcept { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector3 vector3(const std::array<double, 3>& a) noexcept { return {a[0], a[1], a[2]}; }

// Columns of `to from own`: own axes in the other frame.
struct Turn {
  Vector3 x, y, z;
  Vector3 out(Vector3 a) const noexcept { return a.x * x + a.y * y + a.z * z; }        // own -> other
  Vector3 back(Vector3 a) const noexcept { return {dot(x, a), dot(y, a), dot(z, a)}; }  // other -> own
};

inline Turn turn(const std::array<double, 9>& r) noexcept {
  return {{r[0], r[3], r[6]}, {r[1], r[4], r[7]}, {r[2], r[5], r[8]}};
}

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
