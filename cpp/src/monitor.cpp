#include "tauext/monitor.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <type_traits>

namespace tauext {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr std::uint32_t kStateVersion = 4;

// What a saved state begins with.
struct StateHead {
  std::uint32_t version, fingerprint;
  std::uint64_t bytes;
  std::uint32_t crc, unused;
};

std::span<const char> as_chars(std::span<const std::byte> bytes) noexcept {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

SlidingLstm make_network(const Bundle& b, NetworkRate rate) {
  return SlidingLstm(b.shape, b.parameters, b.inputs, b.columns(), b.observer.network_stride, b.window_steps, rate);
}

}  // namespace

const char* name(Alarm alarm) noexcept {
  constexpr const char* names[] = {"none", "contact", "collision"};
  return alarm <= Alarm::collision ? names[static_cast<int>(alarm)] : "";
}

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
  }
  return "";
}

Monitor::Monitor(const Bundle& bundle, NetworkRate rate)
    : joints_(bundle.joints()),
      sample_period_ns_(bundle.observer.sample_period_ns),
      network_period_ns_(sample_period_ns_ * bundle.observer.network_stride),
      slowest_per_s_(bundle.observer.slowest_per_s()),
      residual_(Tree(bundle.links, bundle.gravity), bundle.observer, bundle.prior),
      watch_(joints_, sample_period_ns_, bundle.signals),
      input_factors_(bundle.input_factors),
      output_scale_nm_(bundle.output_scale_nm),
      limits_(bundle.limits),
      alarm_(joints_, static_cast<int>(bundle.prior.widths_rad.size()), bundle.limits),
      drift_(bundle.drift, bundle.limits, joints_, bundle.observer.gain_per_s) {
  for (const Link& link : bundle.links) joint_names_.push_back(link.joint_name);
  if (bundle.has_network()) {
    network_.emplace(make_network(bundle, rate));
    row_.resize(static_cast<std::size_t>(bundle.columns()));
    states_.resize(row_.size() - 2 * bundle.links.size());
    network_out_.resize(bundle.links.size());
  }
  const std::vector<char> bytes = to_bytes(bundle);  // validates it, too
  const char how = static_cast<char>(rate);
  fingerprint_ = crc32(std::span(&how, 1), crc32(bytes));
  reset();
}

void Monitor::reset() noexcept {
  residual_.reset();
  watch_.reset();
  if (network_) network_->restart();
  alarm_.acknowledge();
  alarm_.restore_factors({});
  drift_.reset();
  counters_ = {};
  estimate_ = {};
  estimate_.joints = joints_;
  blank(true);
}

void Monitor::acknowledge() noexcept {
  alarm_.acknowledge();
  report_alarm();
}

void Monitor::resume() noexcept {
  for (int j = 0; j < joints_; ++j)
    if (estimate_.near_stiction >> j & 1) residual_.forget_friction(j);
  acknowledge();
}

void Monitor::report_alarm() noexcept {
  const AlarmStage::State& alarm = alarm_.state();
  estimate_.alarm = alarm.alarm;
  estimate_.alarm_joint = alarm.joint;
  estimate_.alarm_t_ns = alarm.raised_t_ns;
}

void Monitor::blank(bool also_residual) noexcept {
  for (int j = 0; j < joints_; ++j) {
    estimate_.uncertainty[j] = estimate_.tau_ext[j] = estimate_.margin_nm[j] = kNan;
    if (also_residual)
      estimate_.residual[j] = estimate_.prior[j] = estimate_.drift[j] = estimate_.limit_nm[j] = kNan;
  }
  if (also_residual) estimate_.near_stiction = 0;
  estimate_.detection = false;
}

// A sample that does not enter the chain. The alarm stands as it did.
void Monitor::refuse(std::int64_t t_ns, Health health, std::uint32_t cause, int joint) noexcept {
  estimate_.t_ns = t_ns;
  estimate_.causes = cause;
  estimate_.cause_joint = joint;
  estimate_.detection = false;
  estimate_.health = health;
  if (health == Health::fault) {
    blank(true);
    counters_.restart_next = true;
    counters_.causes = cause;
    counters_.cause_joint = joint;
  }
}

const Estimate& Monitor::estimate(const Sample& s) noexcept {
  advance();
  if (refused(s)) return estimate_;
  const std::int64_t ticks = observe(s);
  const bool full = predict(s, ticks);
  Findings findings = examine(s);
  judge(s, full, findings);
  conclude(findings);
  return estimate_;
}

