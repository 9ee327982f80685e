// What a load fixed to a link adds to p and beta, per unit of its inertial parameters: both are linear in them.
#pragma once
#include <array>
#include <span>
#include <vector>

#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Where a load is fixed: a frame on a link of a tree, in the link's own frame.
struct LoadFrame {
  int link = -1;  // index of the tree's links
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  // link from frame, row-major
  std::array<double, 3> translation{};                        // its origin in the link's frame, [m]

  // Throws Error where the link does not exist or the rotation is none.
  void validate(int links) const;
};

// Columns of p and beta of every joint, for a load with parameters phi in the frame's axes, about the frame's origin:
//   phi = (m, h, I):  mass [kg], first moment h = m c [kg m], inertia xx, yy, zz, xy, xz, yz [kg m^2],
//   p_load = sum_k P_k phi_k,    beta_load = sum_k B_k phi_k.
// With S_i the frame's twist for a unit speed of joint i, V_i that of the joints before it, H_k momentum and W_k weight of
// a unit parameter, all in the frame:  P_ik = S_i . H_k,  B_ik = -S_i . W_k - (V_i x S_i) . H_k.  One way down the chain
// from the load to the base finds S and V; joints that do not carry the load have zeros.
class LoadRegressor {
 public:
  static constexpr int kParameters = 10;
  using Columns = std::array<JointVector, kParameters>;
  using Forces = std::array<JointVector, 3>;

  // Throws Error where the frame does not fit the tree.
  LoadRegressor(const Tree& tree, const LoadFrame& frame);

  // One sample; q and dq hold one value a joint.
  void look(std::span<const double> q, std::span<const double> dq) noexcept;

  // Of the last sample: P, B, and the joint torques of a force of 1 N at the frame's origin, along the frame's axes and
  // along the base's.
  const Columns& momentum() const noexcept { return momentum_; }
  const Columns& beta() const noexcept { return beta_; }
  const Forces& frame_forces() const noexcept { return frame_forces_; }
  const Forces& base_forces() const noexcept { return base_forces_; }
  int joints() const noexcept { return static_cast<int>(links_.size()); }

 private:
  std::vector<Link> links_;
  std::array<double, 3> gravity_;
  LoadFrame frame_;
  std::vector<int> chain_;  // links that carry the load, from its own to the base
  Columns momentum_{}, beta_{};
  Forces frame_forces_{}, base_forces_{};
};

}  // namespace tauext
