#include "alarm/coverage.hpp"

#include <algorithm>
#include <cmath>
#include <string>

namespace tauext {
namespace {

constexpr int kCells = CoverageSettings::kCells, kPairCells = CoverageSettings::kPairCells;
constexpr double kFarther = Coverage::kFartherCells;
constexpr double kForgotten = 0.01;           // a share below this counts as 0

// Fraction of a turn from -1/2 to 1/2, or the value itself. Adding 1.5 * 2^52 rounds without a rounding instruction.
// Larger values have no fraction, and any cell is as good.
double within_turn(double x, double turn) noexcept {
  constexpr double kRounds = 6755399441055744.0;
  return x - turn * ((x + kRounds) - kRounds);
}

// A valid cell for any x, including infinity and NaN.
int cell(double x, int cells) noexcept {
  return static_cast<int>(std::max(0.0, std::min(cells - 0.5, (x + 0.5) * cells)));
}

// Distance in cells beyond the reach of the trained ones, by rows or columns, whichever is larger, up to kFartherCells.
// Zero within reach. Grows the region by one cell per pass.
template <class Seen>
void append_beyond(std::vector<std::uint8_t>& out, int rows, int columns, bool rows_turn, bool columns_turn, int reach,
                   Seen seen) {
  std::vector<std::uint8_t> near(static_cast<std::size_t>(rows * columns));
  const auto at = [columns](int r, int c) { return static_cast<std::size_t>(r * columns + c); };
  for (int r = 0; r < rows; ++r)
    for (int c = 0; c < columns; ++c) near[at(r, c)] = seen(r, c);
  const auto grow = [](std::vector<std::uint8_t>& cells, int lines, int length, bool turns, auto index) {
    const std::vector<std::uint8_t> before = cells;
    for (int line = 0; line < lines; ++line)
      for (int k = 0; k < length; ++k)
        for (int by : {-1, 1}) {
          const int from = turns ? (k + by + length) % length : std::clamp(k + by, 0, length - 1);
          cells[index(line, k)] |= before[index(line, from)];
        }
  };
  std::vector<std::uint8_t> beyond(near.size(), 0);
  for (int away = 1; reach > 0 && away < reach + Coverage::kFartherCells; ++away) {
    grow(near, rows, columns, columns_turn, at);
    grow(near, columns, rows, rows_turn, [&](int c, int r) { return at(r, c); });
    for (std::size_t k = 0; away >= reach && k < near.size(); ++k) beyond[k] += near[k] == 0;
  }
  out.insert(out.end(), beyond.begin(), beyond.end());
}

}  // namespace

const char* name(Unseen unseen) noexcept {
  constexpr const char* names[] = {"", "speed", "position", "positions"};
  return unseen <= Unseen::positions ? names[static_cast<int>(unseen)] : "";
}

void CoverageSettings::see(std::span<const double> q) noexcept {
  const auto at = [&](std::size_t j, int cells) {
    return cell(within_turn((q[j] - centre_rad[j]) * (1 / span_rad[j]), turns[j]), cells);
  };
  for (std::size_t j = 0; j < q.size(); ++j) seen[j] |= std::uint64_t{1} << at(j, kCells);
  std::uint32_t* words = seen_together.data();
  for (std::size_t i = 0; reach_together > 0 && i < q.size(); ++i)
    for (std::size_t j = i + 1; j < q.size(); ++j, words += kPairCells)
      words[at(i, kPairCells)] |= std::uint32_t{1} << at(j, kPairCells);
}

Coverage::Coverage(int joints, const CoverageSettings& settings, double fades_per_s) : fades_per_s_(fades_per_s) {
  settings.validate(joints);
  if (settings.empty()) return;
  const auto n = static_cast<std::size_t>(joints);
  joints_ = joints;
  for (std::size_t j = 0; j < n; ++j) {
    axes_.push_back({1 / settings.span_rad[j], settings.centre_rad[j], settings.turns[j] ? 1.0 : 0.0,
                     1 / settings.fastest_rad_s[j]});
    append_beyond(beyond_, 1, kCells, false, settings.turns[j], settings.reach[j],
                  [&](int, int c) { return settings.seen[j] >> c & 1; });
  }
  pairs_ = settings.reach_together > 0;
  if (!pairs_) return;
  const std::uint32_t* words = settings.seen_together.data();
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = i + 1; j < n; ++j, words += kPairCells)
      append_beyond(beyond_together_, kPairCells, kPairCells, settings.turns[i], settings.turns[j],
                    settings.reach_together, [&](int c, int d) { return words[c] >> d & 1; });
}

// First pass: only whether anything is unfamiliar, which is rare.
Unfamiliar Coverage::evaluate(std::span<const double> q, std::span<const double> dq) const noexcept {
  if (joints_ == 0) return {};
  Cells cells, pair_cells;
  double ratio = 0;
  unsigned any = 0;
  for (int j = 0; j < joints_; ++j) {
    const Axis& axis = axes_[j];
    const double x = within_turn((q[j] - axis.centre) * axis.per_span, axis.turn);
    cells[j] = cell(x, kCells);
    pair_cells[j] = cell(x, kPairCells);
    ratio = std::max(ratio, std::fabs(dq[j]) * axis.per_fastest);
    any |= beyond_[j * kCells + cells[j]];
  }
  if (pairs_) {
    const std::uint8_t* table = beyond_together_.data();
    for (int i = 0; i < joints_; ++i) {
      const int row = pair_cells[i] * kPairCells;
      for (int j = i + 1; j < joints_; ++j, table += kPairCells * kPairCells) any |= table[row + pair_cells[j]];
    }
  }
  return any != 0 || ratio > 1 ? farthest(dq, cells, pair_cells) : Unfamiliar{};
}

Unfamiliar Coverage::farthest(std::span<const double> dq, const Cells& cells, const Cells& pair_cells) const noexcept {
  Unfamiliar most;
  const auto see = [&](double share, Unseen what, int joint, int other) noexcept {
    if (share > most.share) most = {share, what, joint, other};
  };
  for (int j = 0; j < joints_; ++j)
    see(std::min((std::fabs(dq[j]) * axes_[j].per_fastest - 1) / kFasterShare, 1.0), Unseen::speed, j, -1);
  for (int j = 0; j < joints_; ++j)
    see(beyond_[j * kCells + cells[j]] / kFarther, Unseen::position, j, -1);
  const std::uint8_t* table = beyond_together_.data();
  for (int i = 0; pairs_ && i < joints_; ++i)
    for (int j = i + 1; j < joints_; ++j, table += kPairCells * kPairCells)
      see(table[pair_cells[i] * kPairCells + pair_cells[j]] / kFarther, Unseen::positions, i, j);
  return most;
}

const Unfamiliar& Coverage::step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq) noexcept {
  Unfamiliar now = evaluate(q, dq);
  if (state_.last.share > 0) {
    const double left =
        state_.last.share * std::exp(-fades_per_s_ * 1e-9 * static_cast<double>(elapsed_ns(t_ns, state_.t_ns)));
    if (left > now.share && left >= kForgotten) {
      now = state_.last;
      now.share = left;
    }
  }
  state_.t_ns = t_ns;
  state_.last = now;
  return state_.last;
}

}  // namespace tauext
