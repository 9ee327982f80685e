// What the sums say: mass and centre of mass, how sure they are, and whether it is a load at all.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/load.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Of each joint, over rows z a network period apart, the sums of worth z z^T / sigma^2; and the same of sums over blocks
// of kBlockRows rows, which tell for how long errors of tau_ext go on in one direction.
class LoadSums {
 public:
  // Columns of a row: what a unit of it shows in tau_ext (load_columns.hpp), and tau_ext itself, [N m].
  static constexpr std::size_t kLoad = 0,  // m, h, I: 10
      kOffset = 10,                        // an offset of the joint's own
      kCoulomb = 11,                       // friction of another size than training saw
      kBase = 12, kFrame = 15,             // forces along the base's and the frame's axes: 3 each
      kGear = 18,                          // what of the load's friction does not grow with it
      kTauExt = 19, kColumns = 20;
  static constexpr int kBlockRows = 100;   // a second
  using Row = std::array<double, kColumns>;

  // Symmetric: what stands in the upper triangle counts.
  using Square = std::array<double, kColumns * kColumns>;
  struct Joint {
    Square whole{}, blocks{};
    Row open{};        // of the block that is not full yet
    double worth = 0;  // rows, each by what it is worth
  };

  // Allocates; nothing else here does.
  explicit LoadSums(int joints) : joints_(static_cast<std::size_t>(joints)) {}

  // As newly made.
  void clear() noexcept;
  // One row, a Row, a sigma > 0 and a worth 0 to 1 a joint.
  void add(std::span<const Row> rows, std::span<const double> sigma, std::span<const double> worth) noexcept;
  // The next row does not follow the last one: it begins a block.
  void end_block() noexcept;
  // All that was added counts only so much (0 to 1) any more.
  void fade(double share) noexcept;

  int joints() const noexcept { return static_cast<int>(joints_.size()); }
  double rows() const noexcept { return rows_; }  // added; faded ones by what they count
  const Joint& joint(int j) const noexcept { return joints_[static_cast<std::size_t>(j)]; }
  // Sum over b of whole_ab theta_b.
  double product(int joint, std::size_t a, const Row& theta) const noexcept;
  // theta^T whole theta, and theta^T blocks theta with the open block.
  double square(int joint, const Row& theta) const noexcept;
  double block_square(int joint, const Row& theta) const noexcept;

 private:
  std::vector<Joint> joints_;
  double rows_ = 0;
  int open_rows_ = 0;
};

// What is known beforehand.
struct LoadBefore {
  JointVector offset_nm{}, coulomb_nm{};  // a joint: standard deviation of its own two unknowns, [N m]
  double moment_kg_m = 0;                 // of each component of h about 0; 0: nothing is known of it
};

// Least squares of tau_ext - gear - X_I phi_I = X values + offset_j + coulomb_j tanh(dq_j / v) + error over all rows: each
// joint's own two unknowns are eliminated before the joints are added up. phi: the load as known so far, whose inertia
// phi_I is taken off.
LoadFit solve_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before,
                   const LoadNoise& noise) noexcept;
// Size and correlation of the errors that a fit leaves: sums over blocks grow with how long errors last.
LoadNoise noise_left(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadFit& fit) noexcept;
// Both in turns, kLoadPasses times.
inline constexpr int kLoadPasses = 4;
LoadFit fit_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before) noexcept;

inline constexpr double kLeastNoiseScale = 0.5;  // beside the bundle's sigma: a few seconds may happen to be easy
// Rows: errors of friction go with the direction of a move, and last for a good part of one, 0.3 s at least. A fit takes
// some of them up, so that what it leaves shows less.
inline constexpr double kLeastCorrelation = 30;

// Eigenvalues (rising) and unit vectors (rows) of a symmetric matrix (size, size) of size 1 to 4.
struct SymmetricAxes {
  std::array<double, 4> values{};
  std::array<std::array<double, 4>, 4> axes{};
};
SymmetricAxes symmetric_axes(std::span<const double> matrix, int size) noexcept;

// What is set of a load beside its columns.
struct WeighSettings {
  JointVector offset_nm{}, coulomb_nm{};     // as LoadBefore
  std::array<double, 3> gravity{};           // in the base frame, [m/s^2]
  double row_s = 0.01;                       // between rows
  double reach_m = kUsualReach_m;            // the centre of mass is within it of the frame's origin
};

inline constexpr double kSigmaOfLimit = 0.2;  // where there is no error scale, whose limits are some five of it

// In rounds, the inertia following from the load found in the round before.
//   set: what the arm is taken to carry, which tau_ext is without
//   phi: what is known so far of what there is beside it, all 0 where that is nothing
inline constexpr int kLoadRounds = 3;
LoadFound weigh(const LoadSums& sums, const WeighSettings& settings, const Load& set, const LoadParameters& phi,
                int rounds = kLoadRounds) noexcept;

// What is known of (m, h) of a load of so much mass before any motion: each of h within m reach / 2 of 0.
LoadBefore before_weighing(const WeighSettings& settings, double mass_kg) noexcept;
// All parameters that follow from (m, h) found beside a load that is set: with it, the mass is at least 0 and its centre
// within the reach. The inertia of what came is that of a ball about its centre; where something was taken off, what is
// left keeps its radii of gyration.
LoadParameters beside(const std::array<double, 4>& found, const Load& set, double reach_m) noexcept;

// About the frame's origin.
LoadParameters parameters_of(const Load& load) noexcept;
// Of such parameters, mass above 0; else no load.
Load load_of(const LoadParameters& phi, double error_share) noexcept;
// A body of this mass above 0 as a ball of aluminium: its inertia is little beside m c^2. It has no error.
Load ball(double mass, const std::array<double, 3>& com) noexcept;
// Two bodies as one; the error share is that of their torques where they pull alike.
Load together(const Load& a, const Load& b) noexcept;

}  // namespace tauext
