// Points on the surface of a link.
#pragma once
#include <cstddef>
#include <span>
#include <vector>

#include "tauext/capsule.hpp"

namespace tauext {

struct Bundle;

// Spread evenly over a link's surface, in the link's frame; a column a quantity, one value a point.
struct LinkSurface {
  std::vector<double> x, y, z;     // [m]
  std::vector<double> nx, ny, nz;  // unit vectors into the link
  std::vector<double> share;       // of the surface's area that the point stands for; they sum to 1

  std::size_t size() const noexcept { return x.size(); }
};

// About so many points on the union of these capsules, which are of one link; parts of one within another are no surface.
LinkSurface surface_of(std::span<const Capsule> capsules, int points);

// The bundle's capsules, and for each link that has none a guess: from its joint to those that it carries, or to the load's
// frame, else to the furthest frame that the robot file fixes to it, kGuessedRadius_m wide.
inline constexpr double kGuessedRadius_m = 0.05;
std::vector<Capsule> capsules_or_guess(const Bundle& bundle);

}  // namespace tauext
