#include "tauext/presliding.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {

Presliding::Presliding(int joints, std::span<const double> widths)
    : joints_(joints), widths_(widths.begin(), widths.end()) {
  if (joints < 1 || joints > kMaxJoints)
    throw Error("presliding states need 1 to " + std::to_string(kMaxJoints) + " joints, not " + std::to_string(joints));
  if (widths.size() > kMaxWidths)
    throw Error("a joint has at most " + std::to_string(kMaxWidths) + " presliding states, not " +
                std::to_string(widths.size()));
  double before = 0;
  for (double width : widths) {
    if (!(width > before) || !std::isfinite(width))
      throw Error("presliding width " + to_text(width) + " rad must be > " + to_text(before));
    before = width;
  }
}

void Presliding::forget(int joint) noexcept {
  for (int w = 0; w < width_count(); ++w) {
    state_.low[index(joint, w)] = -1.0;
    state_.high[index(joint, w)] = 1.0;
  }
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
  }
  state_.started = true;
}

void Presliding::write_ends(std::span<double> low, std::span<double> high) const noexcept {
  std::copy_n(state_.low.begin(), columns(), low.begin());
  std::copy_n(state_.high.begin(), columns(), high.begin());
}

void Presliding::read_ends(std::span<const double> low, std::span<const double> high) noexcept {
  std::copy_n(low.begin(), columns(), state_.low.begin());
  std::copy_n(high.begin(), columns(), state_.high.begin());
}

void Presliding::write(std::span<double> states) const noexcept {
  for (int j = 0; j < joints_; ++j)
    for (int w = 0; w < width_count(); ++w) states[index(j, w)] = value(j, w);
}

}  // namespace tauext
