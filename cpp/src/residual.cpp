#include "tauext/residual.hpp"

#include <algorithm>

namespace tauext {

ResidualStage::ResidualStage(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior)
    : tree_(tree),
      clock_(settings.sample_period_ns, settings.network_stride),
      method_(settings.method),
      observer_(tree.size(), settings.gain_per_s, settings.timing),
      comparison_(tree, settings.method, settings.gain_per_s, settings.timing),
      filter_(tree.size(), settings.high_pass_per_s, settings.low_pass_per_s),
      presliding_(tree.size(), prior.widths_rad),
      prior_(prior, tree.gravity(), tree.size(), settings.gain_per_s),
      has_prior_(!prior.empty()) {
  const bool filtered = settings.high_pass_per_s > 0 || settings.low_pass_per_s > 0;
  if (has_prior_ && (method_ != ResidualMethod::momentum || filtered))
    throw Error(std::string("a prior is filtered as the momentum observer filters; it does not fit the method ") +
                name(method_) + " with a high-pass of " + to_text(settings.high_pass_per_s) + " and a low-pass of " +
                to_text(settings.low_pass_per_s) + " 1/s; presliding widths alone do");
}

void ResidualStage::restore(const State& state) noexcept {
  clock_ = state.clock;
  observer_ = state.observer;
  comparison_ = state.comparison;
  filter_ = state.filter;
  presliding_.restore(state.presliding);
  prior_.restore(state.prior);
}

SampleClock::Tick ResidualStage::step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                                      std::span<const double> tau, std::span<double> residual,
                                      std::span<double> prior, std::span<double> doubt) noexcept {
  const SampleClock::Tick tick = clock_.step(t_ns);
  if (tick.kind == SampleClock::Kind::not_later) return tick;
  if (tick.kind == SampleClock::Kind::restart) {
    observer_.reset();
    comparison_.reset();
    filter_.reset();
    presliding_.reset();
    prior_.reset();
  }
  JointVector momentum, beta;
  const auto n = static_cast<std::size_t>(tree_.size());
  tree_.momentum(q, dq, std::span(momentum).first(n), std::span(beta).first(n));
  if (method_ == ResidualMethod::momentum)
    observer_.step(t_ns, std::span(momentum).first(n), std::span(beta).first(n), tau, residual);
  else
    comparison_.step(tree_, t_ns, q, dq, std::span(momentum).first(n), std::span(beta).first(n), tau, residual);
  filter_.step(t_ns, method_ == ResidualMethod::momentum ? observer_.warm() : comparison_.warm(), residual);
  presliding_.step(q);
  if (has_prior_)
    prior_.step(t_ns, q, dq, presliding_, std::span(momentum).first(n), std::span(beta).first(n), prior, doubt);
  else
    for (std::size_t i = 0; i < n; ++i) prior[i] = doubt[i] = 0.0;
  return tick;
}

