// Torque constants by a load of known mass.
#pragma once
#include <array>
#include <optional>
#include <span>
#include <vector>

#include "load/recorded_load.hpp"

namespace tauext {

struct KnownLoad {
  double mass_kg = 0;
  std::optional<std::array<double, 3>> com_m;  // in the load frame, to kComKnown_m; none: unknown, within the reach
  double reach_m = kUsualReach_m;
};

// Factors by which the bundle's torques are to be multiplied.
struct KnownWeight {
  std::vector<double> factors, errors;  // a joint, with standard errors
  std::vector<double> covariance;       // (joints, joints), of their relative errors
  std::vector<bool> shows;              // whether the factor was found at the joint itself; the others follow the common one
  double common = 0, common_error = 0;  // of all joints together
  std::array<double, 3> com_m{};
};

// Fits tau_ext_j = a_j X_j(m, h) + offset_j + Coulomb_j to the rows; the factors are 1 / a_j. Before the first known weight
// every a_j differs from a common one, of which nothing is known, by the joint's own_share. Each further weight starts from
// the mean and the covariance that the last one left.
//  first: the load as weighed with the bundle's constants
//  skipped: joints whose rows have no worth
// Throws Error if the motion does not determine the common factor to 3 %.
KnownWeight weigh_known(const Bundle& bundle, const LoadFrame& frame, std::span<const WeighedMotion> motions,
                        const KnownLoad& known, const LoadParameters& first, const std::vector<bool>& skipped);

// Makes all torques that the bundle reads, estimates or compares with `factor` times as large. Masses and inertias scale
// with them, since the arm's own weight was found from the same torques. One factor a joint is impossible: no arm has
// such masses.
// Estimates scale up to rounding, and limits keep their promise. Call answer_reference() afterwards.
void scale_torques(Bundle& bundle, double factor);
// Scales by the common factor; what each joint's differs by, and the covariance of the errors, is kept for loads and forces.
void correct_torques(Bundle& bundle, const KnownWeight& known);

}  // namespace tauext
