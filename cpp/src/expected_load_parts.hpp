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

// Mass, first moment and inertia about the frame's origin.
inline std::array<double, LoadRegressor::kParameters> ten_of_load(const Load& load) noexcept {
  const double m = load.mass;
  const auto& c = load.com;
  const auto& in = load.inertia;
  return {m, m * c[0], m * c[1], m * c[2], in[0] + m * (c[1] * c[1] + c[2] * c[2]), in[1] + m * (c[0] * c[0] + c[2] * c[2]),
          in[2] + m * (c[0] * c[0] + c[1] * c[1]), in[3] - m * c[0] * c[1], in[4] - m * c[0] * c[2], in[5] - m * c[1] * c[2]};
}

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
