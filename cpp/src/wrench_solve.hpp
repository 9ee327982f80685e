// Weighted least squares for up to six unknowns, with what is unknown named.
#pragma once
#include <array>
#include <cmath>
#include <cstddef>
#include <span>

#include "tauext/wrench.hpp"

namespace tauext {

// In place, lower triangle, row-major (n, n); false where it is not positive definite.
inline bool cholesky(std::span<double> a, std::size_t n) noexcept {
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j <= i; ++j) {
      double sum = a[i * n + j];
      for (std::size_t k = 0; k < j; ++k) sum -= a[i * n + k] * a[j * n + k];
      if (j < i)
        a[i * n + j] = sum / a[j * n + j];
      else if (!(sum > 0))
        return false;
      else
        a[i * n + i] = std::sqrt(sum);
    }
  return true;
}

// x <- L^-1 x.
inline void forward(std::span<const double> factor, std::size_t n, std::span<double> x) noexcept {
  for (std::size_t i = 0; i < n; ++i) {
    double sum = x[i];
    for (std::size_t k = 0; k < i; ++k) sum -= factor[i * n + k] * x[k];
    x[i] = sum / factor[i * n + i];
  }
}

// What an unknown may be at most, and from which standard error on it counts as unknown, [N]; moments by this length, [m].
struct WrenchScale {
  double largest_n, length_m, blind_n;
};

// s: (n, n), is used up; columns: (unknowns, n), likewise. Fills all of `told` but unknowns, moment of a force, consistent
// and known. false where s is not positive definite.
bool solve_wrench(std::span<double> s, std::span<double> columns, std::span<const double> tau_ext, const WrenchScale& scale,
                  Wrench& told) noexcept;

}  // namespace tauext
