#include "touch/declared_contacts.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iterator>
#include <limits>
#include <vector>

#include "bundle/linear.hpp"
#include "prior/prior.hpp"
#include "tauext/bundle.hpp"

namespace tauext {

const char* name(Declared declared) noexcept {
  constexpr const char* names[] = {"none", "within", "beyond", "moved"};
  return declared <= Declared::moved ? names[static_cast<int>(declared)] : "";
}

namespace {

constexpr double kQuarterTurn = 1.5707963267948966;

// Of unit length; zeros stay zeros.
Vector3 unit(const std::array<double, 3>& v) noexcept {
  const Vector3 a = vector3(v);
  const double size = std::sqrt(dot(a, a));
  return size > 0 ? 1 / size * a : Vector3{0, 0, 0};
}

std::array<double, 3> listed(Vector3 v) noexcept { return {v.x, v.y, v.z}; }

ForceCone cone_of(const DeclaredContact& contact) noexcept {
  const double cosine = contact.half_angle_rad > 0 ? std::cos(contact.half_angle_rad) : 1.0;
  const double sine = contact.half_angle_rad > 0 ? std::sin(contact.half_angle_rad) : 0.0;
  return {unit(contact.axis), cosine, sine, std::numeric_limits<double>::infinity()};
}

// What the drive of a joint can give: its limit or, where that is unknown or training passed it, what no sample may exceed.
double drive_torque(const SignalRanges& signals, std::size_t joint) noexcept {
  const double limit = signals.torque_limit_nm[joint], largest = signals.largest_torque_nm[joint], possible = signals.possible_torque_nm[joint];
  if (std::isfinite(limit) && limit >= largest) return limit;
  return std::isfinite(possible) ? possible : DeclaredContacts::kBeyondTraining * largest;
}

bool all_finite(const std::array<double, 3>& values) noexcept {
  return std::ranges::all_of(values, [](double value) { return std::isfinite(value); });
}

// From a moment about a point to one about the frame's origin; lever: from the origin to the point. A force alone has the moment of
// its lever.
void about_origin(Vector3 lever, Wrench& w) noexcept {
  const Vector3 moment = cross(lever, vector3(w.force));
  w.moment = w.unknowns == 6 ? listed(vector3(w.moment) + moment) : listed(moment);
  if (w.unknowns != 6) return;
  const auto add = [&](double* at, std::size_t step, double share) noexcept {  // to the moment, what the force brings
    const Vector3 v = share * cross(lever, {at[0], at[step], at[2 * step]});
    at[3 * step] += v.x, at[4 * step] += v.y, at[5 * step] += v.z;
  };
  for (std::size_t column = 0; column < 6; ++column) add(w.covariance.data() + column, 6, 1);
  for (std::size_t row = 0; row < 6; ++row) add(w.covariance.data() + 6 * row, 1, 1);
  for (std::size_t k = 0; k < static_cast<std::size_t>(w.blind); ++k) {
    auto& d = w.blind_directions[k];
    add(d.data(), 1, 1 / WrenchModel::kLength_m);
    double square = 0;
    for (const double part : d) square += part * part;
    for (double& part : d) part /= std::sqrt(square);
  }
}

// From the base's axes to the frame's.
void turn_into(const Turn& base, Wrench& w) noexcept {
  const auto m = static_cast<std::size_t>(w.unknowns);
  w.force = listed(base.back(vector3(w.force)));
  w.moment = listed(base.back(vector3(w.moment)));
  for (std::size_t k = 0; k < static_cast<std::size_t>(w.blind); ++k)
    for (std::size_t part = 0; part < m; part += 3) {
      auto& d = w.blind_directions[k];
      const Vector3 v = base.back({d[part], d[part + 1], d[part + 2]});
      d[part] = v.x, d[part + 1] = v.y, d[part + 2] = v.z;
    }
  const auto turned = [&](std::size_t from, std::size_t step) noexcept {  // three numbers of the covariance, step apart
    double* at = w.covariance.data() + from;
    const Vector3 v = base.back({at[0], at[step], at[2 * step]});
    at[0] = v.x, at[step] = v.y, at[2 * step] = v.z;
  };
  for (std::size_t row = 0; row < m; ++row)
    for (std::size_t part = 0; part < m; part += 3) turned(row * m + part, 1);
  for (std::size_t column = 0; column < m; ++column)
    for (std::size_t part = 0; part < m; part += 3) turned(part * m + column, m);
}

}  // namespace

// Orthonormal basis of joint torques, which grows by vectors that it does not hold yet.
class TorqueSpan {
 public:
  int rank() const noexcept { return rank_; }
  void add(JointVector torque, std::size_t n) noexcept {
    double size = 0, left = 0;
    for (std::size_t j = 0; j < n; ++j) size += torque[j] * torque[j];
    for (int b = 0; b < rank_; ++b) {
      const JointVector& one = basis_[static_cast<std::size_t>(b)];
      double along = 0;
      for (std::size_t j = 0; j < n; ++j) along += one[j] * torque[j];
      for (std::size_t j = 0; j < n; ++j) torque[j] -= along * one[j];
    }
    for (std::size_t j = 0; j < n; ++j) left += torque[j] * torque[j];
    if (!(left > kNothing * size)) return;
    for (std::size_t j = 0; j < n; ++j) basis_[static_cast<std::size_t>(rank_)][j] = torque[j] / std::sqrt(left);
    ++rank_;
  }

