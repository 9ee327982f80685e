// The steps of servos.py: servos, their friction and what touches the arm, around MuJoCo's dynamics.
#include <mujoco/mujoco.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

// Rows of the table of servos: the fields of tauext_lab.sim.servo_arm's Servos, in their order.
enum { kTorque, kOhm, kGain, kMostDuty, kGoalSpeed, kCoulomb, kStribeck, kMotorShare, kExternalShare, kMotorStribeck,
       kExternalStribeck, kMotorSquare, kExternalSquare, kStribeckSpeed, kStribeckPower, kViscous };
// Values of a touch: Touch.row of servos.py.
enum { kFrom, kTo, kLink, kPoint, kDirection = kPoint + 3, kPeak = kDirection + 3, kRise, kShape, kTouchValues };
constexpr double kHalfSine = 0, kRamp = 1, kWall = 2;  // SHAPES
// Values of a sample: SAMPLE of servos.py; one row a joint.
enum { kQ, kDq, kGoal, kDuty, kSupply, kSpeed, kMotorNm, kLoadNm, kExternalNm, kSampleValues };

constexpr int kStepsAServoTick = 2;        // physics at 2 kHz, the servos' loop at 1 kHz
constexpr double kLoadFilter = 0.9;        // of the load that friction sees, a step: 5 ms
constexpr double kSupplyFilter = 0.8187;   // of the supply current, a servo tick: 5 ms
constexpr int kSpeedTicks = 20;            // over which a servo takes its difference of positions
constexpr double kSpeedCounts = 50;        // a second: the step of the speed's register
constexpr double kWallNmS = 4.0;           // damping of a wall, N s/m
constexpr double kMostN = 150;

double sign(double x) { return (x > 0) - (x < 0); }

// What resists, [N m]: Rhoban's m6. A load that opposes the motor adds to what the gear carries.
double friction(const double* servos, int n, int j, double motor, double load, double speed) {
  const auto of = [&](int row) { return servos[row * n + j]; };
  const double still = std::exp(-std::pow(std::fabs(speed) / of(kStribeckSpeed), of(kStribeckPower)));
  double most = of(kCoulomb) + std::fabs(load * of(kExternalShare) - motor * of(kMotorShare));
  most += still * (of(kStribeck) + std::fabs(load * of(kExternalStribeck) - motor * of(kMotorStribeck)));
  if (sign(load) != sign(motor))
    most += still * (std::fabs(load) < std::fabs(motor) ? of(kExternalSquare) * load * load : of(kMotorSquare) * motor * motor);
  return most;
}

}  // namespace

