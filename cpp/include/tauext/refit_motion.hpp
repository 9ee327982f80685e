// Motion that a monitor keeps for a refit, in memory that is there before the loop begins.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "tauext/prior.hpp"
#include "tauext/sample.hpp"

namespace tauext {

class RefitMotion {
 public:
  // Allocates; what was kept is lost.
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
  // A sample of as many joints; once it is full, and unless it runs, none is kept.
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

// Friction that a prior expects of a sliding joint, as a line: at_rest + per_speed |dq|, [N m] and [N m s/rad].
struct FrictionLine {
  double at_rest_nm = 0, per_speed = 0;
};
FrictionLine friction_line(const PriorSettings& prior, std::size_t joint);

}  // namespace tauext