 private:
  static constexpr double kNothing = 1e-8;  // squared
  std::array<JointVector, 12> basis_;
  int rank_ = 0;
};

DeclaredContacts::DeclaredContacts(const Bundle& bundle, const WrenchModel& wrench)
    : wrench_(&wrench), joints_(bundle.joints()), gain_per_s_(bundle.observer.gain_per_s), spread_(bundle.limits.declared_spread) {
  for (int j = 0; j < joints_; ++j) {
    told_[static_cast<std::size_t>(j)] = bundle.in_newtons(j);
    monitored_[static_cast<std::size_t>(j)] = bundle.limits.monitors(j);
    friction_nm_[j] = friction_line(bundle.prior, static_cast<std::size_t>(j)).at_rest_nm;
    drive_nm_[j] = drive_torque(bundle.signals, static_cast<std::size_t>(j));
  }
}

ContactFault DeclaredContacts::fault(const DeclaredContact& contact, double seconds) const noexcept {
  const bool of_joint = contact.joint >= 0 && contact.joint < joints_ && contact.frame < 0;
  const bool at_frame = contact.frame >= 0 && contact.frame < wrench_->frames() && contact.joint < 0;
  if (!of_joint && !at_frame) return ContactFault::no_frame;
  if (at_frame && !wrench_->refused().empty()) return ContactFault::no_wrench;
  if (!all_finite(contact.point) || !all_finite(contact.axis) || !std::isfinite(contact.at_most_n) || !std::isfinite(contact.at_most_nm) ||
      !std::isfinite(contact.half_angle_rad) || std::isnan(contact.at_most_travel_m) || std::isnan(seconds) ||
      (contact.boxed && (!all_finite(contact.lowest_m) || !all_finite(contact.highest_m))))
    return ContactFault::not_finite;
  const bool any = contact.axis == std::array<double, 3>{};
  if (contact.half_angle_rad < 0 || contact.half_angle_rad > kQuarterTurn || (any && contact.half_angle_rad > 0)) return ContactFault::no_cone;
  if (contact.at_most_n < 0 || contact.at_most_nm < 0 || !(contact.at_most_n + contact.at_most_nm > 0) || (of_joint && contact.at_most_n > 0))
    return ContactFault::no_size;
  if (!(contact.at_most_travel_m > 0) || (std::isfinite(contact.at_most_travel_m) && (any || of_joint))) return ContactFault::no_travel;
  if (contact.boxed && of_joint) return ContactFault::no_box;
  for (std::size_t i = 0; contact.boxed && i < 3; ++i)
    if (!(contact.lowest_m[i] < contact.highest_m[i])) return ContactFault::no_box;
  if (!(seconds > 0)) return ContactFault::no_time;
  if (at_frame) {
    TorqueSpan explained;
    int before = 0;
    for (std::size_t j = 0; j < static_cast<std::size_t>(joints_); ++j) before += told_[j] && monitored_[j] && moves(contact.frame, j);
    add_explained(contact, explained);
    if (explained.rank() >= before) return ContactFault::explains_everything;
  }
  if (bounds_nothing(contact)) return ContactFault::bounds_nothing;
  if (state_.count < kMostContacts) return ContactFault::none;
  const bool again = std::ranges::any_of(state_.slots, [&](const Slot& slot) { return slot.on && slot.contact == contact; });
  return again ? ContactFault::none : ContactFault::too_many;
}

std::string DeclaredContacts::words(ContactFault fault, const DeclaredContact& contact, double seconds) const {
  const std::string where = contact.at_frame() && contact.frame < wrench_->frames() ? " at '" + wrench_->frame(contact.frame).name + "'" : "";
  switch (fault) {
    case ContactFault::none: return "";
    case ContactFault::no_frame: return "an expected contact needs one frame of the bundle, or one of its joints";
    case ContactFault::no_wrench: return "no contact at a frame can be expected: " + wrench_->refused();
    case ContactFault::not_finite: return "the numbers of an expected contact" + where + " must be finite";
    case ContactFault::no_cone:
      return "half_angle = " + to_text(contact.half_angle_rad) + " rad of an expected contact" + where +
             " must be 0 to pi/2 about an axis; without an axis, any direction is declared and there is no angle";
    case ContactFault::no_size:
      return "an expected contact" + where + " of at most " + to_text(contact.at_most_n) + " N and " + to_text(contact.at_most_nm) +
             " N m must admit a force or a torque above 0; one of a joint has a torque only";
    case ContactFault::no_travel:
      return "at_most_travel = " + to_text(contact.at_most_travel_m) + " m of an expected contact" + where + " must be above 0, along an axis at a frame";
    case ContactFault::no_box:
      return "the box of an expected contact" + where + " must be of a frame, its lowest corner below its highest in x, y and z";
    case ContactFault::no_time: return "the time of an expected contact" + where + " = " + to_text(seconds) + " s must be above 0";
    case ContactFault::explains_everything:
      return "the contact" + where + " would explain any torque of the joints before it, and nothing would be monitored; declare no moment, "
             "or a line (half_angle 0)";
    case ContactFault::bounds_nothing: return bound_words(contact, where);
    case ContactFault::too_many: return "at most " + std::to_string(kMostContacts) + " contacts can be expected at the same time; end one first";
  }
  return "";
}

std::string DeclaredContacts::unmonitored(const DeclaredContact& contact) const {
  if (fault(contact, 1.0) != ContactFault::none) return "";
  if (!contact.at_frame())
    return "within its bound of " + to_text(contact.at_most_nm) + " N m, nothing is monitored on joint '" +
           wrench_->links()[static_cast<std::size_t>(contact.joint)].joint_name + "' meanwhile";
  TorqueSpan explained;
  add_explained(contact, explained);
  std::string hidden, unknown;
  const auto add = [](std::string& to, const std::string& one) { to += (to.empty() ? "" : ", ") + one; };
  for (int j = 0; j < joints_; ++j) {
    const auto at = static_cast<std::size_t>(j);
    TorqueSpan touched, both = explained;
    for (TorqueSpan* one : {&touched, &both}) add_wrenches(j, {}, nullptr, true, true, *one);
    const std::string& name = wrench_->links()[at].joint_name;
    if (touched.rank() > 0 && both.rank() == explained.rank()) add(hidden, name);
    if (monitored_[at] && !told_[at] && moves(contact.frame, at)) add(unknown, name);
  }
  std::string text;
  if (!hidden.empty()) text = "within its bounds, nothing is monitored on the links of " + hidden + " meanwhile";
  if (!unknown.empty()) text += (text.empty() ? "" : "; ") + std::string("not monitored meanwhile, since not in N m: ") + unknown;
  return text;
}

// The largest force at the contact's point, or moment, that the drives can exert: along the best of some directions in the best of
// some poses, that at which the first joint gives way. Infinite where no joint has a lever. A line has no bound of its own: it
// points in any direction of the arm, as the pose changes.
double DeclaredContacts::most_exerted(const DeclaredContact& contact, bool moment) const noexcept {
  static constexpr double kDirections[][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1},  {1, 1, 0},  {1, -1, 0},  {1, 0, 1}, {1, 0, -1},
                                       {0, 1, 1}, {0, 1, -1}, {1, 1, 1}, {1, 1, -1}, {1, -1, 1}, {-1, 1, 1}};
  const auto n = static_cast<std::size_t>(joints_), first = moment ? 3 * n : 0;
  std::array<double, kPoses * std::size(kDirections)> gives_way;  // the largest share of a drive that 1 N takes, or 1 N m
  std::size_t count = 0;
  double strongest = 0;
  for (int pose = 0; pose < kPoses; ++pose) {
    JointVector q;
    for (std::size_t j = 0; j < n; ++j) q[j] = 0.4 + (0.7 + 0.9 * pose) * static_cast<double>(j + 1);
    std::array<double, 6 * kMaxJoints> all;
    wrench_->columns(contact.frame, std::span(q).first(n), contact.point, WrenchAxes::frame, all);
    for (const auto& direction : kDirections) {
      const Vector3 u = unit({direction[0], direction[1], direction[2]});
      double share = 0;
      for (std::size_t j = 0; j < n; ++j) {
        const double lever = dot(u, {all[first + j], all[first + n + j], all[first + 2 * n + j]});
        if (!std::isfinite(lever)) return 0;
        if (told_[j] && monitored_[j]) share = std::max(share, std::fabs(lever) / drive_nm_[j]);
      }
      gives_way[count++] = share;
      strongest = std::max(strongest, share);
    }
  }
  double least = strongest;
  for (std::size_t k = 0; k < count; ++k)
    if (gives_way[k] > kStructure * strongest) least = std::min(least, gives_way[k]);
  return 1 / least;
}

