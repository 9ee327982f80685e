// A link of an arm's model with the joint that moves it, and a body fixed to a link.
#pragma once
#include <array>
#include <cstdint>
#include <string>

namespace tauext {

// Whether the joint rotates or translates its link. Bundles store these numbers.
enum class JointType : std::uint8_t { revolute = 0, prismatic = 1 };

// A moving link and the joint that carries it. The joint axis is the link frame's +z axis and passes through its
// origin.
struct Link {
  std::string joint_name;  // name of the joint in the robot file
  int parent = -1;  // index of the parent link; -1: the base; it may come before or after the link
  JointType type = JointType::revolute;
  std::array<double, 9> rotation{};     // parent from link at q = 0, row-major
  std::array<double, 3> translation{};  // joint origin in the parent's frame, [m]
  double mass = 0;                      // [kg]
  std::array<double, 3> com{};          // centre of mass in the link frame, [m]
  std::array<double, 6> inertia{};      // about the centre of mass, link axes: xx, yy, zz, xy, xz, yz, [kg m^2]
  double rotor_inertia = 0;             // motor inertia times gear ratio squared, [kg m^2] or [kg]
};

// A body fixed to a link in addition to the link's own mass, in the link's axes and about its origin.
struct Carried {
  double mass = 0;                       // [kg]
  std::array<double, 3> first_moment{};  // mass times centre of mass, [kg m]
  std::array<double, 6> inertia{};       // xx, yy, zz, xy, xz, yz, [kg m^2]
};

}  // namespace tauext
