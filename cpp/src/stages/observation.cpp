#include "stages/observation.hpp"

#include <algorithm>
#include <string>

#include "network/lstm.hpp"
#include "stages/observe_stage.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

// What training cannot use is an error, and no gap.
void expect_usable(const Observed& o, const RecordingView& recording, std::size_t k) {
  const std::string here = "sample " + std::to_string(k) + ": ";
  if ((o.causes & (kLateSample | kTimeBackwards)) != 0 && o.passage != Passage::entered)
    throw Error(here + "its time " + std::to_string(recording.t_ns[k]) + " ns must be later than " +
                std::to_string(recording.t_ns[k - 1]) + " ns before it");
  if (o.health == Health::fault)
    throw Error(here + "q, dq or tau of joint " + std::to_string(o.cause_joint) +
                " is not finite, or so large that the observer overflows");
}

}  // namespace

void expect_joints(int joints, const RecordingView& recording) {
  if (recording.joints != joints)
    throw Error("the model has " + std::to_string(joints) + " joints, the recording " +
                std::to_string(recording.joints));
}

Observation observe(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                    const RecordingView& recording) {
  expect_joints(tree.size(), recording);
  const auto N = static_cast<std::size_t>(recording.samples), n = static_cast<std::size_t>(recording.joints);
  Observation out;
  out.residual.resize(N * n);
  out.row.resize(N);
  out.stretch_begin.resize(N);
  out.warm.resize(N);
  ObserveStage stage(tree, settings, prior);
  if (!prior.empty()) {
    out.prior.resize(N * n);
    out.doubt.resize(N * n);
  }
  const auto columns = static_cast<std::size_t>(stage.presliding().columns());
  std::vector<double> states(columns);
  out.presliding.resize(N * columns);
  RowCount at;
  for (std::size_t k = 0; k < N; ++k) {
    const Observed& o = stage.step(recording.at(static_cast<std::int64_t>(k)));
    expect_usable(o, recording, k);
    const auto cells = static_cast<std::ptrdiff_t>(k * n);
    std::copy_n(o.residual.begin(), n, out.residual.begin() + cells);
    if (!prior.empty()) {
      std::copy_n(o.prior.begin(), n, out.prior.begin() + cells);
      std::copy_n(o.doubt.begin(), n, out.doubt.begin() + cells);
    }
    stage.presliding().write(states);
    std::copy(states.begin(), states.end(), out.presliding.begin() + static_cast<std::ptrdiff_t>(k * columns));
    at.add(o.restarted, o.ticks);
    out.row[k] = at.row;
    out.stretch_begin[k] = at.stretch_begin;
    out.warm[k] = o.warm;
  }
  out.row_count = at.row + 1;
  out.held_rows = static_cast<std::int64_t>(stage.progress().bridged);
  out.restarts = static_cast<int>(stage.progress().restarts);
  return out;
}

std::vector<ImpossibleSample> impossible_samples(const ObserverSettings& settings, const SignalRanges& ranges,
                                                 const RecordingView& recording) {
  settings.validate_constants(recording.joints);
  SampleClock(settings.sample_period_ns, settings.network_stride);  // throws for invalid settings
  SignalWatch watch(recording.joints, settings.sample_period_ns, settings.network_stride, ranges);
  const auto bridged_ns = static_cast<std::uint64_t>(
      settings.sample_period_ns * longest_bridged(settings.sample_period_ns, settings.network_stride));
  const auto n = static_cast<std::size_t>(recording.joints);
  std::vector<ImpossibleSample> out;
  JointVector tau{};
  bool follows = false;
  for (std::int64_t k = 0; k < recording.samples; ++k) {
    const Sample s = recording.at(k);
    for (std::size_t j = 0; j < n; ++j)
      tau[j] = settings.nm_per_unit.empty() ? s.tau[j] : s.tau[j] * settings.nm_per_unit[j];
    const std::span<const double> torque(tau.data(), n);
    const bool near = k > 0 && elapsed_ns(s.t_ns, recording.t_ns[k - 1]) <= bridged_ns;
    const Impossible found = watch.check(s.t_ns, s.q, s.dq, torque, follows && near);
    follows = found.cause == 0;
    if (follows)
      watch.step(s.t_ns, 1, s.q, s.dq, torque);
    else
      out.push_back({k, found});
  }
  return out;
}

std::vector<double> mean_steps(std::int64_t sample_period_ns, int network_stride, std::span<const std::int64_t> t_ns) {
  SampleClock clock(sample_period_ns, network_stride);
  SignalWatch watch(0, sample_period_ns, network_stride, {});
  std::vector<double> out;
  out.reserve(t_ns.size());
  for (const std::int64_t t : t_ns) {
    const SampleClock::Tick tick = clock.step(t);
    if (tick.kind != SampleClock::Kind::not_later) watch.step(t, tick.advance, {}, {}, {});
    out.push_back(watch.state().steps);
  }
  return out;
}

std::vector<float> feature_rows(const RecordingView& recording, const Observation& observation,
                                std::span<const float> factors) {
  const auto n = static_cast<std::size_t>(recording.joints), N = static_cast<std::size_t>(recording.samples);
  const std::size_t states = N ? observation.presliding.size() / N : 0, columns = 2 * n + states;
  if (factors.size() != columns)
    throw Error("features need " + std::to_string(columns) + " factors, not " + std::to_string(factors.size()));
  std::vector<float> rows(static_cast<std::size_t>(observation.row_count) * columns);
  std::vector<double> presliding(states);
  for (std::size_t k = 0; k < N; ++k) {
    const Sample sample = recording.at(static_cast<std::int64_t>(k));
    const auto row = static_cast<std::size_t>(observation.row[k]);
    std::copy_n(observation.presliding.begin() + static_cast<std::ptrdiff_t>(k * states), states, presliding.begin());
    const std::span<float> to = std::span(rows).subspan(row * columns, columns);
    write_features(sample.q, sample.dq, presliding, factors, to);
    const auto next = static_cast<std::size_t>(k + 1 == N ? observation.row_count : observation.row[k + 1]);
    for (std::size_t held = row + 1; held < next; ++held)
      std::ranges::copy(to, rows.begin() + static_cast<std::ptrdiff_t>(held * columns));
  }
  return rows;
}

WindowRows windows_of(const Bundle& bundle) noexcept {
  return {nullptr, 0, bundle.columns(), bundle.observer.network_stride, bundle.window_steps, bundle.inputs};
}

}  // namespace tauext