// Whether the contact admits more than the drives can exert, so that it hides whatever the arm does.
bool DeclaredContacts::bounds_nothing(const DeclaredContact& contact) const noexcept {
  if (!contact.at_frame()) return !(contact.at_most_nm < drive_nm_[contact.joint]);
  return (contact.at_most_n > 0 && !(contact.at_most_n < most_exerted(contact, false))) ||
         (contact.at_most_nm > 0 && !(contact.at_most_nm < most_exerted(contact, true)));
}

std::string DeclaredContacts::bound_words(const DeclaredContact& contact, const std::string& where) const {
  if (!contact.at_frame())
    return "at_most_nm = " + to_text(contact.at_most_nm) + " of an expected contact of joint '" +
           wrench_->links()[static_cast<std::size_t>(contact.joint)].joint_name + "' must be below " + to_text(drive_nm_[contact.joint]) +
           ", the most that its drive can give; no torque of the joint would be monitored";
  const double most_n = most_exerted(contact, false);
  const bool force = contact.at_most_n > 0 && !(contact.at_most_n < most_n);
  return (force ? "at_most_n = " + to_text(contact.at_most_n) + " N" : "at_most_nm = " + to_text(contact.at_most_nm) + " N m") +
         " of an expected contact" + where + " must be below " +
         (force ? to_text(most_n) + " N" : to_text(most_exerted(contact, true)) + " N m") +
         ", the most that the drives can exert at its point; no force would be monitored";
}

