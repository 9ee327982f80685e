#include "stages/residual.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {
namespace {

std::uint32_t unknown_constants(const ObserverSettings& settings) noexcept {
  std::uint32_t unknown = 0;
  for (std::size_t j = 0; j < kMaxJoints; ++j) unknown |= std::uint32_t{settings.has_unknown_constant(j)} << j;
  return unknown;
}

}  // namespace

ResidualStage::ResidualStage(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior)
    : motion_(tree, settings.sample_period_ns, settings.network_stride, prior.widths_rad, prior.branches),
      method_(settings.method),
      observer_(tree.size(), settings.gain_per_s, settings.timing),
      comparison_(tree, settings.method, settings.gain_per_s, settings.timing),
      filter_(tree.size(), settings.high_pass_per_s, settings.low_pass_per_s),
      prior_(prior, tree.gravity(), tree.size(), settings.gain_per_s, unknown_constants(settings)),
      has_prior_(!prior.empty()),
      unknown_(unknown_constants(settings)),
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
  recompute();
  if (carrying_.kept && can_go_back()) push_past();
}

void ResidualStage::reset() noexcept {
  motion_.reset();
  carrying_.seen = false;
}

ResidualStage::ModelRows ResidualStage::known_rows() noexcept {
  const std::size_t n = joints();
  for (std::size_t i = 0; i < n; ++i) {
    const bool known = !(unknown_ >> i & 1);
    momentum_[i] = known ? motion_.momentum()[i] : 0.0;
    beta_[i] = known ? motion_.beta()[i] : 0.0;
  }
  return {std::span(momentum_).first(n), std::span(beta_).first(n)};
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
  const auto [momentum, beta] = model_rows();
  if (method_ == ResidualMethod::momentum)
    observer_.step(t_ns, momentum, beta, tau, residual);
  else
    comparison_.step(motion_.tree(), t_ns, q, dq, momentum, beta, tau, residual);
  filter_.step(t_ns, method_ == ResidualMethod::momentum ? observer_.warm() : comparison_.warm(), residual);
  if (has_prior_)
    prior_.step(t_ns, q, dq, presliding(), momentum, beta, prior, doubt);
  else
    for (std::size_t i = 0; i < momentum.size(); ++i) prior[i] = doubt[i] = 0.0;
  std::ranges::copy(q, carrying_.q.begin());
  std::ranges::copy(dq, carrying_.dq.begin());
  if (!loads_) return tick;
  if (carrying_.follows)
    for (std::size_t i = 0; i < doubt.size(); ++i)
      doubt[i] += (carrying_.error_share + units_per_nm_[i]) * std::fabs(carrying_.torques.residual()[i]);
  carrying_.t_ns = t_ns;
  carrying_.seen = true;
  carrying_.kept = false;
  return tick;
}

void ResidualStage::allow_loads(const LoadSettings& settings, std::span<const double> units_per_nm) {
  if (!settings.settable()) return;
  loads_ = settings;
  std::ranges::copy(units_per_nm, units_per_nm_.begin());
  other_units_ = std::ranges::any_of(units_per_nm, [](double units) { return units > 0; });
  model_carries_ = motion_.tree().has_mass();
  bare_ = model_carries_ ? motion_.tree() : *prior_.terms().corrected();
  if (method_ != ResidualMethod::momentum || !unfiltered_) return;
  const double rows = std::ceil(10.0 / gain_per_s_ * 1e9 / static_cast<double>(sample_period_ns_)) + 1;
  past_ = PastSamples(motion_.tree().size(), presliding().kept_columns(),
                      static_cast<std::size_t>(std::clamp(rows, 2.0, static_cast<double>(kMostPast))));
  past_presliding_ = presliding();
}

// Sets the load in the prior's corrected model. The estimated model carries the load only if it has masses; otherwise
// the prior alone includes it.
void ResidualStage::carry(const Load& load) noexcept {
  if (!loads_) return;
  const Carried what = load.mass > 0 ? loads_->in_link(load) : Carried{};
  if (model_carries_) motion_.carry(loads_->link, what);
  prior_.terms().carry(loads_->link, what);
}

// Recomputes p and beta of the last sample with the current models.
void ResidualStage::recompute() noexcept {
  motion_.compute(q(), dq());
  if (has_prior_) prior_.terms().compute(q(), dq(), presliding(), model_rows().beta);
}

void ResidualStage::set_load(const Load& load, std::int64_t since_ns) noexcept {
  if (!loads_) return;
  keep();
  carrying_.load = load.mass > 0 ? load : Load{};
  carry(carrying_.load);
  if (load.mass > 0) {  // else the previous load's share of r continues to decay
    carrying_.error_share = load.error_share;
    carrying_.follows = load.error_share > 0 || other_units_;
    if (!carrying_.follows) forget_load_torques();
  }
  if (!carrying_.seen) return;
  if (past_.size() > 0) {
    go_back(since_ns == kFromNow ? past_.size() - 1 : past_.at_or_before(since_ns));
    return;
  }
  recompute();
  const auto [momentum, beta] = model_rows();
  if (method_ == ResidualMethod::momentum)
    observer_.carry_on(momentum, beta);
  else
    comparison_.carry_on(motion_.tree(), q(), dq(), momentum, beta);
  if (carrying_.follows) begin_load_torques(carrying_.t_ns, q(), dq(), carrying_.torques.residual());
}

