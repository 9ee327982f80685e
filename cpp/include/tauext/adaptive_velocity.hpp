// Velocity from the positions of a coarse encoder.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/types.hpp"

namespace tauext {

// First-order adaptive windowing in its best-fit form [JanabiSharifi2000]: the slope of the line through the longest stretch of the last samples from whose end-to-end line no
// position departs by more than a count. A slow joint is averaged over all of the window, one that accelerates over as
// few samples as its acceleration asks for: a stretch of time T lags by T/2, and a T^2/8 <= count bounds T.
// A joint that flickers between two counts has a velocity near 0, where a difference says count/period.
// The last samples only: a control loop has the same values. No allocation after the constructor.
class AdaptiveVelocity {
 public:
  static constexpr int kMostSteps = 64;  // of a window

  // steps: most steps in a window, 1 (the plain difference) to kMostSteps. count_rad: smallest step of a joint's encoder,
  // >= 0, a joint; 0: the plain difference. Throws Error otherwise.
  AdaptiveVelocity(int steps, std::span<const double> count_rad);

  // Velocities after one more sample of finite positions [rad/s]; 0 with the first one. t_ns must increase: where it does
  // not, or after a pause of more than gap_ns (0: never), the window begins anew.
  void step(std::int64_t t_ns, std::span<const double> q, std::int64_t gap_ns, std::span<double> dq) noexcept;
  // The next sample is a first one.
  void reset() noexcept { filled_ = 0; }

 private:
  double slope(std::size_t joint) const noexcept;
  std::size_t place(int back) const noexcept;  // in the ring, of the sample so many steps ago

  int steps_, newest_ = 0, filled_ = 0;
  std::vector<double> count_rad_;
  std::vector<std::int64_t> t_ns_;
  std::vector<double> q_;  // (steps + 1, joints)
};

}  // namespace tauext
