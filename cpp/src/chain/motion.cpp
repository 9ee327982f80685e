#include "chain/motion.hpp"

#include <algorithm>
#include <cmath>

#include "tauext/types.hpp"

namespace tauext {
namespace {
constexpr std::int64_t kLongestPeriodNs = 10'000'000'000, kBridgedNs = 30'000'000;
}

int longest_bridged(std::int64_t sample_period_ns, int network_stride) noexcept {
  if (sample_period_ns < 1) return network_stride;  // rejected by SampleClock
  return std::max(network_stride, static_cast<int>(std::min<std::int64_t>(kMostBridged, kBridgedNs / sample_period_ns)));
}

SampleClock::SampleClock(std::int64_t sample_period_ns, int network_stride)
    : sample_period_ns_(sample_period_ns) {
  if (sample_period_ns < 1 || sample_period_ns > kLongestPeriodNs)
    throw Error("sample period = " + std::to_string(sample_period_ns) + " ns must be 1 ns to 10 s");
  if (network_stride < 1 || network_stride > kMaxNetworkStride)
    throw Error("network period = " + std::to_string(network_stride) + " samples must be 1 to " +
                std::to_string(kMaxNetworkStride));
  longest_bridged_ = longest_bridged(sample_period_ns, network_stride);
}

SampleClock::Tick SampleClock::step(std::int64_t t_ns) noexcept {
  if (started_ && t_ns <= t_ns_) return {Kind::not_later, 0};
  const double elapsed = static_cast<double>(elapsed_ns(t_ns, t_ns_)) / static_cast<double>(sample_period_ns_) + carry_;
  const bool first = !started_;
  started_ = true;
  t_ns_ = t_ns;
  const double advance = first ? 0.0 : std::max(1.0, std::round(elapsed));
  if (first || advance - 1.0 > longest_bridged_) {
    carry_ = 0;
    return {Kind::restart, 0};
  }
  carry_ = std::clamp(elapsed - advance, -1.0, 1.0);
  return {Kind::next, static_cast<std::int64_t>(advance)};
}

Presliding::Presliding(int joints, std::span<const double> widths, std::span<const double> branches)
    : joints_(joints), widths_(widths.begin(), widths.end()), branches_(branches.begin(), branches.end()) {
  validate_presliding(joints, widths, branches);
  edges_.resize(branches.size());
  slopes_.resize(branches.size());
  for (int j = 0; j < joints_ && has_branches(); ++j) {
    const auto shares = branches.subspan(index(j, 0), widths.size());
    const bool none = std::ranges::all_of(shares, [](double share) { return share == 0; });
    double edge = -1, from = 0;
    for (int w = 0; w < width_count(); ++w) {
      double slope = 0;
      for (int k = w; k < width_count(); ++k) slope += branches_[index(j, k)] / widths_[k];
      edge += slope * (2 * widths_[w] - from);
      from = 2 * widths_[w];
      const bool last = std::ranges::all_of(shares.subspan(static_cast<std::size_t>(w) + 1), [](double share) { return share == 0; });
      edges_[index(j, w)] = none ? -1 : last ? 1 : std::min(edge, 1.0);
      slopes_[index(j, w)] = slope;
    }
  }
}

// Along the branch, segment by segment; a sliding joint stays at its end.
void Presliding::bend_local(int joint, double moved) noexcept {
  double& state = state_.local[static_cast<std::size_t>(joint)];
  const double direction = moved > 0 ? 1.0 : -1.0;
  double at = direction * state, left = std::fabs(moved);
  for (int w = 0; w < width_count(); ++w) {
    const double edge = edges_[index(joint, w)], slope = slopes_[index(joint, w)];
    if (!(at < edge)) continue;
    const double to_edge = (edge - at) / slope;
    if (left < to_edge) {
      at = std::min(at + slope * left, edge);
      break;
    }
    left -= to_edge;
    at = edge;
  }
  state = direction * at;
}

void Presliding::forget(int joint) noexcept {
  for (int w = 0; w < width_count(); ++w) {
    state_.low[index(joint, w)] = -1.0;
    state_.high[index(joint, w)] = 1.0;
  }
  state_.local[static_cast<std::size_t>(joint)] = 0.0;
  find_gap(joint);
}

void Presliding::step(std::span<const double> q) noexcept {
  for (int j = 0; j < joints_; ++j) {
    const double moved = state_.started ? q[j] - state_.q[j] : 0.0;
    state_.q[j] = q[j];
    for (int w = 0; w < width_count(); ++w) {
      const std::size_t at = index(j, w);
      if (!state_.started) {
        state_.low[at] = -1.0;
        state_.high[at] = 1.0;
      }
      const double by = moved / widths_[w];
      state_.low[at] = std::clamp(state_.low[at] + by, -1.0, 1.0);
      state_.high[at] = std::clamp(state_.high[at] + by, -1.0, 1.0);
    }
    if (!state_.started) state_.local[static_cast<std::size_t>(j)] = 0.0;
    if (!has_branches() || (state_.started && moved == 0)) continue;
    bend_local(j, moved);
    find_gap(j);
  }
  state_.started = true;
}

void Presliding::write_ends(std::span<double> low, std::span<double> high) const noexcept {
  std::copy_n(state_.low.begin(), columns(), low.begin());
  std::copy_n(state_.high.begin(), columns(), high.begin());
  for (std::span<double> to : {low, high})
    std::copy_n(state_.local.begin(), kept_columns() - columns(), to.begin() + columns());
}

void Presliding::read_ends(std::span<const double> low, std::span<const double> high) noexcept {
  std::copy_n(low.begin(), columns(), state_.low.begin());
  std::copy_n(high.begin(), columns(), state_.high.begin());
  std::copy_n(low.begin() + columns(), kept_columns() - columns(), state_.local.begin());
  for (int j = 0; j < joints_; ++j) find_gap(j);
}

void Presliding::write(std::span<double> states) const noexcept {
  for (int j = 0; j < joints_; ++j)
    for (int w = 0; w < width_count(); ++w) states[index(j, w)] = value(j, w);
}

}  // namespace tauext
