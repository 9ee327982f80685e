#include "touch/touch_kind.hpp"

#include <algorithm>
#include <cmath>

#include "load/load_solve.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

constexpr std::int64_t kBlock_ns = 10'000'000;
constexpr auto kRecent_ns = static_cast<std::int64_t>(1e9 * TouchKind::kRecent_s);
constexpr double kGap_s = 0.1;  // longest time without an estimate over which S and x stay valid

// The load frame, or the frame of the link that most joints carry.
LoadFrame frame_of(const Bundle& bundle) {
  if (bundle.load.link >= 0) return load_frame(bundle.load);
  int most = -1;
  LoadFrame frame;
  for (int link = 0; link < bundle.joints(); ++link) {
    int carriers = 0;
    for (int at = link; at >= 0; at = bundle.links[static_cast<std::size_t>(at)].parent) ++carriers;
    if (carriers >= most) {
      most = carriers;
      frame.link = link;
    }
  }
  return frame;
}

}  // namespace

const char* name(Touch touch) noexcept {
  constexpr const char* names[] = {"none", "unknown", "impact", "push", "clamp", "load"};
  return touch <= Touch::load ? names[static_cast<int>(touch)] : "";
}

TouchKind::TouchKind(const Bundle& bundle)
    : joints_(bundle.links.size()),
      possible_(bundle.observer.unfiltered_momentum()),
      gain_per_s_(bundle.observer.gain_per_s),
      stands_rad_s_(std::max(kStands_rad_s, bundle.limits.near_stiction_rad_s)),
      block_ns_(kBlock_ns - std::min(bundle.observer.sample_period_ns, kBlock_ns) / 2),
      weight_(Tree(bundle.links, bundle.gravity), frame_of(bundle)),
      bounds_{0, bundle.load.settable() ? bundle.load.largest_mass_kg : kHeaviest_kg, kReach_m} {}

void TouchKind::restart() noexcept {
  state_.lost = true;
  state_.timed = state_.touching = false;
}

void TouchKind::step(const Seen& seen) noexcept {
  State& s = state_;
  if (!seen.alarm) {
    s.kind = Touch::none;
    s.alarmed = false;
  }
  if (!possible_ || !follow(seen)) return;
  double largest = 0;
  int strongest = -1;
  for (std::size_t j = 0; j < joints_; ++j) {
    const double size = std::fabs(seen.tau_ext[j]) / seen.limit_nm[j];
    if (!(size > largest)) continue;
    largest = size;
    strongest = static_cast<int>(j);
  }
  if (largest <= kBegins) s.lost = false;
  if (s.lost) return;
  if (largest > kBegins && strongest != s.strongest) {  // another joint's earlier deviation was an error
    if (s.touching && !s.alarmed && elapsed_s(seen.t_ns, s.begin_ns) > kRecent_s) s.touching = false;
    s.strongest = strongest;
  }
  if (largest > kBegins && !s.touching) begin(seen);
  if (!s.touching) return;
  if (largest > kBegins) s.over_ns = seen.t_ns;
  if (largest <= kBegins && (!s.alarmed || elapsed_s(seen.t_ns, s.over_ns) > kOver_s))
    s.touching = false;
  else
    update(seen);
}

// Speed and position, filtered as by the observer. Returns false if there is nothing to evaluate.
bool TouchKind::follow(const Seen& seen) noexcept {
  State& s = state_;
  for (std::size_t j = 0; j < joints_; ++j)
    if (!std::isfinite(seen.tau_ext[j]) || !(seen.limit_nm[j] > 0)) return false;
  const std::int64_t step_ns = s.timed ? seen.t_ns - s.t_ns : 0;
  const double dt_s = s.timed ? elapsed_s(seen.t_ns, s.t_ns) : 0;
  if (dt_s > kGap_s) restart();
  const double share = s.timed ? s.share.of(step_ns, -gain_per_s_ * dt_s) : 1;
  for (std::size_t j = 0; j < joints_; ++j) {
    s.speed[j] += share * (seen.dq[j] - s.speed[j]);
    s.place[j] += s.speed[j] * dt_s;
  }
  if (!s.timed) s.past.fill(s.speed);
  if (!s.timed || elapsed_s(seen.t_ns, s.past_ns) >= kBefore_s / (kPast - 1)) {
    s.past[s.past_next] = s.speed;
    s.past_next = (s.past_next + 1) % kPast;
    s.past_ns = seen.t_ns;
  }
  s.timed = true;
  s.dt_s = dt_s;
  s.t_ns = seen.t_ns;
  return true;
}

