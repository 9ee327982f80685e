// Payloads that the arm carries: their frame, the bounds on them, and the result of their identification.
#pragma once
#include <array>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "tauext/link.hpp"
#include "tauext/types.hpp"

namespace tauext {

// A rigid body, in the axes of the load frame. Mass 0: no payload.
struct Load {
  // Default of error_share: a mass known to 1 % and a centre of mass known to 1 cm, at half a metre from the axis.
  static constexpr double kUsualError = 0.03;

  double mass = 0;                   // [kg]
  std::array<double, 3> com{};       // centre of mass in the load frame, [m]
  std::array<double, 6> inertia{};   // about the centre of mass, axes of the load frame: xx, yy, zz, xy, xz, yz, [kg m^2]
  double error_share = kUsualError;  // relative error of its torques, 0 to 1: thresholds rise by this share; 0: exact

  bool operator==(const Load&) const = default;
};

// Value of since_ns for "from the next sample on". Any other value is an earlier time.
inline constexpr std::int64_t kFromNow = std::numeric_limits<std::int64_t>::max();

// Reason for refusing a payload.
enum class LoadFault : std::uint8_t {
  none,
  not_settable,      // LoadSettings::refused of the bundle contains the reason
  not_finite,
  negative_mass,
  too_heavy,         // above largest_mass_kg
  too_far,           // the centre of mass is beyond largest_reach_m
  impossible_inertia,  // not positive semidefinite, or against the triangle inequality
  too_wide,          // no body has so much inertia within largest_reach_m
  error_share,       // outside 0 to 1
  no_past,           // since_ns is an earlier time, and the residual of this bundle cannot be recomputed
};

// Where a payload is fixed, and which payloads are accepted.
struct LoadSettings {
  std::string frame;      // name of the load frame
  std::int32_t link = -1;  // link that the frame is fixed to; -1: none
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  // link from load frame, row-major
  std::array<double, 3> translation{};  // origin of the frame in the link's frame, [m]
  double largest_mass_kg = 0, largest_reach_m = 0;  // bounds; the reach is measured from the frame's origin
  // Reason for which no payload can be set; empty: payloads are accepted.
  std::string refused = "the bundle names no frame for a payload";

  bool settable() const noexcept { return refused.empty(); }
  // Throws Error with the field that is invalid for this number of joints.
  void validate(int joints) const;
  // First rule that the payload breaks; none: it is accepted.
  LoadFault fault(const Load& load) const noexcept;
  // The fault as a sentence: quantity, value and rule.
  std::string words(LoadFault fault, const Load& load) const;
  // The payload about the origin of its link, in the link's axes.
  Carried in_link(const Load& load) const noexcept;
  // The link and the payload as one body.
  Link merged(const Load& load, const Link& own) const;
};

// Defaults for bundles that name no load frame: the frame of the last link of the longest chain; at most half the mass
// of the arm, and half its length (at least 0.3 m). `corrected`: the corrected model, which carries the payload if `links`
// have no mass; empty: none.
LoadSettings assumed_load_settings(const std::vector<Link>& links, const std::vector<Link>& corrected);

// Default for the largest distance between the centre of mass of an identified payload and the load frame's origin, [m].
inline constexpr double kUsualReach_m = 0.3;

// m, h, I of a payload about the origin of its frame, in that frame's axes: mass [kg], first moment [kg m], inertia xx,
// yy, zz, xy, xz, yz [kg m^2].
using LoadParameters = std::array<double, 10>;

// Hypotheses of a payload identification: a payload, a constant force along the base's or the frame's axes, or no cause.
enum class LoadCause : std::uint8_t { load, base_force, frame_force, nothing };
inline constexpr int kLoadCauses = 4;

// Noise model of tau_ext in addition to its sigma.
struct LoadNoise {
  JointVector scale;       // per joint: factor on sigma
  double correlation = 0;  // number of rows that carry as much information as one independent row
  // Before any fit: sigma is correct, and a block carries as much information as a row.
  static LoadNoise unknown() noexcept;
};

// Least-squares fit of one hypothesis.
struct LoadFit {
  int size = 0;                          // number of coefficients: 4 (m, h), 3 (force) or 0
  std::array<double, 4> values{};
  std::array<double, 16> covariance{};   // (size, size), row-major
  JointVector offset_nm{}, coulomb_nm{};  // fitted per joint, [N m]
  LoadNoise noise{};                     // noise model that the fit is weighted with
  double misfit = 0;                     // squared standard errors that are left, a row: 1 where nothing else is
  double cost = 0;                       // independent squared errors that are left, and what `before` holds against it
};

// Result of a payload identification.
enum class LoadVerdict : std::uint8_t {
  too_little,  // fewer than kLeastLoadRows rows
  nothing,     // no payload shows
  load,
  contact,     // a constant force fits better than any payload
  lifts,       // the force points up
  unclear,     // no hypothesis explains the torques
};
const char* name(LoadVerdict verdict) noexcept;
inline constexpr int kLeastLoadRows = 30;  // 0.3 s

// Mass and centre of mass found by payload identification, their errors, and whether it is a payload. Lengths and axes are those of the
// load frame. All members but `load` describe what the arm carries BESIDE the payload that is set.
struct LoadFound {
  LoadVerdict verdict = LoadVerdict::too_little;
  Load load;  // both loads together, for set_load(): inertia of a ball, error_share from the standard errors
  double mass_kg = 0;       // negative if the arm carries less than the payload that is set
  double mass_error_kg = 0; // standard error from the errors of tau_ext in this motion
  double constants_error_kg = 0;  // standard error from the torque constants, about the same share of every weight
  JointVector mass_by_constant_kg{};  // a joint: change of the mass with its torque, for all of it
  std::array<double, 3> com_m{}, com_error_m{};  // the errors contain both
  std::array<double, 9> com_covariance{};   // (3, 3), row-major, [m^2]; this and `covariance` without the constants
  std::array<double, 16> covariance{};      // (4, 4) of mass and first moment
  LoadParameters phi{};     // mass, first moment and inertia about the frame's origin
  double seconds = 0;       // duration of the motion, [s]
  double reach_m = 0;       // bound of the search for the centre of mass, [m]
  double misfit = 0;        // squared standard errors a row that the payload leaves: 1 where nothing else is
  bool mass_seen = false;   // false: the motion does not separate the mass from its lever
  bool at_bound = false;    // the centre of mass is at reach_m
  int unseen_count = 0;  // directions of the centre of mass that the motion does not determine, unit vectors
  std::array<std::array<double, 3>, 3> unseen{};
  std::array<LoadFit, kLoadCauses> fits{};  // fit of each hypothesis, by LoadCause
};

}  // namespace tauext
