// A load from what it shows, in four unknowns: mass and first moment, within what a load can be.
#pragma once
#include <array>
#include <cstdint>
#include <span>

#include "chain/load_regressor.hpp"
#include "tauext/load.hpp"
#include "tauext/types.hpp"

namespace tauext {

// m [kg] and h = m c [kg m] in the load frame. For a change of a known load, m may be below 0.
using LoadChange = std::array<double, 4>;

// What a change must be within: low <= m <= high, |h| <= |m| reach.
struct LoadBounds {
  double low_kg = 0, high_kg = 0, reach_m = 0;
};

// Sums over rows for weighted least squares of joint torques on those unknowns; plain bytes.
struct ChangeSums {
  std::array<double, 16> gram{};    // sum of x x^T / sigma^2
  std::array<double, 4> moment{};   // sum of x y / sigma^2
  double squares = 0;               // sum of y^2 / sigma^2
  double rows = 0;                  // samples times joints that count

  // One sample of every joint. load: columns of a unit (LoadColumns); inertia: torques of the load's own inertia, which are
  // subtracted; sigma_nm > 0, infinite for joints that do not count.
  void add(const LoadRegressor::Columns& load, std::span<const double> torque, std::span<const double> inertia,
           std::span<const double> sigma_nm) noexcept;
  void add(const ChangeSums& other) noexcept;

  // What such a change leaves, in squared sigmas, of all rows together and of each.
  double left(const LoadChange& change) const noexcept;
  double misfit(const LoadChange& change) const noexcept { return rows > 0 ? left(change) / rows : 0; }
  // How much of it shows, in squared sigmas.
  double size(const LoadChange& change) const noexcept;

  // The best change within its bounds; h is drawn to 0 with a standard deviation of |m| reach / 2, m as in `near`.
  LoadChange solve(const LoadBounds& bounds, const LoadChange& near) const noexcept;
  // Covariance of that, each row worth 1/alike of one of its own.
  std::array<double, 16> covariance(const LoadBounds& bounds, const LoadChange& near, double alike) const noexcept;
};

// Whether two stretches show the same, within three standard errors of their difference.
bool agree(const ChangeSums& one, const ChangeSums& other, const LoadBounds& bounds, const LoadChange& near,
           double alike) noexcept;

// All ten parameters of a change: its inertia is a ball's of aluminium about its own centre, little beside m c^2.
std::array<double, 10> ten_of(const LoadChange& change) noexcept;

// Sum of the previous load and a change; mass 0 if nothing is left.
Load changed(const Load& before, const LoadChange& change) noexcept;

}  // namespace tauext
