#include "load/load_solve.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

#include "bundle/bodies.hpp"

namespace tauext {
namespace {

constexpr std::size_t kSize = LoadSums::kColumns;

double square_of(const LoadSums::Square& upper, const LoadSums::Row& theta) noexcept {
  double sum = 0;
  for (std::size_t a = 0; a < kSize; ++a) {
    if (theta[a] == 0) continue;
    double row = upper[a * kSize + a] * theta[a];
    for (std::size_t b = a + 1; b < kSize; ++b) row += 2 * upper[a * kSize + b] * theta[b];
    sum += theta[a] * row;
  }
  return sum;
}

// upper += weight z z^T
void add_square(LoadSums::Square& upper, const LoadSums::Row& z, double weight) noexcept {
  for (std::size_t a = 0; a < kSize; ++a) {
    const double times = weight * z[a];
    for (std::size_t b = a; b < kSize; ++b) upper[a * kSize + b] += times * z[b];
  }
}

}  // namespace

void LoadSums::clear() noexcept {
  std::ranges::fill(joints_, Joint{});
  rows_ = 0;
  open_rows_ = 0;
}

void LoadSums::add(std::span<const Row> rows, std::span<const double> sigma, std::span<const double> worth) noexcept {
  if (open_rows_ == kBlockRows) end_block();
  for (std::size_t j = 0; j < joints_.size(); ++j) {
    Joint& joint = joints_[j];
    Row scaled;
    for (std::size_t a = 0; a < kSize; ++a) scaled[a] = rows[j][a] / sigma[j];
    add_square(joint.whole, scaled, worth[j]);
    for (std::size_t a = 0; a < kSize; ++a) joint.open[a] += worth[j] * scaled[a];
    joint.worth += worth[j];
  }
  ++open_rows_;
  rows_ += 1;
}

void LoadSums::end_block() noexcept {
  open_rows_ = 0;
  for (Joint& joint : joints_) {
    add_square(joint.blocks, joint.open, 1.0);
    joint.open = {};
  }
}

double LoadSums::product(const Square& upper, std::size_t a, const Row& theta) noexcept {
  double sum = 0;
  for (std::size_t b = 0; b < a; ++b) sum += upper[b * kSize + a] * theta[b];
  for (std::size_t b = a; b < kSize; ++b) sum += upper[a * kSize + b] * theta[b];
  return sum;
}

double LoadSums::square(int joint, const Row& theta) const noexcept {
  return square_of(joints_[static_cast<std::size_t>(joint)].whole, theta);
}

double LoadSums::block_square(int joint, const Row& theta) const noexcept {
  const Joint& one = joints_[static_cast<std::size_t>(joint)];
  double open = 0;
  for (std::size_t a = 0; a < kSize; ++a) open += one.open[a] * theta[a];
  return square_of(one.blocks, theta) + open * open;
}

namespace {

constexpr std::size_t kMost = 4;  // coefficients that all joints share
// Standard deviation of a mass before any motion: above any payload, so unobserved masses stay undetermined.
constexpr double kUnseenMassKg = 1000;

struct Shared {
  std::size_t first, size;
};

Shared shared_by(LoadCause cause) noexcept {
  switch (cause) {
    case LoadCause::load: return {LoadSums::kLoad, 4};
    case LoadCause::base_force: return {LoadSums::kBase, 3};
    case LoadCause::frame_force: return {LoadSums::kFrame, 3};
    case LoadCause::nothing: break;
  }
  return {0, 0};
}

// The fit's residual of a joint, as a sum of columns.
LoadSums::Row left(const LoadSums::Row& whole, const Shared& shared, const LoadFit& fit, std::size_t joint) noexcept {
  LoadSums::Row theta = whole;
  for (std::size_t k = 0; k < shared.size; ++k) theta[shared.first + k] -= fit.values[k];
  theta[LoadSums::kOffset] = -fit.offset_nm[joint];
  theta[LoadSums::kCoulomb] = -fit.coulomb_nm[joint];
  return theta;
}

double information_of(double standard_deviation) noexcept {
  const double least = std::max(standard_deviation, 1e-9);
  return 1 / (least * least);
}

// Pseudo-inverse of a symmetric matrix (size, size): unobserved directions stay at 0.
std::array<double, kMost * kMost> inverted(const std::array<double, kMost * kMost>& matrix, std::size_t size) noexcept {
  std::array<double, kMost * kMost> out{};
  if (size == 0) return out;
  const SymmetricAxes found = symmetric_axes(std::span(matrix).first(size * size), static_cast<int>(size));
  double largest = 0;
  for (std::size_t m = 0; m < size; ++m) largest = std::max(largest, std::fabs(found.values[m]));
  for (std::size_t m = 0; m < size; ++m) {
    if (!(std::fabs(found.values[m]) > static_cast<double>(size) * std::numeric_limits<double>::epsilon() * largest)) continue;
    for (std::size_t k = 0; k < size; ++k)
      for (std::size_t l = 0; l < size; ++l)
        out[k * size + l] += found.axes[m][k] * found.axes[m][l] / found.values[m];
  }
  return out;
}

void report_left(const LoadSums& sums, const Shared& shared, const LoadSums::Row& whole, const LoadBefore& before,
                 LoadFit& fit) noexcept {
  double total = 0, worth = 0, independent = 0;
  for (int joint = 0; joint < sums.joints(); ++joint) {
    const auto j = static_cast<std::size_t>(joint);
    const double single = std::max(sums.square(joint, left(whole, shared, fit, j)), 0.0);
    total += single;
    worth += sums.joint(joint).worth;
    independent += single / (fit.noise.scale[j] * fit.noise.scale[j]);
    fit.cost += fit.offset_nm[j] * fit.offset_nm[j] * information_of(before.offset_nm[j]) +
                fit.coulomb_nm[j] * fit.coulomb_nm[j] * information_of(before.coulomb_nm[j]);
  }
  fit.cost += independent / fit.noise.correlation;
  if (shared.size == 4) fit.cost += fit.values[0] * fit.values[0] * information_of(kUnseenMassKg);
  if (shared.size == 4 && before.moment_kg_m > 0)
    for (std::size_t k = 1; k < 4; ++k) fit.cost += fit.values[k] * fit.values[k] * information_of(before.moment_kg_m);
  fit.misfit = total / std::max(worth, 1e-9);
}

}  // namespace

LoadNoise LoadNoise::unknown() noexcept {
  LoadNoise noise;
  noise.scale.fill(1.0);
  noise.correlation = LoadSums::kBlockRows;
  return noise;
}

std::array<double, 2> OwnUnknowns::at(std::span<const double> shared) const noexcept {
  std::array<double, 2> own = constant;
  for (std::size_t k = 0; k < shared.size(); ++k)
    for (std::size_t i = 0; i < 2; ++i) own[i] -= per_shared[i][k] * shared[k];
  return own;
}

OwnUnknowns eliminate(const LoadSums::Square& gram, std::size_t first, std::size_t size, const LoadSums::Row& target,
                      double weight, const std::array<double, 2>& sizes, LoadEquations& to) noexcept {
  const auto at = [&](std::size_t a, std::size_t b) noexcept {
    return weight * gram[std::min(a, b) * LoadSums::kColumns + std::max(a, b)];
  };
  constexpr std::size_t own[] = {LoadSums::kOffset, LoadSums::kCoulomb};
  const double d00 = at(own[0], own[0]) + information_of(sizes[0]);
  const double d11 = at(own[1], own[1]) + information_of(sizes[1]);
  const double d01 = at(own[0], own[1]), determinant = d00 * d11 - d01 * d01;
  const auto solved = [&](double x, double y) noexcept {
    return std::array{(d11 * x - d01 * y) / determinant, (d00 * y - d01 * x) / determinant};
  };
  const auto product = [&](std::size_t a) noexcept { return weight * LoadSums::product(gram, a, target); };
  OwnUnknowns out;
  out.constant = solved(product(own[0]), product(own[1]));
  for (std::size_t k = 0; k < size; ++k) {
    const auto gain = solved(at(first + k, own[0]), at(first + k, own[1]));
    out.per_shared[0][k] = gain[0];
    out.per_shared[1][k] = gain[1];
  }
  for (std::size_t k = 0; k < size; ++k) {
    const std::size_t a = first + k;
    to.moment[k] += product(a) - at(a, own[0]) * out.constant[0] - at(a, own[1]) * out.constant[1];
    for (std::size_t l = 0; l < size; ++l)
      to.information[k * size + l] +=
          at(a, first + l) - at(a, own[0]) * out.per_shared[0][l] - at(a, own[1]) * out.per_shared[1][l];
  }
  return out;
}

LoadSums::Row load_target(const LoadParameters& phi, double share) noexcept {
  LoadSums::Row theta{};
  theta[LoadSums::kTauExt] = 1;
  theta[LoadSums::kGear] = -share;
  for (std::size_t k = 4; k < phi.size(); ++k) theta[LoadSums::kLoad + k] = -share * phi[k];
  return theta;
}

LoadFit solve_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before,
                   const LoadNoise& noise) noexcept {
  const Shared shared = shared_by(cause);
  const LoadSums::Row target = load_target(phi);
  LoadEquations equations;
  std::array<OwnUnknowns, kMaxJoints> own;
  if (cause == LoadCause::load) equations.information[0] = information_of(kUnseenMassKg);
  if (cause == LoadCause::load && before.moment_kg_m > 0)
    for (std::size_t k = 1; k < 4; ++k) equations.information[k * 4 + k] = information_of(before.moment_kg_m);
  for (int joint = 0; joint < sums.joints(); ++joint) {
    const auto j = static_cast<std::size_t>(joint);
    const double weight = 1 / (noise.scale[j] * noise.scale[j] * noise.correlation);
    own[j] = eliminate(sums.joint(joint).whole, shared.first, shared.size, target, weight,
                       {before.offset_nm[j], before.coulomb_nm[j]}, equations);
  }
  LoadFit fit;
  fit.size = static_cast<int>(shared.size);
  fit.noise = noise;
  fit.covariance = inverted(equations.information, shared.size);
  for (std::size_t k = 0; k < shared.size; ++k)
    for (std::size_t l = 0; l < shared.size; ++l)
      fit.values[k] += fit.covariance[k * shared.size + l] * equations.moment[l];
  for (std::size_t j = 0; j < static_cast<std::size_t>(sums.joints()); ++j) {
    const auto found = own[j].at(std::span(fit.values).first(shared.size));
    fit.offset_nm[j] = found[0];
    fit.coulomb_nm[j] = found[1];
  }
  report_left(sums, shared, target, before, fit);
  return fit;
}

