// From what a servo reports to what the chain takes: velocity from coarse positions, torque from current, duty or goal.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/types.hpp"

namespace tauext {

// Where a joint's torque comes from. The numbers stand in bundles.
enum class TorqueFrom : std::uint8_t {
  torque = 0,         // the servo reports it; taken as it is
  phase_current = 1,  // current of the windings, signed
  supply_current = 2, // current that the bridge draws, unsigned: |D I|
  duty = 3,           // share of the supply voltage at the motor, signed (Feetech: Present_Load; Dynamixel: Present PWM)
  goal = 4,           // duty from goal and position, by the gain of the servo's position controller
};

// Constants of a servo, at the joint, after its gear: volts, ohm and k_t of a motor with gear N are V, R and N k_t.
struct ServoConstants {
  double volts = 1;          // of the supply, where a sample has none; > 0
  double ohm = 1;            // of the windings, > 0
  double back_emf_v_s = 0;   // k_e [V s/rad], >= 0
  double nm_per_ampere = 1;  // k_t; 1 where it is unknown: torques are in A
  double duty_per_rad = 0;   // gain of the position controller, >= 0; needed where torque comes from the goal
  double most_duty = 1;      // its limit, 0 to 1
  double count_rad = 0;      // step of the encoder, >= 0
};

struct ServoSettings {
  static constexpr int kMostDelay = 64;  // of goals, in sample periods

  TorqueFrom torque_from = TorqueFrom::torque;
  int velocity_steps = 0;              // most steps in the velocity's window; 0: dq as it is given
  std::int64_t sample_period_ns = 0;   // > 0 where velocity_steps is; a pause of over 2.5 of them restarts the window
  std::int64_t goal_delay_ns = 0;      // a goal acts so long after its stamp, at most kMostDelay sample periods
  std::vector<ServoConstants> joints;  // empty: these are no servos, and a ServoInput cannot be made

  bool on() const noexcept { return !joints.empty(); }
  // Throws Error, naming what breaks which rule.
  void validate() const;
};

// One report of all servos; lists over the joints, empty where not measured.
struct ServoSample {
  std::int64_t t_ns = 0;
  std::span<const double> q;  // [rad]
  std::span<const double> dq = {}, tau = {};  // [rad/s], [N m]
  std::span<const double> q_des = {};         // goal, [rad]
  std::span<const double> current = {};       // [A]
  std::span<const double> duty = {};          // -1 to 1
  std::span<const double> voltage = {};       // of the supply, [V]
};

// First-order adaptive windowing in its best-fit form [JanabiSharifi2000]: the slope of the line through the longest stretch of the last samples from whose end-to-end line no
// position departs by more than a count. A slow joint is averaged over all of the window, one that accelerates over as
// few samples as its acceleration requires: a stretch of time T lags by T/2, and a T^2/8 <= count bounds T.
// A joint that flickers between two counts has a velocity near 0, where a difference gives count/period.
// The last samples only: a control loop has the same values. No allocation after the constructor.
class AdaptiveVelocity {
 public:
  static constexpr int kMostSteps = 64;  // of a window

  // steps: most steps in a window, 1 (the plain difference) to kMostSteps. count_rad: smallest step of a joint's encoder,
  // >= 0, a joint; 0: the plain difference. Throws Error otherwise.
  AdaptiveVelocity(int steps, std::span<const double> count_rad);

  // Velocities after one more sample of finite positions [rad/s]; 0 with the first one. t_ns must increase: where it does
  // not, or after a pause of more than gap_ns (0: never), the window restarts.
  void step(std::int64_t t_ns, std::span<const double> q, std::int64_t gap_ns, std::span<double> dq) noexcept;
  // The next sample is a first one.
  void reset() noexcept { filled_ = 0; }

 private:
  double slope(std::size_t joint) const noexcept;
  std::size_t place(int back) const noexcept;  // in the ring, of the sample so many steps ago

  int steps_, newest_ = 0, filled_ = 0;
  std::vector<double> count_rad_;
  std::vector<std::int64_t> t_ns_;
  std::vector<double> q_;  // (steps + 1, joints)
};

// Memory: the velocity's window and the goals of the delay, so that a recording and the loop that made it have the same values.
//   V D = R I + k_e w,   tau = k_t I
// with the duty D, speed w and winding current I. Where torque comes from
//   the phase current    I is given;
//   the duty             I = (V D - k_e w) / R;
//   the goal             D = clip(g (q_des - q), +-most), then as from the duty; the goal is that of goal_delay_ns ago, on
//                        the line between two samples, since bus and servo take their time;
//   the supply current   V D^2 - k_e w D = R I_s by the balance of power, I_s = D I:
//                        D = (k_e w +- sqrt((k_e w)^2 + 4 V R |I_s|)) / 2V, with the sign of the duty, or that of q_des - q
//                        where the duty is not measured, which changes over two counts of the encoder.
// At standstill the supply current is proportional to the square of the torque: its root is taken.
class ServoInput {
 public:
  // Throws Error as validate().
  explicit ServoInput(const ServoSettings& settings);

  // Fills dq() and tau() from a sample. What is needed and is not there, or not finite, makes them NaN, which the chain
  // takes for a fault.
  void step(const ServoSample& sample) noexcept;
  std::span<const double> dq() const noexcept { return {dq_.data(), joints_.size()}; }    // [rad/s]
  std::span<const double> tau() const noexcept { return {tau_.data(), joints_.size()}; }  // [N m], or A
  // The next sample is a first one.
  void reset() noexcept {
    velocity_.reset();
    goals_filled_ = 0;
  }

 private:
  double torque(const ServoSample& sample, std::span<const double> q_des, std::size_t joint) const noexcept;
  std::span<const double> delayed(const ServoSample& sample) noexcept;

  TorqueFrom from_;
  bool derives_;
  std::int64_t gap_ns_;
  std::vector<ServoConstants> joints_;
  AdaptiveVelocity velocity_;
  std::int64_t delay_ns_;
  int goals_newest_ = 0, goals_filled_ = 0;  // a ring
  std::vector<std::int64_t> goals_ns_;
  std::vector<double> goals_;  // (ring, joints)
  JointVector dq_{}, tau_{}, goal_{};
};

}  // namespace tauext
