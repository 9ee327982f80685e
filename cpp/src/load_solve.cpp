#include "tauext/load_solve.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace tauext {
namespace {

constexpr std::size_t kMost = 4;  // coefficients that all joints share
// Of a mass before any motion, standard deviation: what no joint shows has it still, not none. No arm carries so much.
constexpr double kUntoldKg = 1000;

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

// What is to be explained, as a sum of columns.
LoadSums::Row target(const LoadParameters& phi) noexcept {
  LoadSums::Row theta{};
  theta[LoadSums::kTauExt] = 1;
  theta[LoadSums::kGear] = -1;
  for (std::size_t k = 4; k < phi.size(); ++k) theta[LoadSums::kLoad + k] = -phi[k];
  return theta;
}

// What a fit leaves of a joint, likewise.
LoadSums::Row left(const LoadSums::Row& whole, const Shared& shared, const LoadFit& fit, std::size_t joint) noexcept {
  LoadSums::Row theta = whole;
  for (std::size_t k = 0; k < shared.size; ++k) theta[shared.first + k] -= fit.values[k];
  theta[LoadSums::kOffset] = -fit.offset_nm[joint];
  theta[LoadSums::kCoulomb] = -fit.coulomb_nm[joint];
  return theta;
}

// Of a joint: its own two unknowns as a function of the shared ones.
struct Own {
  std::array<std::array<double, kMost>, 2> per_shared;
  std::array<double, 2> constant;
};

double information_of(double standard_deviation) noexcept {
  const double least = std::max(standard_deviation, 1e-9);
  return 1 / (least * least);
}

// information += A - C D^-1 C^T, moment += b - C D^-1 d, with D of the joint's own two unknowns.
Own eliminate(const LoadSums& sums, int joint, const Shared& shared, const LoadSums::Row& whole, double weight,
              const LoadBefore& before, std::array<double, kMost * kMost>& information,
              std::array<double, kMost>& moment) noexcept {
  const auto j = static_cast<std::size_t>(joint);
  const LoadSums::Square& gram = sums.joint(joint).whole;
  const auto at = [&](std::size_t a, std::size_t b) noexcept {
    return weight * gram[std::min(a, b) * LoadSums::kColumns + std::max(a, b)];
  };
  constexpr std::size_t own[] = {LoadSums::kOffset, LoadSums::kCoulomb};
  const double d00 = at(own[0], own[0]) + information_of(before.offset_nm[j]);
  const double d11 = at(own[1], own[1]) + information_of(before.coulomb_nm[j]);
  const double d01 = at(own[0], own[1]), determinant = d00 * d11 - d01 * d01;
  const auto solved = [&](double x, double y) noexcept {
    return std::array{(d11 * x - d01 * y) / determinant, (d00 * y - d01 * x) / determinant};
  };
  Own out;
  out.constant = solved(weight * sums.product(joint, own[0], whole), weight * sums.product(joint, own[1], whole));
  for (std::size_t k = 0; k < shared.size; ++k) {
    const auto gain = solved(at(shared.first + k, own[0]), at(shared.first + k, own[1]));
    out.per_shared[0][k] = gain[0];
    out.per_shared[1][k] = gain[1];
  }
  for (std::size_t k = 0; k < shared.size; ++k) {
    const std::size_t a = shared.first + k;
    moment[k] += weight * sums.product(joint, a, whole) - at(a, own[0]) * out.constant[0] - at(a, own[1]) * out.constant[1];
    for (std::size_t l = 0; l < shared.size; ++l)
      information[k * shared.size + l] += at(a, shared.first + l) - at(a, own[0]) * out.per_shared[0][l] -
                                          at(a, own[1]) * out.per_shared[1][l];
  }
  return out;
}

// Pseudo-inverse of a symmetric matrix (size, size): directions that nothing tells are left at 0.
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

void tell_left(const LoadSums& sums, const Shared& shared, const LoadSums::Row& whole, const LoadBefore& before,
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
  if (shared.size == 4) fit.cost += fit.values[0] * fit.values[0] * information_of(kUntoldKg);
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

LoadFit solve_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before,
                   const LoadNoise& noise) noexcept {
  const Shared shared = shared_by(cause);
  const LoadSums::Row whole = target(phi);
  std::array<double, kMost * kMost> information{};
  std::array<double, kMost> moment{};
  std::array<Own, kMaxJoints> own;
  if (cause == LoadCause::load) information[0] = information_of(kUntoldKg);
  if (cause == LoadCause::load && before.moment_kg_m > 0)
    for (std::size_t k = 1; k < 4; ++k) information[k * 4 + k] = information_of(before.moment_kg_m);
  for (int joint = 0; joint < sums.joints(); ++joint) {
    const auto j = static_cast<std::size_t>(joint);
    const double weight = 1 / (noise.scale[j] * noise.scale[j] * noise.correlation);
    own[j] = eliminate(sums, joint, shared, whole, weight, before, information, moment);
  }
  LoadFit fit;
  fit.size = static_cast<int>(shared.size);
  fit.noise = noise;
  fit.covariance = inverted(information, shared.size);
  for (std::size_t k = 0; k < shared.size; ++k)
    for (std::size_t l = 0; l < shared.size; ++l) fit.values[k] += fit.covariance[k * shared.size + l] * moment[l];
  for (std::size_t j = 0; j < static_cast<std::size_t>(sums.joints()); ++j) {
    fit.offset_nm[j] = own[j].constant[0];
    fit.coulomb_nm[j] = own[j].constant[1];
    for (std::size_t k = 0; k < shared.size; ++k) {
      fit.offset_nm[j] -= own[j].per_shared[0][k] * fit.values[k];
      fit.coulomb_nm[j] -= own[j].per_shared[1][k] * fit.values[k];
    }
  }
  tell_left(sums, shared, whole, before, fit);
  return fit;
}

LoadNoise noise_left(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadFit& fit) noexcept {
  const Shared shared = shared_by(cause);
  const LoadSums::Row whole = target(phi);
  LoadNoise noise = LoadNoise::unknown();
  double singles = 0, blocks = 0;
  for (int joint = 0; joint < sums.joints(); ++joint) {
    const auto j = static_cast<std::size_t>(joint);
    const LoadSums::Row theta = left(whole, shared, fit, j);
    const double single = std::max(sums.square(joint, theta), 0.0);
    const double square = std::max(single / std::max(sums.joint(joint).worth, 1e-9), kLeastNoiseScale * kLeastNoiseScale);
    noise.scale[j] = std::sqrt(square);
    singles += single / square;
    blocks += std::max(sums.block_square(joint, theta), 0.0) / square;
  }
  noise.correlation =
      std::clamp(blocks / std::max(singles, 1e-300), kLeastCorrelation, static_cast<double>(LoadSums::kBlockRows));
  return noise;
}

LoadFit fit_load(const LoadSums& sums, LoadCause cause, const LoadParameters& phi, const LoadBefore& before) noexcept {
  LoadFit fit = solve_load(sums, cause, phi, before, LoadNoise::unknown());
  for (int pass = 1; pass < kLoadPasses; ++pass)
    fit = solve_load(sums, cause, phi, before, noise_left(sums, cause, phi, fit));
  return fit;
}

// By Jacobi's rotations.
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

}  // namespace tauext
