// One joint's share of a refit: its own weights, most likely after today's motion.
#pragma once
#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "refit_rows.hpp"

namespace tauext {

// First and end of one of so many stretches of rows, as long as each other.
inline std::pair<std::size_t, std::size_t> block_of(std::size_t rows, int block, int blocks) noexcept {
  const auto at = [&](int b) { return rows * static_cast<std::size_t>(b) / static_cast<std::size_t>(blocks); };
  return {at(block), at(block + 1)};
}

// minimise |u|^2 + k sum_r t_r (y_r - a_r.u)^2 / s^2 over the unknowns u of RefitSettings, with y = error / sigma,
// a = terms' values by sigma times what a unit of u changes their weights by (of the trend: by that row's time), t Tukey's weights, s the spread of what is
// left and k the share of rows that are independent.
class JointFit {
 public:
  JointFit(const Bundle& bundle, const RefitRows& rows, int joint, const RefitSettings& settings);

  // Factors and constant.
  void tell(RefitJoint& out) const;
  // The joint's weights, and its network's scale.
  void put(Bundle& bundle) const;
  // Error of every row after a fit without its block, [N m].
  std::vector<double> left_out(int blocks) const;
  double memory_s() const noexcept { return memory_s_; }

 private:
  enum class Group : std::uint8_t { friction, viscous, constant, ripple, network };
  struct Column {
    Group group;
    std::size_t place;  // in the prior's terms
    double weight;      // the old one; 1 of a network
    std::vector<double> values;  // (rows)
  };

  void find_columns();
  void build(const RefitSettings& settings);
  void iterate();
  double spread_of(std::span<const double> rest) const;
  // Unknowns by the rows outside [first, end), and their covariance where it is asked for.
  std::vector<double> solve(std::size_t first, std::size_t end, std::vector<double>* covariance) const;
  std::vector<double> left(std::span<const double> unknowns) const;
  double size_of(Group group) const;
  RefitFactor factor(Group group) const;
  double change(std::size_t column, std::span<const double> unknowns) const;

  const Bundle& bundle_;
  const RefitRows& rows_;
  std::size_t joint_;
  std::vector<Column> columns_;
  std::size_t unknowns_ = 0;
  double expected_ = 1;              // factor of friction before today's motion is seen
  double unseen_error_ = 0;          // of a factor of which today's motion says nothing
  std::vector<double> effect_;       // (columns, unknowns): change of a weight by a unit of an unknown
  std::vector<double> standard_;     // (rows, unknowns): a
  std::vector<double> given_;        // (rows): error / sigma beside what is expected
  std::vector<double> trust_;        // (rows): t
  double spread_ = 1, independent_ = 1, memory_s_ = 0;
  std::vector<double> found_, covariance_;
};

}  // namespace tauext