// Whether the joint moves the frame.
bool DeclaredContacts::moves(int frame, std::size_t joint) const noexcept {
  for (int at = wrench_->frame(frame).link; at >= 0; at = wrench_->links()[static_cast<std::size_t>(at)].parent)
    if (static_cast<std::size_t>(at) == joint) return true;
  return false;
}

// Torques of unit forces and moments at a frame, in a pose without symmetries, of the joints that can raise an alarm by a force.
// line: one direction of the force, or null for three.
void DeclaredContacts::add_wrenches(int frame, const std::array<double, 3>& point, const Vector3* line, bool force, bool moment,
                                    TorqueSpan& into) const noexcept {
  const auto n = static_cast<std::size_t>(joints_);
  JointVector q;
  for (std::size_t j = 0; j < n; ++j) q[j] = 0.4 + 0.7 * static_cast<double>(j);
  std::array<double, 6 * kMaxJoints> all;
  wrench_->columns(frame, std::span(q).first(n), point, WrenchAxes::frame, all);
  for (std::size_t i = 0; i < 6; ++i) {
    if (i < 3 ? !force || (line && i > 0) : !moment) continue;
    JointVector torque;
    for (std::size_t j = 0; j < n; ++j) {
      const double value = line && i == 0 ? dot(*line, {all[j], all[n + j], all[2 * n + j]}) : all[i * n + j];
      torque[j] = told_[j] && monitored_[j] ? value : 0.0;
    }
    into.add(torque, n);
  }
}

void DeclaredContacts::add_explained(const DeclaredContact& contact, TorqueSpan& into) const noexcept {
  const ForceCone cone = cone_of(contact);
  add_wrenches(contact.frame, contact.point, cone.line() ? &cone.axis : nullptr, contact.at_most_n > 0, contact.at_most_nm > 0, into);
}

int DeclaredContacts::start(const DeclaredContact& contact, double seconds) noexcept {
  if (fault(contact, seconds) != ContactFault::none) return -1;
  int which = -1;
  for (int k = kMostContacts - 1; k >= 0; --k)
    if (!state_.slots[static_cast<std::size_t>(k)].on) which = k;
  for (int k = 0; k < kMostContacts; ++k)
    if (const Slot& slot = state_.slots[static_cast<std::size_t>(k)]; slot.on && slot.contact == contact) which = k;
  if (which < 0) return -1;
  Slot& slot = state_.slots[static_cast<std::size_t>(which)];
  state_.count += !slot.on;
  slot = {};
  slot.on = true;
  slot.contact = contact;
  slot.cone = cone_of(contact);
  slot.seconds = seconds;
  slot.order = ++state_.declared;
  return which;
}

