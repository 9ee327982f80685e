// What the two halves of ExpectedLoad share.
#pragma once
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "tauext/load.hpp"
#include "tauext/load_change.hpp"
#include "tauext/load_regressor.hpp"

namespace tauext {

inline constexpr double kForgotten = 3;  // times 1/K0: so long r still shows what was before

inline std::int64_t to_ns(double seconds) noexcept { return std::llround(seconds * 1e9); }

inline double torque(const LoadRegressor::Columns& columns, const std::array<double, LoadRegressor::kParameters>& ten,
                     std::size_t joint, std::size_t first = 0) noexcept {
  double sum = 0;
  for (std::size_t k = first; k < ten.size(); ++k) sum += columns[k][joint] * ten[k];
  return sum;
}

inline LoadChange less(const LoadChange& one, const LoadChange& other) noexcept {
  LoadChange out;
  for (std::size_t k = 0; k < out.size(); ++k) out[k] = one[k] - other[k];
  return out;
}

}  // namespace tauext
