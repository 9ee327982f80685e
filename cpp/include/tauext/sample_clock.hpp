// Assigns samples to the ticks of a regular clock by their time stamps.
#pragma once
#include <cstdint>

namespace tauext {

// Missing samples that the clock bridges at most: those of a network period, and below 300 Hz up to three within 30 ms.
// There a network period is a sample or two, and a log that loses one sample in ten would restart for every second pair.
int longest_bridged(std::int64_t sample_period_ns, int network_stride) noexcept;
inline constexpr int kMostBridged = 3;  // of samples that are longer than a third of a network period

// Jittering stamps fall on consecutive ticks; the rounding error is carried on, so that ticks count time and not
// samples. A gap of at most longest_bridged() missing samples is bridged: the ticks in between hold the last sample. A
// longer gap restarts everything that looks back in time.
class SampleClock {
 public:
  // Throws Error where the period or the stride is not positive.
  SampleClock(std::int64_t sample_period_ns, int network_stride);

  // Where a sample stands: at the start of a stretch, after the last one, or nowhere.
  enum class Kind : std::uint8_t { restart, next, not_later };
  struct Tick {
    Kind kind;
    std::int64_t advance;  // ticks since the last sample, at least 1; 0 unless kind is next
  };

  // The next sample is a first one.
  void reset() noexcept { started_ = false; }
  // not_later, which changes nothing, where t_ns is not later than the last sample; restart for the first sample.
  Tick step(std::int64_t t_ns) noexcept;

 private:
  std::int64_t sample_period_ns_;
  int longest_bridged_;
  bool started_ = false;
  std::int64_t t_ns_ = 0;
  double carry_ = 0;  // ticks that the stamps are ahead of the count, within +-1
};

}  // namespace tauext
