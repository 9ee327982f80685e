// The share of a first-order filter's step.
#pragma once
#include <cmath>
#include <cstdint>

namespace tauext {

// 1 - exp(exponent), exponent = -K dt of a step: exact for small steps. Steps are nearly always equal, so the exponential
// is computed only where the step differs from the last one; K must not change.
class StepShare {
 public:
  double of(std::int64_t step_ns, double exponent) noexcept {
    if (step_ns != step_ns_) {
      step_ns_ = step_ns;
      share_ = -std::expm1(exponent);
    }
    return share_;
  }

 private:
  std::int64_t step_ns_ = 0;
  double share_ = 0;
};

}  // namespace tauext
