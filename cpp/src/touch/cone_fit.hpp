// The force within a cone, and the moment within a ball, that explain torques best.
#pragma once
#include <array>

#include "chain/vector3.hpp"

namespace tauext {

// Symmetric 3 x 3 matrix.
struct Symmetric3 {
  double xx = 0, yy = 0, zz = 0, xy = 0, xz = 0, yz = 0;

  Vector3 times(Vector3 v) const noexcept {
    return {xx * v.x + xy * v.y + xz * v.z, xy * v.x + yy * v.y + yz * v.z, xz * v.x + yz * v.y + zz * v.z};
  }
  Symmetric3 plus(double on_diagonal) const noexcept {
    return {xx + on_diagonal, yy + on_diagonal, zz + on_diagonal, xy, xz, yz};
  }
  // Adds w v v'.
  void add(double w, Vector3 v) noexcept {
    xx += w * v.x * v.x, yy += w * v.y * v.y, zz += w * v.z * v.z;
    xy += w * v.x * v.y, xz += w * v.x * v.z, yz += w * v.y * v.z;
  }
  // Of a positive definite matrix.
  Symmetric3 inverse() const noexcept;
};

// Normal equations of the least-squares problem: minimise f' FF f / 2 + f' FM m + m' MM m / 2 - f' ft - m' mt.
// FM: row i is the product of the force's direction i with the moment's directions.
struct WrenchEquations {
  Symmetric3 force, moment;
  std::array<Vector3, 3> mixed{};
  Vector3 force_seen{0, 0, 0}, moment_seen{0, 0, 0};
};

// Forces that are admitted: at most most_n, within half_angle of the unit vector axis.
struct ForceCone {
  Vector3 axis{0, 0, 0};          // zeros: any direction
  double cosine = 0, sine = 1;    // of half_angle, 0 to pi/2
  double most_n = 0;              // may be infinite

  bool any() const noexcept { return axis.x == 0 && axis.y == 0 && axis.z == 0; }
  bool line() const noexcept { return !any() && sine == 0; }
  bool holds(Vector3 f) const noexcept;  // within the cone, whatever its size
};

struct ConeFit {
  Vector3 force{0, 0, 0}, moment{0, 0, 0};
  double force_sigma = 0;   // standard error along the force, if the equations are in standard errors
  double moment_sigma = 0;  // the same of the moment
};

// The force of the cone, and the moment of at most most_nm, that minimise the problem. Exact but for the moment's bound, which
// is met within 1 %. 0 for most_nm: no moment. Fixed time at most: about half a microsecond, with a bounded moment four.
ConeFit fit_cone(const WrenchEquations& equations, const ForceCone& cone, double most_nm) noexcept;

}  // namespace tauext
