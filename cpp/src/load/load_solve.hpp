// Solves the sums for mass and centre of mass, with errors, and decides whether a load is there.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/load.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Per joint, over rows z one network period apart: sums of worth z z^T / sigma^2, and the same of sums over blocks of
// kBlockRows rows. The blocks show how long errors of tau_ext persist.
class LoadSums {
 public:
  // Columns of a row: contribution per unit to tau_ext (load_columns.hpp), and tau_ext itself, [N m].
  static constexpr std::size_t kLoad = 0,  // m, h, I: 10
      kOffset = 10,                        // an offset of the joint's own
      kCoulomb = 11,                       // deviation of friction from training
      kBase = 12, kFrame = 15,             // forces along the base's and the frame's axes: 3 each
      kGear = 18,                          // the constant part of the load's friction
      kTauExt = 19, kColumns = 20;
  static constexpr int kBlockRows = 100;   // a second
  using Row = std::array<double, kColumns>;

  // Symmetric: only the upper triangle is used.
  using Square = std::array<double, kColumns * kColumns>;
  struct Joint {
    Square whole{}, blocks{};
    Row open{};        // of the current block
    double worth = 0;  // sum of the rows' worth
  };

  // Allocates; nothing else here does.
  explicit LoadSums(int joints) : joints_(static_cast<std::size_t>(joints)) {}

  // Back to the state after construction.
  void clear() noexcept;
  // Adds one row; per joint a Row, a sigma > 0 and a worth of 0 to 1.
  void add(std::span<const Row> rows, std::span<const double> sigma, std::span<const double> worth) noexcept;
  // The next row does not follow the last one; starts a block.
  void end_block() noexcept;

  int joints() const noexcept { return static_cast<int>(joints_.size()); }
  double rows() const noexcept { return rows_; }
  const Joint& joint(int j) const noexcept { return joints_[static_cast<std::size_t>(j)]; }
  // Sum over b of upper_ab theta_b.
  static double product(const Square& upper, std::size_t a, const Row& theta) noexcept;
  // theta^T whole theta, and theta^T blocks theta with the open block.
  double square(int joint, const Row& theta) const noexcept;
  double block_square(int joint, const Row& theta) const noexcept;

 private:
  std::vector<Joint> joints_;
  double rows_ = 0;
  int open_rows_ = 0;
};

// Prior knowledge.
struct LoadBefore {
  JointVector offset_nm{}, coulomb_nm{};  // a joint: standard deviation of its own two unknowns, [N m]
  double moment_kg_m = 0;                 // standard deviation of each component of h; 0: none given
};

// Normal equations of the coefficients that all joints share: up to 4, row-major.
struct LoadEquations {
  std::array<double, 16> information{};
  std::array<double, 4> moment{};
};
// A joint's offset and Coulomb friction as a function of the shared coefficients.
struct OwnUnknowns {
  std::array<std::array<double, 4>, 2> per_shared;
  std::array<double, 2> constant;

  std::array<double, 2> at(std::span<const double> shared) const noexcept;
};
// Adds a joint to the equations of the columns first to first + size, with its own two unknowns eliminated:
// information += A - C D^-1 C^T, moment += b - C D^-1 d.
//  gram: as LoadSums::Joint::whole
//  target: the sum of columns that is explained
//  sizes: standard deviations of offset and Coulomb friction
OwnUnknowns eliminate(const LoadSums::Square& gram, std::size_t first, std::size_t size, const LoadSums::Row& target,
                      double weight, const std::array<double, 2>& sizes, LoadEquations& to) noexcept;
// What is left of tau_ext for mass and first moment, as a sum of columns: without `share` of the gear's constant part and
// of the inertia of the load as known so far.
LoadSums::Row load_target(const LoadParameters& phi, double share = 1) noexcept;
// Size and correlation of residuals, which are sums of columns: sums over blocks grow with the correlation time.
LoadNoise noise_of(const LoadSums& sums, std::span<const LoadSums::Row> residuals) noexcept;

// Least squares of tau_ext - gear - X_I phi_I = X values + offset_j + coulomb_j tanh(dq_j / v) + error over all rows: each
// joint's own two unknowns are eliminated before the joints are added up. phi: the load as known so far, whose inertia
// phi_I is taken off.
LoadFit solve_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before,
                   const LoadNoise& noise) noexcept;
// The noise of a fit's residuals.
LoadNoise noise_left(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadFit& fit) noexcept;
// Alternates both, kLoadPasses times.
inline constexpr int kLoadPasses = 4;
LoadFit fit_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before) noexcept;

inline constexpr double kLeastNoiseScale = 0.5;  // relative to the bundle's sigma: a few seconds may have small errors
// Rows: friction errors depend on the direction of motion and last for a good part of a move, at least 0.3 s. The fit
// absorbs some of them, so its residuals underestimate them.
inline constexpr double kLeastCorrelation = 30;

// Eigenvalues (rising) and unit vectors (rows) of a symmetric matrix (size, size) of size 1 to 4.
struct SymmetricAxes {
  std::array<double, 4> values{};
  std::array<std::array<double, 4>, 4> axes{};
};
SymmetricAxes symmetric_axes(std::span<const double> matrix, int size) noexcept;

// Load settings beside the columns.
struct WeighSettings {
  JointVector offset_nm{}, coulomb_nm{};     // see LoadBefore
  std::array<double, 3> gravity{};           // in the base frame, [m/s^2]
  std::vector<double> torque_covariance;     // (joints, joints), of the relative errors of the torque constants
  double row_s = 0.01;                       // between rows
  double reach_m = kUsualReach_m;            // largest distance of the centre of mass from the frame's origin
};

inline constexpr double kLeastMass_kg = 0.1;   // least mass for the prior of the first moment
inline constexpr double kMassShows = 3.0;      // standard errors between a mass and 0
inline constexpr double kSigmaOfLimit = 0.2;  // without an error scale; limits are about five of its sigmas

// Iterates; each round uses the inertia of the load found before.
//  set: the load already subtracted from tau_ext
//  phi: current estimate of the additional load, all 0 if none
inline constexpr int kLoadRounds = 3;
LoadFound weigh(const LoadSums& sums, const WeighSettings& settings, const Load& set, const LoadParameters& phi,
                int rounds = kLoadRounds) noexcept;

// Prior of (m, h) for a load of this mass: each component of h within m reach / 2 of 0.
LoadBefore before_weighing(const WeighSettings& settings, double mass_kg) noexcept;
// The whole load, given (m, h) found beside a set load. If both cannot be bodies within the reach, the set one is scaled.
Load changed(const Load& set, const std::array<double, 4>& found, double reach_m) noexcept;
// All parameters, given (m, h) found beside a set load. In total, the mass is at least 0 and the centre within reach.
// The added part has the inertia of a ball about its centre; after a removal, the rest keeps its radii of gyration.
LoadParameters beside(const std::array<double, 4>& found, const Load& set, double reach_m) noexcept;

// About the frame's origin.
LoadParameters parameters_of(const Load& load) noexcept;
// Load of these parameters if the mass is above 0; else none.
Load load_of(const LoadParameters& phi, double error_share) noexcept;
// An aluminium ball of this mass > 0, without error; its inertia is small beside m c^2.
Load ball(double mass, const std::array<double, 3>& com) noexcept;
// Combines two loads; the error share is that of aligned torques.
Load together(const Load& a, const Load& b) noexcept;

}  // namespace tauext
