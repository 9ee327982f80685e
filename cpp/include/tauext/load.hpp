// What the arm carries beside its own links: a load at a frame that the bundle names, and what of it can be believed.
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

// A load that is set from an earlier time on is told with that; this is none: from the next sample on.
inline constexpr std::int64_t kFromNow = std::numeric_limits<std::int64_t>::max();

// Why a load is refused.
enum class LoadFault : std::uint8_t {
  none,
  not_settable,      // the bundle says why (LoadSettings::refused)
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

}  // namespace tauext
