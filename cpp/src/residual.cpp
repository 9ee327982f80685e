#include "tauext/residual.hpp"

#include <algorithm>

namespace tauext {

ResidualStage::ResidualStage(const Tree& tree, const ObserverSettings& settings)
    : tree_(tree),
      state_{SampleClock(settings.sample_period_ns, settings.network_stride),
             MomentumObserver(tree.size(), settings.gain_per_s, settings.timing)} {}

SampleClock::Tick ResidualStage::step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                                      std::span<const double> tau, std::span<double> residual) noexcept {
  const SampleClock::Tick tick = state_.clock.step(t_ns);
  if (tick.kind == SampleClock::Kind::not_later) return tick;
  if (tick.kind == SampleClock::Kind::restart) state_.observer.reset();
  JointVector momentum, beta;
  const auto n = static_cast<std::size_t>(tree_.size());
  tree_.momentum(q, dq, std::span(momentum).first(n), std::span(beta).first(n));
  state_.observer.step(t_ns, std::span(momentum).first(n), std::span(beta).first(n), tau, residual);
  return tick;
}

Observation observe(const Tree& tree, const ObserverSettings& settings, const RecordingView& recording) {
  const int n = recording.joints;
  if (n != tree.size())
    throw Error("the model has " + std::to_string(tree.size()) + " joints, the recording " + std::to_string(n));
  const auto N = static_cast<std::size_t>(recording.samples);
  Observation out;
  out.residual.resize(N * n);
  out.row.resize(N);
  out.stretch_begin.resize(N);
  out.warm.resize(N);
  ResidualStage stage(tree, settings);
  std::int64_t row = -1, begin = 0;
  for (std::size_t k = 0; k < N; ++k) {
    const auto values = [&](const double* signal) { return std::span(signal + k * n, static_cast<std::size_t>(n)); };
    const SampleClock::Tick tick =
        stage.step(recording.t_ns[k], values(recording.q), values(recording.dq), values(recording.tau),
                   std::span(out.residual).subspan(k * n, n));
    if (tick.kind == SampleClock::Kind::not_later)
      throw Error("sample " + std::to_string(k) + ": its time " + std::to_string(recording.t_ns[k]) +
                  " ns must be later than " + std::to_string(recording.t_ns[k - 1]) + " ns before it");
    if (tick.kind == SampleClock::Kind::restart) {
      begin = ++row;
      out.restarts += k > 0;
    } else {
      row += tick.advance;
      out.held_rows += tick.advance - 1;
    }
    out.row[k] = row;
    out.stretch_begin[k] = begin;
    out.warm[k] = stage.warm();
  }
  out.row_count = row + 1;
  return out;
}

std::vector<float> feature_rows(const RecordingView& recording, const Observation& observation,
                                std::span<const float> factors) {
  const int n = recording.joints, columns = 2 * n;
  if (static_cast<int>(factors.size()) != columns)
    throw Error("features need " + std::to_string(columns) + " factors, not " + std::to_string(factors.size()));
  std::vector<float> rows(static_cast<std::size_t>(observation.row_count) * columns);
  for (std::int64_t k = 0; k < recording.samples; ++k) {
    float* to = rows.data() + observation.row[k] * columns;
    for (int j = 0; j < n; ++j) {
      to[j] = static_cast<float>(recording.q[k * n + j]) * factors[j];
      to[n + j] = static_cast<float>(recording.dq[k * n + j]) * factors[n + j];
    }
    const bool last = k + 1 == recording.samples;
    const std::int64_t next = last ? observation.row_count : observation.row[k + 1];
    for (std::int64_t held = observation.row[k] + 1; held < next; ++held) std::copy_n(to, columns, rows.data() + held * columns);
  }
  return rows;
}

}  // namespace tauext
