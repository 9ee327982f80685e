// The sums that everything about an unknown load follows from: of fixed size, a row at a time.
#pragma once
#include <array>
#include <cstddef>
#include <span>
#include <vector>

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

}  // namespace tauext