bool DeclaredContacts::end(int which) noexcept {
  if (!contact(which)) return false;
  state_.slots[static_cast<std::size_t>(which)] = {};
  --state_.count;
  state_.in_effect = std::ranges::any_of(state_.slots, [](const Slot& slot) { return slot.acts; });
  if (state_.fitted == which) state_.fitted = -1;
  return true;
}

// Whether the contact is in effect: within its time and its box, or not long after.
bool DeclaredContacts::acts(Slot& slot, std::int64_t t_ns, std::span<const double> q) const noexcept {
  const auto lasts_ns = static_cast<std::int64_t>(1e9 * kForgotten / gain_per_s_);
  if (!slot.timed) {
    slot.timed = true;
    const double ns = 1e9 * slot.seconds;
    slot.end_ns = ns < 9e18 - static_cast<double>(t_ns) ? t_ns + static_cast<std::int64_t>(ns) : std::numeric_limits<std::int64_t>::max();
  }
  if (t_ns > slot.end_ns && t_ns - slot.end_ns > lasts_ns) {
    slot.on = false;
    return false;
  }
  if (!slot.contact.boxed) return true;
  const auto [rotation, origin] = wrench_->pose(slot.contact.frame, q);
  bool inside = true;
  for (std::size_t i = 0; i < 3; ++i) inside = inside && origin[i] >= slot.contact.lowest_m[i] && origin[i] <= slot.contact.highest_m[i];
  if (inside) {
    slot.inside_ns = t_ns;
    slot.was_inside = true;
  }
  return inside || (slot.was_inside && elapsed_ns(t_ns, slot.inside_ns) <= static_cast<std::uint64_t>(lasts_ns));
}

void DeclaredContacts::explain_joints(const Observed& observed, std::span<const double> q, const ContactErrors& errors,
                                      Estimate& e) noexcept {
  state_.in_effect = false;
  state_.count = 0;
  for (Slot& slot : state_.slots) {
    if (observed.jumped && slot.timed && std::isfinite(slot.seconds)) slot.on = false;  // its end was a stamp of another clock
    slot.acts = slot.on && acts(slot, observed.t_ns, q);
    state_.count += slot.on;
    state_.in_effect = state_.in_effect || slot.acts;
  }
  if (state_.in_effect && observed.judged) take_joints(errors, e);
}

// What contacts of joints explain beside declared_nm, which holds what one at a frame does.
void DeclaredContacts::take_joints(const ContactErrors& errors, Estimate& e) const noexcept {
  if (e.declared == Declared::none) e.declared = Declared::within;
  for (int k = 0; k < kMostContacts; ++k) {
    const Slot& slot = state_.slots[static_cast<std::size_t>(k)];
    if (!slot.acts || slot.contact.at_frame()) continue;
    const auto j = static_cast<std::size_t>(slot.contact.joint);
    const double sign = slot.contact.axis[0], most = slot.contact.at_most_nm;
    const double torque = e.tau_ext[j] - e.load_nm[j] - e.declared_nm[j];
    e.declared_nm[j] += std::clamp(torque, sign > 0 ? 0.0 : -most, sign < 0 ? 0.0 : most);
    const double size = sign > 0 ? std::max(torque, 0.0) : sign < 0 ? std::max(-torque, 0.0) : std::fabs(torque);
    const double sigma_nm = e.sigma_nm[j] > 0 ? e.sigma_nm[j] : 0.0;  // unknown without an error scale
    const double sigma = std::sqrt(sigma_nm * sigma_nm + errors.brought(slot.contact.joint, e.near_stiction >> j & 1, torque));
    const bool beyond = size - kSure * sigma > most;
    if (e.declared_contact >= 0 && !(beyond && e.declared == Declared::within)) continue;
    e.declared_contact = k;
    e.declared_size = size;
    e.declared_sigma = sigma;
    if (beyond) e.declared = Declared::beyond;
  }
}

bool DeclaredContacts::explain_frame(const Observed& observed, std::span<const double> q, const ContactErrors& errors, bool frames,
                                     Estimate& e, JointVector& spread_nm) noexcept {
  int which = -1;  // the one declared last
  for (int k = 0; k < kMostContacts; ++k) {
    const Slot& slot = state_.slots[static_cast<std::size_t>(k)];
    if (frames && slot.acts && slot.contact.at_frame() && (which < 0 || slot.order > state_.slots[static_cast<std::size_t>(which)].order))
      which = k;
  }
  if (state_.fitted != which || observed.restarted) {
    state_.fitted = -1;
    state_.pressed = state_.moved = false;
    state_.travel_m = 0;
  }
  if (!observed.judged) return false;
  bool pressed = false;
  if (which >= 0) {
    e.declared = Declared::none;
    e.declared_contact = -1;
    std::fill_n(e.declared_nm.begin(), joints_, 0.0);
    pressed = explain_at(which, observed, q, errors, e);
    take_joints(errors, e);
  }
  stand(observed, errors, pressed, e, spread_nm);
  return pressed;
}

