// The external wrench at a frame of the arm, from the joints' tau_ext and how wrong each of them may be.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

struct Bundle;

// A frame that is fixed to a link, relative to the link's own.
struct WrenchFrame {
  std::string name;
  std::int32_t link = -1;
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  // link from frame, row-major
  std::array<double, 3> translation{};                        // its origin in the link's frame, [m]
};

// Axes that force and moment are given along; the moment is about the frame's origin either way.
enum class WrenchAxes : std::uint8_t { base = 0, frame = 1 };

// What is estimated from the joints: a force and a moment, or a force alone at a point that is known.
enum class WrenchKind : std::uint8_t { wrench = 0, force = 1 };

// Model of the errors of tau_ext across the joints; sigma_nm of the estimate is the size of each.
struct WrenchSettings {
  static constexpr double kUsualTorqueShare = 0.05;  // measured torques and makers' constants are off by 5 to 10 %

  std::vector<WrenchFrame> frames;   // that the robot file names
  std::vector<double> correlation;   // (joints, joints) of the errors of free motion, positive definite; none: independent
  std::vector<double> torque_share;  // a joint: standard error of its torque constant, as a share; none: kUsualTorqueShare
  double common_share = 0;           // of a factor that all joints have in common
  // By WrenchKind: variances of free motion are so many times those of sigma and correlation, so that 95 % of its errors
  // lie within the ellipsoid of 95 %; and residual_radius is the factor of the joints' unexplained rest to its chi-square.
  std::array<double, 2> radius{1, 1}, residual_radius{1, 1};

  // Throws Error, naming what does not fit `joints`.
  void validate(int joints) const;
};

// Force and moment that the surroundings exert on the arm. NaN where nothing is known.
struct Wrench {
  static constexpr int kMost = 6;

  bool known = false;               // the sample had torques with a standard error, and the frame exists
  int unknowns = 0;                 // 6: force, then moment; 3: force alone
  std::array<double, 3> force{};    // [N]
  std::array<double, 3> moment{};   // about the frame's origin, [N m]; of a force alone: what it makes of its point
  std::array<double, kMost * kMost> covariance{};  // the first unknowns x unknowns of it, row-major, [N^2], [N^2 m], [N^2 m^2]
  // Directions that this pose cannot show, unit vectors of (N, N, N, N m / kLength_m ...): their variance counts as infinite.
  // The covariance has at most kLargestForce_n squared there.
  int blind = 0;
  std::array<std::array<double, kMost>, kMost> blind_directions{};
  double chi_square = 0;  // of what such a wrench leaves unexplained in tau_ext, ...
  int freedom = 0;        // ... with so many degrees of freedom; 0: whatever the joints show, some wrench here explains it
  double consistent = 1;  // probability of so much or more where it is a touch at this frame; 1 with no freedom
};

// tau_ext = J^T w + e,  e ~ N(0, S),
//   S_ij = radius sigma_i sigma_j R_ij + (c^2 + delta_ij c_i^2) tau_i tau_j + delta_ij (contact_sigma_i^2 - sigma_i^2),
// with c_i the share that the torque constant of a joint may be off and c what all have in common; the last term is what a
// contact adds to the errors of free motion (ContactErrors). What a wrench can be
// at all, w ~ N(0, P) with P of kLargestForce_n and that times kLength_m, keeps the answer continuous through
// singularities: w = (J S^-1 J^T + P^-1)^-1 J S^-1 tau_ext. Where a direction is known to kBlindForce_n or better, P shrinks it by
// 1 % at most, by 0.01 % at 10 N; where it is not, it is named blind.
// Eigenvectors of the whitened J S^-1 J^T are the directions. Joints that do not answer in N m have no row in any of it.
// Gears rub harder under load, and the prior's friction includes the arm's own weight alone. Where dq is given, what a touch
// adds is taken off first, of joints whose share s was found from their own load: a joint that moves gets
//   tau_ext + s tanh(dq / kSignSpeed) (|g - tau_ext| - |g|),  g the weight that it holds.
class WrenchModel {
 public:
  static constexpr double kLargestForce_n = 1000;  // no touch that an arm survives is far beyond it
  static constexpr double kBlindForce_n = 100;     // standard error; an estimate with a larger error is no evidence of a touch
  static constexpr double kRubbingDoubt = 0.3;     // of the friction under a load that is taken off: 0.08 of it found, +- 0.02
  static constexpr double kLength_m = 0.1;  // a force so far from the frame is a usual moment: half a link's width