LoadNoise noise_of(const LoadSums& sums, std::span<const LoadSums::Row> residuals) noexcept {
  LoadNoise noise = LoadNoise::unknown();
  double singles = 0, blocks = 0;
  for (int joint = 0; joint < sums.joints(); ++joint) {
    const auto j = static_cast<std::size_t>(joint);
    const double single = std::max(sums.square(joint, residuals[j]), 0.0);
    const double square = std::max(single / std::max(sums.joint(joint).worth, 1e-9), kLeastNoiseScale * kLeastNoiseScale);
    noise.scale[j] = std::sqrt(square);
    singles += single / square;
    blocks += std::max(sums.block_square(joint, residuals[j]), 0.0) / square;
  }
  noise.correlation =
      std::clamp(blocks / std::max(singles, 1e-300), kLeastCorrelation, static_cast<double>(LoadSums::kBlockRows));
  return noise;
}

LoadNoise noise_left(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadFit& fit) noexcept {
  std::array<LoadSums::Row, kMaxJoints> residuals;
  for (std::size_t j = 0; j < static_cast<std::size_t>(sums.joints()); ++j)
    residuals[j] = left(load_target(phi), shared_by(cause), fit, j);
  return noise_of(sums, residuals);
}

LoadFit fit_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before) noexcept {
  LoadFit fit = solve_load(sums, cause, phi, before, LoadNoise::unknown());
  for (int pass = 1; pass < kLoadPasses; ++pass)
    fit = solve_load(sums, cause, phi, before, noise_left(sums, cause, phi, fit));
  return fit;
}

