// What the benchmarks of wrench_bench and touch_place_bench share: an arm whose errors are correlated, and quantiles.
#pragma once
#include <algorithm>
#include <cstdio>
#include <vector>

#include "../tests/made_bundle.hpp"

namespace made {

// With an error scale of 1 N m for every joint, and errors that correlate by 0.2.
inline tauext::Bundle with_errors(tauext::Bundle bundle) {
  const auto n = static_cast<std::size_t>(bundle.joints());
  bundle.error_scale.features = {tauext::MotionFeature::constant};
  bundle.error_scale.limit_weights = bundle.error_scale.sigma_weights = bundle.error_scale.sigma_near_weights =
      bundle.error_scale.largest = bundle.error_scale.largest_sigma = std::vector<double>(n, 1.0);
  bundle.wrench.correlation.assign(n * n, 0.2);
  for (std::size_t j = 0; j < n; ++j) bundle.wrench.correlation[j * n + j] = 1;
  return bundle;
}

inline tauext::Bundle force_bundle(int joints) { return with_errors(made::bundle(joints, 0, 30, 10, 1)); }

// A member of the JSON object on stdout.
inline void print_quantiles(const char* name, std::vector<double>& ns) {
  std::ranges::sort(ns);
  const auto at = [&](double share) { return ns[static_cast<std::size_t>(share * static_cast<double>(ns.size() - 1))]; };
  std::printf(", \"%s_ns\": {\"p50\": %.0f, \"p99\": %.0f, \"p99_9\": %.0f}", name, at(0.5), at(0.99), at(0.999));
}

}  // namespace made
