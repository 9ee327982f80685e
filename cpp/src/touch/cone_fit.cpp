#include "touch/cone_fit.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace tauext {
namespace {

// Keeps directions that no joint shows at 0: the prior of a force has a standard deviation of 1000 N, of a moment 100 N m.
constexpr double kForceRidge = 1e-6, kMomentRidge = 1e-4;
constexpr int kNewtonSteps = 12, kTurns = 24, kTurnSteps = 10, kMomentSteps = 12;
constexpr double kTolerance = 1e-9, kMomentTolerance = 0.01;

double length(Vector3 v) noexcept { return std::sqrt(dot(v, v)); }

struct Circle {
  std::array<double, kTurns> cosine, sine;
  Circle() noexcept {
    for (int k = 0; k < kTurns; ++k) {
      const double angle = 2 * 3.14159265358979323846 * k / kTurns;
      cosine[static_cast<std::size_t>(k)] = std::cos(angle);
      sine[static_cast<std::size_t>(k)] = std::sin(angle);
    }
  }
};
const Circle kCircle;

// Minimum of f' A f / 2 - b' f within |f| <= most: Newton's method on 1/most - 1/|f|, which is monotone [Conn2000].
Vector3 within_ball(const Symmetric3& a, Vector3 b, double most) noexcept {
  Vector3 f = a.inverse().times(b);
  double size = length(f), shift = 0;
  for (int step = 0; step < kNewtonSteps && size > most * (1 + kTolerance); ++step) {
    const Symmetric3 inverse = a.plus(shift).inverse();
    f = inverse.times(b);
    size = length(f);
    if (!(size > most)) break;
    shift += dot(f, f) / dot(f, inverse.times(f)) * (size - most) / most;
  }
  return size > most ? most / size * f : f;
}

// The same on a cone's surface: for each direction on it the best size is known, so one angle remains. Its best value on a grid
// is refined by halving the interval in which the slope changes its sign.
class Surface {
 public:
  Surface(const Symmetric3& a, Vector3 b, const ForceCone& cone) noexcept : most_(cone.most_n) {
    const Vector3 axis = cone.axis;
    const Vector3 other = std::fabs(axis.x) < 0.6 ? Vector3{1, 0, 0} : Vector3{0, 1, 0};
    const Vector3 across = cross(axis, other);
    along_ = cone.cosine * axis;
    first_ = cone.sine / length(across) * across;
    second_ = cross(axis, first_);
    const Vector3 aa = a.times(along_), af = a.times(first_), as = a.times(second_);
    b_ = {dot(b, along_), dot(b, first_), dot(b, second_)};
    products_ = {dot(aa, along_), dot(af, first_), dot(as, second_), dot(af, along_), dot(as, along_), dot(as, first_)};
  }

  Vector3 best() const noexcept {
    int at = 0;
    double most = -1;
    for (int k = 0; k < kTurns; ++k)
      if (const double value = gain(kCircle.cosine[static_cast<std::size_t>(k)], kCircle.sine[static_cast<std::size_t>(k)]); value > most) {
        most = value;
        at = k;
      }
    if (!(most > 0)) return {0, 0, 0};
    const double step = 2 * 3.14159265358979323846 / kTurns;
    double low = (at - 1) * step, high = (at + 1) * step;
    for (int k = 0; k < kTurnSteps; ++k) {
      const double middle = (low + high) / 2;
      (slope(std::cos(middle), std::sin(middle)) > 0 ? low : high) = middle;
    }
    const double c = std::cos((low + high) / 2), s = std::sin((low + high) / 2);
    return size(c, s) * (along_ + c * first_ + s * second_);
  }

 private:
  double seen(double c, double s) const noexcept { return b_.x + c * b_.y + s * b_.z; }
  double product(double c, double s) const noexcept {
    return products_.xx + c * c * products_.yy + s * s * products_.zz + 2 * (c * products_.xy + s * products_.xz + c * s * products_.yz);
  }
  double size(double c, double s) const noexcept { return std::clamp(seen(c, s) / product(c, s), 0.0, most_); }
  double gain(double c, double s) const noexcept {
    const double n = size(c, s);
    return n * seen(c, s) - n * n * product(c, s) / 2;
  }
  // Derivative of the gain; that of the best size contributes nothing.
  double slope(double c, double s) const noexcept {
    const double n = size(c, s);
    const double turned = c * b_.z - s * b_.y;
    const double product_turned = c * s * (products_.zz - products_.yy) - s * products_.xy + c * products_.xz + (c * c - s * s) * products_.yz;
    return n * turned - n * n * product_turned;
  }

