// The last samples of a stretch and where the filters stood at them, so that r can be found anew for another load.
#pragma once
#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/types.hpp"

namespace tauext {

// A ring; nothing is allocated once it is made.
class PastSamples {
 public:
  struct Row {
    // A value a joint: the sample, where r, prior, doubt and the load's share stood after it; ends of the presliding
    // states, a value a joint and width.
    std::span<double> q, dq, tau, residual, prior, doubt, load, low, high;
  };

  PastSamples() = default;
  PastSamples(int joints, int states, std::size_t rows)
      : joints_(static_cast<std::size_t>(joints)),
        states_(static_cast<std::size_t>(states)),
        t_ns_(rows),
        raised_(rows),
        values_(rows * width()) {}

  void clear() noexcept { next_ = count_ = 0; }
  std::size_t size() const noexcept { return count_; }
  std::size_t capacity() const noexcept { return t_ns_.size(); }

  // Room for one more sample, later than those before; the oldest makes way. raised: see Prior::State.
  Row push(std::int64_t t_ns, bool raised) noexcept {
    const std::size_t at = next_;
    t_ns_[at] = t_ns;
    raised_[at] = raised;
    next_ = next_ + 1 == capacity() ? 0 : next_ + 1;
    count_ = std::min(count_ + 1, capacity());
    return row(at);
  }

  // 0 is the oldest.
  Row operator[](std::size_t k) noexcept { return row(place(k)); }
  std::int64_t t_ns(std::size_t k) const noexcept { return t_ns_[place(k)]; }
  bool raised(std::size_t k) const noexcept { return raised_[place(k)] != 0; }
  // The last one that is not later than t_ns; the oldest where all are. There must be one.
  std::size_t at_or_before(std::int64_t t) const noexcept {
    std::size_t low = 0, high = count_;
    while (high - low > 1) {
      const std::size_t middle = low + (high - low) / 2;
      (t_ns(middle) <= t ? low : high) = middle;
    }
    return low;
  }

 private:
  std::size_t width() const noexcept { return 7 * joints_ + 2 * states_; }
  std::size_t place(std::size_t k) const noexcept { return (next_ + capacity() - count_ + k) % capacity(); }
  Row row(std::size_t at) noexcept {
    const std::span<double> all = std::span(values_).subspan(at * width(), width());
    const auto joint_part = [&](std::size_t which) noexcept { return all.subspan(which * joints_, joints_); };
    return {joint_part(0), joint_part(1), joint_part(2), joint_part(3), joint_part(4), joint_part(5), joint_part(6),
            all.subspan(7 * joints_, states_), all.subspan(7 * joints_ + states_, states_)};
  }

  std::size_t joints_ = 0, states_ = 0;
  std::vector<std::int64_t> t_ns_;
  std::vector<std::uint8_t> raised_;
  std::vector<double> values_;
  std::size_t next_ = 0, count_ = 0;
};

}  // namespace tauext
