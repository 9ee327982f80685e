#include "stages/observe_stage.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include "stages/observation.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

bool too_large(double value) noexcept { return !(std::fabs(value) <= ObserveStage::kLargest); }  // true for NaN

}  // namespace

const char* name(Health health) noexcept {
  constexpr const char* names[] = {"warming up", "ok", "stale", "fault"};
  return health <= Health::fault ? names[static_cast<int>(health)] : "";
}

const char* name(Cause cause) noexcept {
  switch (cause) {
    case kNotFinite: return "not finite";
    case kWrongSize: return "wrong size";
    case kLateSample: return "late sample";
    case kTimeBackwards: return "time backwards";
    case kMissingSample: return "missing sample";
    case kGap: return "gap";
    case kWrongRate: return "wrong rate";
    case kTorqueSaturated: return "torque saturated";
    case kEncoderStill: return "encoder still";
    case kImpossibleTorque: return "impossible torque";
    case kImpossibleVelocity: return "impossible velocity";
    case kImpossiblePosition: return "impossible position";
  }
  return "";
}

void write_features(std::span<const double> q, std::span<const double> dq, std::span<const double> presliding,
                    std::span<const float> factors, std::span<float> row) noexcept {
  const std::size_t n = q.size();
  for (std::size_t j = 0; j < n; ++j) {
    row[j] = static_cast<float>(q[j]) * factors[j];
    row[n + j] = static_cast<float>(dq[j]) * factors[n + j];
  }
  for (std::size_t c = 0; c < presliding.size(); ++c)
    row[2 * n + c] = static_cast<float>(presliding[c]) * factors[2 * n + c];
}

ObserveStage::ObserveStage(const Tree& tree, const ObserverSettings& observer, const PriorSettings& prior)
    : joints_(tree.size()),
      bridged_ns_(observer.sample_period_ns * longest_bridged(observer.sample_period_ns, observer.network_stride)),
      slowest_per_s_(observer.slowest_per_s()),
      nm_per_unit_(observer.nm_per_unit),
      residual_(tree, observer, prior) {}

ObserveStage::ObserveStage(const Bundle& bundle, int answer_every)
    : ObserveStage(Tree(bundle.links, bundle.gravity), bundle.observer, bundle.prior) {
  watch_.emplace(joints_, bundle.observer.sample_period_ns, bundle.observer.network_stride, bundle.signals,
                 bundle.servo.on());
  limits_ = bundle.limits;
  reports_friction_parts_ = bundle.drift.follows_factors() || bundle.error_scale.on();
  near_memory_ns_ = std::llround(1e9 * bundle.limits.near_memory_s);
  if (!bundle.has_network()) return;
  input_factors_ = bundle.input_factors;
  row_.resize(static_cast<std::size_t>(bundle.columns()));
  states_.resize(row_.size() - 2 * bundle.links.size());
  largest_input_ = largest_lstm_input(bundle.shape, bundle.parameters);
  reach_ = windows_of(bundle).reach();
  answer_every_ = answer_every;
}

void ObserveStage::reset() noexcept {
  residual_.reset();
  residual_.set_load({}, kFromNow);
  residual_.forget_temperature();
  if (watch_) watch_->reset();
  progress_ = {};
}

void ObserveStage::restore(const State& state) noexcept {
  progress_ = state.progress;
  residual_.restore(state.residual);
  if (watch_) watch_->restore(state.watch);
}

void ObserveStage::forget_friction(std::uint32_t joints) noexcept {
  for (int j = 0; j < joints_; ++j)
    if (joints >> j & 1) residual_.forget_friction(j);
}

const Observed& ObserveStage::step(const Sample& s) noexcept {
  if (usable(s)) {
    enter(s);
    Findings findings;
    watch(s, findings);
    find_overflow(findings);
    conclude(findings);
  }
  record_health();
  return observed_;
}

const Observed& ObserveStage::no_sample(std::int64_t now_ns) noexcept {
  Progress& p = progress_;
  const bool recent =
      now_ns <= p.t_ns || elapsed_ns(now_ns, p.t_ns) <= static_cast<std::uint64_t>(bridged_ns_);
  const bool broken = p.restart_next || (recent && stands_still(now_ns));
  if (!p.started || (recent && !broken))
    hold(now_ns, kMissingSample);
  else
    refuse(now_ns, kGap, -1);
  p.restart_next = broken;  // a silence breaks nothing: the stamp of the next sample shows whether samples are lost
  record_health();
  return observed_;
}

