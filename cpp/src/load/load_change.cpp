#include "load/load_change.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "bundle/linear.hpp"
#include "load/load_solve.hpp"

namespace tauext {
namespace {

constexpr double kLeastKg = 0.1;     // the reach of a lighter load counts as this one's: else nothing could begin to show
constexpr double kNothing = 1e-6;    // information about the mass before any row, [1/kg^2]: invertible, and no more
constexpr int kTries = 16;             // of making a prior stronger
constexpr double kStronger = 4;      // times, each
constexpr double kSameSigmas = 9;    // squared: three standard errors

using Matrix = std::array<double, 16>;

std::array<double, 3> com_of(const LoadChange& change) noexcept {
  return {change[1] / change[0], change[2] / change[0], change[3] / change[0]};
}

constexpr double kLeastPivot = 1e-300;

// Solves A x = b; overwrites A, of this many rows.
LoadChange solved(Matrix& a, LoadChange b, std::size_t size) noexcept {
  cholesky(std::span(a).first(size * size), size, kLeastPivot);
  substitute(std::span(a).first(size * size), size, std::span(b).first(size));
  return b;
}

// Information about h of a load of this mass before any row, [1/(kg m)^2].
double prior_of(double mass_kg, double reach_m) noexcept {
  const double size = std::max(std::fabs(mass_kg), kLeastKg) * reach_m / 2;
  return 1 / (size * size);
}

Matrix with_prior(const Matrix& gram, double mass_kg, double reach_m) noexcept {
  Matrix a = gram;
  a[0] += kNothing;
  for (std::size_t i = 1; i < 4; ++i) a[5 * i] += prior_of(mass_kg, reach_m);
  return a;
}

Matrix inverse(Matrix a) noexcept {
  cholesky(a, 4, kLeastPivot);
  Matrix out;
  invert(a, 4, out);
  return out;
}

double quadratic(const Matrix& a, const LoadChange& x) noexcept {
  double sum = 0;
  for (std::size_t i = 0; i < 4; ++i)
    for (std::size_t k = 0; k < 4; ++k) sum += x[i] * a[4 * i + k] * x[k];
  return sum;
}

// The best one with this prior of h, and whether it is within reach.
LoadChange best_under(const Matrix& a, const LoadChange& moment, const LoadBounds& bounds) noexcept {
  Matrix used = a;
  LoadChange x = solved(used, moment, 4);
  const double mass = std::clamp(x[0], bounds.low_kg, bounds.high_kg);
  if (mass == 0) return {};
  if (mass != x[0]) {
    LoadChange rest{};  // of h alone
    for (std::size_t i = 1; i < 4; ++i) {
      rest[i - 1] = moment[i] - a[4 * i] * mass;
      for (std::size_t k = 1; k < 4; ++k) used[3 * (i - 1) + k - 1] = a[4 * i + k];
    }
    const LoadChange h = solved(used, rest, 3);
    x = {mass, h[0], h[1], h[2]};
  }
  return x;
}

// The best one with the prior of this mass. Where h would be out of reach, its prior is made stronger until it is not:
// cutting h alone would leave the mass that belongs to the long one, which may be worse than no load at all.
LoadChange best(const Matrix& gram, const LoadChange& moment, const LoadBounds& bounds, double mass_kg) noexcept {
  Matrix a = with_prior(gram, mass_kg, bounds.reach_m);
  LoadChange x = best_under(a, moment, bounds);
  double far = 0, reach = 0, prior = prior_of(mass_kg, bounds.reach_m);
  for (int tries = 0;; ++tries) {
    far = std::hypot(x[1], x[2], x[3]);
    reach = std::fabs(x[0]) * bounds.reach_m;
    if (far <= reach || tries == kTries) break;
    for (std::size_t i = 1; i < 4; ++i) a[5 * i] += (kStronger - 1) * prior;
    prior *= kStronger;
    x = best_under(a, moment, bounds);
  }
  if (far > reach)
    for (std::size_t i = 1; i < 4; ++i) x[i] *= reach / far;
  return x;
}

}  // namespace

void ChangeSums::add(const LoadRegressor::Columns& load, std::span<const double> torque, std::span<const double> inertia,
                   std::span<const double> sigma_nm) noexcept {
  for (std::size_t j = 0; j < torque.size(); ++j) {
    const double weight = 1 / (sigma_nm[j] * sigma_nm[j]), y = torque[j] - inertia[j];
    for (std::size_t i = 0; i < 4; ++i) {
      const double x = weight * load[i][j];
      for (std::size_t k = 0; k < 4; ++k) gram[4 * i + k] += x * load[k][j];
      moment[i] += x * y;
    }
    squares += weight * y * y;
    rows += weight > 0;
  }
}

void ChangeSums::add(const ChangeSums& other) noexcept {
  for (std::size_t i = 0; i < 16; ++i) gram[i] += other.gram[i];
  for (std::size_t i = 0; i < 4; ++i) moment[i] += other.moment[i];
  squares += other.squares;
  rows += other.rows;
}

double ChangeSums::left(const LoadChange& change) const noexcept {
  double sum = squares + quadratic(gram, change);
  for (std::size_t i = 0; i < 4; ++i) sum -= 2 * moment[i] * change[i];
  return std::max(sum, 0.0);
}

double ChangeSums::size(const LoadChange& change) const noexcept { return quadratic(gram, change); }

LoadChange ChangeSums::solve(const LoadBounds& bounds, const LoadChange& near) const noexcept {
  return best(gram, moment, bounds, near[0]);
}

std::array<double, 16> ChangeSums::covariance(const LoadBounds& bounds, const LoadChange& near,
                                              double alike) const noexcept {
  Matrix a = gram;
  for (double& value : a) value /= alike;
  return inverse(with_prior(a, near[0], bounds.reach_m));
}

bool agree(const ChangeSums& one, const ChangeSums& other, const LoadBounds& bounds, const LoadChange& near,
           double alike) noexcept {
  LoadChange apart = one.solve(bounds, near);
  const LoadChange from = other.solve(bounds, near);
  for (std::size_t i = 0; i < 4; ++i) apart[i] -= from[i];
  Matrix covariance = inverse(with_prior(one.gram, near[0], bounds.reach_m));
  const Matrix more = inverse(with_prior(other.gram, near[0], bounds.reach_m));
  for (std::size_t i = 0; i < 16; ++i) covariance[i] = alike * (covariance[i] + more[i]);
  const LoadChange half = solved(covariance, apart, 4);
  double squared = 0;
  for (std::size_t i = 0; i < 4; ++i) squared += half[i] * apart[i];
  return squared <= kSameSigmas;
}

std::array<double, 10> ten_of(const LoadChange& change) noexcept {
  if (change[0] == 0) return {};
  LoadParameters ten = parameters_of(ball(std::fabs(change[0]), com_of(change)));
  if (change[0] < 0)
    for (double& value : ten) value = -value;
  return ten;
}

Load changed(const Load& before, const LoadChange& change) noexcept {
  Load load = changed(before, change, std::numeric_limits<double>::infinity());
  load.error_share = Load::kUsualError;
  return load;
}

}  // namespace tauext