// Degrees of freedom 2j and 2j + 1 are those of joint j: its gear, and its link in the backlash.
// goals: (writes, n), each acting from its tick of goal_ticks on. samples are taken at sample_ticks, before that tick.
// Returns how many samples were taken.
extern "C" int servo_steps(const mjModel* shared, mjData* d, const double* servos, int n, double volts, double supply_ohm,
                           double count_rad, const double* goals, const int* goal_ticks, int writes, const double* touches,
                           int touch_count, const int* sample_ticks, int samples, double* out, double* out_volts) {
  mjModel* m = const_cast<mjModel*>(shared);  // friction is the model's
  std::vector<double> follows(goals, goals + n), duty(n), supply(n), motor(n), load(n), pressed(n), external(n), jacobian(3 * m->nv);
  std::vector<double> counts(n), past(static_cast<std::size_t>(n) * kSpeedTicks);
  double at_servos = volts;
  const double* goal = goals;
  int next_goal = 0, next_sample = 0, touch = 0;
  double direction[3], wall[3], scale = 0;
  bool touching = false;
  for (int j = 0; j < n; ++j) std::fill_n(&past[j * kSpeedTicks], kSpeedTicks, std::round(d->qpos[2 * j] / count_rad));
  for (int step = 0; next_sample < samples; ++step) {
    if (step % kStepsAServoTick == 0) {
      const int tick = step / kStepsAServoTick;
      const double tick_s = kStepsAServoTick * m->opt.timestep;
      while (next_goal < writes && goal_ticks[next_goal] <= tick) goal = goals + n * next_goal++;
      double drawn = 0;
      for (int j = 0; j < n; ++j) {
        const auto of = [&](int row) { return servos[row * n + j]; };
        counts[j] = std::round((d->qpos[2 * j] + d->qpos[2 * j + 1]) / count_rad);
        const double most = of(kGoalSpeed) * tick_s;
        follows[j] += std::clamp(goal[j] - follows[j], -most, most);
        duty[j] = std::clamp(of(kGain) * (follows[j] - count_rad * counts[j]), -of(kMostDuty), of(kMostDuty));
        const double ampere = (at_servos * duty[j] - of(kTorque) * d->qvel[2 * j]) / of(kOhm);
        supply[j] = kSupplyFilter * supply[j] + (1 - kSupplyFilter) * duty[j] * ampere;
        drawn += std::fabs(supply[j]);
      }
      if (tick == sample_ticks[next_sample]) {
        for (int j = 0; j < n; ++j) {
          double* row = out + (static_cast<std::size_t>(next_sample) * n + j) * kSampleValues;
          const double moved = (counts[j] - past[j * kSpeedTicks + tick % kSpeedTicks]) / (kSpeedTicks * tick_s);
          row[kQ] = d->qpos[2 * j] + d->qpos[2 * j + 1];
          row[kDq] = d->qvel[2 * j] + d->qvel[2 * j + 1];
          row[kGoal] = goal[j];
          row[kDuty] = duty[j];
          row[kSupply] = supply[j];
          row[kSpeed] = std::round(moved / kSpeedCounts) * kSpeedCounts * count_rad;
          row[kMotorNm] = servos[kTorque * n + j] * (at_servos * duty[j] - servos[kTorque * n + j] * d->qvel[2 * j]) / servos[kOhm * n + j];
          row[kLoadNm] = load[j];
          row[kExternalNm] = external[j];
        }
        out_volts[next_sample++] = at_servos;
      }
      for (int j = 0; j < n; ++j) past[j * kSpeedTicks + tick % kSpeedTicks] = counts[j];
      at_servos = volts - supply_ohm * drawn;
    }
    for (int j = 0; j < n; ++j) {
      const double torque = servos[kTorque * n + j];
      motor[j] = torque * (at_servos * duty[j] - torque * d->qvel[2 * j]) / servos[kOhm * n + j];
      m->dof_frictionloss[2 * j] = friction(servos, n, j, motor[j], load[j], d->qvel[2 * j]);
    }
    mj_step1(m, d);
    std::fill(external.begin(), external.end(), 0.0);
    const double time_s = step * m->opt.timestep;
    const double* one = touches + touch * kTouchValues;
    if (touch < touch_count && time_s >= one[kTo]) {
      ++touch;
      touching = false;
      one += kTouchValues;
    }
    if (touch < touch_count && time_s >= one[kFrom]) {
      const int body = static_cast<int>(one[kLink]) + 1;
      double point[3], speed[3] = {};
      mju_mulMatVec3(point, d->xmat + 9 * body, one + kPoint);
      mju_addTo3(point, d->xpos + 3 * body);
      mj_jac(m, d, jacobian.data(), nullptr, point, body);
      mju_mulMatVec(speed, jacobian.data(), d->qvel, 3, m->nv);
      if (!touching) {  // what is run into pushes back
        touching = true;
        mju_copy3(direction, one + kDirection);
        if (one[kShape] != kRamp && mju_norm3(speed) > 0.02) {
          mju_scl3(direction, speed, -1.0);
          mju_normalize3(direction);
        }
        mju_copy3(wall, point);
        double most = 1e-9;
        for (int j = 0; j < n; ++j)
          most = std::max(most, std::fabs(jacobian[2 * j] * direction[0] + jacobian[m->nv + 2 * j] * direction[1] +
                                          jacobian[2 * m->nv + 2 * j] * direction[2]));
        scale = std::min(one[kPeak] / most, kMostN);
      }
      double force = 0;
      if (one[kShape] == kWall) {  // kPeak is its stiffness, N/m
        double depth = 0;
        for (int a = 0; a < 3; ++a) depth += direction[a] * (wall[a] - point[a]);
        if (depth > 0) force = std::clamp(one[kPeak] * depth - kWallNmS * mju_dot3(direction, speed), 0.0, kMostN);
      } else if (one[kShape] == kHalfSine) {
        force = scale * std::sin(M_PI * (time_s - one[kFrom]) / (one[kTo] - one[kFrom]));
      } else {
        force = scale * std::min({1.0, (time_s - one[kFrom]) / one[kRise], (one[kTo] - time_s) / one[kRise]});
      }
      for (int j = 0; j < n; ++j)
        for (int a = 0; a < 3; ++a) external[j] += jacobian[a * m->nv + 2 * j] * direction[a] * force;
    }
    for (int j = 0; j < n; ++j) {
      d->qfrc_applied[2 * j] = motor[j] + external[j];
      d->qfrc_applied[2 * j + 1] = external[j];
    }
    mj_step2(m, d);
    for (int j = 0; j < n; ++j) pressed[j] = -d->qfrc_constraint[2 * j + 1];  // minus the stop's force on the link
    for (int i = 0; i < d->nefc; ++i)  // without the bearing's friction, of which the gear feels nothing
      if (d->efc_type[i] == mjCNSTR_FRICTION_TENDON) pressed[d->efc_id[i]] += d->efc_force[i];
    for (int j = 0; j < n; ++j) load[j] = kLoadFilter * load[j] + (1 - kLoadFilter) * pressed[j];
  }
  return next_sample;
}
