// Kinematic tree and the one O(n) sweep that the momentum observer needs: p and beta, with no matrix.
#pragma once
#include <span>
#include <string>
#include <vector>

#include "tauext/types.hpp"

namespace tauext {

// How a joint moves its link: it turns it or it slides it. The numbers stand in bundles.
enum class JointType : std::uint8_t { revolute = 0, prismatic = 1 };

// One moving link and the joint that carries it. The joint axis is the link frame's +z, its origin the frame's origin.
struct Link {
  std::string joint_name;  // the name that users give it
  int parent = -1;  // index of the parent link, -1 for the base; it may come before or after the link itself
  JointType type = JointType::revolute;
  std::array<double, 9> rotation{};     // parent from link at q = 0, row-major
  std::array<double, 3> translation{};  // joint origin in the parent's frame, [m]
  double mass = 0;                      // [kg]
  std::array<double, 3> com{};          // centre of mass in the link frame, [m]
  std::array<double, 6> inertia{};      // about the centre of mass, link axes: xx, yy, zz, xy, xz, yz, [kg m^2]
  double rotor_inertia = 0;             // motor inertia times gear ratio squared, [kg m^2] or [kg]
};

// What is fixed to a link beside its own mass, in the link's axes and about its origin.
struct Carried {
  double mass = 0;                       // [kg]
  std::array<double, 3> first_moment{};  // mass times centre of mass, [kg m]
  std::array<double, 6> inertia{};       // xx, yy, zz, xy, xz, yz, [kg m^2]
};

// A tree of 1 to kMaxJoints links in any order: the order of the links is that of q, dq, p and beta.
// All masses, inertias and rotor inertias zero is the "no model": p = beta = 0.
class Tree {
 public:
  // gravity: acceleration of free fall in the base frame, [m/s^2], (0, 0, -9.81) for an upright base.
  // Throws Error where a link is not finite, has negative mass, a rotation that is none, or does not hang on the base.
  Tree(std::vector<Link> links, std::array<double, 3> gravity);

  // Generalised momentum p = M dq and beta = g - C^T dq = -dL/dq, with L = T - U.
  // Outward: body velocities v_i; inward: composite momenta H_i and composite weights W_i;
  // p_i = S_i . H_i + J_i dq_i, (C^T dq)_i = (v_parent x S_i) . H_i, g_i = -S_i . W_i.
  // q [rad or m], dq [rad/s or m/s], p [N m s or N s], beta [N m or N]; every span holds size() values.
  void momentum(std::span<const double> q, std::span<const double> dq, std::span<double> p,
                std::span<double> beta) const noexcept;

  // From now on this link carries that, and nothing else; links() stay as they are. A Carried of zeros takes it off to
  // the last bit. Nothing happens where there is no such link.
  void carry(int link, const Carried& what) noexcept;

  int size() const noexcept { return static_cast<int>(links_.size()); }  // joints
  // Whether some link has mass: the "no model" has none.
  bool has_mass() const noexcept;
  // As they were given.
  const std::vector<Link>& links() const noexcept { return links_; }
  const std::array<double, 3>& gravity() const noexcept { return gravity_; }

 private:
  // What the sweep needs of a link, all in the link's frame and about its origin.
  struct Body {
    int joint, parent;  // index in q, and of the parent among the bodies
    JointType type;
    std::array<double, 9> rotation;
    std::array<double, 3> translation;
    double mass, subtree_mass;           // of the link, and of it and all that it carries
    std::array<double, 3> first_moment;  // mass times centre of mass
    std::array<double, 6> inertia;       // as in Link, but about the origin
    double rotor_inertia;
  };
  std::vector<Body> sort_bodies() const;
  static void sum_masses(std::vector<Body>& bodies) noexcept;

  std::vector<Link> links_;
  std::array<double, 3> gravity_;
  std::vector<Carried> own_;  // of every link
  std::vector<Body> bodies_;  // parents before their children
};

}  // namespace tauext
