// The shape of links: capsules fixed to them.
#pragma once
#include <array>
#include <cstdint>
#include <span>

namespace tauext {

// All points within radius_m of the line from start to end, which are seen from the link's own frame, [m].
struct Capsule {
  std::int32_t link = -1;
  std::array<double, 3> start{}, end{};
  double radius_m = 0;
};

// Throws Error unless all are fixed to one of so many links, within 1000 m of it, and 0.1 mm to 10 m wide.
void validate_capsules(std::span<const Capsule> capsules, int joints);

}  // namespace tauext
