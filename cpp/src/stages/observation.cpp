#include "stages/observation.hpp"

#include <algorithm>
#include <optional>
#include <string>

#include "stages/observe_stage.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

void expect_joints(int joints, const RecordingView& recording) {
  if (recording.joints != joints)
    throw Error("the model has " + std::to_string(joints) + " joints, the recording " +
                std::to_string(recording.joints));
}

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

std::vector<double> prior_regressors(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                                     const RecordingView& recording, std::span<const std::int64_t> samples) {
  expect_joints(tree.size(), recording);
  prior.validate(recording.joints);
  const std::size_t M = prior.terms.size();
  MotionStage motion(tree, settings.sample_period_ns, settings.network_stride, prior.widths_rad, prior.branches);
  PriorTerms terms(prior, tree.gravity());
  // A filter takes kMaxJoints values at a time; which of them are joints is nothing to it.
  std::vector<MomentumObserver> filters;
  for (std::size_t first = 0; first < M; first += kMaxJoints)
    filters.emplace_back(static_cast<int>(std::min<std::size_t>(kMaxJoints, M - first)), settings.gain_per_s,
                         TorqueTiming::held);
  std::vector<double> out(samples.size() * M);
  JointVector filtered;
  constexpr JointVector zero{};
  std::size_t next = 0;
  for (std::int64_t k = 0; k < recording.samples && next < samples.size(); ++k) {
    const Sample sample = recording.at(k);
    if (motion.step(sample.t_ns, sample.q, sample.dq).kind == SampleClock::Kind::restart)
      for (MomentumObserver& filter : filters) filter.reset();
    terms.compute(sample.q, sample.dq, motion.presliding(), motion.beta());
    const bool wanted = samples[next] == k;
    for (std::size_t f = 0; f < filters.size(); ++f) {
      const std::size_t first = f * kMaxJoints, count = std::min<std::size_t>(kMaxJoints, M - first);
      JointVector p{}, v{};
      for (std::size_t m = 0; m < count; ++m) (is_momentum(prior.terms[first + m]) ? p : v)[m] = terms.value(first + m);
      filters[f].step(sample.t_ns, std::span(p).first(count), std::span(v).first(count), std::span(zero).first(count),
                      std::span(filtered).first(count));
      if (wanted) std::copy_n(filtered.begin(), count, out.begin() + static_cast<std::ptrdiff_t>(next * M + first));
    }
    next += wanted;
  }
  if (next != samples.size()) throw Error("samples must be ascending and within the recording");
  return out;
}

LinkRegressors::LinkRegressors(const Tree& tree, const ObserverSettings& settings, std::span<const int> links,
                               std::span<const int> parameters)
    : joints_(tree.size()),
      columns_(links.size() * parameters.size()),
      clock_(settings.sample_period_ns, settings.network_stride) {
  std::size_t column = 0;
  for (const int link : links) {
    links_.emplace_back(tree, LoadFrame{.link = link});
    for (const int parameter : parameters) {
      if (parameter < 0 || parameter >= kParameters)
        throw Error("a link has " + std::to_string(kParameters) + " parameters, none of them " + std::to_string(parameter));
      const bool rotor = parameter == LoadRegressor::kParameters;
      for (int j = link; j >= 0; j = rotor ? -1 : tree.links()[static_cast<std::size_t>(j)].parent)
        cells_.push_back({links_.size() - 1, static_cast<std::size_t>(parameter), static_cast<std::size_t>(j), column});
      ++column;
    }
  }
  for (std::size_t first = 0; first < cells_.size(); first += kMaxJoints)
    filters_.emplace_back(static_cast<int>(std::min<std::size_t>(kMaxJoints, cells_.size() - first)),
                          settings.gain_per_s, TorqueTiming::held);
}

std::vector<double> LinkRegressors::rows(const RecordingView& part, std::span<const std::int64_t> samples) {
  expect_joints(joints_, part);
  const std::size_t width = static_cast<std::size_t>(joints_) * columns_;
  std::vector<double> out(samples.size() * width);
  constexpr JointVector zero{};
  JointVector filtered;
  std::size_t next = 0;
  for (std::int64_t k = 0; k < part.samples; ++k) {
    const Sample sample = part.at(k);
    if (clock_.step(sample.t_ns).kind == SampleClock::Kind::restart)
      for (MomentumObserver& filter : filters_) filter.reset();
    for (LoadRegressor& link : links_) link.compute(sample.q, sample.dq);
    const bool wanted = next < samples.size() && samples[next] == k;
    for (std::size_t f = 0; f < filters_.size(); ++f) {
      const std::size_t first = f * kMaxJoints, count = std::min<std::size_t>(kMaxJoints, cells_.size() - first);
      JointVector p, beta;
      for (std::size_t c = 0; c < count; ++c) {
        const Cell& cell = cells_[first + c];
        const bool rotor = cell.parameter == LoadRegressor::kParameters;
        // r shows what the model lacks with the opposite sign.
        p[c] = -(rotor ? sample.dq[cell.joint] : links_[cell.link].momentum()[cell.parameter][cell.joint]);
        beta[c] = rotor ? 0.0 : -links_[cell.link].beta()[cell.parameter][cell.joint];
      }
      filters_[f].step(sample.t_ns, std::span(p).first(count), std::span(beta).first(count),
                       std::span(zero).first(count), std::span(filtered).first(count));
      for (std::size_t c = 0; wanted && c < count; ++c) {
        const Cell& cell = cells_[first + c];
        out[next * width + cell.joint * columns_ + cell.column] = filtered[c];
      }
    }
    next += wanted;
  }
  if (next != samples.size()) throw Error("samples must be ascending and within the recording");
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
