#include "tauext/residual.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {

void ObserverSettings::validate_constants(int joints) const {
  if (nm_per_unit.empty()) return;
  if (nm_per_unit.size() != static_cast<std::size_t>(joints))
    throw Error("nm_per_unit has " + std::to_string(nm_per_unit.size()) + " values where " + std::to_string(joints) +
                " belong");
  for (double constant : nm_per_unit)
    if (constant == 0 || !std::isfinite(constant))
      throw Error("nm_per_unit = " + to_text(constant) + " must be finite and not 0");
}

ResidualStage::ResidualStage(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior)
    : motion_(tree, settings.sample_period_ns, settings.network_stride, prior.widths_rad, prior.branches),
      method_(settings.method),
      observer_(tree.size(), settings.gain_per_s, settings.timing),
      comparison_(tree, settings.method, settings.gain_per_s, settings.timing),
      filter_(tree.size(), settings.high_pass_per_s, settings.low_pass_per_s),
      prior_(prior, tree.gravity(), tree.size(), settings.gain_per_s),
      has_prior_(!prior.empty()),
      gain_per_s_(settings.gain_per_s),
      sample_period_ns_(settings.sample_period_ns),
      unfiltered_(!(settings.high_pass_per_s > 0 || settings.low_pass_per_s > 0)),
      carrying_(MomentumObserver(tree.size(), settings.gain_per_s, TorqueTiming::held)) {
  settings.validate_constants(tree.size());
  if (has_prior_ && (method_ != ResidualMethod::momentum || !unfiltered_))
    throw Error(std::string("a prior is filtered as the momentum observer filters; it does not fit the method ") +
                name(method_) + " with a high-pass of " + to_text(settings.high_pass_per_s) + " and a low-pass of " +
                to_text(settings.low_pass_per_s) + " 1/s; presliding widths alone do");
}

void ResidualStage::restore(const State& state) noexcept {
  motion_.restore(state.motion);
  observer_ = state.observer;
  comparison_ = state.comparison;
  filter_ = state.filter;
  prior_.restore(state.prior);
  carrying_ = state.carrying;
  past_.clear();
  carry(carrying_.load);
  if (!loads_ || !carrying_.seen) return;
  look_again();
  if (carrying_.kept && can_go_back()) push_past();
}

void ResidualStage::reset() noexcept {
  motion_.reset();
  carrying_.seen = false;
}

SampleClock::Tick ResidualStage::step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                                      std::span<const double> tau, std::span<double> residual,
                                      std::span<double> prior, std::span<double> doubt) noexcept {
  const SampleClock::Tick tick = motion_.step(t_ns, q, dq);
  if (tick.kind == SampleClock::Kind::not_later) return tick;
  if (tick.kind == SampleClock::Kind::restart) {
    observer_.reset();
    comparison_.reset();
    filter_.reset();
    prior_.reset();
    carrying_.torques.reset();
    past_.clear();
  }
  const std::span<const double> momentum = motion_.momentum(), beta = motion_.beta();
  if (method_ == ResidualMethod::momentum)
    observer_.step(t_ns, momentum, beta, tau, residual);
  else
    comparison_.step(motion_.tree(), t_ns, q, dq, momentum, beta, tau, residual);
  filter_.step(t_ns, method_ == ResidualMethod::momentum ? observer_.warm() : comparison_.warm(), residual);
  if (has_prior_)
    prior_.step(t_ns, q, dq, presliding(), momentum, beta, prior, doubt);
  else
    for (std::size_t i = 0; i < momentum.size(); ++i) prior[i] = doubt[i] = 0.0;
  if (!loads_) return tick;
  if (carrying_.follows)
    for (std::size_t i = 0; i < doubt.size(); ++i)
      doubt[i] += (carrying_.error_share + units_per_nm_[i]) * std::fabs(carrying_.torques.residual()[i]);
  carrying_.t_ns = t_ns;
  std::ranges::copy(q, carrying_.q.begin());
  std::ranges::copy(dq, carrying_.dq.begin());
  carrying_.seen = true;
  carrying_.kept = false;
  return tick;
}

}  // namespace tauext
