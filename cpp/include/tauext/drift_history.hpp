// What the trackers of drift knew at earlier times, so that what they learned of a load nobody had told them of can be taken back.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "tauext/drift.hpp"
#include "tauext/friction_factors.hpp"

namespace tauext {

// One state a second of the last minute: what a tracker learns in a second is a sixtieth of its size at most.
class DriftHistory {
 public:
  static constexpr std::size_t kKept = 60;
  static constexpr std::int64_t kStepNs = 1'000'000'000;

  // Allocates; nothing is kept before.
  void begin() { kept_.resize(kKept); }
  void clear() noexcept { next_ = count_ = 0; }

  // Once a sample, or seldom: keeps the state when a second has passed, or where time went backwards.
  void keep(std::int64_t t_ns, const DriftTracker& tracker, const FrictionFactors& factors) noexcept {
    if (kept_.empty() || !tracker.on()) return;
    if (count_ > 0 && t_ns >= last().t_ns && elapsed_ns(t_ns, last().t_ns) < kStepNs) return;
    kept_[next_] = {t_ns, tracker.state().coefficients, factors.learned()};
    next_ = (next_ + 1) % kKept;
    count_ = std::min(count_ + 1, kKept);
  }
  // The trackers know what they knew then, by the newest state that is not later, or the oldest; nothing happens where none
  // is kept.
  void go_back(std::int64_t t_ns, DriftTracker& tracker, FrictionFactors& factors) noexcept {
    if (count_ == 0) return;
    while (count_ > 1 && last().t_ns > t_ns) {  // what came later was learned of the load
      next_ = (next_ + kKept - 1) % kKept;
      --count_;
    }
    tracker.put_coefficients(last().coefficients);
    factors.put_learned(last().factors);
  }

 private:
  struct Then {
    std::int64_t t_ns = 0;
    DriftTracker::Terms coefficients{};
    FrictionFactors::Learned factors{};
  };
  const Then& last() const noexcept { return kept_[(next_ + kKept - 1) % kKept]; }

  std::vector<Then> kept_;
  std::size_t next_ = 0, count_ = 0;
};

}  // namespace tauext