// Whether the sample cannot enter the chain; then the estimate already says so.
bool Monitor::refused(const Sample& s) noexcept {
  const auto n = static_cast<std::size_t>(joints_);
  if (s.q.size() != n || s.dq.size() != n || s.tau.size() != n) {
    refuse(s.t_ns, Health::fault, kWrongSize, -1);
    watch_.pass(s.t_ns);
    return true;
  }
  for (int j = 0; j < joints_; ++j)
    if (!std::isfinite(s.q[j]) || !std::isfinite(s.dq[j]) || !std::isfinite(s.tau[j])) {
      refuse(s.t_ns, Health::fault, kNotFinite, j);
      watch_.pass(s.t_ns);
      return true;
    }
  if (!counters_.started || counters_.restart_next || s.t_ns > counters_.t_ns) return false;
  if (elapsed_ns(counters_.t_ns, s.t_ns) > static_cast<std::uint64_t>(network_period_ns_))
    refuse(s.t_ns, Health::fault, kTimeBackwards, -1);
  else
    hold(s.t_ns, kLateSample);
  return true;
}

// No new sample: the last estimate is held, and stale if there was one; a fault or warm-up goes on.
void Monitor::hold(std::int64_t t_ns, std::uint32_t cause) noexcept {
  if (estimate_.health == Health::ok || estimate_.health == Health::stale) {
    refuse(t_ns, Health::stale, cause, -1);
    return;
  }
  estimate_.t_ns = t_ns;
  estimate_.causes |= cause;
  estimate_.detection = false;
}

// Clock, dynamics, observer and drift; returns the ticks since the last sample, 0 where this one began anew.
std::int64_t Monitor::observe(const Sample& s) noexcept {
  if (counters_.restart_next) residual_.reset();
  const SampleClock::Tick tick = residual_.step(s.t_ns, s.q, s.dq, s.tau, first_joints(estimate_.residual),
                                                first_joints(estimate_.prior), first_joints(estimate_.doubt));
  if (tick.kind == SampleClock::Kind::restart) {
    if (counters_.started && !counters_.restart_next) {
      counters_.causes = kGap;
      counters_.cause_joint = -1;
    }
    counters_.restarts += counters_.started;
    counters_.saturated = false;
    drift_.restart();
    if (network_) network_->restart();
  } else {
    counters_.bridged += static_cast<std::uint64_t>(tick.advance - 1);
  }
  drift_.step(s.t_ns, s.dq, first_joints(estimate_.drift));
  ++counters_.samples;
  counters_.restart_next = false;
  counters_.started = true;
  counters_.t_ns = estimate_.t_ns = s.t_ns;
  return tick.advance;
}

// The network's answer, in network_out_; false while its window is not full.
bool Monitor::predict(const Sample& s, std::int64_t ticks) noexcept {
  if (!network_) return true;
  const auto n = static_cast<std::size_t>(joints_);
  for (std::size_t j = 0; j < n; ++j) {
    row_[j] = static_cast<float>(s.q[j]) * input_factors_[j];
    row_[n + j] = static_cast<float>(s.dq[j]) * input_factors_[n + j];
  }
  residual_.presliding().write(states_);
  for (std::size_t c = 0; c < states_.size(); ++c) row_[2 * n + c] = static_cast<float>(states_[c]) * input_factors_[2 * n + c];
  network_->push(row_, ticks);
  return network_->answer(network_out_);
}

// What is wrong with the signals themselves.
Monitor::Findings Monitor::examine(const Sample& s) noexcept {
  const SignalWatch::Verdict signals = watch_.step(s.t_ns, s.q, s.dq, s.tau);
  Findings findings;
  if (signals.still_joint >= 0) findings.add(kEncoderStill, signals.still_joint);
  if (signals.wrong_rate) findings.add(kWrongRate, -1);
  findings.trusted = findings.causes == 0;
  if (signals.saturated_joint >= 0) {
    findings.add(kTorqueSaturated, signals.saturated_joint);
    counters_.saturated = true;
    counters_.saturated_ns = s.t_ns;
  }
  const double since_s = 1e-9 * static_cast<double>(elapsed_ns(s.t_ns, counters_.saturated_ns));
  if (counters_.saturated && since_s * slowest_per_s_ >= 10.0) counters_.saturated = false;
  return findings;
}