// The standing rest, see the class; and the spread of the limits.
void DeclaredContacts::stand(const Observed& observed, const ContactErrors& errors, bool pressed, Estimate& e,
                             JointVector& spread_nm) noexcept {
  State& s = state_;
  const double dt = observed.restarted || s.stood_ns == 0 ? 0.0 : elapsed_s(observed.t_ns, s.stood_ns);
  s.stood_ns = observed.t_ns;
  const double share = dt > 0 ? 1 - std::exp(-dt / kStandsS) : 0.0, kept = std::exp(-gain_per_s_ * dt);
  s.released = pressed ? 1.0 : (1 - share) * s.released;
  // The part of a torque that the standing rest explains: all of it between 0 and b, since a joint that slides loses its rest.
  const auto of_rest = [&s](double torque, int j) noexcept { return std::clamp(torque, std::min(s.standing_nm[j], 0.0), std::max(s.standing_nm[j], 0.0)); };
  bool frozen = false, moves = s.fitted < 0 || observed.restarted;
  for (int j = 0; j < joints_; ++j) {
    const double torque = e.tau_ext[j] - e.load_nm[j] - e.declared_nm[j];
    frozen = frozen || std::fabs(torque - of_rest(torque, j)) > kFrozen * e.limit_nm[j];  // of the sample before
    moves = moves || !(e.near_stiction >> j & 1);
  }
  if (moves) s.moved_ns = observed.t_ns;
  const bool stands = elapsed_s(observed.t_ns, s.moved_ns) >= Limits::kSlidS;
  for (int j = 0; j < joints_; ++j) {
    const std::uint32_t bit = std::uint32_t{1} << j;
    const bool rests = e.near_stiction & bit;
    if (rests) s.rested_ns[j] = observed.t_ns;
    if (rests && (pressed || stands)) s.rests |= bit;  // standing, also by a force that is too small to be seen
    else if (elapsed_s(observed.t_ns, s.rested_ns[j]) >= Limits::kSlidS) s.rests &= ~bit;
    const double explained = e.declared_nm[j], change = std::fabs(explained - s.slow_nm[j]);
    s.slow_nm[j] += share * (explained - s.slow_nm[j]);
    const double of_torque = std::sqrt(errors.brought(j, false, explained));
    const double friction = rests && (s.rests & bit) ? friction_nm_[j] : 0.0;
    s.most_nm[j] = std::max(spread_ * of_torque + friction, kept * s.most_nm[j]);  // r follows no faster
    const double most = s.most_nm[j], torque = e.tau_ext[j] - e.load_nm[j] - explained;
    const double step = share * (torque - s.standing_nm[j]), frees = stands ? kFrees * dt * friction : 0.0;
    s.standing_nm[j] = std::clamp(s.standing_nm[j] + (frozen ? std::clamp(step, -frees, frees) : step), -most, most);
    e.declared_nm[j] += of_rest(torque, j);
    const double of_change = spread_ * std::sqrt(errors.brought(j, false, change)), of_slide = kSlides * of_torque;
    const double of_friction = std::min(friction, pressed ? change : std::max(change, s.released * friction));
    spread_nm[j] = std::sqrt(of_slide * of_slide + of_change * of_change + of_friction * of_friction);
  }
}

// Passes the Jacobian of a contact's frame, (parts, joints), through the observer's filter.
void DeclaredContacts::filter_columns(int which, std::int64_t t_ns, std::span<const double> now) noexcept {
  const auto n = static_cast<std::size_t>(joints_);
  const bool fresh = state_.fitted != which;
  const double kept = fresh ? 0.0 : std::exp(-gain_per_s_ * elapsed_s(t_ns, state_.t_ns));
  state_.t_ns = t_ns;
  state_.fitted = which;
  for (std::size_t i = 0; i < now.size() / n; ++i)
    for (std::size_t j = 0; j < n; ++j) {
      double& column = state_.columns[i][j];
      column = fresh ? now[i * n + j] : column + (1 - kept) * (now[i * n + j] - column);
    }
}

