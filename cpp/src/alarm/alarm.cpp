#include "alarm/alarm.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace tauext {
namespace {

std::uint64_t to_ns(double seconds) noexcept { return static_cast<std::uint64_t>(std::llround(seconds * 1e9)); }

constexpr std::uint64_t kSlidNs = static_cast<std::uint64_t>(Limits::kSlidS * 1e9);
constexpr std::int64_t kNever = std::numeric_limits<std::int64_t>::min();

}  // namespace

const char* name(Alarm alarm) noexcept {
  constexpr const char* names[] = {"none", "contact", "collision"};
  return alarm <= Alarm::collision ? names[static_cast<int>(alarm)] : "";
}

AlarmStage::AlarmStage(int joints, int widths, const Limits& limits)
    : joints_(joints),
      limits_(limits),
      collision_hold_ns_(to_ns(limits.collision.hold_s)),
      contact_hold_ns_(to_ns(limits.contact.hold_s)),
      contact_release_ns_(to_ns(limits.contact_release_s)) {
  limits.validate(joints, widths);
  reset();
}

void AlarmStage::reset() noexcept {
  state_ = {};
  acknowledge();
}

void AlarmStage::acknowledge() noexcept {
  const State before = state_;
  state_ = {};
  state_.pushed = before.pushed;  // the prior's friction does not model the push
  state_.touching = before.touching;
  state_.stuck_t_ns = before.stuck_t_ns;
  state_.number = before.number;
  state_.collision_since_ns.fill(kNever);
  state_.contact_since_ns.fill(kNever);
}

bool AlarmStage::set_factors(std::span<const double> collision, std::span<const double> contact) noexcept {
  const auto bounded = [&](std::span<const double> factors) noexcept {
    return factors.size() == static_cast<std::size_t>(joints_) && std::ranges::all_of(factors, [](double factor) {
             return factor >= LimitFactors::kLowest && factor <= LimitFactors::kHighest;  // false for NaN
           });
  };
  if (!bounded(collision) || !bounded(contact)) return false;
  std::ranges::copy(collision, factors_.collision.begin());
  std::ranges::copy(contact, factors_.contact.begin());
  return true;
}

bool AlarmStage::step(std::int64_t t_ns, const JointVector& tau_ext, const JointVector& scale, const JointVector& doubt,
                      std::uint32_t near_stiction, bool trusted, JointVector& limit_nm, JointVector& contact_limit_nm,
                      const JointVector& spread_nm, bool pressed) noexcept {
  for (int j = 0; state_.pushed != 0 && j < joints_; ++j) {
    const std::uint32_t bit = std::uint32_t{1} << j;
    if (near_stiction & bit) state_.stuck_t_ns[j] = t_ns;
    else if (elapsed_ns(t_ns, state_.stuck_t_ns[j]) >= kSlidNs) state_.pushed &= ~bit;
  }
  const std::uint32_t raised = state_.touching || pressed ? 0 : state_.pushed;
  bool detection = false, touching = false;
  // The alarm's joint is the one furthest over its limit among those whose hold time has passed.
  int collision_joint = -1, contact_joint = -1;
  double collision_excess = 0, contact_excess = 0;
  for (int j = 0; j < joints_; ++j) {
    const bool near = near_stiction >> j & 1;
    const double times = (raised >> j & 1 ? limits_.after_contact_factor : 1.0) * scale[j];
    const double spread = spread_nm[j];
    const auto limit = [&](const Level& level, double factor) noexcept {
      const double free = times * factor * limits_.limit_nm(level, j, near);
      return (spread > 0 ? std::sqrt(free * free + spread * spread) : free) + doubt[j];
    };
    limit_nm[j] = limit(limits_.collision, factors_.collision[j]);
    const double size = trusted ? std::fabs(tau_ext[j]) : 0.0;
    const auto held = [&](bool over, std::int64_t& since_ns, std::uint64_t hold_ns) noexcept {
      if (!over) since_ns = kNever;
      if (over && since_ns == kNever) since_ns = t_ns;
      return over && elapsed_ns(t_ns, since_ns) >= hold_ns;
    };
    const double contact_limit = limit(limits_.contact, factors_.contact[j]);
    contact_limit_nm[j] = contact_limit;
    const bool over = size > limit_nm[j], over_contact = size > contact_limit;
    detection = detection || over;
    touching = touching || over_contact;
    if (held(over, state_.collision_since_ns[j], collision_hold_ns_) && size / limit_nm[j] > collision_excess) {
      collision_excess = size / limit_nm[j];
      collision_joint = j;
    }
    if (held(over_contact, state_.contact_since_ns[j], contact_hold_ns_) && size / contact_limit > contact_excess) {
      contact_excess = size / contact_limit;
      contact_joint = j;
    }
  }
  state_.held_alarm = collision_joint >= 0 ? Alarm::collision : contact_joint >= 0 ? Alarm::contact : Alarm::none;
  const bool touched = touching || detection;  // a profile may put the limit of a contact above that of a collision
  if (touched) state_.touch_t_ns = t_ns;
  if (touched || !trusted) state_.contact_seen_ns = t_ns;
  state_.touch_over = trusted && !touched && elapsed_ns(t_ns, state_.contact_seen_ns) >= contact_release_ns_;
  for (int j = 0; (touching || pressed) && j < joints_; ++j)
    if (near_stiction >> j & 1) state_.stuck_t_ns[j] = t_ns;
  if (touching || pressed) state_.pushed |= near_stiction;
  state_.touching = touching;
  if (state_.alarm != Alarm::collision && collision_joint >= 0) {
    rise(Alarm::collision, collision_joint, t_ns);
  } else if (state_.alarm == Alarm::none && contact_joint >= 0) {
    rise(Alarm::contact, contact_joint, t_ns);
  } else if (state_.alarm == Alarm::contact && state_.touch_over) {
    state_.alarm = Alarm::none;
    state_.joint = -1;
  }
  return detection;
}

}  // namespace tauext
