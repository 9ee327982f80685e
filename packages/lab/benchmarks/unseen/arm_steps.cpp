// The steps of simulation.py: a drive, the friction of its gears and what touches the arm, around MuJoCo's dynamics.
#include <mujoco/mujoco.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

// Rows of the table of joints: simulation.py's joint_table, in its order.
enum { kInertia, kMost, kCoulomb, kAsymmetry, kStaticShare, kStribeck, kStiffness, kDamping, kViscous, kLoadShare,
       kWarmDrop, kRipple, kCycles, kPhase, kIntegral, kModel };
// Values of a contact: simulation.py's contact_row.
enum { kFrom, kTo, kFirst, kBody, kPoint, kDirection = kPoint + 3, kPeak = kDirection + 3, kRise, kInLink, kContactValues };

// Gains of the drive's cascade; the integral forgets, so that a standing joint does not hunt.
constexpr double kPositionPerS = 20, kVelocityPerS = 80, kForgetS = 1;
constexpr double kViscousBend = 2;  // rad/s
// Values of a press at a sample: simulation.py's Pressing.rows.
enum { kNormal, kGrip, kAt, kPressValues = kAt + 3 };
constexpr double kSlips = 0.002;  // m/s, from which friction at the tool is that of sliding

// Models of the friction at rest: simulation.py's PRESLIDING, in its order.
enum { kLuGre, kElastoPlastic, kMaxwellSlip };
constexpr double kElastic = 0.7;  // share of the steady bend up to which elasto-plastic bristles do not slip
constexpr int kElements = 6;      // of Maxwell slip, of equal force; the k-th slips at k times the bend of the first
constexpr double kHarmonic = 1 + 1 / 2.0 + 1 / 3.0 + 1 / 4.0 + 1 / 5.0 + 1 / 6.0;

double sign(double x) { return (x > 0) - (x < 0); }

// A half sine without a rise; else a ramp at both ends.
double force(const double* contact, double time_s) {
  if (time_s < contact[kFrom] || time_s >= contact[kTo]) return 0;
  if (contact[kRise] <= 0) return contact[kPeak] * std::sin(M_PI * (time_s - contact[kFrom]) / (contact[kTo] - contact[kFrom]));
  return contact[kPeak] * std::min({1.0, (time_s - contact[kFrom]) / contact[kRise], (contact[kTo] - time_s) / contact[kRise]});
}

// What the mean bend of a joint's bristles changes by over a step of constant speed v. g: their torque in sliding at |v|. z: the
// elements of Maxwell slip.
double moved(int model, double mean, double* z, double v, double dt, double stiffness, double g) {
  const double steady = g * sign(v) / stiffness, rate = stiffness * std::fabs(v) * dt / g;
  if (model == kMaxwellSlip) {
    double bent = 0;
    for (int k = 1; k <= kElements; ++k) {
      const double most = k * kHarmonic / kElements * g / stiffness;
      z[k - 1] = std::clamp(z[k - 1] + v * dt, -most, most);
      bent += z[k - 1] / (k * kHarmonic);
    }
    return bent - mean;
  }
  double slips = 1;
  if (model == kElastoPlastic) {
    const double share = v == 0 ? 0 : mean / steady;
    slips = share <= kElastic ? 0 : share >= 1 ? 1 : 0.5 + 0.5 * std::sin(M_PI * (share - (1 + kElastic) / 2) / (1 - kElastic));
  }
  if (slips == 1) return (steady - mean) * -std::expm1(-rate);
  const double most = std::max(std::fabs(steady), std::fabs(mean));
  return std::clamp(mean + (slips > 0 ? (steady / slips - mean) * -std::expm1(-slips * rate) : v * dt), -most, most) - mean;
}

// Friction of a joint of the table over a step of constant speed. mean, z: see moved(). load_nm: through the gear.
template <typename Of>
double friction_nm(const Of& of, double& mean, double* z, double q, double v, double load_nm, double warm, double dt) {
  const double sliding = warm * of(kCoulomb) * (1 + of(kAsymmetry) * sign(v)) + of(kLoadShare) * load_nm, slow = v / of(kStribeck);
  const double g = sliding * (1 + (of(kStaticShare) - 1) * std::exp(-slow * slow));
  const double change = moved(static_cast<int>(of(kModel)), mean, z, v, dt, of(kStiffness), g);
  mean += change;
  const double bent = v / kViscousBend, viscous = warm * of(kViscous) * v / std::sqrt(1 + bent * bent);
  const double ripple = of(kRipple) * std::sin(of(kCycles) * q + of(kPhase));
  return of(kStiffness) * mean + of(kDamping) * change / dt + viscous + ripple;
}

}  // namespace

// Friction of one joint that moves at these speeds, cold and without a load. joint: a column of the table. out: (samples).
extern "C" void friction_steps(const double* joint, const double* speed, double dt, int samples, double* out) {
  double bristle[kElements]{}, mean = 0, q = 0;
  for (int k = 0; k < samples; q += dt * speed[k++])
    out[k] = friction_nm([joint](int what) { return joint[what]; }, mean, bristle, q, speed[k], 0, 1, dt);
}

