// What the arm carries beside its own links: a load at a frame that the bundle names, and bounds on it.
#pragma once
#include <array>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// A rigid body in the axes of the load frame. Mass 0 is no load.
struct Load {
  // A mass weighed to 1 % and a centre of mass known to 1 cm, half a metre from the axis that it weighs on.
  static constexpr double kUsualError = 0.03;

  double mass = 0;                   // [kg]
  std::array<double, 3> com{};       // centre of mass in the load frame, [m]
  std::array<double, 6> inertia{};   // about the centre of mass, axes of the load frame: xx, yy, zz, xy, xz, yz, [kg m^2]
  double error_share = kUsualError;  // how wrong its torques may be: limits rise by this share of them; 0: it is exact

  bool operator==(const Load&) const = default;
};

// since_ns of a load that holds from the next sample on; any other value is an earlier time that it holds from.
inline constexpr std::int64_t kFromNow = std::numeric_limits<std::int64_t>::max();

// Why a load is refused.
enum class LoadFault : std::uint8_t {
  none,
  not_settable,      // LoadSettings::refused of the bundle has the reason
  not_finite,
  negative_mass,
  too_heavy,         // beyond largest_mass_kg
  too_far,           // its centre of mass is beyond largest_reach_m
  impossible_inertia,  // no body has it: not positive semidefinite, or against the triangle inequality
  too_wide,          // no body has so much inertia within the reach of its centre of mass
  error_share,       // not 0 to 1
  no_past,           // it is to hold since an earlier time, and the residual of this bundle cannot go back
};

struct LoadSettings {
  std::string frame;      // its name, for people
  std::int32_t link = -1; // index of the link that it is fixed to; -1: none
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  // link from load frame, row-major
  std::array<double, 3> translation{};  // the frame's origin in the link's frame, [m]
  double largest_mass_kg = 0, largest_reach_m = 0;  // of a load; the reach from the frame's origin
  std::string refused = "the bundle names no frame for a load";  // why none can be set; empty: it can

  bool settable() const noexcept { return refused.empty(); }
  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
  LoadFault fault(const Load& load) const noexcept;
  // The fault in a sentence: what, the value, the rule.
  std::string words(LoadFault fault, const Load& load) const;
  // The load about the origin of its link, in the link's axes.
  Carried in_link(const Load& load) const noexcept;
  // The link with the load as a part of it.
  Link merged(const Load& load, const Link& own) const;
};

// For bundles that name no frame themselves: the frame of the last link of the longest chain; at most half the mass and
// half the length of the arm (0.3 m at least). `corrected`: the model as data corrected it, which alone carries a load
// where `links` have no mass; empty: there is none.
LoadSettings assumed_load_settings(const std::vector<Link>& links, const std::vector<Link>& corrected);

// How far the centre of mass of a load that is weighed may be from the load frame's origin.
inline constexpr double kUsualReach_m = 0.3;

// m, h, I of a load about its frame's origin, in that frame's axes: mass [kg], first moment [kg m],
// inertia xx, yy, zz, xy, xz, yz [kg m^2].
using LoadParameters = std::array<double, 10>;

// What may have acted, as the columns that all joints share.
enum class LoadCause : std::uint8_t { load, base_force, frame_force, nothing };
inline constexpr int kLoadCauses = 4;

// What is known of the errors of tau_ext beside its sigma.
struct LoadNoise {
  JointVector scale;       // a joint: times sigma
  double correlation = 0;  // rows that carry as much information as one independent row
  // Before any fit: sigma is right, and a block carries as much information as a row.
  static LoadNoise unknown() noexcept;
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

// Result of the sums of weighing.
enum class LoadVerdict : std::uint8_t {
  too_little,  // fewer than kLeastLoadRows rows: no measurement
  nothing,     // no load shows
  load,
  contact,     // a constant force fits better than any load
  lifts,       // what shows pulls up
  unclear,     // neither explains it
};
const char* name(LoadVerdict verdict) noexcept;
inline constexpr int kLeastLoadRows = 30;  // three tenths of a second

// What weighing finds: mass and centre of mass, how sure they are, and whether it is a load at all. Lengths and axes are
// those of the load frame. Numbers without `load` are of what was found BESIDE the load that is set.
struct LoadFound {
  LoadVerdict verdict = LoadVerdict::too_little;
  Load load;                // both together, for set_load(); a ball's inertia, the error share of its standard errors
  double mass_kg = 0;       // may be below 0 only where a load is set, which is less then
  double mass_error_kg = 0; // standard error
  std::array<double, 3> com_m{}, com_error_m{};
  std::array<double, 9> com_covariance{};   // (3, 3), [m^2]
  std::array<double, 16> covariance{};      // (4, 4) of mass and first moment
  LoadParameters phi{};     // mass, first moment and inertia about the frame's origin
  double seconds = 0;       // of motion
  double reach_m = 0;       // of the search: the centre of mass is within it
  double misfit = 0;        // squared standard errors a row that the load leaves: 1 where nothing else is
  bool mass_seen = false;   // false: the motion does not separate the mass from its lever
  bool at_bound = false;    // the centre of mass is at the reach
  int unseen_count = 0;     // directions of the centre of mass that the motion did not determine, unit vectors:
  std::array<std::array<double, 3>, 3> unseen{};
  std::array<LoadFit, kLoadCauses> fits{};  // by LoadCause: what each of them would explain
};

}  // namespace tauext
