// A load from its sums: weighted least squares, with what the errors of tau_ext say of their own size and memory.
#pragma once
#include <array>
#include <cstdint>
#include <span>

#include "tauext/load_sums.hpp"
#include "tauext/types.hpp"

namespace tauext {

// m, h, I of a load about its frame's origin, as LoadRegressor has them.
using LoadParameters = std::array<double, 10>;

// What may have acted, as the columns that all joints share.
enum class LoadCause : std::uint8_t { load, base_force, frame_force, nothing };
inline constexpr int kLoadCauses = 4;

// What is known of the errors of tau_ext beside its sigma.
struct LoadNoise {
  JointVector scale;       // a joint: times sigma
  double correlation = 0;  // rows that say as much as one
  // Before any fit: sigma is right, and a block says as much as a row.
  static LoadNoise unknown() noexcept;
};

// What is known beforehand.
struct LoadBefore {
  JointVector offset_nm{}, coulomb_nm{};  // a joint: standard deviation of its own two unknowns, [N m]
  double moment_kg_m = 0;                 // of each component of h about 0; 0: nothing is known of it
};

// Coefficients of the columns of a cause.
struct LoadFit {
  int size = 0;                          // of them, so many count: 4 (m, h), 3 (forces) or 0
  std::array<double, 4> values{};
  std::array<double, 16> covariance{};   // (size, size), row-major
  JointVector offset_nm{}, coulomb_nm{}; // of each joint, [N m]
  LoadNoise noise{};                     // that it was weighted with
  double misfit = 0;                     // squared standard errors that are left, a row: 1 where nothing else is
  double cost = 0;                       // independent squared errors that are left, and what `before` holds against it
};

// Least squares of tau_ext - gear - X_I phi_I = X values + offset_j + coulomb_j tanh(dq_j / v) + error over all rows: each
// joint's own two unknowns are eliminated before the joints are added up. phi: the load as known so far, whose inertia
// phi_I is taken off.
LoadFit solve_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before,
                   const LoadNoise& noise) noexcept;
// Size and correlation of the errors that a fit leaves: sums over blocks grow with how long errors last.
LoadNoise noise_left(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadFit& fit) noexcept;
// Both in turns, kLoadPasses times.
inline constexpr int kLoadPasses = 4;
LoadFit fit_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before) noexcept;

inline constexpr double kLeastNoiseScale = 0.5;  // beside the bundle's sigma: a few seconds may happen to be easy
// Rows: errors of friction go with the direction of a move, and last for a good part of one, 0.3 s at least. A fit takes
// some of them up, so that what it leaves shows less.
inline constexpr double kLeastCorrelation = 30;

// Eigenvalues (rising) and unit vectors (rows) of a symmetric matrix (size, size) of size 1 to 4.
struct SymmetricAxes {
  std::array<double, 4> values{};
  std::array<std::array<double, 4>, 4> axes{};
};
SymmetricAxes symmetric_axes(std::span<const double> matrix, int size) noexcept;

}  // namespace tauext
