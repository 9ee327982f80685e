#include <algorithm>
#include <cmath>
#include <limits>

#include "tauext/bundle.hpp"

namespace tauext {

Estimates estimate(const Bundle& bundle, const RecordingView& recording, int threads) {
  const int n = recording.joints;
  const auto N = static_cast<std::size_t>(recording.samples);
  Observation observation = observe(Tree(bundle.links, bundle.gravity), bundle.observer, recording);
  Estimates out;
  out.residual = std::move(observation.residual);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  out.network.assign(N * n, nan);
  out.tau_ext.assign(N * n, nan);
  out.limit_nm.resize(N * n);
  out.near_stiction.resize(N * n);
  out.healthy.assign(N, 0);
  out.detection.assign(N, 0);

  std::vector<std::int64_t> sample, end;  // of every sample with a warm observer and a full window
  WindowRows windows;
  std::vector<float> rows, y;
  if (bundle.has_network()) {
    rows = feature_rows(recording, observation, bundle.input_factors);
    windows = {rows.data(),         observation.row_count, 2 * n, bundle.observer.network_stride,
               bundle.window_steps, bundle.inputs};
  }
  const std::int64_t reach = bundle.has_network() ? windows.reach() : 0;
  for (std::size_t k = 0; k < N; ++k) {
    if (!observation.warm[k] || observation.row[k] - reach < observation.stretch_begin[k]) continue;
    sample.push_back(static_cast<std::int64_t>(k));
    end.push_back(observation.row[k]);
  }
  y.assign(end.size() * n, 0.0f);
  if (bundle.has_network()) lstm_forward(bundle.shape, bundle.parameters, windows, end, y, threads);

  for (std::size_t w = 0; w < sample.size(); ++w) {
    out.healthy[sample[w]] = 1;
    for (int j = 0; j < n; ++j) {
      const std::size_t at = static_cast<std::size_t>(sample[w]) * n + j;
      out.network[at] = bundle.has_network() ? bundle.output_scale_nm[j] * static_cast<double>(y[w * n + j]) : 0.0;
      out.tau_ext[at] = out.residual[at] - out.network[at];
    }
  }
  for (std::size_t k = 0; k < N; ++k)
    for (int j = 0; j < n; ++j) {
      const std::size_t at = k * n + j;
      out.near_stiction[at] = bundle.limits.near_stiction(recording.dq[at]);
      out.limit_nm[at] = bundle.limits.limit_nm(bundle.limits.collision, j, recording.dq[at]);
      if (out.healthy[k] && std::fabs(out.tau_ext[at]) > out.limit_nm[at]) out.detection[k] = 1;
    }
  return out;
}

}  // namespace tauext
