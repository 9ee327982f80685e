#include "tauext/tree.hpp"

#include <cmath>

namespace tauext {
namespace {

struct Vec3 {
  double x, y, z;
};

Vec3 operator+(Vec3 a, Vec3 b) noexcept { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec3 operator*(double s, Vec3 a) noexcept { return {s * a.x, s * a.y, s * a.z}; }
Vec3 cross(Vec3 a, Vec3 b) noexcept {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
double dot(Vec3 a, Vec3 b) noexcept { return a.x * b.x + a.y * b.y + a.z * b.z; }

// Columns of the rotation parent_from_link.
struct Rotation {
  Vec3 x, y, z;
  Vec3 to_parent(Vec3 a) const noexcept { return a.x * x + a.y * y + a.z * z; }
  Vec3 to_link(Vec3 a) const noexcept { return {dot(x, a), dot(y, a), dot(z, a)}; }
};

struct Sweep {
  Rotation rotation;
  Vec3 origin;       // of the link's frame, in the parent's
  Vec3 omega, v;     // of the link, at its origin, link axes
  Vec3 gravity;      // link axes
  Vec3 linear;       // composite momentum of the subtree, link axes
  Vec3 angular;      // the same, about the link's origin
  Vec3 first_moment; // sum of m c over the subtree, about the link's origin
};

Vec3 vec(const std::array<double, 3>& a) noexcept { return {a[0], a[1], a[2]}; }

bool finite(std::span<const double> values) noexcept {
  for (double v : values)
    if (!std::isfinite(v)) return false;
  return true;
}

void validate(const std::vector<Link>& links, const std::array<double, 3>& gravity) {
  if (links.empty() || links.size() > kMaxJoints)
    throw Error("a tree has 1 to " + std::to_string(kMaxJoints) + " moving joints, not " + std::to_string(links.size()));
  if (!finite(gravity)) throw Error("gravity must be finite");
  for (std::size_t i = 0; i < links.size(); ++i) {
    const Link& link = links[i];
    const std::string who = "joint '" + link.joint_name + "': ";
    if (link.parent < -1 || link.parent >= static_cast<int>(i))
      throw Error(who + "parent " + std::to_string(link.parent) + " must come before link " + std::to_string(i));
    if (link.type != JointType::revolute && link.type != JointType::prismatic)
      throw Error(who + "the joint type must be revolute or prismatic");
    const double scalars[] = {link.mass, link.rotor_inertia};
    if (!finite(link.rotation) || !finite(link.translation) || !finite(link.com) || !finite(link.inertia) ||
        !finite(scalars))
      throw Error(who + "every number of a link must be finite");
    if (link.mass < 0) throw Error(who + "mass = " + std::to_string(link.mass) + " kg must be >= 0");
    if (link.rotor_inertia < 0)
      throw Error(who + "rotor inertia = " + std::to_string(link.rotor_inertia) + " must be >= 0");
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        double product = 0;
        for (int row = 0; row < 3; ++row) product += link.rotation[3 * row + a] * link.rotation[3 * row + b];
        if (std::fabs(product - (a == b ? 1.0 : 0.0)) > 1e-9) throw Error(who + "its rotation is not orthonormal");
      }
  }
}

}  // namespace

Tree::Tree(std::vector<Link> links, std::array<double, 3> gravity) : links_(std::move(links)), gravity_(gravity) {
  validate(links_, gravity_);
  subtree_mass_.resize(links_.size());
  for (std::size_t i = links_.size(); i-- > 0;) {
    subtree_mass_[i] += links_[i].mass;
    if (links_[i].parent >= 0) subtree_mass_[links_[i].parent] += subtree_mass_[i];
  }
}

void Tree::momentum(std::span<const double> q, std::span<const double> dq, std::span<double> p,
                    std::span<double> beta) const noexcept {
  std::array<Sweep, kMaxJoints> sweep;  // left uninitialised: every field is written before it is read
  const int n = size();

  for (int i = 0; i < n; ++i) {
    const Link& link = links_[i];
    Sweep& s = sweep[i];
    const auto& r = link.rotation;
    s.rotation = {{r[0], r[3], r[6]}, {r[1], r[4], r[7]}, {r[2], r[5], r[8]}};
    s.origin = vec(link.translation);
    const bool revolute = link.type == JointType::revolute;
    if (revolute) {
      const double c = std::cos(q[i]), sn = std::sin(q[i]);
      const Vec3 x = s.rotation.x, y = s.rotation.y;
      s.rotation.x = c * x + sn * y;
      s.rotation.y = -sn * x + c * y;
    } else {
      s.origin = s.origin + q[i] * s.rotation.z;
    }
    if (link.parent < 0) {
      s.omega = s.v = {0, 0, 0};
      s.gravity = s.rotation.to_link(vec(gravity_));
    } else {
      const Sweep& parent = sweep[link.parent];
      s.omega = s.rotation.to_link(parent.omega);
      s.v = s.rotation.to_link(parent.v + cross(parent.omega, s.origin));
      s.gravity = s.rotation.to_link(parent.gravity);
    }
    (revolute ? s.omega.z : s.v.z) += dq[i];
    const Vec3 c = vec(link.com);
    const auto& I = link.inertia;
    const Vec3 w = s.omega;
    s.linear = link.mass * (s.v + cross(w, c));
    s.angular = Vec3{I[0] * w.x + I[3] * w.y + I[4] * w.z, I[3] * w.x + I[1] * w.y + I[5] * w.z,
                     I[4] * w.x + I[5] * w.y + I[2] * w.z} +
                cross(c, s.linear);
    s.first_moment = link.mass * c;
  }

  for (int i = n; i-- > 0;) {
    const Link& link = links_[i];
    const Sweep& s = sweep[i];
    // v x S needs the parent's velocity only: the joint's own part is parallel to S and drops out.
    double coriolis_transpose, gravity;
    if (link.type == JointType::revolute) {
      p[i] = s.angular.z;
      coriolis_transpose =
          s.omega.y * s.angular.x - s.omega.x * s.angular.y + s.v.y * s.linear.x - s.v.x * s.linear.y;
      gravity = s.first_moment.y * s.gravity.x - s.first_moment.x * s.gravity.y;
    } else {
      p[i] = s.linear.z;
      coriolis_transpose = s.omega.y * s.linear.x - s.omega.x * s.linear.y;
      gravity = -subtree_mass_[i] * s.gravity.z;
    }
    p[i] += link.rotor_inertia * dq[i];
    beta[i] = gravity - coriolis_transpose;
    if (link.parent >= 0) {
      Sweep& parent = sweep[link.parent];
      const Vec3 linear = s.rotation.to_parent(s.linear);
      parent.linear = parent.linear + linear;
      parent.angular = parent.angular + s.rotation.to_parent(s.angular) + cross(s.origin, linear);
      parent.first_moment =
          parent.first_moment + s.rotation.to_parent(s.first_moment) + subtree_mass_[i] * s.origin;
    }
  }
}

}  // namespace tauext