// Least squares of the torques of the joints in use, for a force (parts = 3) or a wrench (6) of the filtered Jacobian.
WrenchEquations DeclaredContacts::equations_of(const std::array<bool, kMaxJoints>& used, std::size_t parts,
                                               const ContactErrors& errors, const Estimate& e) const noexcept {
  WrenchEquations equations;
  for (std::size_t j = 0; j < static_cast<std::size_t>(joints_); ++j) {
    if (!used[j]) continue;
    const double rest = e.tau_ext[j] - e.load_nm[j];
    const Vector3 f{state_.columns[0][j], state_.columns[1][j], state_.columns[2][j]};
    const double w = 1 / (e.sigma_nm[j] * e.sigma_nm[j] + errors.brought(static_cast<int>(j), e.near_stiction >> j & 1, rest));
    equations.force.add(w, f);
    equations.force_seen = equations.force_seen + w * rest * f;
    if (parts == 3) continue;
    const Vector3 m{state_.columns[3][j], state_.columns[4][j], state_.columns[5][j]};
    equations.moment.add(w, m);
    equations.mixed[0] = equations.mixed[0] + w * f.x * m;
    equations.mixed[1] = equations.mixed[1] + w * f.y * m;
    equations.mixed[2] = equations.mixed[2] + w * f.z * m;
    equations.moment_seen = equations.moment_seen + w * rest * m;
  }
  return equations;
}

// The wrench at the frame of a contact; returns whether a force acts.
bool DeclaredContacts::explain_at(int which, const Observed& observed, std::span<const double> q, const ContactErrors& errors,
                                  Estimate& e) noexcept {
  const Slot& slot = state_.slots[static_cast<std::size_t>(which)];
  const DeclaredContact& contact = slot.contact;
  const auto n = static_cast<std::size_t>(joints_);
  std::array<double, 6 * kMaxJoints> now;
  const auto [rotation, origin] = wrench_->columns(contact.frame, q, contact.point, WrenchAxes::base, now);
  const Turn base = turn(rotation);  // base from frame
  const std::size_t parts = contact.at_most_nm > 0 ? 6 : 3;
  std::array<bool, kMaxJoints> used{};  // a joint with a contact of its own shows nothing of the force
  for (std::size_t j = 0; j < n; ++j) used[j] = told_[j] && e.sigma_nm[j] > 0;
  for (const Slot& other : state_.slots)
    if (other.acts && !other.contact.at_frame()) used[static_cast<std::size_t>(other.contact.joint)] = false;
  filter_columns(which, observed.t_ns, std::span(now).first(parts * n));
  ForceCone cone = slot.cone;
  if (contact.axes == WrenchAxes::frame) cone.axis = base.out(cone.axis);
  const Vector3 shift = base.out(vector3(contact.point));
  const std::array<double, 3> at{origin[0] + shift.x, origin[1] + shift.y, origin[2] + shift.z};

  const WrenchEquations equations = equations_of(used, parts, errors, e);
  constexpr double kNoBound = std::numeric_limits<double>::infinity();
  const bool pushes = contact.at_most_n > 0;
  if (!pushes) cone.most_n = 0;
  ConeFit fit = fit_cone(equations, cone, parts == 6 ? kNoBound : 0.0);
  const double size = std::sqrt(dot(fit.force, fit.force)), moment = std::sqrt(dot(fit.moment, fit.moment));
  const bool acts = size > kSure * fit.force_sigma || (parts == 6 && moment > kSure * fit.moment_sigma);
  const bool force_beyond = pushes && size - kSure * fit.force_sigma > contact.at_most_n;
  const bool beyond = force_beyond || (parts == 6 && moment - kSure * fit.moment_sigma > contact.at_most_nm);
  if (!acts) {
    state_.travel_m = 0;
    state_.moved = false;
  } else if (state_.pressed) {
    state_.travel_m += dot({at[0] - state_.at_m[0], at[1] - state_.at_m[1], at[2] - state_.at_m[2]}, cone.axis);
    state_.moved = state_.moved || std::fabs(state_.travel_m) > contact.at_most_travel_m;
  }
  state_.pressed = acts;
  state_.at_m = at;
  e.declared = state_.moved ? Declared::moved : beyond ? Declared::beyond : Declared::within;
  e.declared_contact = which;
  e.declared_size = size;
  e.declared_sigma = fit.force_sigma;
  e.declared_moment_nm = moment;
  e.declared_travel_m = state_.travel_m;
  if (state_.moved) return acts;
  if (size > contact.at_most_n || moment > contact.at_most_nm) {
    cone.most_n = contact.at_most_n;
    fit = fit_cone(equations, cone, contact.at_most_nm);
  }
  for (std::size_t j = 0; j < n; ++j) {
    const Vector3 f{state_.columns[0][j], state_.columns[1][j], state_.columns[2][j]};
    double explained = dot(f, fit.force);
    if (parts == 6) explained += dot({state_.columns[3][j], state_.columns[4][j], state_.columns[5][j]}, fit.moment);
    if (!told_[j] && (f.x != 0 || f.y != 0 || f.z != 0)) explained = e.tau_ext[j] - e.load_nm[j];  // its unit is unknown
    e.declared_nm[j] = explained;
  }
  return acts;
}

