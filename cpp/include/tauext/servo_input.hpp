// Computes the chain's inputs from servo signals: velocity from coarse positions, torque from current, duty or goal.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// One report of all servos: one value per joint; empty: not measured.
struct ServoSample {
  std::int64_t t_ns = 0;
  std::span<const double> q;  // [rad]
  std::span<const double> dq = {}, tau = {};  // [rad/s], [N m]
  std::span<const double> q_des = {};         // goal, [rad]
  std::span<const double> current = {};       // [A]
  std::span<const double> duty = {};          // -1 to 1
  std::span<const double> voltage = {};       // of the supply, [V]
};

// Computes velocities from coarse positions by first-order adaptive windowing, best-fit form [JanabiSharifi2000]. The
// velocity is the slope of the line through the longest run of recent samples in which no position differs from the
// line between its ends by more than a count. For a slow joint this is the whole window. For an accelerating joint it
// is shorter: a run of time T lags by T/2, and a T^2/8 <= count bounds T. A joint that flickers between two counts has
// a velocity near 0; a difference would give count/period. Uses past samples only, so a recording and a control loop
// have the same values. Allocates in the constructor only.
class AdaptiveVelocity {
 public:
  static constexpr int kMostSteps = ServoSettings::kMostSteps;  // largest window

  // steps: largest window, 1 (difference of two samples) to kMostSteps. count_rad: encoder resolution per joint, >= 0,
  // [rad]; 0: difference of two samples. Throws Error for other values.
  AdaptiveVelocity(int steps, std::span<const double> count_rad);

  // Fills the velocities [rad/s] after one more sample of finite positions; 0 for the first one. t_ns must increase.
  // The window restarts otherwise, and after a pause longer than gap_ns (0: never).
  void step(std::int64_t t_ns, std::span<const double> q, std::int64_t gap_ns, std::span<double> dq) noexcept;
  // Treats the next sample as the first one.
  void reset() noexcept { filled_ = 0; }

 private:
  double slope(std::size_t joint) const noexcept;
  std::size_t place(int back) const noexcept;  // index in the ring of the sample this many steps ago

  int steps_, newest_ = 0, filled_ = 0;
  std::vector<double> count_rad_;
  std::vector<std::int64_t> t_ns_;
  std::vector<double> q_;  // (steps + 1, joints)
};

// Computes dq and tau from servo signals. Its memory is the window of the velocity and the delayed goals, so that a
// recording and the loop that made it have the same values.
//
//   V D = R I + k_e w,   tau = k_t I
//
// with duty D, speed w and winding current I. By TorqueFrom:
//
//   phase_current   I is measured.
//   duty            I = (V D - k_e w) / R.
//   goal            D = clip(g (q_des - q), +-most_duty), then as duty. The goal is that of goal_delay_ns ago, on the
//                   line between two samples: the delay of bus and servo.
//   supply_current  V D^2 - k_e w D = R I_s by the balance of power, I_s = D I:
//                   D = (k_e w +- sqrt((k_e w)^2 + 4 V R |I_s|)) / 2V, with the sign of the duty. If the duty is not
//                   measured, it is the sign of q_des - q, which changes over two counts of the encoder.
//
// At standstill the supply current is proportional to the square of the torque.
class ServoInput {
 public:
  // Throws Error, see ServoSettings::validate().
  explicit ServoInput(const ServoSettings& settings);

  // Fills dq() and tau() from a sample. If a required signal is missing or not finite, they are NaN, which the chain
  // reports as a fault.
  void step(const ServoSample& sample) noexcept;
  std::span<const double> dq() const noexcept { return {dq_.data(), joints_.size()}; }    // [rad/s]
  std::span<const double> tau() const noexcept { return {tau_.data(), joints_.size()}; }  // [N m] or [A]
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
