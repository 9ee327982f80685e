// What ExpectedLoad does with what it has seen: a load, an alarm, or a better estimate.
#include <algorithm>
#include <cmath>

#include "expected_load_parts.hpp"
#include "tauext/expected_load.hpp"

namespace tauext {

ExpectedLoad::Decision ExpectedLoad::decide() noexcept {
  State& s = state_;
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
  if (s.count > 0 && block(0).samples == 0) return;  // nothing was judged
  if (s.count == kBlocks && s.has_set && s.blocks[s.next].begin_ns >= s.begin_ns) s.past.add(s.blocks[s.next].sums);
  s.blocks[s.next] = {};
  s.next = (s.next + 1) % kBlocks;
  s.count = std::min(s.count + 1, kBlocks);
}

// `count` blocks, the newest of them `from` blocks ago.
ExpectedLoad::Stretch ExpectedLoad::last_blocks(std::size_t from, std::size_t count) const noexcept {
  Stretch out;
  for (std::size_t k = from; k < from + count && k < state_.count; ++k) {
    out.sums.add(block(k).sums);
    out.samples += block(k).samples;
    out.begin_ns = block(k).begin_ns;
  }
  return out;
}

// The longest stretch up to now whose parts agree with what came after them; once the window is over, all since the load
// was found.
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
    whole.samples += state_.past.rows / told_;
    whole.begin_ns = state_.begin_ns;
  }
  if (all) whole.begin_ns = state_.begin_ns;
  return whole;
}

// Whether the torques of both are the same there: within a sigma, or a tenth.
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

// Whether their torques differ at the last sample by more than a share of some joint's limit.
bool ExpectedLoad::shows(const LoadChange& one, const LoadChange& other, double share) const noexcept {
  const auto from = ten_of(one), to = ten_of(other);
  for (std::size_t j = 0; j < static_cast<std::size_t>(joints_); ++j) {
    if (units_per_nm_[j] > 0) continue;
    const double apart = torque(columns_.state().load, from, j) - torque(columns_.state().load, to, j);
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
    // Limits that rise hide growth in the one, poses in the other.
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

// A better estimate of the load that is set.
ExpectedLoad::Decision ExpectedLoad::refine() noexcept {
  State& s = state_;
  s.refine_ns = s.t_ns + to_ns(kStretch_s);
  const Stretch whole = agreeing(), recent = last_blocks(0, kStretchBlocks);
  if (whole.samples == 0 || recent.samples == 0) return {};
  const LoadChange change = whole.sums.solve(s.bounds, s.change);
  if (recent.sums.misfit(change) >= kPoor || !shows(change, s.set, kWorth)) return {};
  return take(whole, change);
}

// The window is over and nothing is held back: what is known of the load by now, or of one too light for an alarm.
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
  if (change[0] < 0) {  // nothing left, where that explains as much
    const Load& c = s.carried;
    const LoadChange all = {-c.mass, -c.mass * c.com[0], -c.mass * c.com[1], -c.mass * c.com[2]};
    ends = c.mass + change[0] < std::min(kSure * error, kRest * c.mass) || same(stretch, change, all);
    if (ends) change = all;
  }
  Load load = changed(s.carried, change);
  const double far = std::hypot(load.com[0], load.com[1], load.com[2]);
  if (far > settings_.largest_reach_m)  // the little that is left after most has gone may seem to be anywhere
    for (double& c : load.com) c *= 0.99 * settings_.largest_reach_m / far;
  if (settings_.fault(load) != LoadFault::none) return s.held != Alarm::none ? give_alarm() : Decision{};
  s.set = s.change = change;
  s.has_set = true;
  s.held = Alarm::none;
  if (s.phase != LoadPhase::weighing) s.phase = LoadPhase::found;
  if (stretch.begin_ns > s.begin_ns) s.past = {};
  s.covariance = covariance_of(stretch, change);
  s.found_ns = s.t_ns;
  s.error_kg = error;
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

// It was none.
ExpectedLoad::Decision ExpectedLoad::give_alarm() noexcept {
  State& s = state_;
  Decision decision;
  decision.alarm = s.fails ? Alarm::none : s.held;  // what no load explains has raised its own
  decision.joint = s.joint;
  s.fails = false;
  s.held = Alarm::none;
  s.failed = true;
  s.held_ns = s.t_ns;
  s.phase = LoadPhase::weighing;
  if (!s.has_set) stop();
  return decision;
}

// Two stretches after the alarm, r shows what is there: a load that was set in this window goes again where nothing at
// all explains more than it does.
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
