// Estimates the external wrench at a frame of the arm, with its covariance, from tau_ext.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "tauext/link.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

struct Bundle;

// Axes of force and moment. The moment is about the frame's origin in both cases.
enum class WrenchAxes : std::uint8_t { base = 0, frame = 1 };

// What is estimated: force and moment, or a force without a moment at a known point.
enum class WrenchKind : std::uint8_t { wrench = 0, force = 1 };

// Force and moment that the environment exerts on the arm, with covariance. NaN while unknown.
struct Wrench {
  static constexpr int kMost = 6;

  bool known = false;               // false: no torques with a standard error, or no such frame
  int unknowns = 0;                 // 6: force, then moment; 3: force only
  std::array<double, 3> force{};    // [N]
  std::array<double, 3> moment{};   // about the frame's origin, [N m]; with 3 unknowns the moment of the force
  std::array<double, kMost * kMost> covariance{};  // (unknowns, unknowns), row-major, [N^2], [N^2 m], [N^2 m^2]
  // Directions that this pose cannot show: unit vectors of (N, N, N, N m / kLength_m, ...). Their variance counts as
  // infinite; the covariance contains at most kLargestForce_n squared for them.
  int blind = 0;
  std::array<std::array<double, kMost>, kMost> blind_directions{};
  double chi_square = 0;  // of the part of tau_ext that the wrench does not explain
  int freedom = 0;        // its degrees of freedom; 0: some wrench at this frame explains any torques
  double consistent = 1;  // p-value of chi_square for a touch at this frame; 1 if freedom is 0
};

// Estimates wrenches at the frames of a bundle's arm by least squares with a prior:
//
//   tau_ext = J^T w + e,  e ~ N(0, S),  w ~ N(0, P),  w = (J S^-1 J^T + P^-1)^-1 J S^-1 tau_ext,
//   S_ij = radius sigma_i sigma_j R_ij + (c^2 + delta_ij c_i^2) tau_i tau_j
//          + delta_ij max(contact_sigma_i^2 - sigma_i^2 - (c^2 + c_i^2) tau_i^2, 0).
//
// R is the correlation, c_i the relative error of a joint's torque constant, and c that of the common factor. The last
// term is the additional error during a contact (ContactErrors) beside that of the constants. P has kLargestForce_n for
// forces and kLength_m times that for moments; it keeps the result continuous through singularities. P shrinks a
// direction whose standard error is kBlindForce_n by at most 1 %, one with 10 N by 0.01 %. Directions with a larger
// error are reported as blind; they are eigenvectors of the whitened J S^-1 J^T. Joints that do not answer in N m have
// no row.
// Gear friction grows with the load, and the prior contains only the arm's own weight. If dq is given and training
// found the share s from the joint's own load, the friction that a touch adds is subtracted first for moving joints:
//
//   tau_ext + s tanh(dq / kSignSpeed) (|g - tau_ext| - |g|),  with g the weight that the joint holds.
class WrenchModel {
 public:
  static constexpr double kLargestForce_n = 1000;  // standard deviation of the prior; no survivable touch is far beyond
  static constexpr double kBlindForce_n = 100;     // a direction with a larger standard error is blind
  static constexpr double kRubbingDoubt = 0.3;  // relative error of the subtracted friction: 0.08 of it found, +- 0.02
  static constexpr double kLength_m = 0.1;  // lever that relates moments to forces: half a link's width

  // The bundle must be valid.
  explicit WrenchModel(const Bundle& bundle);