// tau_ext against its limits. A saturated drive makes tau_ext doubtful, but a collision is what saturates drives: it is
// judged all the same.
void Monitor::judge(const Sample& s, bool full, Findings& findings) noexcept {
  const auto expect_finite = [&](const JointVector& values) noexcept {
    for (int j = 0; j < joints_; ++j) {
      if (std::isfinite(values[j])) continue;
      findings.add(kNotFinite, j);
      findings.trusted = false;
      return;
    }
  };
  expect_finite(estimate_.residual);
  if (!full || !residual_.warm()) findings.trusted = false;
  if (findings.trusted) {
    for (int j = 0; j < joints_; ++j) {
      const double network = network_ ? network_torque_nm(output_scale_nm_[j], network_out_[j]) : 0.0;
      estimate_.uncertainty[j] = estimate_.prior[j] + network + estimate_.drift[j];
      estimate_.tau_ext[j] = estimate_.residual[j] - estimate_.uncertainty[j];
    }
    expect_finite(estimate_.tau_ext);
  }
  if (!findings.trusted) blank((findings.causes & kNotFinite) != 0);
  estimate_.near_stiction = 0;
  for (int j = 0; j < joints_; ++j) {
    const double state =
        limits_.region_width < 0 ? 0.0 : static_cast<float>(residual_.presliding().value(j, limits_.region_width));
    if (limits_.near_stiction(s.dq[j], state)) estimate_.near_stiction |= std::uint32_t{1} << j;
  }
  estimate_.detection =
      alarm_.step(s.t_ns, first_joints(estimate_.tau_ext), first_joints(estimate_.doubt), estimate_.near_stiction,
                  findings.trusted, first_joints(estimate_.limit_nm));
  drift_.learn(first_joints(estimate_.tau_ext), first_joints(estimate_.doubt), estimate_.near_stiction,
               findings.trusted && findings.causes == 0 && !counters_.saturated);
  estimate_.drift_saturated = drift_.saturated();
  for (int j = 0; findings.trusted && j < joints_; ++j)
    estimate_.margin_nm[j] = estimate_.limit_nm[j] - std::fabs(estimate_.tau_ext[j]);
  report_alarm();
}

// Health follows from what was found; why the chain broke stays named until it is healthy again.
void Monitor::conclude(const Findings& findings) noexcept {
  if (findings.causes != 0) {
    estimate_.health = Health::fault;
    counters_.causes = findings.causes;
    counters_.cause_joint = findings.joint;
    counters_.restart_next = (findings.causes & ~static_cast<std::uint32_t>(kTorqueSaturated)) != 0;
  } else if (!findings.trusted || counters_.saturated) {
    estimate_.health = Health::warming_up;
  } else {
    estimate_.health = Health::ok;
    counters_.causes = 0;
    counters_.cause_joint = -1;
  }
  estimate_.causes = counters_.causes;
  estimate_.cause_joint = counters_.cause_joint;
}

void Monitor::advance() noexcept {
  if (network_) network_->advance();
}

const Estimate& Monitor::no_sample(std::int64_t now_ns) noexcept {
  advance();
  const bool recent = now_ns <= counters_.t_ns ||
                      elapsed_ns(now_ns, counters_.t_ns) <= static_cast<std::uint64_t>(network_period_ns_);
  if (!counters_.started || (recent && !counters_.restart_next))
    hold(now_ns, kMissingSample);
  else
    refuse(now_ns, Health::fault, kGap, -1);
  return estimate_;
}

// What a state holds, in this order; all of it plain bytes.
std::size_t Monitor::state_bytes() const noexcept {
  return sizeof(StateHead) + sizeof counters_ + sizeof(ResidualStage::State) + sizeof(SignalWatch::State) +
         sizeof(AlarmStage::State) + sizeof(LimitFactors) + sizeof(DriftTracker::State) + sizeof estimate_ +
         (network_ ? network_->state_bytes() : 0);
}

bool Monitor::save_state(std::span<std::byte> state) const noexcept {
  if (state.size() != state_bytes()) return false;
  std::span<std::byte> left = state.subspan(sizeof(StateHead));
  const auto put = [&](const auto& part) noexcept {
    static_assert(std::is_trivially_copyable_v<std::remove_cvref_t<decltype(part)>>);
    std::memcpy(left.data(), &part, sizeof part);
    left = left.subspan(sizeof part);
  };
  put(counters_);
  put(residual_.state());
  put(watch_.state());
  put(alarm_.state());
  put(alarm_.factors());
  put(drift_.state());
  put(estimate_);
  if (network_) network_->save(left);
  const StateHead head{kStateVersion, fingerprint_, state.size(), crc32(as_chars(state.subspan(sizeof head))), 0};
  std::memcpy(state.data(), &head, sizeof head);
  return true;
}

bool Monitor::restore_state(std::span<const std::byte> state) noexcept {
  StateHead head;
  if (state.size() != state_bytes()) return false;
  std::memcpy(&head, state.data(), sizeof head);
  std::span<const std::byte> left = state.subspan(sizeof head);
  if (head.version != kStateVersion || head.fingerprint != fingerprint_ || head.bytes != state.size() ||
      head.crc != crc32(as_chars(left)))
    return false;
  const auto take = [&](auto part) noexcept {  // a copy of what stands there gives it its type
    std::memcpy(&part, left.data(), sizeof part);
    left = left.subspan(sizeof part);
    return part;
  };
  counters_ = take(counters_);
  residual_.restore(take(residual_.state()));
  watch_.restore(take(watch_.state()));
  alarm_.restore(take(alarm_.state()));
  alarm_.restore_factors(take(alarm_.factors()));
  drift_.restore(take(drift_.state()));
  estimate_ = take(estimate_);
  if (network_) network_->restore(left);
  return true;
}

}  // namespace tauext
