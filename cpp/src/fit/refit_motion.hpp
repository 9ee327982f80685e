// The motion of a running arm that a refit needs.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "tauext/sample.hpp"

namespace tauext {

// Motion stored for a refit, in memory allocated before the loop starts.
class RefitMotion {
 public:
  // Allocates; discards the stored samples.
  void reserve(int joints, std::int64_t samples) {
    *this = {};
    joints_ = joints;
    const auto count = static_cast<std::size_t>(samples), cells = count * static_cast<std::size_t>(joints);
    t_ns_.resize(count);
    q_.resize(cells);
    dq_.resize(cells);
    tau_.resize(cells);
  }
  bool reserved() const noexcept { return !t_ns_.empty(); }
  bool running() const noexcept { return running_; }
  bool full() const noexcept { return samples_ == static_cast<std::int64_t>(t_ns_.size()); }

  void start() noexcept {
    samples_ = 0;
    running_ = true;
  }
  void stop() noexcept { running_ = false; }
  // Stores one sample; nothing is stored when full or not running.
  void push(const Sample& sample) noexcept {
    if (!running_ || full()) return;
    t_ns_[static_cast<std::size_t>(samples_)] = sample.t_ns;
    const auto at = static_cast<std::ptrdiff_t>(samples_ * joints_);
    std::copy_n(sample.q.begin(), joints_, q_.begin() + at);
    std::copy_n(sample.dq.begin(), joints_, dq_.begin() + at);
    std::copy_n(sample.tau.begin(), joints_, tau_.begin() + at);
    ++samples_;
  }
  RecordingView view() const noexcept { return {samples_, joints_, t_ns_.data(), q_.data(), dq_.data(), tau_.data()}; }

 private:
  int joints_ = 0;
  std::int64_t samples_ = 0;
  bool running_ = false;
  std::vector<std::int64_t> t_ns_;
  std::vector<double> q_, dq_, tau_;  // (samples, joints)
};

}  // namespace tauext