// Jacobi eigenvalue iteration.
SymmetricAxes symmetric_axes(std::span<const double> matrix, int size) noexcept {
  const auto n = static_cast<std::size_t>(size);
  std::array<std::array<double, kMost>, kMost> a{};
  SymmetricAxes out;
  for (std::size_t i = 0; i < n; ++i) {
    out.axes[i][i] = 1;
    for (std::size_t j = 0; j < n; ++j) a[i][j] = 0.5 * (matrix[i * n + j] + matrix[j * n + i]);
  }
  for (int sweep = 0; sweep < 32; ++sweep) {
    double off = 0;
    for (std::size_t p = 0; p < n; ++p)
      for (std::size_t q = p + 1; q < n; ++q) {
        const double apq = a[p][q];
        off += std::fabs(apq);
        if (apq == 0) continue;
        const double theta = (a[q][q] - a[p][p]) / (2 * apq);
        const double t = std::copysign(1.0, theta) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (std::size_t k = 0; k < n; ++k) {
          const double kp = a[k][p], kq = a[k][q];
          a[k][p] = c * kp - s * kq;
          a[k][q] = s * kp + c * kq;
        }
        for (std::size_t k = 0; k < n; ++k) {
          const double pk = a[p][k], qk = a[q][k];
          a[p][k] = c * pk - s * qk;
          a[q][k] = s * pk + c * qk;
        }
        a[p][q] = a[q][p] = 0;
        for (std::size_t k = 0; k < n; ++k) {
          const double pk = out.axes[p][k], qk = out.axes[q][k];
          out.axes[p][k] = c * pk - s * qk;
          out.axes[q][k] = s * pk + c * qk;
        }
      }
    if (!(off > 0)) break;
  }
  for (std::size_t i = 0; i < n; ++i) out.values[i] = a[i][i];
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = i + 1; j < n; ++j)
      if (out.values[j] < out.values[i]) {
        std::swap(out.values[i], out.values[j]);
        std::swap(out.axes[i], out.axes[j]);
      }
  return out;
}

