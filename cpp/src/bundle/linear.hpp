// Small dense symmetric systems by Cholesky's factor. Matrices are (n, n), row-major.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <span>

namespace tauext {

// The lower factor in the place of the lower triangle. Pivots are at least `least`; where that is 0, a pivot that is not
// positive ends it: false.
inline bool cholesky(std::span<double> a, std::size_t n, double least = 0) noexcept {
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j <= i; ++j) {
      double sum = a[i * n + j];
      for (std::size_t k = 0; k < j; ++k) sum -= a[i * n + k] * a[j * n + k];
      if (j < i)
        a[i * n + j] = sum / a[j * n + j];
      else if (least == 0 && !(sum > 0))
        return false;
      else
        a[i * n + i] = std::sqrt(least == 0 ? sum : std::max(sum, least));
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

// x <- (L L^T)^-1 x.
inline void substitute(std::span<const double> factor, std::size_t n, std::span<double> x) noexcept {
  forward(factor, n, x);
  for (std::size_t i = n; i-- > 0;) {
    for (std::size_t k = i + 1; k < n; ++k) x[i] -= factor[k * n + i] * x[k];
    x[i] /= factor[i * n + i];
  }
}

// inverse <- (L L^T)^-1.
inline void invert(std::span<const double> factor, std::size_t n, std::span<double> inverse) noexcept {
  std::ranges::fill(inverse, 0.0);
  for (std::size_t i = 0; i < n; ++i) {
    inverse[i * n + i] = 1;
    substitute(factor, n, inverse.subspan(i * n, n));
  }
}

}  // namespace tauext