void TouchKind::begin(const Seen& seen) noexcept {
  State& s = state_;
  s.touching = true;
  s.alarmed = s.bounced = false;
  s.begin_ns = s.peak_ns = seen.t_ns;
  s.base = -1;
  s.peak = s.way = s.came = s.fastest = s.steepest = s.yields = s.decided_size = 0;
  s.candidate = Touch::none;
  s.load = {};
  s.count = s.next = 0;
  s.speed_at = s.speed;
  s.speed_before = s.past[s.past_next];  // the oldest
  s.place = {};
  std::ranges::copy(seen.limit_nm, s.limit_nm.begin());
}

// Whether the joint's speed and torque determine a direction.
bool TouchKind::strong(const Seen& seen, std::size_t joint) const noexcept {
  double most = 0;
  for (std::size_t j = 0; j < joints_; ++j) most = std::max(most, std::fabs(seen.tau_ext[j]) / state_.limit_nm[j]);
  return std::fabs(seen.tau_ext[joint]) >= std::min(kStrong * most, kSurely) * state_.limit_nm[joint];
}

// Updates S, x and their peaks.
void TouchKind::measure(const Seen& seen) noexcept {
  State& s = state_;
  double squares = 0, power = 0;
  for (std::size_t j = 0; j < joints_; ++j) {
    const double size = seen.tau_ext[j] / s.limit_nm[j];
    squares += size * size;
    if (strong(seen, j)) power -= seen.tau_ext[j] * s.speed[j];
  }
  s.size = std::sqrt(squares);
  const bool first = s.base < 0;
  if (first) s.base = s.size;
  else s.way += power / s.size * s.dt_s;
  if (s.size > s.peak) {
    s.peak = s.size;
    s.peak_ns = seen.t_ns;
  }
  if (!seen.over || s.alarmed) return;
  s.alarmed = true;
  s.alarm_ns = seen.t_ns;
  s.kind = Touch::unknown;
  s.came = first ? power / s.size : s.way / elapsed_s(seen.t_ns, s.begin_ns);
}

// Updates the sums with this sample.
void TouchKind::update(const Seen& seen) noexcept {
  State& s = state_;
  measure(seen);
  if (s.count > 0 && seen.t_ns - before(seen.t_ns).t_ns < block_ns_) return;
  close_block(seen);
  const Stretch recent = recent_blocks();
  if (recent.s > 0) {
    s.fastest = std::max(s.fastest, recent.grown / recent.s);
    s.yields = std::max(s.yields, -recent.gone / recent.s);
  }
  if (s.alarmed) decide(recent, seen);
}

void TouchKind::close_block(const Seen& seen) noexcept {
  State& s = state_;
  s.blocks[s.next] = {seen.t_ns, s.size, s.way, left_by_load(seen)};
  s.next = (s.next + 1) % kBlocks;
  s.count = std::min(s.count + 1, kBlocks);
}

// The newest block of at least this age, or the oldest.
const TouchKind::Block& TouchKind::before(std::int64_t t_ns) const noexcept {
  std::size_t at = state_.next;
  for (std::size_t k = 0; k < state_.count; ++k) {
    at = (state_.next + kBlocks - 1 - k) % kBlocks;
    if (state_.blocks[at].t_ns <= t_ns) break;
  }
  return state_.blocks[at];
}

