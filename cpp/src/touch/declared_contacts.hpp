// The contacts that are declared, and the part of tau_ext that they explain.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <string>

#include "alarm/contact_errors.hpp"
#include "chain/observed.hpp"
#include "tauext/declared_contact.hpp"
#include "tauext/estimate.hpp"
#include "tauext/sample.hpp"
#include "touch/cone_fit.hpp"

namespace tauext {

struct Bundle;
class TorqueSpan;

// Explains tau_ext by what the declared contacts admit. At a frame that is the wrench w = (f, m) of
//
//   min |M^-1 (tau_ext - F^T w)|,  f within its cone, |f| <= at_most_n, |m| <= at_most_nm,
//   M_j^2 = sigma_j^2 + hidden_j^2 + (of_torque_j tau_j)^2,
//
// with the variances of ContactErrors. F is the frame's Jacobian behind the observer's filter: a constant force then explains r
// exactly while the arm moves. Of a joint, it is the torque within its bounds.
//
// What is explained is wrong by a share of it (torque constants, gear friction) and by the friction that resting joints hide. These
// errors stand as long as force and pose do, while hits come and go. A standing rest b follows the unexplained torque, with the
// time constant kStandsS, within what these errors admit, and is explained, too:
//
//   |b_j| <= k (of_torque_j |explained_j|), and beyond that the joint's friction at rest while it rests since a press.
//
// Torques between 0 and b are explained, since a joint that slides loses its rest. Where the unexplained torque exceeds kFrozen of
// a limit, it may be a hit, and b stops. An arm that stands in a contact is the exception: its joints take up any part of the force
// within their friction, and a force that varies a little changes this part within seconds, even one too small to be seen. There
// b goes on, by kFrees of the friction in a second: a push that grows more slowly is noticed from limit and friction on.
//
// Limits rise, in squares, by kSlides standard errors of the share, which changes as the arm moves, and by what b cannot follow
// while the force changes: k of_torque_j |d_j|, and for a resting joint |d_j|, at most its friction, all of which a released
// force may leave. d_j = explained_j - its low-pass of kStandsS; k is Limits::declared_spread. No torque that is left raises a limit.
//
// A joint before the frame that does not answer in N m is explained completely, since its share of the force is unknown.
// Of several contacts at frames the one declared last that is in effect counts. Contacts of joints count
// beside it: they explain what it leaves of their joints, which show nothing of its force.
class DeclaredContacts {
 public:
  static constexpr double kSure = 2;       // standard errors from which on a force acts, or is beyond its bound
  static constexpr double kStandsS = 0.7;  // time constant of the standing rest, [s]
  static constexpr double kSlides = 1.5;   // standard errors by which the share changes as the arm moves
  static constexpr double kFrozen = 0.5;   // of a limit: beyond it the rest may be a hit, and is not taken for a standing one
  static constexpr double kFrees = 0.2;    // of a joint's friction in a second: how fast a varying force changes what it takes up
  static constexpr int kPoses = 4;                  // in which it is judged what the drives can exert
  static constexpr double kStructure = 0.01;        // of the strongest lever: a direction with less is held by the structure
  static constexpr double kBeyondTraining = 10;     // times its torque in training: what an unknown drive may give
  static constexpr double kForgotten = 5;  // in 1/K0: so long a contact stays in effect afterwards, since r still contains it

  // The bundle must be valid.
  explicit DeclaredContacts(const Bundle& bundle, const WrenchModel& wrench);

  ContactFault fault(const DeclaredContact& contact, double seconds) const noexcept;
  // A sentence with value, rule and choices; empty without a fault.
  std::string words(ContactFault fault, const DeclaredContact& contact, double seconds) const;
  // What is not monitored while the contact is in effect; empty: nothing. A sentence.
  std::string unmonitored(const DeclaredContact& contact) const;
  // Starts at the next sample; an equal contact that is declared already starts again. Returns its number; -1: fault().
  int start(const DeclaredContact& contact, double seconds) noexcept;
  // At once; false: there is none of this number.
  bool end(int which) noexcept;
  void reset() noexcept { state_ = {}; }
  // Whether there is a contact, or a rest of one in joints that have not slid since.
  bool any() const noexcept { return state_.count > 0 || state_.rests != 0; }
  // The contact of this number; null: none.
  const DeclaredContact* contact(int which) const noexcept {
    return which >= 0 && which < kMostContacts && state_.slots[static_cast<std::size_t>(which)].on
               ? &state_.slots[static_cast<std::size_t>(which)].contact
               : nullptr;
  }

