// A contact that the task means: what it may do to the arm, and for how long.
#pragma once
#include <array>
#include <cstdint>
#include <limits>

#include "tauext/wrench.hpp"

namespace tauext {

// What the environment may exert on the arm at a frame: a force within a cone and a moment, or a torque of one joint. The
// alarm then uses only the part of tau_ext that nothing within these bounds explains.
struct DeclaredContact {
  int frame = -1;                      // of WrenchModel::frame(); -1: of a joint
  int joint = -1;                      // -1: at a frame
  std::array<double, 3> point{};       // where the force acts, [m] along the frame's own axes
  // Middle of the cone: the direction of the force on the arm, of any length; zeros: any direction. With a joint: {1, 0, 0} for a
  // positive torque, {-1, 0, 0} for a negative one, zeros for both.
  std::array<double, 3> axis{};
  WrenchAxes axes = WrenchAxes::frame;  // of the axis
  double half_angle_rad = 0;           // of the cone, 0 (a line) to pi/2
  double at_most_n = 0;                // largest force, [N]
  double at_most_nm = 0;               // largest moment about the point, [N m]; with a joint its largest torque, in the joint's unit
  double at_most_travel_m = std::numeric_limits<double>::infinity();  // largest way of the point along the axis during the contact
  bool boxed = false;                  // in effect only while the frame's origin is in this box, in the base's axes, [m]
  std::array<double, 3> lowest_m{}, highest_m{};

  bool at_frame() const noexcept { return frame >= 0; }
  bool operator==(const DeclaredContact&) const = default;
};

// A contact that is declared before the first sample of a recording at or after from_ns.
struct TimedContact {
  DeclaredContact contact;
  std::int64_t from_ns = std::numeric_limits<std::int64_t>::min();
  double seconds = std::numeric_limits<double>::infinity();
};

// Reason for which an expected contact is refused.
enum class ContactFault : std::uint8_t {
  none,
  no_frame,             // neither a frame nor a joint, or both, or an unknown one
  no_wrench,            // the bundle has no model or no standard errors
  not_finite,           // NaN or infinity
  no_cone,              // half_angle_rad outside 0 to pi/2, or a cone without an axis
  no_size,              // no force and no moment, or a negative one
  no_travel,            // at_most_travel_m is not above 0
  no_box,               // empty
  no_time,              // seconds are not above 0
  explains_everything,  // no torque of the joints before the frame would be left for the alarm
  bounds_nothing,       // at_most_n or at_most_nm is no less than the drives can exert there
  too_many,             // kMostContacts are declared
};

inline constexpr int kMostContacts = 8;  // declared at the same time
inline constexpr double kAlways_s = std::numeric_limits<double>::infinity();  // until end_contact()

// The force at the tool as a sensor would measure it.
struct ToolForce {
  Wrench wrench;             // at the expected contact in effect, else at the load frame; along the declared line, if there is one
  int frame = -1;            // of WrenchModel; -1: there is none
  bool declared = false;     // an expected contact is in effect
  // Standard errors of the force along itself, by cause, [N]: errors of free motion, friction hidden by resting joints and lag,
  // torque constants and gear friction under the load.
  double motion_n = 0, rest_n = 0, constants_n = 0;
};

}  // namespace tauext