bool TouchKind::moves(const JointVector& speed, const Seen& seen) const noexcept {
  for (std::size_t j = 0; j < joints_; ++j)
    if (std::fabs(speed[j]) > stands_rad_s_ && strong(seen, j)) return true;
  return false;
}

// Power of such a speed against the torque beyond its error.
double TouchKind::against(const JointVector& speed, const Seen& seen) const noexcept {
  double power = 0;
  for (std::size_t j = 0; j < joints_; ++j) {
    const double shows = std::max(std::fabs(seen.tau_ext[j]) - kBegins * state_.limit_nm[j], 0.0);
    power -= std::copysign(shows, seen.tau_ext[j]) * speed[j];
  }
  return power;
}

// A stretch of 0 s if there are not enough blocks.
TouchKind::Stretch TouchKind::recent_blocks() const noexcept {
  const State& s = state_;
  const Block& old = before(s.t_ns - kRecent_ns);
  const double recent_s = elapsed_s(s.t_ns, old.t_ns);
  if (recent_s < 0.9 * kRecent_s) return {0, 0, 0};
  return {s.size - old.size, s.way - old.way, recent_s};
}

// Squared residual of tau_ext after the best-fitting weight.
double TouchKind::left_by_load(const Seen& seen) noexcept {
  State& s = state_;
  const JointVector still{};
  weight_.compute(seen.q, std::span(still).first(joints_));
  JointVector pull, sigma;  // a load adds to beta, so tau_ext shows the opposite sign
  for (std::size_t j = 0; j < joints_; ++j) {
    pull[j] = -seen.tau_ext[j];
    sigma[j] = kSigmaOfLimit * s.limit_nm[j];
  }
  ChangeSums sums;
  sums.add(weight_.beta(), std::span(pull).first(joints_), still, std::span(sigma).first(joints_));
  s.load = sums.solve(bounds_, s.load);
  return kSigmaOfLimit * kSigmaOfLimit * sums.left(s.load);
}

// Over the recent blocks; a weight of zero does not count.
bool TouchKind::fits_load() const noexcept {
  const State& s = state_;
  if (!(s.load[0] > 0)) return false;
  double left = 0, squares = 0, rows = 0;
  for (std::size_t k = 0; k < s.count; ++k) {
    const Block& block = s.blocks[(s.next + kBlocks - 1 - k) % kBlocks];
    if (elapsed_s(s.t_ns, block.t_ns) > kRecent_s) break;
    left += block.left;
    squares += block.size * block.size;
    rows += static_cast<double>(joints_);
  }
  return left <= kFitNoise * kFitNoise * rows + kFitModel * kFitModel * squares;
}

// Detects an impact: S rose and fell quickly. A touch that returns, or persists after r has responded, is none.
bool TouchKind::bounces(bool over) noexcept {
  State& s = state_;
  if (s.bounced) {
    const bool stays = over && elapsed_s(s.t_ns, s.peak_ns) > kBounce_s + 3 / gain_per_s_;
    if (stays || s.size > std::max(1.0, kBack * s.peak)) {
      s.bounced = false;
      s.kind = Touch::unknown;
      s.candidate = Touch::none;
    }
  } else if (s.size <= kFell * s.peak && elapsed_s(s.peak_ns, s.begin_ns) <= kBounce_s + 1.5 / gain_per_s_ &&
             elapsed_s(s.t_ns, s.peak_ns) <= kBounce_s + 0.7 / gain_per_s_ + 0.01) {
    s.bounced = true;
    s.kind = Touch::impact;
  }
  return s.bounced;
}