// Follows setpoints (samples, n).
// press: (samples, kPressValues), or null. The last link is pressed along `axis`, in its own axes.
// out: position, motor, friction and external torque, each (samples, n). tool: force of the press, base axes, (samples, 3).
extern "C" void arm_steps(const mjModel* m, mjData* d, const double* joints, double warm_from_s, double warm_s, const double* q_des,
                          const double* dq_des, const double* forward, int samples, const double* contacts, int contact_count,
                          const double* press, const double* axis, double* out, double* tool) {
  const int n = m->nv;
  const double dt = m->opt.timestep;
  const std::size_t size = static_cast<std::size_t>(samples) * n;
  std::vector<double> jacobian(3 * n), torque(n), bristle(kElements * n), mean(n), integral(n), friction(n);
  int number = 0;  // of the next contact
  bool acts_now = false;
  double along[3];
  for (int k = 0; k < samples; ++k) {
    const double warmth = -std::expm1(-(warm_from_s + k * dt) / warm_s);
    const std::size_t row = static_cast<std::size_t>(k) * n;
    for (int j = 0; j < n; ++j) {
      const auto of = [&](int what) { return joints[what * n + j]; };
      const double q = d->qpos[j], v = d->qvel[j], warm = 1 - of(kWarmDrop) * warmth;
      const double error = dq_des[row + j] + kPositionPerS * (q_des[row + j] - q) - v;
      integral[j] += dt * (error - integral[j] / kForgetS);
      double motor = forward[row + j] + of(kInertia) * kVelocityPerS * (error + of(kIntegral) * integral[j]);
      motor = std::clamp(motor, -of(kMost), of(kMost));
      friction[j] = friction_nm(of, mean[j], &bristle[kElements * j], q, v, std::fabs(motor - friction[j]), warm, dt);
      out[row + j] = q;
      out[size + row + j] = motor;
      out[2 * size + row + j] = friction[j];
      d->qfrc_applied[j] = motor - friction[j];
    }
    const double* one = contacts + static_cast<std::size_t>(number) * kContactValues;
    if (number < contact_count && k >= one[kFirst]) {
      const int body = static_cast<int>(one[kBody]);
      double point[3], arm[3], acts[3];
      mju_mulMatVec3(point, d->xmat + 9 * body, one + kPoint);
      mju_addTo3(point, d->xpos + 3 * body);
      mj_jac(m, d, jacobian.data(), nullptr, point, body);
      if (!acts_now) {  // an obstacle that is run into pushes back, and keeps its direction
        acts_now = true;
        double speed[3];
        mju_mulMatVec(speed, jacobian.data(), d->qvel, 3, n);
        if (one[kRise] <= 0 && mju_norm3(speed) > 0.1) {
          mju_normalize3(speed);
          mju_scl3(along, speed, -1.0);
        } else if (one[kInLink] != 0) {
          mju_mulMatVec3(along, d->xmat + 9 * body, one + kDirection);
        } else {
          mju_copy3(along, one + kDirection);
        }
      }
      mju_scl3(acts, along, force(one, k * dt));
      mju_copy3(d->xfrc_applied + 6 * body, acts);
      mju_sub3(arm, point, d->xipos + 3 * body);
      mju_cross(d->xfrc_applied + 6 * body + 3, arm, acts);
      mju_mulMatTVec(out + 3 * size + row, jacobian.data(), acts, 3, n);
      if (k * dt >= one[kTo]) {
        mju_zero(d->xfrc_applied, 6 * m->nbody);
        ++number;
        acts_now = false;
      }
    }
    const double* pressed = press == nullptr ? nullptr : press + static_cast<std::size_t>(k) * kPressValues;
    if (pressed != nullptr && pressed[kNormal] > 0) {
      const int body = m->nbody - 1;
      double point[3], normal[3], speed[3], *acts = tool + 3 * static_cast<std::size_t>(k);
      mju_mulMatVec3(point, d->xmat + 9 * body, pressed + kAt);
      mju_addTo3(point, d->xpos + 3 * body);
      mju_mulMatVec3(normal, d->xmat + 9 * body, axis);
      mj_jac(m, d, jacobian.data(), nullptr, point, body);
      mju_mulMatVec(speed, jacobian.data(), d->qvel, 3, n);
      mju_addToScl3(speed, normal, -mju_dot3(speed, normal));  // along the surface
      mju_scl3(acts, normal, pressed[kNormal]);
      mju_addToScl3(acts, speed, -pressed[kGrip] * pressed[kNormal] / std::hypot(mju_norm3(speed), kSlips));
      mju_mulMatTVec(torque.data(), jacobian.data(), acts, 3, n);
      mju_addTo(d->qfrc_applied, torque.data(), n);
      mju_addTo(out + 3 * size + row, torque.data(), n);
    }
    mj_step(m, d);
  }
}