namespace {

// Aluminium: a load's inertia about its own centre is approximated by a ball, small beside m c^2.
constexpr double kDensity = 2700.0;      // [kg/m^3]
constexpr double kUsualMass = 2;         // [kg]: usual payload of arms of this size
// Another explanation must be cheaper by these. The difference: odds of 90 to 1, for independent errors. The ratio:
// model errors are correlated and affect each explanation differently.
constexpr double kBetter = 9.0, kByHowMuch = 1.3;
constexpr double kDown = 0.95;           // cosine of the angle to gravity, 18 degrees, within which a force is a weight
// Squared standard errors per row that a load may leave: twice the usual error, as for some arms. A wrench that moves
// along the arm leaves more; then a load must explain this share of the torque.
constexpr double kPoor = 4.0, kExplains = 0.5;
// If the load leaves more, errors are taken from the bundle: otherwise a contact would count as a large error.
constexpr double kMostScale = 1.5;
// A direction of the centre of mass is unobserved if its standard error exceeds half the assumed one.
constexpr double kUnseenShare = 0.5;
constexpr double kMassUnseen = 0.25, kMassSeen_kg = 0.05;  // larger standard errors: the mass is not reported
constexpr double kUsualLever_m = 0.5;    // as Load::kUsualError has it
constexpr double kErrorsOfLoad = 2.0;    // standard errors of its torques: 95 % of loads are within

using Vec3 = std::array<double, 3>;

// Scaled towards the origin to satisfy the reach.
Vec3 within(const Vec3& com, double reach_m) noexcept {
  const double share = std::min(1.0, reach_m / std::max(length(com), 1e-12));
  return {share * com[0], share * com[1], share * com[2]};
}

// Whether a force in base axes points down (or, with a set load, up): without acceleration that is a load.
bool along(const LoadFit& force, const Vec3& gravity, bool either_way) noexcept {
  const Vec3 f{force.values[0], force.values[1], force.values[2]};
  const double dot = f[0] * gravity[0] + f[1] * gravity[1] + f[2] * gravity[2];
  return (either_way ? std::fabs(dot) : dot) > kDown * length(f) * length(gravity);
}

const LoadFit& fit_of(const LoadFound& found, LoadCause cause) noexcept {
  return found.fits[static_cast<std::size_t>(cause)];
}

LoadVerdict verdict(const LoadFound& found, double mass_kg, const Load& set, const Vec3& gravity) noexcept {
  const LoadFit &load = fit_of(found, LoadCause::load), &nothing = fit_of(found, LoadCause::nothing);
  const LoadFit& base = fit_of(found, LoadCause::base_force);
  double other = fit_of(found, LoadCause::frame_force).cost;
  if (!along(base, gravity, set.mass > 0)) other = std::min(other, base.cost);
  if (nothing.cost - std::min(load.cost, other) < kBetter) return LoadVerdict::nothing;
  if (kByHowMuch * other + kBetter < load.cost) return LoadVerdict::contact;
  if (mass_kg + set.mass < -kMassShows * found.mass_error_kg) return LoadVerdict::lifts;
  if (load.misfit > kPoor && nothing.cost - load.cost < kExplains * nothing.cost) return LoadVerdict::unclear;
  const bool shows = std::fabs(mass_kg) > kMassShows * found.mass_error_kg || nothing.cost - load.cost >= kBetter;
  return shows ? LoadVerdict::load : LoadVerdict::nothing;
}

using Square4 = std::array<double, kMost * kMost>;

// Change of a load's (m, h) with each joint's torque, for all of the torque that it carries.
using ByConstant = std::array<std::array<double, kMost>, kMaxJoints>;

ByConstant by_constant(const LoadSums& sums, const LoadFit& fit, const LoadParameters& about, const LoadBefore& before,
                       const LoadParameters& carried) noexcept {
  const auto times = [](const Square4& matrix, const std::array<double, kMost>& vector) noexcept {
    std::array<double, kMost> out{};
    for (std::size_t a = 0; a < kMost; ++a)
      for (std::size_t b = 0; b < kMost; ++b) out[a] += matrix[kMost * a + b] * vector[b];
    return out;
  };
  ByConstant out{};
  for (int joint = 0; joint < sums.joints(); ++joint) {
    const auto j = static_cast<std::size_t>(joint);
    LoadEquations of_joint;
    const double weight = 1 / (fit.noise.scale[j] * fit.noise.scale[j] * fit.noise.correlation);
    eliminate(sums.joint(joint).whole, LoadSums::kLoad, kMost, load_target(about), weight,
              {before.offset_nm[j], before.coulomb_nm[j]}, of_joint);
    out[j] = times(fit.covariance, times(of_joint.information, {carried[0], carried[1], carried[2], carried[3]}));
  }
  return out;
}

// Covariance of (m, h) from the torque constants.
Square4 of_constants(const ByConstant& moved, const WeighSettings& settings, std::size_t joints) noexcept {
  Square4 out{};
  for (std::size_t j = 0; j < joints; ++j)
    for (std::size_t k = 0; k < joints; ++k)
      for (std::size_t a = 0; a < kMost; ++a)
        for (std::size_t b = 0; b < kMost; ++b)
          out[kMost * a + b] += moved[j][a] * settings.torque_covariance[j * joints + k] * moved[k][b];
  return out;
}

// Mass, centre of mass, their errors and the unobserved parts.
void report(const LoadFit& fit, const LoadParameters& phi, const Square4& constants, double reach_m, LoadFound& out) noexcept {
  out.phi = phi;
  out.covariance = fit.covariance;
  out.mass_kg = phi[0];
  out.mass_error_kg = std::sqrt(std::max(fit.covariance[0], 0.0));
  out.constants_error_kg = std::sqrt(std::max(constants[0], 0.0));
  const double divisor = std::copysign(std::max(std::fabs(phi[0]), 1e-6), phi[0]);
  for (std::size_t i = 0; i < 3; ++i) out.com_m[i] = phi[1 + i] / divisor;
  std::array<std::array<double, 4>, 3> slope{};  // of the centre of mass with (m, h)
  for (std::size_t i = 0; i < 3; ++i) {
    slope[i][0] = -out.com_m[i] / divisor;
    slope[i][1 + i] = 1 / divisor;
  }
  const auto of_com = [&slope](const Square4& covariance, std::size_t i, std::size_t j) noexcept {
    double sum = 0;
    for (std::size_t a = 0; a < 4; ++a)
      for (std::size_t b = 0; b < 4; ++b) sum += slope[i][a] * covariance[4 * a + b] * slope[j][b];
    return sum;
  };
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) out.com_covariance[3 * i + j] = of_com(fit.covariance, i, j);
    out.com_error_m[i] = std::sqrt(std::max(out.com_covariance[4 * i] + of_com(constants, i, i), 0.0));
  }
  const SymmetricAxes axes = symmetric_axes(out.com_covariance, 3);
  const double seen = kUnseenShare * reach_m / 2;
  for (std::size_t m = 0; m < 3; ++m)
    if (axes.values[m] > seen * seen)
      out.unseen[static_cast<std::size_t>(out.unseen_count++)] = {axes.axes[m][0], axes.axes[m][1], axes.axes[m][2]};
  out.mass_seen = out.mass_error_kg <= std::max(kMassUnseen * std::fabs(out.mass_kg), kMassSeen_kg);
}