  // Reason for which there is no wrench; empty: none.
  const std::string& refused() const noexcept { return refused_; }
  // Number of frames: the links by the names of their joints, then the load frame, then those of the robot file.
  int frames() const noexcept { return static_cast<int>(frames_.size()); }
  const WrenchFrame& frame(int which) const { return frames_.at(static_cast<std::size_t>(which)); }
  // Number of the frame with this name; -1: none.
  int find(std::string_view name) const noexcept;
  int joints() const noexcept { return static_cast<int>(links_.size()); }
  const std::vector<Link>& links() const noexcept { return links_; }
  // Joints that answer in N m, in rising order. Of the others, only q is used; what only they would show is blind.
  std::span<const std::size_t> told() const noexcept { return told_; }
  // Whether all used values are finite, sigma_nm of the told() joints is above 0, and contact_sigma_nm is not smaller.
  bool known(std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
             std::span<const double> contact_sigma_nm) const noexcept;
  // Reduces (count, joints) to (count, told) in place; square: (joints, joints) to (told, told).
  void keep_told(std::span<double> values, std::size_t count, bool square) const noexcept;
  const WrenchSettings& settings() const noexcept { return settings_; }

  // Pose of a frame: rotation base from frame, row-major, and origin in the base's frame, [m].
  struct Pose {
    std::array<double, 9> rotation;
    std::array<double, 3> origin;
  };

  // Fills (6, joints): joint torques of a unit force, then of a unit moment, along `axes`, at `point` of the frame, [m]
  // along the frame's own axes. This is J at that point. Returns the frame's pose. Allocates nothing.
  Pose columns(int frame, std::span<const double> q, const std::array<double, 3>& point, WrenchAxes axes,
               std::span<double> into) const noexcept;
  Pose pose(int frame, std::span<const double> q) const noexcept;
  // The estimate for given columns, (6, joints), along the base's axes: of a force, or of force and moment. direction, of unit
  // length: a force along it only, with a covariance of rank 1. A moment is left unset where only a force is estimated.
  Wrench of_columns(WrenchKind kind, std::span<const double> columns, std::span<const double> q, std::span<const double> tau_ext,
                    std::span<const double> sigma_nm, std::span<const double> contact_sigma_nm, std::span<const double> dq,
                    const std::array<double, 3>* direction = nullptr) const noexcept;
  // S of a sample, (joints, joints). contact_sigma_nm: empty in free motion.
  void covariance(WrenchKind kind, std::span<const double> tau_ext, std::span<const double> sigma_nm,
                  std::span<const double> contact_sigma_nm, std::span<double> into) const noexcept;
  // Subtracts from tau_ext, in place, the friction that a touch adds to moving joints, and fills S of the result:
  // kRubbingDoubt squared remains of this friction's variance in contact_sigma_nm.
  void take_off_rubbing(WrenchKind kind, std::span<const double> q, std::span<const double> dq,
                        std::span<const double> sigma_nm, std::span<const double> contact_sigma_nm,
                        std::span<double> tau_ext, std::span<double> into) const noexcept;
  // Estimates force and moment. All spans have one value per joint. contact_sigma_nm: empty in free motion; dq: empty
  // for joints at rest. Allocates and throws nothing. The result for an unknown frame is not known.
  Wrench wrench(int frame, std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
                WrenchAxes axes = WrenchAxes::base, std::span<const double> contact_sigma_nm = {},
                std::span<const double> dq = {}) const noexcept;
  // Estimates a force without a moment that acts at `point` of the frame, [m] along the frame's own axes.
  Wrench force(int frame, const std::array<double, 3>& point, std::span<const double> q, std::span<const double> tau_ext,
               std::span<const double> sigma_nm, WrenchAxes axes = WrenchAxes::base,
               std::span<const double> contact_sigma_nm = {}, std::span<const double> dq = {}) const noexcept;

 private:
  Wrench solve(WrenchKind kind, int frame, const std::array<double, 3>& point, std::span<const double> q,
               std::span<const double> tau_ext, std::span<const double> sigma_nm, WrenchAxes axes,
               std::span<const double> contact_sigma_nm, std::span<const double> dq) const noexcept;

  std::string refused_;
  std::vector<Link> links_;
  std::vector<std::size_t> told_;
  WrenchSettings settings_;
  std::vector<WrenchFrame> frames_;
  Tree tree_;                         // the corrected model
  std::vector<double> rubbing_;       // per joint: share of a load that adds to the gear friction; 0: not found
};

// Probability that a chi-square with this many degrees of freedom (at least 1) is at least `value`.
double chi_square_beyond(double value, int freedom) noexcept;

}  // namespace tauext
