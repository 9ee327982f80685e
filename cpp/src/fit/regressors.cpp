#include "fit/regressors.hpp"

#include <algorithm>
#include <string>

#include "bundle/terms.hpp"
#include "prior/prior.hpp"
#include "stages/observation.hpp"

namespace tauext {

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
        if (!settings.has_unknown_constant(static_cast<std::size_t>(j)))
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

}  // namespace tauext