// Error of the load's torques in poses outside this motion: of its weight at a usual lever and its first moment in any
// direction.
double error_share(const LoadFound& found, double mass_kg) noexcept {
  if (!(mass_kg > 0)) return Load::kUsualError;
  const double lever2 = kUsualLever_m * kUsualLever_m;
  const double square = lever2 * found.covariance[0] +
                        (found.covariance[5] + found.covariance[10] + found.covariance[15]) / 3;
  const double share = kErrorsOfLoad * std::sqrt(std::max(square, 0.0)) / (kUsualLever_m * mass_kg);
  return std::clamp(share, Load::kUsualError, 1.0);
}

}  // namespace

Load ball(double mass, const Vec3& com) noexcept {
  const double radius = std::cbrt(3 * mass / (4 * std::numbers::pi * kDensity)), own = 0.4 * mass * radius * radius;
  return {mass, com, {own, own, own, 0, 0, 0}, 0};
}

const char* name(LoadVerdict verdict) noexcept {
  constexpr const char* names[] = {"too little", "nothing", "load", "contact", "lifts", "unclear"};
  return verdict <= LoadVerdict::unclear ? names[static_cast<int>(verdict)] : "";
}

LoadBefore before_weighing(const WeighSettings& settings, double mass_kg) noexcept {
  return {settings.offset_nm, settings.coulomb_nm, std::max(mass_kg, kLeastMass_kg) * settings.reach_m / 2};
}