Observation observe(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                    const RecordingView& recording) {
  const int n = recording.joints;
  if (n != tree.size())
    throw Error("the model has " + std::to_string(tree.size()) + " joints, the recording " + std::to_string(n));
  const auto N = static_cast<std::size_t>(recording.samples);
  Observation out;
  out.residual.resize(N * n);
  out.row.resize(N);
  out.stretch_begin.resize(N);
  out.warm.resize(N);
  ResidualStage stage(tree, settings, prior);
  if (!prior.empty()) {
    out.prior.resize(N * n);
    out.doubt.resize(N * n);
  }
  const auto columns = static_cast<std::size_t>(stage.presliding().columns());
  std::vector<double> states(columns);
  out.presliding.resize(N * columns);
  JointVector expected, doubt;
  std::int64_t row = -1, begin = 0;
  for (std::size_t k = 0; k < N; ++k) {
    const auto values = [&](const double* signal) { return std::span(signal + k * n, static_cast<std::size_t>(n)); };
    const SampleClock::Tick tick =
        stage.step(recording.t_ns[k], values(recording.q), values(recording.dq), values(recording.tau),
                   std::span(out.residual).subspan(k * n, n), std::span(expected).first(n),
                   std::span(doubt).first(n));
    if (!prior.empty()) {
      std::copy_n(expected.begin(), n, out.prior.begin() + static_cast<std::ptrdiff_t>(k * n));
      std::copy_n(doubt.begin(), n, out.doubt.begin() + static_cast<std::ptrdiff_t>(k * n));
    }
    stage.presliding().write(states);
    std::copy(states.begin(), states.end(), out.presliding.begin() + static_cast<std::ptrdiff_t>(k * columns));
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

std::vector<double> prior_regressors(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                                     const RecordingView& recording, std::span<const std::int64_t> samples) {
  const int n = recording.joints;
  if (n != tree.size())
    throw Error("the model has " + std::to_string(tree.size()) + " joints, the recording " + std::to_string(n));
  prior.validate(n);
  const std::size_t M = prior.terms.size();
  SampleClock clock(settings.sample_period_ns, settings.network_stride);
  Presliding presliding(n, prior.widths_rad);
  // A filter takes kMaxJoints values at a time; which of them are joints is nothing to it.
  std::vector<MomentumObserver> filters;
  for (std::size_t first = 0; first < M; first += kMaxJoints)
    filters.emplace_back(static_cast<int>(std::min<std::size_t>(kMaxJoints, M - first)), settings.gain_per_s,
                         TorqueTiming::held);
  std::vector<double> out(samples.size() * M);
  std::optional<Tree> corrected;
  if (!prior.corrected_links.empty()) corrected.emplace(prior.corrected_links, tree.gravity());
  JointVector momentum, beta, corrected_beta, filtered;
  constexpr JointVector zero{};
  std::size_t next = 0;
  for (std::int64_t k = 0; k < recording.samples && next < samples.size(); ++k) {
    const std::span q(recording.q + k * n, static_cast<std::size_t>(n)), dq(recording.dq + k * n, static_cast<std::size_t>(n));
    if (clock.step(recording.t_ns[k]).kind == SampleClock::Kind::restart) {
      presliding.reset();
      for (MomentumObserver& filter : filters) filter.reset();
    }
    presliding.step(q);
    tree.momentum(q, dq, std::span(momentum).first(q.size()), std::span(beta).first(q.size()));
    if (corrected) corrected->momentum(q, dq, std::span(momentum).first(q.size()), std::span(corrected_beta).first(q.size()));
    const std::span<const double> loads[] = {std::span(beta).first(q.size()), std::span(corrected_beta).first(q.size())};
    const bool wanted = samples[next] == k;
    for (std::size_t f = 0; f < filters.size(); ++f) {
      const std::size_t first = f * kMaxJoints, count = std::min<std::size_t>(kMaxJoints, M - first);
      JointVector p{}, v{};
      for (std::size_t m = 0; m < count; ++m) {
        const Term& term = prior.terms[first + m];
        (term.kind == TermKind::momentum ? p : v)[m] =
            term_value(term, q, dq, presliding, loads[is_load(term) ? term.form : 0]);
      }
      filters[f].step(recording.t_ns[k], std::span(p).first(count), std::span(v).first(count),
                      std::span(zero).first(count), std::span(filtered).first(count));
      if (wanted) std::copy_n(filtered.begin(), count, out.begin() + static_cast<std::ptrdiff_t>(next * M + first));
    }
    next += wanted;
  }
  if (next != samples.size()) throw Error("samples must rise and stand in the recording");
  return out;
}

std::vector<float> feature_rows(const RecordingView& recording, const Observation& observation,
                                std::span<const float> factors) {
  const int n = recording.joints;
  const int states = recording.samples ? static_cast<int>(observation.presliding.size() / recording.samples) : 0;
  const int columns = 2 * n + states;
  if (static_cast<int>(factors.size()) != columns)
    throw Error("features need " + std::to_string(columns) + " factors, not " + std::to_string(factors.size()));
  std::vector<float> rows(static_cast<std::size_t>(observation.row_count) * columns);
  for (std::int64_t k = 0; k < recording.samples; ++k) {
    float* to = rows.data() + observation.row[k] * columns;
    for (int j = 0; j < n; ++j) {
      to[j] = static_cast<float>(recording.q[k * n + j]) * factors[j];
      to[n + j] = static_cast<float>(recording.dq[k * n + j]) * factors[n + j];
    }
    for (int c = 0; c < states; ++c) to[2 * n + c] = observation.presliding[k * states + c] * factors[2 * n + c];
    const bool last = k + 1 == recording.samples;
    const std::int64_t next = last ? observation.row_count : observation.row[k + 1];
    for (std::int64_t held = observation.row[k] + 1; held < next; ++held) std::copy_n(to, columns, rows.data() + held * columns);
  }
  return rows;
}

}  // namespace tauext
