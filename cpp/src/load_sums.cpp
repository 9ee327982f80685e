#include "tauext/load_sums.hpp"

#include <algorithm>
#include <cmath>

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

void LoadSums::fade(double share) noexcept {
  const double of_sums = std::sqrt(share);
  for (Joint& joint : joints_) {
    for (double& value : joint.whole) value *= share;
    for (double& value : joint.blocks) value *= share;
    for (double& value : joint.open) value *= of_sums;
    joint.worth *= share;
  }
  rows_ *= share;
}

double LoadSums::product(int joint, std::size_t a, const Row& theta) const noexcept {
  const Square& upper = joints_[static_cast<std::size_t>(joint)].whole;
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

}  // namespace tauext