// Recomputes r, prior and doubt from the stored sample `first` on, with the current models.
void ResidualStage::go_back(std::size_t first) noexcept {
  JointVector residual;
  for (std::size_t k = first; k < past_.size(); ++k) {
    const std::int64_t t_ns = past_.t_ns(k);
    const PastSamples::Row row = past_[k];
    past_presliding_->read_ends(row.low, row.high);
    motion_.compute(row.q, row.dq);
    const auto [momentum, beta] = model_rows();
    if (k == first) {
      observer_.go_back(t_ns, momentum, beta, row.tau, row.residual);
      if (has_prior_) prior_.go_back(t_ns, row.q, row.dq, *past_presliding_, momentum, beta, row.prior, row.doubt);
      if (carrying_.follows) begin_load_torques(t_ns, row.q, row.dq, row.load);
    } else {
      observer_.step(t_ns, momentum, beta, row.tau, std::span(residual).first(joints()));
      if (has_prior_) prior_.step_again(t_ns, row.q, row.dq, *past_presliding_, momentum, beta, past_.raised(k));
      if (carrying_.follows) step_load_torques(t_ns, row.q, row.dq);
    }
    std::ranges::copy(observer_.residual(), row.residual.begin());
    std::ranges::copy(prior_.state().filter.residual(), row.prior.begin());
    std::ranges::copy(prior_.state().doubt_filter.residual(), row.doubt.begin());
    std::ranges::copy(carrying_.torques.residual(), row.load.begin());
  }
  if (has_prior_) prior_.terms().compute(q(), dq(), presliding(), model_rows().beta);
}

void ResidualStage::keep() noexcept {
  if (!loads_ || carrying_.kept) return;
  carrying_.kept = true;
  if (carrying_.follows) {
    if (carrying_.torques.started())
      step_load_torques(carrying_.t_ns, q(), dq());
    else
      begin_load_torques(carrying_.t_ns, q(), dq(), {});
  }
  if (can_go_back()) push_past();
}

void ResidualStage::push_past() noexcept {
  const PastSamples::Row row = past_.push(carrying_.t_ns, prior_.state().raised);
  std::ranges::copy(q(), row.q.begin());
  std::ranges::copy(dq(), row.dq.begin());
  std::ranges::copy(observer_.tau_m(), row.tau.begin());
  std::ranges::copy(observer_.residual(), row.residual.begin());
  std::ranges::copy(prior_.state().filter.residual(), row.prior.begin());
  std::ranges::copy(prior_.state().doubt_filter.residual(), row.doubt.begin());
  std::ranges::copy(carrying_.torques.residual(), row.load.begin());
  presliding().write_ends(row.low, row.high);
}

// p and beta of the load alone, at the state for which the models were last computed.
void ResidualStage::load_torques(std::span<const double> q, std::span<const double> dq, JointVector& p,
                                 JointVector& beta) noexcept {
  p.fill(0.0);
  beta.fill(0.0);
  if (!(carrying_.load.mass > 0)) return;
  const std::size_t n = joints();
  bare_->momentum(q, dq, std::span(p).first(n), std::span(beta).first(n));
  const std::span<const double> with_p = model_carries_ ? motion_.momentum() : prior_.terms().corrected_momentum();
  const std::span<const double> with_beta = model_carries_ ? motion_.beta() : prior_.terms().corrected_beta();
  for (std::size_t i = 0; i < n; ++i) {
    p[i] = with_p[i] - p[i];
    beta[i] = with_beta[i] - beta[i];
  }
}

// A new load's weight raises the limits at once, although r follows with a delay: the load may have been there before.
// `least`: remaining torques of the previous load.
void ResidualStage::begin_load_torques(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                                       std::span<const double> least) noexcept {
  const std::size_t n = joints();
  JointVector p, beta, torques;
  load_torques(q, dq, p, beta);
  for (std::size_t i = 0; i < n; ++i)
    torques[i] = i < least.size() && std::fabs(least[i]) > std::fabs(beta[i]) ? least[i] : beta[i];
  constexpr JointVector zero{};
  const auto of = [n](const JointVector& values) noexcept { return std::span(values).first(n); };
  if (!carrying_.torques.started()) {
    JointVector none;
    carrying_.torques.step(t_ns, of(p), of(beta), of(zero), std::span(none).first(n));
  }
  carrying_.torques.go_back(t_ns, of(p), of(beta), of(zero), of(torques));
}

void ResidualStage::step_load_torques(std::int64_t t_ns, std::span<const double> q,
                                      std::span<const double> dq) noexcept {
  const std::size_t n = joints();
  JointVector p, beta, torques;
  constexpr JointVector zero{};
  const auto of = [n](const JointVector& values) noexcept { return std::span(values).first(n); };
  load_torques(q, dq, p, beta);
  carrying_.torques.step(t_ns, of(p), of(beta), of(zero), std::span(torques).first(n));
  if (carrying_.load.mass > 0) return;
  double largest = 0;
  for (std::size_t i = 0; i < n; ++i) largest = std::max(largest, std::fabs(torques[i]));
  if (largest >= kFadedNm) return;
  carrying_.follows = false;
  forget_load_torques();
}

void ResidualStage::forget_load_torques() noexcept {
  constexpr JointVector zero{};
  const auto none = std::span(zero).first(joints());
  carrying_.torques.go_back(carrying_.t_ns, none, none, none, none);
  carrying_.torques.reset();
}

}  // namespace tauext