// Whether the sample can enter the chain; otherwise it was held or refused. Fills tau_.
bool ObserveStage::usable(const Sample& s) noexcept {
  const auto n = static_cast<std::size_t>(joints_);
  const bool temperatures = s.temperature.empty() || s.temperature.size() == n;
  if (s.q.size() != n || s.dq.size() != n || s.tau.size() != n || !temperatures) {
    refuse(s.t_ns, kWrongSize, -1);
    if (watch_) watch_->pass(s.t_ns);
    return false;
  }
  for (std::size_t j = 0; j < n; ++j) tau_[j] = nm_per_unit_.empty() ? s.tau[j] : s.tau[j] * nm_per_unit_[j];
  if (const Impossible found = impossible(s); found.cause != 0) {
    refuse(s.t_ns, found.cause, found.joint);
    if (watch_) watch_->pass(s.t_ns);
    return false;
  }
  const Progress& p = progress_;
  if (!p.started || p.restart_next || s.t_ns > p.t_ns) return true;
  if (elapsed_ns(p.t_ns, s.t_ns) > static_cast<std::uint64_t>(bridged_ns_))
    refuse(s.t_ns, kTimeBackwards, -1);
  else if (stands_still(s.t_ns))
    refuse(s.t_ns, kLateSample, -1);
  else
    hold(s.t_ns, kLateSample);
  return false;
}

// Why the sample is impossible, if it is; tau_ext is not used.
Impossible ObserveStage::impossible(const Sample& s) const noexcept {
  const Progress& p = progress_;
  if (watch_) {
    const bool follows = p.started && !p.restart_next && s.t_ns > p.t_ns &&
                         elapsed_ns(s.t_ns, p.t_ns) <= static_cast<std::uint64_t>(bridged_ns_);
    return watch_->check(s.t_ns, s.q, s.dq, tau(), follows);
  }
  for (std::size_t j = 0; j < s.q.size(); ++j)
    if (!std::isfinite(s.q[j]) || !std::isfinite(s.dq[j]) || !std::isfinite(tau_[j])) return {kNotFinite, static_cast<int>(j)};
  return {};
}

// Clock, dynamics, residual, prior, features and region.
void ObserveStage::enter(const Sample& s) noexcept {
  Progress& p = progress_;
  Observed& o = observed_;
  const auto n = static_cast<std::size_t>(joints_);
  if (p.restart_next) residual_.reset();
  residual_.follow_temperature(s.temperature);
  const std::span residual = std::span(residual_nm_).first(n), prior = std::span(prior_nm_).first(n),
                  doubt = std::span(doubt_nm_).first(n);
  const SampleClock::Tick tick = residual_.step(s.t_ns, s.q, s.dq, tau(), residual, prior, doubt);
  o.residual = residual;
  o.prior = prior;
  o.doubt = doubt;
  if (reports_friction_parts_) {
    const std::span coulomb = std::span(coulomb_nm_).first(n), viscous = std::span(viscous_nm_).first(n);
    residual_.friction(coulomb, viscous);
    o.coulomb = coulomb;
    o.viscous = viscous;
  }
  if (presliding().has_branches()) {
    for (std::size_t j = 0; j < n; ++j) memory_gap_[j] = presliding().memory_gap(static_cast<int>(j));
    o.memory_gap = std::span(memory_gap_).first(n);
  }
  o.restarted = tick.kind == SampleClock::Kind::restart;
  o.jumped = o.restarted && p.started && (s.t_ns <= p.t_ns || elapsed_ns(s.t_ns, p.t_ns) > static_cast<std::uint64_t>(kJumpNs));
  p.jumps += o.jumped;
  p.held = 0;
  if (o.restarted) {
    if (p.started && !p.restart_next) {
      p.causes = kGap;
      p.cause_joint = -1;
    }
    p.restarts += p.started;
    p.saturated = false;
    p.row = 0;
  } else {
    p.bridged += static_cast<std::uint64_t>(tick.advance - 1);
    p.row += tick.advance;
  }
  const std::int64_t step_ns = o.restarted ? 0 : static_cast<std::int64_t>(elapsed_ns(s.t_ns, p.t_ns));
  ++p.samples;
  p.restart_next = false;
  p.started = true;
  p.t_ns = s.t_ns;
  o.passage = Passage::entered;
  o.t_ns = s.t_ns;
  o.ticks = tick.advance;
  o.warm = residual_.warm();
  if (!row_.empty()) write_features(s);
  update_region(s, step_ns);
}

// Selects the limit that applies to each joint. step_ns: since the last sample, 0 after a restart.
void ObserveStage::update_region(const Sample& s, std::int64_t step_ns) noexcept {
  observed_.near_stiction = 0;
  for (int j = 0; limits_ && j < joints_; ++j) {
    const auto at = static_cast<std::size_t>(j);
    std::int64_t& left_ns = progress_.near_ns[at];
    const double state = limits_->region_width < 0 ? 0.0 : presliding().value(j, limits_->region_width);
    const bool now = limits_->near_stiction(s.dq[at], state);
    left_ns = now ? near_memory_ns_ : step_ns == 0 ? 0 : std::max<std::int64_t>(left_ns - step_ns, 0);
    if (now || left_ns > 0) observed_.near_stiction |= std::uint32_t{1} << j;
  }
}

void ObserveStage::write_features(const Sample& s) noexcept {
  presliding().write(states_);
  tauext::write_features(s.q, s.dq, states_, input_factors_, row_);
}

