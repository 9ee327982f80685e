// Kinematic tree: computes p and beta of the momentum observer in one O(n) sweep, without matrices.
#pragma once
#include <array>
#include <span>
#include <vector>

#include "tauext/link.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Sine and cosine of every position: computed once for all models at one state.
struct Angles {
  JointVector sine{}, cosine{};
  void compute(std::span<const double> q) noexcept;
};

// Kinematic tree of 1 to kMaxJoints links in any order; q, dq, p and beta have the order of the links. With all masses,
// inertias and rotor inertias 0 ("no model"), p = beta = 0.
class Tree {
 public:
  // gravity: acceleration of free fall in the base frame, [m/s^2], (0, 0, -9.81) for an upright base. Throws Error if a
  // link is not finite, has a negative mass or an invalid rotation, or is not connected to the base.
  Tree(std::vector<Link> links, std::array<double, 3> gravity);

  // Computes the generalised momentum p = M dq and beta = g - C^T dq = -dL/dq, with L = T - U. Outward sweep: body
  // velocities v_i. Inward sweep: composite momenta H_i and composite weights W_i; p_i = S_i . H_i + J_i dq_i, (C^T
  // dq)_i = (v_parent x S_i) . H_i, g_i = -S_i . W_i. q [rad or m], dq [rad/s or m/s], p [N m s or N s], beta [N m or
  // N]; every span has size() values.
  void momentum(std::span<const double> q, std::span<const double> dq, std::span<double> p,
                std::span<double> beta) const noexcept;
  // angles: of q.
  void momentum(std::span<const double> q, std::span<const double> dq, const Angles& angles, std::span<double> p,
                std::span<double> beta) const noexcept;

  // Fixes a body to this link and replaces an earlier one; links() do not change. A Carried of zeros removes it to the
  // last bit. Does nothing for an unknown link.
  void carry(int link, const Carried& what) noexcept;

  int size() const noexcept { return static_cast<int>(links_.size()); }  // number of joints
  // False for the "no model": no link has mass.
  bool has_mass() const noexcept;
  // Links and gravity, as passed to the constructor.
  const std::vector<Link>& links() const noexcept { return links_; }
  const std::array<double, 3>& gravity() const noexcept { return gravity_; }

 private:
  // Data of a link for the sweep, in the link's frame and about its origin.
  struct Body {
    int joint, parent;  // index in q, and of the parent in bodies_
    JointType type;
    std::array<double, 9> rotation;
    std::array<double, 3> translation;
    double mass, subtree_mass;           // of the link, and of the link with all links that it carries
    std::array<double, 3> first_moment;  // mass times centre of mass
    std::array<double, 6> inertia;       // as in Link, but about the origin
    double rotor_inertia;
  };
  void sweep(std::span<const double> q, std::span<const double> dq, const JointVector& sine, const JointVector& cosine,
             std::span<double> p, std::span<double> beta) const noexcept;
  std::vector<Body> sort_bodies() const;
  static void sum_masses(std::vector<Body>& bodies) noexcept;

  std::vector<Link> links_;
  std::array<double, 3> gravity_;
  std::vector<Carried> own_;  // per link
  std::vector<Body> bodies_;  // parents before their children
};

}  // namespace tauext
