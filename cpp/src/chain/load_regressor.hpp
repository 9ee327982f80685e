// p and beta of a rigid body on a link, linear in the body's mass, first moment and inertia.
#pragma once
#include <array>
#include <span>
#include <vector>

#include "tauext/link.hpp"
#include "tauext/load.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Mounting of a load: a frame on a link of a tree, in the link's own frame.
struct LoadFrame {
  int link = -1;  // index of the tree's links
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  // link from frame, row-major
  std::array<double, 3> translation{};                        // its origin in the link's frame, [m]

  // Throws Error if the link does not exist or the rotation is none.
  void validate(int links) const;
};
inline LoadFrame load_frame(const LoadSettings& loads) noexcept { return {loads.link, loads.rotation, loads.translation}; }

// Columns of p and beta of every joint, for a load with parameters phi in the frame's axes, about the frame's origin:
//   phi = (m, h, I):  mass [kg], first moment h = m c [kg m], inertia xx, yy, zz, xy, xz, yz [kg m^2],
//   p_load = sum_k P_k phi_k,    beta_load = sum_k B_k phi_k.
// All in the frame: S_i is its twist for a unit speed of joint i, V_i that of the joints before it. H_k and W_k are
// momentum and weight of a unit parameter. P_ik = S_i . H_k,  B_ik = -S_i . W_k - (V_i x S_i) . H_k. One pass from the
// load to the base gives S and V; other joints have zeros.
class LoadRegressor {
 public:
  static constexpr int kParameters = 10;
  using Columns = std::array<JointVector, kParameters>;
  using Forces = std::array<JointVector, 3>;

  // Throws Error if the frame does not fit the tree.
  LoadRegressor(const Tree& tree, const LoadFrame& frame);

  // Processes one sample; q and dq hold one value per joint.
  void compute(std::span<const double> q, std::span<const double> dq) noexcept;

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
