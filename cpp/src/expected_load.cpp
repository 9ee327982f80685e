#include "tauext/expected_load.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "expected_load_parts.hpp"
#include "tauext/bundle.hpp"
#include "tauext/load_found.hpp"

namespace tauext {

const char* name(LoadPhase phase) noexcept {
  constexpr const char* names[] = {"none", "expecting", "deciding", "found", "weighing"};
  return phase <= LoadPhase::weighing ? names[static_cast<int>(phase)] : "";
}

bool ExpectedLoad::possible(const Bundle& bundle) noexcept {
  return bundle.load.settable() && bundle.observer.method == ResidualMethod::momentum &&
         !(bundle.observer.high_pass_per_s > 0 || bundle.observer.low_pass_per_s > 0);
}

ExpectedLoad::ExpectedLoad(const Bundle& bundle)
    : joints_(bundle.joints()),
      settings_(bundle.load),
      gain_per_s_(bundle.observer.gain_per_s),
      period_s_(1e-9 * static_cast<double>(bundle.observer.sample_period_ns)),
      bare_(bundle.links, bundle.gravity),
      columns_(bare_, bundle.prior, {bundle.load.link, bundle.load.rotation, bundle.load.translation}, gain_per_s_),
      usual_(joints_, static_cast<int>(bundle.prior.widths_rad.size()), bundle.limits) {
  std::ranges::copy(bundle.most_units_per_nm(), units_per_nm_.begin());
  for (int j = 0; j < joints_; ++j) told_ += bundle.in_newtons(j);
}

std::string ExpectedLoad::why_not(double seconds, double at_most_kg) const {
  if (!(seconds > 0 && seconds <= kLongestWindow_s))
    return "a load can be expected for " + to_text(kLongestWindow_s) + " s at most, more than 0, not for " + to_text(seconds) + " s";
  if (!(at_most_kg >= 0 && at_most_kg <= settings_.largest_mass_kg))
    return "at_most_kg = " + to_text(at_most_kg) + " must be 0 to " + to_text(settings_.largest_mass_kg) +
           " kg, what this arm can carry where its training was";
  return "";
}

bool ExpectedLoad::start(double seconds, double at_most_kg, const Load& carried, const AlarmStage& alarm) noexcept {
  if (!(seconds > 0 && seconds <= kLongestWindow_s) || !(at_most_kg >= 0 && at_most_kg <= settings_.largest_mass_kg))
    return false;
  const double high = std::max(at_most_kg - state_.carried.mass, 0.0);
  if (state_.held != Alarm::none) {  // what is held back is decided, whatever is asked for meanwhile
    state_.end_ns = state_.t_ns + to_ns(seconds);
    state_.bounds.high_kg = std::max(state_.bounds.low_kg, high);
    return true;
  }
  state_ = {};
  state_.phase = LoadPhase::expecting;
  state_.seconds = seconds;
  state_.carried = carried;
  state_.carried_ten = parameters_of(carried);
  state_.bounds = {-carried.mass, std::max(at_most_kg - carried.mass, 0.0), std::min(kReach_m, settings_.largest_reach_m)};
  columns_.reset();
  usual_.restore(alarm.state());
  usual_.acknowledge();
  usual_.restore_factors(alarm.factors());
  return true;
}

void ExpectedLoad::reset() noexcept { state_ = {}; }

void ExpectedLoad::explain(const Sample& sample, const Observed& observed, std::span<const double> tau_ext,
                           std::span<const double> limit_nm, std::span<double> explained,
                           std::span<double> raised) noexcept {
  State& s = state_;
  const auto n = static_cast<std::size_t>(joints_);
  if (!s.timed) {
    s.end_ns = sample.t_ns + to_ns(s.seconds);
    s.block_end_ns = sample.t_ns + to_ns(kBlock_s);
    s.timed = true;
  }
  if (!observed.judged && s.held != Alarm::none) {  // what cannot be seen has not gone
    s.held_ns += sample.t_ns - s.t_ns;
    s.grown_ns += sample.t_ns - s.t_ns;
  }
  s.t_ns = sample.t_ns;
  s.fresh = true;
  std::array<double, LoadRegressor::kParameters> whole = ten_of(s.change);
  for (std::size_t k = 0; k < whole.size(); ++k) whole[k] += s.carried_ten[k];
  JointVector momentum, beta;
  bare_.momentum(sample.q, sample.dq, std::span(momentum).first(n), std::span(beta).first(n));
  if (observed.restarted) {
    columns_.reset();  // as r does
    s.count = 0;
  }
  const std::span<const double> bare_beta = std::span(beta).first(n);
  if (!columns_.started() && !observed.restarted)
    columns_.begin(sample.t_ns, sample.q, sample.dq, bare_beta, whole);
  else
    columns_.step(sample.t_ns, sample.q, sample.dq, bare_beta, whole);
  std::ranges::fill(explained, 0.0);
  if (!observed.judged) return;
  std::ranges::copy(limit_nm, s.limit_nm.begin());
  fit(tau_ext, explained);
  const bool over = s.t_ns >= s.end_ns && s.held == Alarm::none;  // the window, and nothing is to be decided any more
  if (over || s.phase == LoadPhase::weighing) std::ranges::fill(explained, 0.0);
  for (std::size_t j = 0; j < n; ++j)
    if (units_per_nm_[j] > 0) {  // nobody knows what the load shows there, but how much at most
      raised[j] += units_per_nm_[j] * std::fabs(explained[j]);
      explained[j] = 0;
    }
  if (s.phase == LoadPhase::weighing) raise(raised);
}

// By what the torques of the load may be off.
void ExpectedLoad::raise(std::span<double> raised) const noexcept {
  const LoadRegressor::Columns& columns = columns_.state().load;
  for (std::size_t j = 0; j < raised.size(); ++j) {
    double variance = 0;
    for (std::size_t i = 0; i < 4; ++i)
      for (std::size_t k = 0; k < 4; ++k) variance += columns[i][j] * state_.covariance[4 * i + k] * columns[k][j];
    raised[j] += kRaise * std::sqrt(std::max(variance, 0.0)) * (units_per_nm_[j] > 0 ? units_per_nm_[j] : 1.0);
  }
}

// Samples that say no more than one: errors of r last for 1/K0.
double ExpectedLoad::alike() const noexcept { return std::max(1.0, 1 / (gain_per_s_ * period_s_)); }

// The change that this sample shows best, and what of tau_ext it is beyond the load that is set.
void ExpectedLoad::fit(std::span<const double> tau_ext, std::span<double> explained) noexcept {
  State& s = state_;
  const auto n = static_cast<std::size_t>(joints_);
  const LoadRegressor::Columns& columns = columns_.state().load;
  const auto told = ten_of(s.set), before = ten_of(s.change);
  JointVector shown, inertia, sigma;
  for (std::size_t j = 0; j < n; ++j) {
    if (!(s.limit_nm[j] > 0)) return;
    sigma[j] = units_per_nm_[j] > 0 ? std::numeric_limits<double>::infinity() : kSigmaOfLimit * s.limit_nm[j];
    shown[j] = tau_ext[j] + torque(columns, told, j);
    inertia[j] = torque(columns, before, j, 4);
  }
  ChangeSums one;
  one.add(columns, std::span(shown).first(n), inertia, sigma);
  s.change = one.solve(s.bounds, s.change);
  const auto now = ten_of(s.change);
  for (std::size_t j = 0; j < n; ++j) explained[j] = torque(columns, now, j) - torque(columns, told, j);
  if (s.count == 0) {
    s.next = 0;
    s.count = 1;
    s.blocks[0] = {};
    s.next = 1;
    s.block_end_ns = s.t_ns + to_ns(kBlock_s);
  }
  Stretch& last = s.blocks[(s.next + kBlocks - 1) % kBlocks];
  if (last.samples == 0) last.begin_ns = s.t_ns;
  last.samples += 1;
  last.sums.add(one);
}

void ExpectedLoad::follow(std::int64_t t_ns, std::span<const double> tau_ext, std::span<const double> scale,
                          std::span<const double> doubt, std::uint32_t near_stiction, bool trusted,
                          const AlarmStage& alarm) noexcept {
  State& s = state_;
  if (s.phase == LoadPhase::weighing) {
    if (alarm.state().held_alarm != Alarm::none && !s.failed) s.fails = true;
    return;
  }
  JointVector limit, contact;
  const auto n = static_cast<std::size_t>(joints_);
  usual_.step(t_ns, tau_ext, scale, doubt, near_stiction, trusted, std::span(limit).first(n), std::span(contact).first(n));
  const Alarm left = alarm.state().held_alarm, usual = usual_.state().held_alarm;
  if (left == Alarm::collision) s.fails = true;
  if (usual > left) {
    if (s.held == Alarm::none && t_ns < s.end_ns) {
      s.held_ns = s.grown_ns = t_ns;
      s.most = s.set;
      s.most_size = 0;
      s.phase = LoadPhase::deciding;
      s.held = usual;
      s.joint = usual_.state().joint;
    } else if (s.held != Alarm::none && usual > s.held) {
      s.held = usual;
      s.joint = usual_.state().joint;
    }
  }
}

std::size_t ExpectedLoad::state_bytes() const noexcept { return sizeof(State) + columns_.state_bytes(); }

void ExpectedLoad::save(std::span<std::byte> to) const noexcept {
  static_assert(std::is_trivially_copyable_v<State>);
  State state = state_;
  state.usual = usual_.state();
  state.factors = usual_.factors();
  std::memcpy(to.data(), &state, sizeof state);
  columns_.save(to.subspan(sizeof state));
}

void ExpectedLoad::restore(std::span<const std::byte> from) noexcept {
  std::memcpy(&state_, from.data(), sizeof state_);
  usual_.restore(state_.usual);
  usual_.restore_factors(state_.factors);
  columns_.restore(from.subspan(sizeof state_));
}

}  // namespace tauext