  // Of a bundle that holds together.
  explicit WrenchModel(const Bundle& bundle);

  // Why there is none; empty: there is one.
  const std::string& refused() const noexcept { return refused_; }
  // Frames by number: the links, by the names of their joints, then the load's frame, then the robot file's.
  int frames() const noexcept { return static_cast<int>(frames_.size()); }
  const WrenchFrame& frame(int which) const { return frames_.at(static_cast<std::size_t>(which)); }
  // -1: there is no such frame.
  int find(std::string_view name) const noexcept;
  int joints() const noexcept { return static_cast<int>(links_.size()); }
  const std::vector<Link>& links() const noexcept { return links_; }
  // Joints that answer in N m, rising. Of the others only q is used: what they alone would show is blind.
  std::span<const std::size_t> told() const noexcept { return told_; }
  // Whether all values in use are finite, sigma of the told() joints above 0, and contact_sigma no less.
  bool known(std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
             std::span<const double> contact_sigma_nm) const noexcept;
  // (count, joints) to (count, told), in place; square: (joints, joints) to (told, told).
  void keep_told(std::span<double> values, std::size_t count, bool square) const noexcept;
  const WrenchSettings& settings() const noexcept { return settings_; }

  // Joint torques of a unit of each unknown, (6, joints): force, then moment, along those axes, with the force at `point`
  // of the frame, [m] along its own axes. J of w at that point; no allocation.
  void columns(int frame, std::span<const double> q, const std::array<double, 3>& point, WrenchAxes axes,
               std::span<double> into) const noexcept;
  // Where a frame stands: `base from frame`, row-major, and its origin in the base's frame, [m]; no allocation.
  void pose(int frame, std::span<const double> q, std::array<double, 9>& rotation, std::array<double, 3>& origin) const noexcept;
  // S of a sample, (joints, joints). contact_sigma_nm: empty in free motion.
  void covariance(WrenchKind kind, std::span<const double> tau_ext, std::span<const double> sigma_nm,
                  std::span<const double> contact_sigma_nm, std::span<double> into) const noexcept;
  // tau_ext less what a touch's load adds to the friction of joints that move, in place, and S of it: of the variance that
  // this friction has in contact_sigma, kRubbingDoubt squared remains.
  void take_off_rubbing(WrenchKind kind, std::span<const double> q, std::span<const double> dq,
                        std::span<const double> sigma_nm, std::span<const double> contact_sigma_nm,
                        std::span<double> tau_ext, std::span<double> into) const noexcept;
  // All take a value a joint; no contact_sigma_nm: as in free motion; no dq: as where joints stand. Nothing allocates or
  // throws. The wrench at an unknown frame is not known.
  Wrench wrench(int frame, std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
                WrenchAxes axes = WrenchAxes::base, std::span<const double> contact_sigma_nm = {},
                std::span<const double> dq = {}) const noexcept;
  // Force alone, which acts at `point` of the frame, [m] along its own axes.
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
  Tree tree_;                         // as data corrected it
  std::vector<double> rubbing_;       // a joint: share of a load by which its gear rubs harder; 0: not found
};

// Probability that a chi-square with so many degrees of freedom, 1 or more, is at least this.
double chi_square_beyond(double value, int freedom) noexcept;

}  // namespace tauext
