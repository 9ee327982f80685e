// Lengths, rotations and inertias of rigid bodies.
#pragma once
#include <array>
#include <cmath>
#include <cstddef>

namespace tauext {

inline double length(const std::array<double, 3>& v) noexcept {
  return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}

// Inertia about the origin of a mass m at c, m (c.c 1 - c c^T): xx, yy, zz, xy, xz, yz, [kg m^2].
inline std::array<double, 6> point_inertia(double m, const std::array<double, 3>& c) noexcept {
  return {m * (c[1] * c[1] + c[2] * c[2]), m * (c[0] * c[0] + c[2] * c[2]), m * (c[0] * c[0] + c[1] * c[1]),
          -m * c[0] * c[1],                -m * c[0] * c[2],                -m * c[1] * c[2]};
}

// Whether a 3 x 3 matrix, row-major, is orthonormal and right-handed.
inline bool is_rotation(const std::array<double, 9>& r) noexcept {
  for (std::size_t i = 0; i < 3; ++i)
    for (std::size_t j = 0; j < 3; ++j) {
      const double dot = r[3 * i] * r[3 * j] + r[3 * i + 1] * r[3 * j + 1] + r[3 * i + 2] * r[3 * j + 2];
      if (!(std::fabs(dot - (i == j ? 1.0 : 0.0)) <= 1e-9)) return false;
    }
  return r[0] * (r[4] * r[8] - r[5] * r[7]) - r[1] * (r[3] * r[8] - r[5] * r[6]) + r[2] * (r[3] * r[7] - r[4] * r[6]) > 0;
}

}  // namespace tauext
