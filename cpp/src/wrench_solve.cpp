#include "wrench_solve.hpp"

#include <algorithm>

namespace tauext {
namespace {

constexpr std::size_t kMost = Wrench::kMost;
using Square = std::array<double, kMost * kMost>;

// Eigenvalues onto the diagonal of `a` (m, m), symmetric; eigenvectors are the columns of `vectors`. Jacobi's rotations.
void eigen(Square& a, Square& vectors, std::size_t m) noexcept {
  vectors.fill(0);
  for (std::size_t i = 0; i < m; ++i) vectors[i * m + i] = 1;
  for (int sweep = 0; sweep < 30; ++sweep) {
    double off = 0, on = 0;
    for (std::size_t i = 0; i < m; ++i)
      for (std::size_t j = 0; j < m; ++j) (i == j ? on : off) += a[i * m + j] * a[i * m + j];
    if (off <= 1e-24 * on) return;
    for (std::size_t p = 0; p < m; ++p)
      for (std::size_t r = p + 1; r < m; ++r) {
        if (a[p * m + r] == 0) continue;
        const double theta = (a[r * m + r] - a[p * m + p]) / (2 * a[p * m + r]);
        const double t = std::copysign(1 / (std::fabs(theta) + std::hypot(theta, 1.0)), theta);
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (std::size_t k = 0; k < m; ++k) {
          const double x = a[k * m + p], y = a[k * m + r];
          a[k * m + p] = c * x - s * y;
          a[k * m + r] = s * x + c * y;
        }
        for (std::size_t k = 0; k < m; ++k) {
          const double x = a[p * m + k], y = a[r * m + k];
          a[p * m + k] = c * x - s * y;
          a[r * m + k] = s * x + c * y;
        }
        for (std::size_t k = 0; k < m; ++k) {
          const double x = vectors[k * m + p], y = vectors[k * m + r];
          vectors[k * m + p] = c * x - s * y;
          vectors[k * m + r] = s * x + c * y;
        }
      }
  }
}

// What was seen of unknowns in units of what each may be at most: columns' products, and theirs with the torques.
struct Seen {
  Square products{};
  double shown[kMost] = {}, size[kMost] = {}, whole = 0;
  std::size_t m = 0;
};

// The inverse of a matrix of this Cholesky factor, lower triangle, (m, m).
void invert(std::span<const double> factor, std::size_t m, Square& inverse) noexcept {
  Square lower{};
  for (std::size_t e = 0; e < m; ++e) {
    double column[kMost] = {};
    column[e] = 1;
    forward(factor, m, std::span(column).first(m));
    for (std::size_t i = 0; i < m; ++i) lower[i * m + e] = column[i];
  }
  for (std::size_t i = 0; i < m; ++i)
    for (std::size_t j = 0; j < m; ++j) {
      double sum = 0;
      for (std::size_t k = std::max(i, j); k < m; ++k) sum += lower[k * m + i] * lower[k * m + j];
      inverse[i * m + j] = sum;
    }
}

// Where no direction can be blind, since the trace of the relative covariance is below that: no eigenvectors are needed.
// false where that is not so.
bool solve_seen(const Seen& seen, double blind_share, std::size_t n, std::array<double, kMost>& w, Wrench& told) noexcept {
  const std::size_t m = seen.m;
  Square alone = seen.products, with_prior = seen.products;
  for (std::size_t i = 0; i < m; ++i) with_prior[i * m + i] += 1;
  if (n < m || !cholesky(std::span(alone).first(m * m), m) || !cholesky(std::span(with_prior).first(m * m), m)) return false;
  Square inverse;
  invert(with_prior, m, inverse);
  double trace = 0;
  for (std::size_t i = 0; i < m; ++i) trace += inverse[i * m + i];
  if (!(trace < blind_share)) return false;
  told.blind = 0;
  told.chi_square = seen.whole;
  told.freedom = static_cast<int>(n - m);
  double explained[kMost];
  std::copy_n(seen.shown, m, explained);
  forward(alone, m, std::span(explained).first(m));
  for (std::size_t i = 0; i < m; ++i) {
    told.chi_square -= explained[i] * explained[i];
    for (std::size_t j = 0; j < m; ++j) {
      w[i] += seen.size[i] * inverse[i * m + j] * seen.shown[j];
      told.covariance[i * m + j] = seen.size[i] * seen.size[j] * inverse[i * m + j];
    }
  }
  return true;
}

// A direction in which a force of largest_n shows as less than a tenth of a standard error explains nothing.
constexpr double kExplains = 0.01;

void solve_by_directions(Seen& seen, double blind_share, std::size_t n, std::array<double, kMost>& w, Wrench& told) noexcept {
  const std::size_t m = seen.m;
  Square vectors;
  eigen(seen.products, vectors, m);
  told.blind = 0;
  told.chi_square = seen.whole;
  told.freedom = static_cast<int>(n);
  for (std::size_t e = 0; e < m; ++e) {
    const double value = std::max(seen.products[e * m + e], 0.0);
    double along = 0;
    for (std::size_t i = 0; i < m; ++i) along += vectors[i * m + e] * seen.shown[i];
    if (value > kExplains) {
      told.chi_square -= along * along / value;
      --told.freedom;
    }
    for (std::size_t i = 0; i < m; ++i) {
      w[i] += seen.size[i] * vectors[i * m + e] * along / (value + 1);
      for (std::size_t j = 0; j < m; ++j)
        told.covariance[i * m + j] += seen.size[i] * vectors[i * m + e] * seen.size[j] * vectors[j * m + e] / (value + 1);
    }
    if (blind_share * (value + 1) >= 1) continue;
    auto& direction = told.blind_directions[static_cast<std::size_t>(told.blind++)];
    for (std::size_t i = 0; i < m; ++i) direction[i] = vectors[i * m + e];
  }
}

}  // namespace

bool solve_wrench(std::span<double> s, std::span<double> columns, std::span<const double> tau_ext, const WrenchScale& scale,
                  Wrench& told) noexcept {
  const std::size_t n = tau_ext.size(), m = columns.size() / n;
  if (!cholesky(s, n)) return false;
  std::array<double, kMaxJoints> y;
  std::ranges::copy(tau_ext, y.begin());
  forward(s, n, std::span(y).first(n));
  Seen seen;
  seen.m = m;
  for (std::size_t k = 0; k < n; ++k) seen.whole += y[k] * y[k];
  for (std::size_t i = 0; i < m; ++i) {
    seen.size[i] = scale.largest_n * (i < 3 ? 1.0 : scale.length_m);
    const std::span<double> column = columns.subspan(i * n, n);
    for (double& value : column) value *= seen.size[i];
    forward(s, n, column);
    for (std::size_t k = 0; k < n; ++k) seen.shown[i] += column[k] * y[k];
    for (std::size_t j = 0; j <= i; ++j) {
      double sum = 0;
      for (std::size_t k = 0; k < n; ++k) sum += column[k] * columns[j * n + k];
      seen.products[i * m + j] = seen.products[j * m + i] = sum;
    }
  }
  const double blind_share = std::pow(scale.blind_n / scale.largest_n, 2);
  std::array<double, kMost> w{};
  told.covariance.fill(0);
  if (!solve_seen(seen, blind_share, n, w, told)) solve_by_directions(seen, blind_share, n, w, told);
  told.chi_square = std::max(told.chi_square, 0.0);
  told.freedom = std::max(told.freedom, 0);
  for (std::size_t i = 0; i < 3; ++i) {
    told.force[i] = w[i];
    if (m == kMost) told.moment[i] = w[3 + i];
  }
  return true;
}

}  // namespace tauext
