#include <algorithm>
#include <cmath>
#include <limits>

#include "tauext/bundle.hpp"

namespace tauext {

Estimates estimate(const Bundle& bundle, const RecordingView& recording, int threads) {
  const int n = recording.joints;
  const auto N = static_cast<std::size_t>(recording.samples);
  Observation observation = observe(Tree(bundle.links, bundle.gravity), bundle.observer, bundle.prior, recording);
  Estimates out;
  out.residual = std::move(observation.residual);
  out.prior = std::move(observation.prior);
  out.prior.resize(N * n);
  out.doubt = std::move(observation.doubt);
  out.doubt.resize(N * n);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  out.network.assign(N * n, nan);
  out.tau_ext.assign(N * n, nan);
  out.drift.resize(N * n);
  out.limit_nm.resize(N * n);
  out.near_stiction.resize(N * n);
  out.healthy.assign(N, 0);
  out.detection.assign(N, 0);
  out.alarm.assign(N, 0);

  std::vector<std::int64_t> sample, end;  // of every sample with a warm observer and a full window
  WindowRows windows;
  std::vector<float> rows, y;
  if (bundle.has_network()) {
    rows = feature_rows(recording, observation, bundle.input_factors);
    windows = {rows.data(),         observation.row_count, bundle.columns(), bundle.observer.network_stride,
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
      out.network[at] = bundle.has_network() ? network_torque_nm(bundle.output_scale_nm[j], y[w * n + j]) : 0.0;
    }
  }
  const int widths = static_cast<int>(bundle.prior.widths_rad.size()), region = bundle.limits.region_width;
  AlarmStage alarm(n, widths, bundle.limits);
  DriftTracker tracker(bundle.drift, bundle.limits, n, bundle.observer.gain_per_s);
  for (std::size_t k = 0; k < N; ++k) {
    std::uint32_t near_stiction = 0;
    for (int j = 0; j < n; ++j) {
      const std::size_t at = k * n + j;
      const double state = region < 0 ? 0.0 : observation.presliding[at * widths + region];
      out.near_stiction[at] = bundle.limits.near_stiction(recording.dq[at], state);
      if (out.near_stiction[at]) near_stiction |= std::uint32_t{1} << j;
    }
    const auto row = [&](std::vector<double>& values) { return std::span(values).subspan(k * n, n); };
    if (observation.row[k] == observation.stretch_begin[k]) tracker.restart();
    tracker.step(recording.t_ns[k], std::span(recording.dq + k * n, static_cast<std::size_t>(n)), row(out.drift));
    for (std::size_t at = k * n; out.healthy[k] && at < (k + 1) * n; ++at)
      out.tau_ext[at] = out.residual[at] - (out.prior[at] + out.network[at] + out.drift[at]);
    out.detection[k] = alarm.step(recording.t_ns[k], row(out.tau_ext), row(out.doubt), near_stiction, out.healthy[k],
                                  row(out.limit_nm));
    tracker.learn(row(out.tau_ext), row(out.doubt), near_stiction, out.healthy[k]);
    out.alarm[k] = static_cast<std::uint8_t>(alarm.state().held);
  }
  return out;
}

}  // namespace tauext
