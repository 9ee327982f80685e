#include "tauext/sample_clock.hpp"

#include <algorithm>
#include <cmath>

#include "tauext/types.hpp"

namespace tauext {
namespace {
constexpr std::int64_t kLongestPeriodNs = 10'000'000'000, kBridgedNs = 30'000'000;
}

int longest_bridged(std::int64_t sample_period_ns, int network_stride) noexcept {
  if (sample_period_ns < 1) return network_stride;  // SampleClock refuses it
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

}  // namespace tauext