  double most_;
  Vector3 along_, first_, second_, b_;
  Symmetric3 products_;
};

// Minimum of f' A f / 2 - b' f over the cone.
Vector3 nearest_force(const Symmetric3& a, Vector3 b, const ForceCone& cone) noexcept {
  if (cone.line()) return std::clamp(dot(b, cone.axis) / dot(cone.axis, a.times(cone.axis)), 0.0, cone.most_n) * cone.axis;
  const Vector3 inside = within_ball(a, b, cone.most_n);  // if that is in the cone, the cone changes nothing
  return cone.any() || cone.holds(inside) ? inside : Surface(a, b, cone).best();
}

Vector3 row_times(const std::array<Vector3, 3>& rows, Vector3 v) noexcept { return {dot(rows[0], v), dot(rows[1], v), dot(rows[2], v)}; }

Vector3 times_rows(const std::array<Vector3, 3>& rows, Vector3 v) noexcept { return v.x * rows[0] + v.y * rows[1] + v.z * rows[2]; }

// A - R B R' with the rows R: what is left of one part once the other has been solved for.
Symmetric3 reduced(const Symmetric3& a, const std::array<Vector3, 3>& rows, const Symmetric3& b) noexcept {
  const Vector3 x = b.times(rows[0]), y = b.times(rows[1]), z = b.times(rows[2]);
  return {a.xx - dot(rows[0], x), a.yy - dot(rows[1], y), a.zz - dot(rows[2], z),
          a.xy - dot(rows[0], y), a.xz - dot(rows[0], z), a.yz - dot(rows[1], z)};
}

double error_along(const Symmetric3& covariance, Vector3 v) noexcept {
  const double squared = dot(v, v);
  return squared > 0 ? std::sqrt(std::max(dot(v, covariance.times(v)) / squared, 0.0)) : 0.0;
}

}  // namespace

Symmetric3 Symmetric3::inverse() const noexcept {
  const double a = yy * zz - yz * yz, b = xz * yz - xy * zz, c = xy * yz - xz * yy;
  const double scale = 1 / (xx * a + xy * b + xz * c);
  return {a * scale, (xx * zz - xz * xz) * scale, (xx * yy - xy * xy) * scale,
          b * scale, c * scale, (xy * xz - xx * yz) * scale};
}

bool ForceCone::holds(Vector3 f) const noexcept { return any() || dot(f, axis) >= cosine * length(f) * (1 - 1e-12); }

ConeFit fit_cone(const WrenchEquations& equations, const ForceCone& cone, double most_nm) noexcept {
  const Symmetric3 force = equations.force.plus(kForceRidge);
  ConeFit fit;
  const auto finish = [&](const Symmetric3& of_force) noexcept {
    fit.force_sigma = cone.line() ? 1 / std::sqrt(dot(cone.axis, of_force.times(cone.axis))) : error_along(of_force.inverse(), fit.force);
  };
  if (!(most_nm > 0)) {
    fit.force = nearest_force(force, equations.force_seen, cone);
    finish(force);
    return fit;
  }
  const Symmetric3 moment = equations.moment.plus(kMomentRidge);
  // With a multiplier on the moment's diagonal, the moment falls: sought is the one at which it meets its bound.
  double shift = 0, low = 0, high = 0;
  for (int step = 0; step < kMomentSteps; ++step) {
    const Symmetric3 inverse = moment.plus(shift).inverse();
    const Symmetric3 left = reduced(force, equations.mixed, inverse);
    const Vector3 seen = equations.force_seen - row_times(equations.mixed, inverse.times(equations.moment_seen));
    fit.force = nearest_force(left, seen, cone);
    fit.moment = inverse.times(equations.moment_seen - times_rows(equations.mixed, fit.force));
    if (step == 0) finish(left);
    const double size = length(fit.moment);
    if (size <= most_nm && (shift == 0 || size >= most_nm * (1 - kMomentTolerance))) break;
    (size > most_nm ? low : high) = shift;
    const double newton = shift + dot(fit.moment, fit.moment) / dot(fit.moment, inverse.times(fit.moment)) * (size - most_nm) / most_nm;
    shift = newton > low && (high == 0 || newton < high) ? newton : (high > 0 ? (low + high) / 2 : 2 * low + 1e-6);
  }
  if (const double size = length(fit.moment); size > most_nm) fit.moment = most_nm / size * fit.moment;
  if (shift > 0) fit.force = nearest_force(force, equations.force_seen - row_times(equations.mixed, fit.moment), cone);
  const std::array<Vector3, 3>& m = equations.mixed;
  const std::array<Vector3, 3> turned{{{m[0].x, m[1].x, m[2].x}, {m[0].y, m[1].y, m[2].y}, {m[0].z, m[1].z, m[2].z}}};
  fit.moment_sigma = error_along(reduced(moment, turned, force.inverse()).inverse(), fit.moment);
  return fit;
}

}  // namespace tauext