// Checks the signals themselves.
void ObserveStage::watch(const Sample& s, Findings& findings) noexcept {
  if (!watch_) return;
  Progress& p = progress_;
  const SignalWatch::Verdict signals = watch_->step(s.t_ns, observed_.ticks, s.q, s.dq, tau());
  if (signals.still_joint >= 0) findings.add(kEncoderStill, signals.still_joint);
  if (signals.wrong_rate) findings.add(kWrongRate, -1);
  findings.trusted = findings.causes == 0;
  if (signals.saturated_joint >= 0) {
    findings.add(kTorqueSaturated, signals.saturated_joint);
    p.saturated = true;
    p.saturated_ns = s.t_ns;
  }
  const double since_s = elapsed_s(s.t_ns, p.saturated_ns);
  if (p.saturated && since_s * slowest_per_s_ >= 10.0) p.saturated = false;
}

// Whether nothing inside the chain overflowed; no branches.
bool ObserveStage::all_finite() const noexcept {
  unsigned fine = 1;
  const auto within = [](auto value, auto most) { return static_cast<unsigned>(std::fabs(value) <= most); };
  for (int j = 0; j < joints_; ++j)
    fine &= within(residual_nm_[j], kLargest) & within(prior_nm_[j], kLargest) & within(doubt_nm_[j], kLargest);
  for (int j = 0; reports_friction_parts_ && j < joints_; ++j)
    fine &= within(coulomb_nm_[j], kLargest) & within(viscous_nm_[j], kLargest);
  for (const float value : row_) fine &= within(value, largest_input_);
  return fine;
}

// Finds overflow inside the chain: not finite, or too large for the network or for tau_ext.
void ObserveStage::find_overflow(Findings& findings) noexcept {
  Observed& o = observed_;
  o.overflowed = false;
  if (all_finite()) return;
  for (int j = 0; j < joints_ && !o.overflowed; ++j)
    if (too_large(residual_nm_[j]) || too_large(prior_nm_[j]) || too_large(doubt_nm_[j]) ||
        (reports_friction_parts_ && (too_large(coulomb_nm_[j]) || too_large(viscous_nm_[j])))) {
      findings.add(kNotFinite, j);
      o.overflowed = true;
    }
  const int widths = joints_ > 0 ? static_cast<int>(states_.size()) / joints_ : 0;
  for (std::size_t c = 0; c < row_.size() && !o.overflowed; ++c)
    if (!(std::fabs(row_[c]) <= largest_input_)) {
      const int column = static_cast<int>(c), own = column - 2 * joints_;
      findings.add(kNotFinite, own < 0 ? column % joints_ : own / widths);
      o.overflowed = true;
    }
  if (o.overflowed) findings.trusted = false;
}

// Derives the health. The causes of a restart stay reported until the health is ok. A saturated drive makes tau_ext
// uncertain, but collisions saturate drives: the sample is judged and not learned from.
void ObserveStage::conclude(const Findings& findings) noexcept {
  Progress& p = progress_;
  Observed& o = observed_;
  const bool full = p.row - p.row % answer_every_ >= reach_;
  o.judged = findings.trusted && full && o.warm;
  o.teaches = o.judged && findings.causes == 0 && !p.saturated;
  if (findings.causes != 0) {
    o.health = Health::fault;
    p.causes = findings.causes;
    p.cause_joint = findings.joint;
    p.restart_next = (findings.causes & ~static_cast<std::uint32_t>(kTorqueSaturated)) != 0;
  } else if (!o.judged || p.saturated) {
    o.health = Health::warming_up;
  } else {
    o.health = Health::ok;
    p.causes = 0;
    p.cause_joint = -1;
  }
  o.causes = p.causes;
  o.cause_joint = p.cause_joint;
}

// Skips a sample as a fault; the chain restarts at the next good one.
void ObserveStage::refuse(std::int64_t t_ns, std::uint32_t cause, int joint) noexcept {
  observed_.t_ns = t_ns;
  observed_.passage = Passage::refused;
  observed_.health = Health::fault;
  observed_.causes = progress_.causes = cause;
  observed_.cause_joint = progress_.cause_joint = joint;
  progress_.restart_next = true;
}

// No new sample: an existing estimate is held as stale; a fault or warm-up continues.
void ObserveStage::hold(std::int64_t t_ns, std::uint32_t cause) noexcept {
  const Progress& p = progress_;
  const bool had_one = p.reported == Health::ok || p.reported == Health::stale;
  observed_.t_ns = t_ns;
  observed_.passage = Passage::held;
  observed_.health = had_one ? Health::stale : p.reported;
  observed_.causes = had_one ? cause : p.reported_causes | cause;
  observed_.cause_joint = had_one ? -1 : p.reported_joint;
}

// Whether the stamps have stopped; counts this sample.
bool ObserveStage::stands_still(std::int64_t t_ns) noexcept {
  return t_ns <= progress_.t_ns && ++progress_.held > kMostHeld;
}

void ObserveStage::record_health() noexcept {
  progress_.reported = observed_.health;
  progress_.reported_causes = observed_.causes;
  progress_.reported_joint = observed_.cause_joint;
}

}  // namespace tauext
