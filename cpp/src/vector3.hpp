// Vectors and rotations of space.
#pragma once
#include <array>

namespace tauext {

struct Vector3 {
  double x = 0, y = 0, z = 0;
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
  Vector3 x{1, 0, 0}, y{0, 1, 0}, z{0, 0, 1};
  Vector3 out(Vector3 a) const noexcept { return a.x * x + a.y * y + a.z * z; }        // own -> other
  Vector3 back(Vector3 a) const noexcept { return {dot(x, a), dot(y, a), dot(z, a)}; }  // other -> own
};

inline Turn turn(const std::array<double, 9>& r) noexcept {
  return {{r[0], r[3], r[6]}, {r[1], r[4], r[7]}, {r[2], r[5], r[8]}};
}

}  // namespace tauext
