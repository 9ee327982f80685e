#include "load/expected_load.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>

#include "load/load_change.hpp"
#include "load/load_columns.hpp"
#include "load/load_solve.hpp"
#include "tauext/bundle.hpp"
#include "tauext/load.hpp"

namespace tauext {
namespace {

constexpr double kForgotten = 3;  // times 1/K0: the memory of r

std::int64_t to_ns(double seconds) noexcept { return std::llround(seconds * 1e9); }

double torque(const LoadRegressor::Columns& columns, const std::array<double, LoadRegressor::kParameters>& ten,
                     std::size_t joint, std::size_t first = 0) noexcept {
  double sum = 0;
  for (std::size_t k = first; k < ten.size(); ++k) sum += columns[k][joint] * ten[k];
  return sum;
}

LoadChange less(const LoadChange& one, const LoadChange& other) noexcept {
  LoadChange out;
  for (std::size_t k = 0; k < out.size(); ++k) out[k] = one[k] - other[k];
  return out;
}

}  // namespace

const char* name(LoadPhase phase) noexcept {
  constexpr const char* names[] = {"none", "expecting", "deciding", "found", "weighing"};
  return phase <= LoadPhase::weighing ? names[static_cast<int>(phase)] : "";
}

bool ExpectedLoad::possible(const Bundle& bundle) noexcept {
  return bundle.load.settable() && bundle.observer.unfiltered_momentum();
}

ExpectedLoad::ExpectedLoad(const Bundle& bundle)
    : joints_(bundle.joints()),
      settings_(bundle.load),
      gain_per_s_(bundle.observer.gain_per_s),
      period_s_(1e-9 * static_cast<double>(bundle.observer.sample_period_ns)),
      bare_(bundle.links, bundle.gravity),
      columns_(bare_, bundle.prior, load_frame(bundle.load), gain_per_s_),
      usual_(joints_, static_cast<int>(bundle.prior.widths_rad.size()), bundle.limits) {
  std::ranges::copy(bundle.most_units_per_nm(), units_per_nm_.begin());
  double own = 0;
  for (int j = 0; j < joints_; ++j)
    if (bundle.in_newtons(j)) {
      ++newton_joints_;
      const auto at = static_cast<std::size_t>(j);
      own += std::pow(std::hypot(bundle.wrench.own_share(at), bundle.wrench.factor(at) - 1), 2);
    }
  const int n = std::max(newton_joints_, 1);
  constants_share_ = std::hypot(bundle.wrench.common_share, std::sqrt(own / (n * std::min(n, 3))));
}

std::string ExpectedLoad::why_not(double seconds, double at_most_kg) const {
  if (!(seconds > 0 && seconds <= kLongestWindow_s))
    return "a payload can be expected for " + to_text(kLongestWindow_s) + " s at most, more than 0, not for " + to_text(seconds) + " s";
  if (!(at_most_kg >= 0 && at_most_kg <= settings_.largest_mass_kg))
    return "at_most_kg = " + to_text(at_most_kg) + " must be 0 to " + to_text(settings_.largest_mass_kg) +
           " kg, what this arm can carry where its training was";
  return "";
}

bool ExpectedLoad::start(double seconds, double at_most_kg, const Load& carried, const AlarmStage& alarm) noexcept {
  if (!(seconds > 0 && seconds <= kLongestWindow_s) || !(at_most_kg >= 0 && at_most_kg <= settings_.largest_mass_kg))
    return false;
  const double high = std::max(at_most_kg - state_.carried.mass, 0.0);
  if (state_.held != Alarm::none) {  // an alarm that is held back must be decided first
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
  if (observed.jumped && s.timed) {  // decide() ends it
    s.jumped = true;
    std::ranges::fill(explained, 0.0);
    return;
  }
  if (!s.timed) {
    s.end_ns = sample.t_ns + to_ns(s.seconds);
    s.block_end_ns = sample.t_ns + to_ns(kBlock_s);
    s.timed = true;
  }
  if (!observed.judged && s.held != Alarm::none) {  // the contact may persist unseen
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
  const bool over = s.t_ns >= s.end_ns && s.held == Alarm::none;  // the window is over and nothing is held back
  if (over || s.phase == LoadPhase::weighing) std::ranges::fill(explained, 0.0);
  for (std::size_t j = 0; j < n; ++j)
    if (units_per_nm_[j] > 0) {  // unknown load torque: only its bound is used
      raised[j] += units_per_nm_[j] * std::fabs(explained[j]);
      explained[j] = 0;
    }
  if (s.phase == LoadPhase::weighing) raise(raised);
}

// Raises the limits by the uncertainty of the load's torques.
void ExpectedLoad::raise(std::span<double> raised) const noexcept {
  const LoadRegressor::Columns& columns = columns_.shown().load;
  for (std::size_t j = 0; j < raised.size(); ++j) {
    double variance = 0;
    for (std::size_t i = 0; i < 4; ++i)
      for (std::size_t k = 0; k < 4; ++k) variance += columns[i][j] * state_.covariance[4 * i + k] * columns[k][j];
    raised[j] += kRaise * std::sqrt(std::max(variance, 0.0)) * (units_per_nm_[j] > 0 ? units_per_nm_[j] : 1.0);
  }
}

// Samples that count as one: errors of r are correlated over 1/K0.
double ExpectedLoad::alike() const noexcept { return std::max(1.0, 1 / (gain_per_s_ * period_s_)); }

// Fits the load change to this sample. explained: its torques beyond those of the load that is set.
void ExpectedLoad::fit(std::span<const double> tau_ext, std::span<double> explained) noexcept {
  State& s = state_;
  const auto n = static_cast<std::size_t>(joints_);
  const LoadRegressor::Columns& columns = columns_.shown().load;
  const auto already = ten_of(s.set), before = ten_of(s.change);
  JointVector shown, inertia, sigma;
  for (std::size_t j = 0; j < n; ++j) {
    if (!(s.limit_nm[j] > 0)) return;
    sigma[j] = units_per_nm_[j] > 0 ? std::numeric_limits<double>::infinity() : kSigmaOfLimit * s.limit_nm[j];
    shown[j] = tau_ext[j] + torque(columns, already, j);
    inertia[j] = torque(columns, before, j, 4);
  }
  ChangeSums one;
  one.add(columns, std::span(shown).first(n), inertia, sigma);
  s.change = one.solve(s.bounds, s.change);
  const auto now = ten_of(s.change);
  for (std::size_t j = 0; j < n; ++j) explained[j] = torque(columns, now, j) - torque(columns, already, j);
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

void ExpectedLoad::follow(std::int64_t t_ns, const JointVector& tau_ext, const JointVector& scale, const JointVector& doubt,
                          std::uint32_t near_stiction, bool trusted, const AlarmStage& alarm) noexcept {
  State& s = state_;
  if (s.jumped) return;
  if (s.phase == LoadPhase::weighing) {
    if (alarm.state().held_alarm != Alarm::none && !s.failed) s.fails = true;
    return;
  }
  JointVector limit, contact;
  usual_.step(t_ns, tau_ext, scale, doubt, near_stiction, trusted, limit, contact);
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

ExpectedLoad::Decision ExpectedLoad::decide() noexcept {
  State& s = state_;
  if (on() && s.jumped) return end_by_jump();
  if (!on() || !s.fresh) return {};
  s.fresh = false;
  if (s.fails) return give_alarm();
  if (s.t_ns < s.block_end_ns) return {};
  if (s.failed) {
    const Decision decision = take_back();
    if (on()) close_block();
    return decision;
  }
  if (s.held != Alarm::none) {
    const Decision decision = decide_held();
    if (on()) close_block();
    return decision;
  }
  if (s.phase == LoadPhase::weighing && s.t_ns >= s.end_ns + to_ns(kWeigh_s)) {
    stop();
    return {};
  }
  if (s.phase != LoadPhase::weighing && s.t_ns >= s.end_ns) {
    const Decision decision = finish();
    if (on()) close_block();
    return decision;
  }
  Decision decision;
  if (s.has_set && s.t_ns >= s.refine_ns) decision = refine();
  close_block();
  return decision;
}

void ExpectedLoad::close_block() noexcept {
  State& s = state_;
  s.block_end_ns = s.t_ns + to_ns(kBlock_s);
  if (s.count > 0 && block(0).samples == 0) return;  // no judged sample
  if (s.count == kBlocks && s.has_set && s.blocks[s.next].begin_ns >= s.begin_ns) s.past.add(s.blocks[s.next].sums);
  s.blocks[s.next] = {};
  s.next = (s.next + 1) % kBlocks;
  s.count = std::min(s.count + 1, kBlocks);
}

// Sum of `count` blocks; the newest is `from` blocks back.
ExpectedLoad::Stretch ExpectedLoad::last_blocks(std::size_t from, std::size_t count) const noexcept {
  Stretch out;
  for (std::size_t k = from; k < from + count && k < state_.count; ++k) {
    out.sums.add(block(k).sums);
    out.samples += block(k).samples;
    out.begin_ns = block(k).begin_ns;
  }
  return out;
}

// The longest stretch up to now whose parts agree with later ones. After the window: everything since the load was
// found.
ExpectedLoad::Stretch ExpectedLoad::agreeing() const noexcept {
  const bool all = state_.phase == LoadPhase::weighing;
  Stretch whole = last_blocks(0, 2 * kStretchBlocks);
  for (std::size_t from = 2 * kStretchBlocks; from + kStretchBlocks <= state_.count; from += kStretchBlocks) {
    const Stretch more = last_blocks(from, kStretchBlocks);
    if (all && more.begin_ns < state_.begin_ns) break;
    if (!all && !agree(more.sums, whole.sums, state_.bounds, state_.change, alike())) return whole;
    whole.sums.add(more.sums);
    whole.samples += more.samples;
    whole.begin_ns = more.begin_ns;
  }
  if (state_.past.rows > 0 && (all || agree(state_.past, whole.sums, state_.bounds, state_.change, alike()))) {
    whole.sums.add(state_.past);
    whole.samples += state_.past.rows / newton_joints_;
    whole.begin_ns = state_.begin_ns;
  }
  if (all) whole.begin_ns = state_.begin_ns;
  return whole;
}

// Whether both loads have the same torques: within one sigma, or a tenth.
bool ExpectedLoad::same(const Stretch& stretch, const LoadChange& one, const LoadChange& other) const noexcept {
  const double apart = stretch.sums.size(less(one, other));
  return apart < stretch.samples || apart < kSameShare * stretch.sums.size(other);
}

std::array<double, 16> ExpectedLoad::covariance_of(const Stretch& stretch, const LoadChange& change) const noexcept {
  std::array<double, 16> out = stretch.sums.covariance(state_.bounds, change, std::max(1.0, kErrorLasts_s / period_s_));
  const double misfit = std::max(stretch.sums.misfit(change), kLeastMisfit);
  for (double& value : out) value *= misfit;
  return out;
}

double ExpectedLoad::error_of(const Stretch& stretch, const LoadChange& change) const noexcept {
  return std::sqrt(covariance_of(stretch, change)[0]);
}

// Whether their torques at the last sample differ by more than a share of some joint's limit.
bool ExpectedLoad::shows(const LoadChange& one, const LoadChange& other, double share) const noexcept {
  const auto from = ten_of(one), to = ten_of(other);
  for (std::size_t j = 0; j < static_cast<std::size_t>(joints_); ++j) {
    if (units_per_nm_[j] > 0) continue;
    const double apart = torque(columns_.shown().load, from, j) - torque(columns_.shown().load, to, j);
    if (std::fabs(apart) > share * state_.limit_nm[j]) return true;
  }
  return false;
}

ExpectedLoad::Decision ExpectedLoad::decide_held() noexcept {
  State& s = state_;
  const Stretch recent = last_blocks(0, kStretchBlocks), old = last_blocks(kStretchBlocks, kStretchBlocks);
  if (recent.samples > 0) {
    const LoadChange now = recent.sums.solve(s.bounds, s.change);
    const double size = recent.sums.size(less(now, s.set)) / recent.samples;
    // The first is insensitive to growth because of raised limits, the second to poses.
    const bool heavier = std::fabs(now[0] - s.set[0]) > std::sqrt(kGrowth) * std::fabs(s.most[0] - s.set[0]) + kHeavier_kg;
    if (size > kGrowth * s.most_size || heavier) {
      s.most_size = std::max(s.most_size, size);
      s.most = now;
      s.grown_ns = s.t_ns;
    }
    const Stretch last = last_blocks(0, 1);
    if (last.samples > 0 && last.sums.left(s.most) - last.sums.left(s.set) > kSure * kSure * alike()) return give_alarm();
    if (old.samples > 0 && s.count >= 2 * kStretchBlocks && s.t_ns - s.held_ns >= to_ns(2 * kStretch_s)) {
      const LoadChange then = old.sums.solve(s.bounds, s.change);
      Stretch both = recent;
      both.sums.add(old.sums);
      both.samples += old.samples;
      both.begin_ns = old.begin_ns;
      const LoadChange change = both.sums.solve(s.bounds, now);
      const bool sure = std::fabs(change[0]) > kSure * std::sqrt(both.sums.covariance(s.bounds, change, alike())[0]);
      const bool explains = both.sums.left(change) < kUnexplained * both.sums.left(s.set);
      if (sure && explains && same(recent, then, now) && both.sums.misfit(change) < kPoor) return take(both, change);
    }
  }
  if (s.t_ns - s.grown_ns > to_ns(kDecide_s) || s.t_ns - s.held_ns > to_ns(kLongest_s)) return give_alarm();
  return {};
}

// Updates the load with a better estimate.
ExpectedLoad::Decision ExpectedLoad::refine() noexcept {
  State& s = state_;
  s.refine_ns = s.t_ns + to_ns(kStretch_s);
  const Stretch whole = agreeing(), recent = last_blocks(0, kStretchBlocks);
  if (whole.samples == 0 || recent.samples == 0) return {};
  const LoadChange change = whole.sums.solve(s.bounds, s.change);
  if (recent.sums.misfit(change) >= kPoor || !shows(change, s.set, kWorth)) return {};
  return take(whole, change);
}

// After the window, with nothing held back: the final estimate, also of loads too light for an alarm.
ExpectedLoad::Decision ExpectedLoad::finish() noexcept {
  State& s = state_;
  const Stretch whole = agreeing();
  Decision decision;
  if (whole.samples > 0 && s.count >= 4 * kStretchBlocks) {
    const LoadChange change = whole.sums.solve(s.bounds, s.change);
    const bool sure = std::fabs(change[0]) > kSure * error_of(whole, change);
    if (whole.sums.misfit(change) < kPoor && (s.has_set || sure)) decision = take(whole, change);
  }
  if (s.has_set && on())
    s.phase = LoadPhase::weighing;
  else
    stop();
  return decision;
}

ExpectedLoad::Decision ExpectedLoad::take(const Stretch& stretch, LoadChange change) noexcept {
  State& s = state_;
  const double error = error_of(stretch, change);
  bool ends = false;
  if (change[0] < 0) {  // removed completely, if that explains the data as well
    const Load& c = s.carried;
    const LoadChange all = {-c.mass, -c.mass * c.com[0], -c.mass * c.com[1], -c.mass * c.com[2]};
    ends = c.mass + change[0] < std::min(kSure * error, kRest * c.mass) || same(stretch, change, all);
    if (ends) change = all;
  }
  Load load = changed(s.carried, change);
  const double far = std::hypot(load.com[0], load.com[1], load.com[2]);
  if (far > settings_.largest_reach_m)  // after most of the load was removed, the rest is poorly located
    for (double& c : load.com) c *= 0.99 * settings_.largest_reach_m / far;
  if (settings_.fault(load) != LoadFault::none) return s.held != Alarm::none ? give_alarm() : Decision{};
  s.set = s.change = change;
  s.has_set = true;
  s.held = Alarm::none;
  if (s.phase != LoadPhase::weighing) s.phase = LoadPhase::found;
  if (stretch.begin_ns > s.begin_ns) s.past = {};
  s.covariance = covariance_of(stretch, change);
  s.found_ns = s.t_ns;
  s.error_kg = std::hypot(error, constants_share_ * change[0]);
  s.refine_ns = s.t_ns + to_ns(kStretch_s);
  s.begin_ns = stretch.begin_ns;
  usual_.acknowledge();
  if (change[0] > 0) s.bounds.low_kg = std::max(s.bounds.low_kg, kKept * change[0]);
  if (change[0] < 0) s.bounds.high_kg = std::min(s.bounds.high_kg, kKept * change[0]);
  Decision decision;
  decision.sets = true;
  decision.load = load;
  decision.since_ns = stretch.begin_ns - to_ns(kForgotten / gain_per_s_);
  if (ends) stop();
  return decision;
}

// Decides that the contact was not a load.
ExpectedLoad::Decision ExpectedLoad::give_alarm() noexcept {
  State& s = state_;
  Decision decision;
  decision.alarm = s.fails ? Alarm::none : s.held;  // the unexplained torque already raised its own alarm
  decision.joint = s.joint;
  s.fails = false;
  s.held = Alarm::none;
  s.failed = true;
  s.held_ns = s.t_ns;
  s.phase = LoadPhase::weighing;
  if (!s.has_set) stop();
  return decision;
}

// The stamps jumped: nothing that was held back waits for a time of the old clock.
ExpectedLoad::Decision ExpectedLoad::end_by_jump() noexcept {
  Decision decision;
  decision.alarm = state_.held;
  decision.joint = state_.joint;
  stop();
  return decision;
}

// Two stretches after the alarm: removes a load set in this window if no load at all explains the torques better.
ExpectedLoad::Decision ExpectedLoad::take_back() noexcept {
  State& s = state_;
  Decision decision;
  if (s.t_ns - s.held_ns < to_ns(2 * kStretch_s)) return decision;
  const Stretch recent = last_blocks(0, kStretchBlocks);
  if (recent.samples > 0 && recent.sums.left({}) < recent.sums.left(s.set)) {
    decision.sets = true;
    decision.load = s.carried;
    s.found_ns = 0;
  }
  stop();
  return decision;
}

}  // namespace tauext