ToolForce DeclaredContacts::tool(const Torques& t, const ContactErrors& errors, int load_frame, WrenchAxes axes) const noexcept {
  ToolForce tool;
  const DeclaredContact* declared = contact(state_.fitted);
  tool.declared = declared;
  tool.frame = declared ? declared->frame : load_frame;
  if (tool.frame < 0) return tool;
  const std::array<double, 3> point = declared ? declared->point : std::array<double, 3>{};
  const ForceCone cone = declared ? cone_of(*declared) : ForceCone{};
  const bool line = declared && cone.line() && !(declared->at_most_nm > 0), moment = declared && declared->at_most_nm > 0;
  const WrenchKind kind = moment ? WrenchKind::wrench : WrenchKind::force;
  // Along the base's axes, and of a declared contact behind the observer's filter, as tau_ext is.
  const auto n = static_cast<std::size_t>(joints_);
  std::array<double, 6 * kMaxJoints> columns;
  const Turn base = turn(wrench_->columns(tool.frame, t.q, point, WrenchAxes::base, columns).rotation);
  for (std::size_t i = 0; declared && i < (moment ? 6u : 3u); ++i) std::copy_n(state_.columns[i].begin(), n, columns.begin() + static_cast<std::ptrdiff_t>(i * n));
  const std::array<double, 3> axis = line ? listed(declared->axes == WrenchAxes::frame ? base.out(cone.axis) : cone.axis) : std::array<double, 3>{};
  tool.wrench = wrench_->of_columns(kind, std::span(columns).first(6 * n), t.q, t.tau_ext, t.sigma_nm, t.contact_sigma_nm, t.dq, line ? &axis : nullptr);
  if (!tool.wrench.known) return tool;
  // The estimate's weights of the torques, h = S^-1 J^T C u, for the force along itself.
  const Vector3 u = unit(tool.wrench.force);
  const auto unknowns = static_cast<std::size_t>(tool.wrench.unknowns);
  std::array<double, 6> c{};
  for (std::size_t i = 0; i < unknowns; ++i)
    c[i] = dot({tool.wrench.covariance[i * unknowns], tool.wrench.covariance[i * unknowns + 1], tool.wrench.covariance[i * unknowns + 2]}, u);
  const double variance = dot({c[0], c[1], c[2]}, u);
  std::array<double, kMaxJoints * kMaxJoints> s;
  std::array<double, kMaxJoints> pushed, h;
  std::ranges::copy(t.tau_ext.first(n), pushed.begin());
  wrench_->take_off_rubbing(kind, t.q, t.dq, t.sigma_nm, t.contact_sigma_nm, std::span(pushed).first(n), s);
  for (std::size_t j = 0; j < n; ++j) {
    h[j] = 0;
    for (std::size_t i = 0; i < unknowns; ++i) h[j] += columns[i * n + j] * c[i];
  }
  wrench_->keep_told(s, n, true);
  wrench_->keep_told(h, 1, false);
  const std::size_t rows = wrench_->told().size();
  if (!cholesky(std::span(s).first(rows * rows), rows)) return tool;
  substitute(std::span(s).first(rows * rows), rows, std::span(h).first(rows));
  double rest = 0, constants = 0;
  for (std::size_t row = 0; row < rows; ++row) {
    const std::size_t j = wrench_->told()[row];
    const double of_torque = errors.brought(static_cast<int>(j), false, t.tau_ext[j]);
    const double brought = t.contact_sigma_nm[j] * t.contact_sigma_nm[j] - t.sigma_nm[j] * t.sigma_nm[j];
    rest += h[row] * h[row] * std::max(brought - of_torque, 0.0);
    constants += h[row] * h[row] * of_torque;
  }
  tool.rest_n = std::sqrt(rest);
  tool.constants_n = std::sqrt(constants);
  tool.motion_n = std::sqrt(std::max(variance - rest - constants, 0.0));
  about_origin(base.out(vector3(point)), tool.wrench);
  if (axes == WrenchAxes::frame) turn_into(base, tool.wrench);
  return tool;
}

}  // namespace tauext