void TouchKind::decide(const Stretch& recent, const Seen& seen) noexcept {
  State& s = state_;
  if (bounces(seen.over)) return;
  const Touch found = classify(recent, seen);
  if (found != s.candidate) {
    s.candidate = found;
    s.candidate_ns = s.t_ns;
  }
  const bool open = s.kind == Touch::unknown || s.kind == Touch::impact || elapsed_s(s.t_ns, s.alarm_ns) <= kDecided_s;
  const bool sure = found != Touch::none && elapsed_s(s.t_ns, s.candidate_ns) >= kSure_s - 1e-6;
  const bool lets_go = s.kind == Touch::clamp && found == Touch::push;  // an arm that slips off looks the same
  if (open && sure && found != s.kind && !lets_go) {
    s.kind = found;
    s.decided_size = s.size;
  }
  const bool may_turn = s.kind == Touch::push || s.kind == Touch::load;
  if (open || !may_turn || s.size <= kDoubled * s.decided_size) return;
  s.alarm_ns = s.begin_ns = s.t_ns;  // larger than a constant hand force or a weight
  s.base = s.peak = s.size;
  s.way = s.fastest = s.steepest = s.yields = 0;
  s.count = s.next = 0;
  s.speed_at = s.speed_before = s.speed;
  s.place = {};
  s.candidate = Touch::none;
  s.kind = Touch::unknown;
}

// Classifies by the recent blocks; none: undecided.
Touch TouchKind::classify(const Stretch& recent, const Seen& seen) noexcept {
  State& s = state_;
  if (!(recent.s > 0)) return Touch::none;
  const double since_s = elapsed_s(s.t_ns, s.alarm_ns);
  const bool moved = moves(s.speed_at, seen), driven = moved && s.came > 0;
  const bool away = s.came < 0 && moves(s.speed_before, seen) && against(s.speed_before, seen) < 0;
  const bool doubtful = moved && !driven && against(s.speed_at, seen) > 0;  // contradicts the work
  Touch it = Touch::push;  // an arm that moves away by itself cannot be clamped
  if (driven) it = driven_into(recent, since_s);
  else if (!away) it = standing(recent, seen, since_s);
  if (since_s < kFirst_s) return Touch::none;
  if (fits_load()) return Touch::load;
  return doubtful ? Touch::none : it;
}

// The arm was driven into the contact: does the contact yield?
Touch TouchKind::driven_into(const Stretch& recent, double since_s) noexcept {
  State& s = state_;
  if (recent.gone >= kOnward * s.came * recent.s) {
    const double steep = recent.grown / recent.gone;
    s.steepest = std::max(s.steepest, steep);
    const bool soft = steep <= 0 || steep * steep * s.way < kSoft * (s.size - s.base) * s.steepest;
    if (soft && (since_s < kDriven_s || s.kind == Touch::push)) return Touch::push;  // later it may be slipping off
  }
  const bool stopped = recent.gone < kStopped * s.came * recent.s && s.size >= kHeld * s.peak && since_s > kAlong_s;
  return stopped || since_s >= kDriven_s ? Touch::clamp : Touch::none;
}

// The contact moved the arm, or nothing moves: has the force stopped growing?
Touch TouchKind::standing(const Stretch& recent, const Seen& seen, double since_s) const noexcept {
  const State& s = state_;
  const double growth = recent.grown / recent.s, mean = (s.size - s.base) / elapsed_s(s.t_ns, s.begin_ns);
  const double steady = growth > 0 && mean > 0 ? growth / mean * growth / s.fastest : 0;
  bool stuck = true;
  for (std::size_t j = 0; j < joints_; ++j) stuck = stuck && (std::fabs(s.place[j]) < kStuck_rad || !strong(seen, j));
  const bool comes_on = !stuck && -recent.gone > kYields * s.yields * recent.s;
  const bool settled = steady < kFlat || (steady < kSettled && (s.fastest - growth) * recent.s > kShows);
  if (settled && !comes_on) return Touch::push;
  return since_s >= kStanding_s && steady >= kGrowing ? Touch::clamp : Touch::none;
}

}  // namespace tauext