Load changed(const Load& set, const std::array<double, 4>& found, double reach_m) noexcept {
  const double mass = set.mass + found[0];
  if (!(mass > 0)) return {};
  Vec3 com, added{};
  for (std::size_t i = 0; i < 3; ++i) com[i] = (set.mass * set.com[i] + found[1 + i]) / mass;
  for (std::size_t i = 0; i < 3 && found[0] > 0; ++i) added[i] = found[1 + i] / found[0];
  if (found[0] > 0 && length(added) <= reach_m) return together(set, ball(found[0], added));
  Load whole = set;
  whole.mass = mass;
  whole.com = within(com, std::max(reach_m, length(set.com)));
  for (double& moment : whole.inertia) moment *= mass / set.mass;
  return whole;
}

LoadParameters beside(const std::array<double, 4>& found, const Load& set, double reach_m) noexcept {
  LoadParameters phi{};
  if (set.mass > 0) {
    const LoadParameters whole = parameters_of(changed(set, found, reach_m)), before = parameters_of(set);
    for (std::size_t k = 0; k < phi.size(); ++k) phi[k] = whole[k] - before[k];
    return phi;
  }
  if (!(found[0] > 0)) return phi;
  return parameters_of(ball(found[0], within({found[1] / found[0], found[2] / found[0], found[3] / found[0]}, reach_m)));
}

