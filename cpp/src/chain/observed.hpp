// What is known of a sample before the network.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/sample.hpp"

namespace tauext {

// How a sample was handled.
enum class Passage : std::uint8_t {
  entered,  // processed by the chain
  held,     // skipped; the previous estimate stays valid
  refused,  // skipped as a fault; the previous estimate is void
};

// Result for one sample, before the network. If the sample did not enter, only time, passage, health and causes are
// valid.
struct Observed {
  std::int64_t t_ns = 0;            // stamp of the sample
  Passage passage = Passage::refused;  // how it was handled
  Health health = Health::warming_up;  // final: no later stage changes it
  std::uint32_t causes = 0;         // bits of Cause
  int cause_joint = -1;             // the first joint concerned by a cause
  bool restarted = false;           // the chain restarted at this sample
  bool jumped = false;              // ... because the stamps jumped or stood still: times from before count no more
  std::int64_t ticks = 0;           // since the last entered sample; 0 if restarted
  bool warm = false;                // the residual is warmed up
  bool overflowed = false;          // some number overflowed: no residual either
  bool judged = false;              // tau_ext exists and is checked against its limits
  bool teaches = false;             // the drift tracker may learn from it
  std::uint32_t near_stiction = 0;  // one bit per joint: which limit applies
  std::span<const double> residual, prior, doubt;  // per joint, [N m]; valid until the stage's next sample
  std::span<const double> coulomb, viscous;  // friction in the prior, before its filter; empty unless requested
  std::span<const double> memory_gap;  // Presliding::memory_gap of each joint; empty if the prior has no branches
};

}  // namespace tauext