  // For each sample that entered: first what contacts of joints explain, then what one at a frame explains of the rest. Write
  // the declared_* fields of the estimate, which must hold tau_ext, load_nm and sigma_nm, and the spread. frames: false while an
  // expected load explains forces. The second returns whether a force acts at the frame.
  void explain_joints(const Observed& observed, std::span<const double> q, const ContactErrors& errors, Estimate& estimate) noexcept;
  bool explain_frame(const Observed& observed, std::span<const double> q, const ContactErrors& errors, bool frames, Estimate& estimate,
                     JointVector& spread_nm) noexcept;
  // Whether some contact is in effect at the last sample, so that nothing may be learned from it.
  bool in_effect() const noexcept { return state_.in_effect; }

  // Torques of a sample, one value per joint.
  struct Torques {
    std::span<const double> q, dq, tau_ext, sigma_nm, contact_sigma_nm;
  };
  // See Monitor::tool_force(). load_frame: the frame used while no contact at a frame is in effect; -1: none.
  ToolForce tool(const Torques& torques, const ContactErrors& errors, int load_frame, WrenchAxes axes) const noexcept;

  struct Slot {
    bool on = false, timed = false, acts = false;  // acts: was in effect at the last sample
    DeclaredContact contact;
    ForceCone cone;             // in the axes of the contact
    double seconds = 0;
    std::uint64_t order = 0;    // grows with each declaration
    std::int64_t end_ns = 0;    // of its time
    std::int64_t inside_ns = 0;  // last sample in its box, for how long it stays in effect
    bool was_inside = false;
  };
  struct State {
    std::array<Slot, kMostContacts> slots{};
    int count = 0;
    std::uint64_t declared = 0;
    bool in_effect = false;
    // Of the contact at a frame in effect: the filtered Jacobian, and where the contact began.
    int fitted = -1;
    std::int64_t t_ns = 0;
    std::array<JointVector, 6> columns{};
    bool pressed = false, moved = false;
    // The standing rest of each joint and the low-pass of what is explained; joints that rest since a press, a bit each, and when
    // they rested last.
    JointVector standing_nm{}, slow_nm{}, most_nm{};  // most: what the standing rest may be
    double released = 0;                               // 1 while a force acts, then fades with kStandsS
    std::uint32_t rests = 0;
    std::array<std::int64_t, kMaxJoints> rested_ns{};
    std::int64_t stood_ns = 0;
    std::int64_t moved_ns = 0;        // when a joint moved, or no contact was in effect
    std::array<double, 3> at_m{};     // last position of the point
    double travel_m = 0;                  // since the force began
  };
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  bool moves(int frame, std::size_t joint) const noexcept;
  void add_wrenches(int frame, const std::array<double, 3>& point, const Vector3* line, bool force, bool moment, TorqueSpan& into) const noexcept;
  double most_exerted(const DeclaredContact& contact, bool moment) const noexcept;
  bool bounds_nothing(const DeclaredContact& contact) const noexcept;
  std::string bound_words(const DeclaredContact& contact, const std::string& where) const;
  void add_explained(const DeclaredContact& contact, TorqueSpan& into) const noexcept;
  bool acts(Slot& slot, std::int64_t t_ns, std::span<const double> q) const noexcept;
  void stand(const Observed& observed, const ContactErrors& errors, bool pressed, Estimate& estimate, JointVector& spread_nm) noexcept;
  void take_joints(const ContactErrors& errors, Estimate& estimate) const noexcept;
  void filter_columns(int which, std::int64_t t_ns, std::span<const double> now) noexcept;
  WrenchEquations equations_of(const std::array<bool, kMaxJoints>& used, std::size_t parts, const ContactErrors& errors,
                               const Estimate& estimate) const noexcept;
  bool explain_at(int which, const Observed& observed, std::span<const double> q, const ContactErrors& errors,
                  Estimate& estimate) noexcept;

  const WrenchModel* wrench_;
  int joints_;
  double gain_per_s_, spread_;
  std::array<bool, kMaxJoints> told_{}, monitored_{};
  JointVector friction_nm_{};  // at rest
  JointVector drive_nm_{};     // what each drive can give
  State state_;
};

}  // namespace tauext