LoadFound weigh(const LoadSums& sums, const WeighSettings& settings, const Load& set, const LoadParameters& phi,
                int rounds) noexcept {
  LoadFound out;
  out.seconds = sums.rows() * settings.row_s;
  out.reach_m = settings.reach_m;
  out.load = set;
  out.phi = phi;
  if (!(sums.rows() >= kLeastLoadRows)) return out;
  const auto before = [&](double mass_kg) noexcept {
    return before_weighing(settings, set.mass > 0 ? std::fabs(mass_kg) : mass_kg);
  };
  LoadParameters now = phi, about = phi;
  LoadFit fit;
  LoadBefore last;
  for (int round = 0; round < rounds; ++round) {
    about = now;
    // Start from the usual mass: a light load's prior would limit a heavy one's levers in all later rounds.
    fit = fit_load(sums, LoadCause::load, about, before(about[0] == 0 ? kUsualMass : about[0]));
    last = before(fit.values[0]);
    fit = fit_load(sums, LoadCause::load, about, last);
    now = beside(fit.values, set, settings.reach_m);
  }
  LoadNoise noise = fit.noise;
  for (double& scale : noise.scale) scale = std::min(scale, kMostScale);
  for (int cause = 0; cause < kLoadCauses; ++cause)
    out.fits[static_cast<std::size_t>(cause)] = solve_load(sums, static_cast<LoadCause>(cause), about, last, noise);
  LoadParameters whole = parameters_of(set);
  for (std::size_t k = 0; k < whole.size(); ++k) whole[k] += now[k];
  const ByConstant moved = by_constant(sums, fit, about, last, whole);
  for (std::size_t j = 0; j < moved.size(); ++j) out.mass_by_constant_kg[j] = moved[j][0];
  report(fit, now, of_constants(moved, settings, static_cast<std::size_t>(sums.joints())), settings.reach_m, out);
  out.misfit = fit_of(out, LoadCause::load).misfit;
  out.load = load_of(whole, error_share(out, whole[0]));
  out.at_bound = length(set.mass > 0 ? out.load.com : out.com_m) >= settings.reach_m * (1 - 1e-9);
  out.verdict = verdict(out, fit.values[0], set, settings.gravity);
  return out;
}

LoadParameters parameters_of(const Load& load) noexcept {
  const std::array<double, 6> far = point_inertia(load.mass, load.com);
  LoadParameters phi{load.mass, load.mass * load.com[0], load.mass * load.com[1], load.mass * load.com[2]};
  for (std::size_t k = 0; k < 6; ++k) phi[4 + k] = load.inertia[k] + far[k];
  return phi;
}

Load load_of(const LoadParameters& phi, double error_share) noexcept {
  if (!(phi[0] > 0)) return {};
  Load load{phi[0], {phi[1] / phi[0], phi[2] / phi[0], phi[3] / phi[0]}, {}, error_share};
  const std::array<double, 6> far = point_inertia(load.mass, load.com);
  for (std::size_t k = 0; k < 6; ++k) load.inertia[k] = phi[4 + k] - far[k];
  return load;
}

Load together(const Load& a, const Load& b) noexcept {
  const double mass = a.mass + b.mass;
  if (!(mass > 0)) return {};
  const LoadParameters of_a = parameters_of(a), of_b = parameters_of(b);
  LoadParameters sum;
  for (std::size_t k = 0; k < sum.size(); ++k) sum[k] = of_a[k] + of_b[k];
  return load_of(sum, (a.mass * a.error_share + b.mass * b.error_share) / mass);
}

}  // namespace tauext
