// The momentum of an arm at one pose and velocity, and an arm with a body fixed to it.
#pragma once
#include <string>
#include <utility>
#include <vector>

#include "tauext/load.hpp"
#include "tauext/tree.hpp"

struct Momentum {
  tauext::JointVector p{}, beta{};
};

inline Momentum momentum_of(const tauext::Tree& tree, const tauext::JointVector& q, const tauext::JointVector& dq) {
  Momentum out;
  const auto n = static_cast<std::size_t>(tree.size());
  tree.momentum({q.data(), n}, {dq.data(), n}, {out.p.data(), n}, {out.beta.data(), n});
  return out;
}

// The arm with the load fixed at a frame by a joint that never moves: p and beta of the other joints are those of both.
template <class Frame>
std::vector<tauext::Link> with_fixed_body(std::vector<tauext::Link> links, const Frame& at, const tauext::Load& load) {
  links.push_back({"held still", at.link, tauext::JointType::prismatic, at.rotation, at.translation, load.mass, load.com,
                   load.inertia});
  return links;
}
