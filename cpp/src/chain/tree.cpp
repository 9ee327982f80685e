#include "tauext/tree.hpp"

#include <algorithm>
#include <cmath>

#include "bundle/bodies.hpp"
#include "chain/vector3.hpp"

namespace tauext {
namespace {

struct Sweep {
  Turn rotation;
  Vector3 origin;        // of the link's frame, in the parent's
  Vector3 omega, v;      // of the link, at its origin, link axes
  Vector3 gravity;       // link axes
  Vector3 linear;        // composite momentum of the subtree, link axes
  Vector3 angular;       // the same, about the link's origin
  Vector3 first_moment;  // sum of m c over the subtree, about the link's origin
};

Vector3 symmetric_product(const std::array<double, 6>& a, Vector3 w) noexcept {
  return {a[0] * w.x + a[3] * w.y + a[4] * w.z, a[3] * w.x + a[1] * w.y + a[5] * w.z,
          a[4] * w.x + a[5] * w.y + a[2] * w.z};
}

// Largest mass, length, inertia or gravity, in SI units: products of larger values overflow.
constexpr double kLargestOfAnArm = 1e9;

void expect_sizes_of_an_arm(std::span<const double> values, const std::string& who) {
  for (double v : values) {
    if (!std::isfinite(v)) throw Error(who + "must be finite");
    if (std::fabs(v) > kLargestOfAnArm)
      throw Error(who + "must be within +-" + to_text(kLargestOfAnArm) + ", not " + to_text(v));
  }
}

// A link's own mass about its origin.
Carried about_origin(const Link& link) noexcept {
  const auto& c = link.com;
  const double m = link.mass;
  Carried own{m, {m * c[0], m * c[1], m * c[2]}, link.inertia};
  const std::array<double, 6> far = point_inertia(m, c);
  for (std::size_t k = 0; k < far.size(); ++k) own.inertia[k] += far[k];
  return own;
}

void validate(const std::vector<Link>& links, const std::array<double, 3>& gravity) {
  const int n = static_cast<int>(links.size());
  if (n < 1 || n > kMaxJoints)
    throw Error("a tree has 1 to " + std::to_string(kMaxJoints) + " moving joints, not " + std::to_string(n));
  expect_sizes_of_an_arm(gravity, "gravity ");
  for (const Link& link : links) {
    const std::string who = "joint '" + link.joint_name + "': ";
    if (link.parent < -1 || link.parent >= n)
      throw Error(who + "parent " + std::to_string(link.parent) + " must be -1 or one of the " + std::to_string(n) +
                  " links");
    if (link.type != JointType::revolute && link.type != JointType::prismatic)
      throw Error(who + "the joint type must be revolute or prismatic");
    const double scalars[] = {link.mass, link.rotor_inertia};
    using Numbers = std::span<const double>;
    for (Numbers numbers : {Numbers(link.rotation), Numbers(link.translation), Numbers(link.com), Numbers(link.inertia),
                            Numbers(scalars)})
      expect_sizes_of_an_arm(numbers, who + "every number of a link ");
    if (link.mass < 0) throw Error(who + "mass = " + std::to_string(link.mass) + " kg must be >= 0");
    if (link.rotor_inertia < 0)
      throw Error(who + "rotor inertia = " + std::to_string(link.rotor_inertia) + " must be >= 0");
    if (!is_rotation(link.rotation)) throw Error(who + "its rotation is not one: orthonormal, right-handed");
  }
}

}  // namespace

std::vector<Tree::Body> Tree::sort_bodies() const {
  const std::vector<Link>& links = links_;
  const int n = static_cast<int>(links.size());
  std::vector<int> place(n, -1);  // index of a link's body
  std::vector<Body> bodies;
  while (static_cast<int>(bodies.size()) < n) {
    const std::size_t before = bodies.size();
    for (int i = 0; i < n; ++i) {
      const Link& link = links[i];
      if (place[i] >= 0 || (link.parent >= 0 && place[link.parent] < 0)) continue;
      place[i] = static_cast<int>(bodies.size());
      const Carried& own = own_[static_cast<std::size_t>(i)];
      bodies.push_back({i, link.parent < 0 ? -1 : place[link.parent], link.type, link.rotation, link.translation,
                        own.mass, own.mass, own.first_moment, own.inertia, link.rotor_inertia});
    }
    if (bodies.size() == before)
      for (int i = 0; i < n; ++i)
        if (place[i] < 0)
          throw Error("joint '" + links[i].joint_name + "': its chain of parents ends in a ring, never at the base");
  }
  sum_masses(bodies);
  return bodies;
}

void Tree::sum_masses(std::vector<Body>& bodies) noexcept {
  for (Body& body : bodies) body.subtree_mass = body.mass;
  for (std::size_t k = bodies.size(); k-- > 0;)
    if (bodies[k].parent >= 0) bodies[static_cast<std::size_t>(bodies[k].parent)].subtree_mass += bodies[k].subtree_mass;
}

void Tree::carry(int link, const Carried& what) noexcept {
  for (Body& body : bodies_) {
    if (body.joint != link) continue;
    const Carried& own = own_[static_cast<std::size_t>(link)];
    body.mass = own.mass + what.mass;
    for (std::size_t i = 0; i < 3; ++i) body.first_moment[i] = own.first_moment[i] + what.first_moment[i];
    for (std::size_t i = 0; i < 6; ++i) body.inertia[i] = own.inertia[i] + what.inertia[i];
  }
  sum_masses(bodies_);
}

Tree::Tree(std::vector<Link> links, std::array<double, 3> gravity) : links_(std::move(links)), gravity_(gravity) {
  validate(links_, gravity_);
  for (const Link& link : links_) own_.push_back(about_origin(link));
  bodies_ = sort_bodies();
}

bool Tree::has_mass() const noexcept {
  return std::ranges::any_of(links_, [](const Link& link) { return link.mass > 0; });
}

[[gnu::always_inline]] inline void Tree::sweep(std::span<const double> q, std::span<const double> dq,
                                               const JointVector& sine, const JointVector& cosine, std::span<double> p,
                                               std::span<double> beta) const noexcept {
  std::array<Sweep, kMaxJoints> sweep;  // left uninitialised: every field is written before it is read
  const int n = size();

  for (int k = 0; k < n; ++k) {
    const Body& body = bodies_[k];
    Sweep& s = sweep[k];
    s.rotation = turn(body.rotation);
    s.origin = vector3(body.translation);
    const bool revolute = body.type == JointType::revolute;
    if (revolute) {
      const double c = cosine[body.joint], sn = sine[body.joint];
      const Vector3 x = s.rotation.x, y = s.rotation.y;
      s.rotation.x = c * x + sn * y;
      s.rotation.y = -sn * x + c * y;
    } else {
      s.origin = s.origin + q[body.joint] * s.rotation.z;
    }
    if (body.parent < 0) {
      s.omega = s.v = {0, 0, 0};
      s.gravity = s.rotation.back(vector3(gravity_));
    } else {
      const Sweep& parent = sweep[body.parent];
      s.omega = s.rotation.back(parent.omega);
      s.v = s.rotation.back(parent.v + cross(parent.omega, s.origin));
      s.gravity = s.rotation.back(parent.gravity);
    }
    (revolute ? s.omega.z : s.v.z) += dq[body.joint];
    s.first_moment = vector3(body.first_moment);
    s.linear = body.mass * s.v + cross(s.omega, s.first_moment);
    s.angular = symmetric_product(body.inertia, s.omega) + cross(s.first_moment, s.v);
  }

  for (int k = n; k-- > 0;) {
    const Body& body = bodies_[k];
    const Sweep& s = sweep[k];
    // v x S needs only the parent's velocity: the joint's own part is parallel to S and vanishes.
    double momentum, coriolis_transpose, gravity;
    if (body.type == JointType::revolute) {
      momentum = s.angular.z;
      coriolis_transpose =
          s.omega.y * s.angular.x - s.omega.x * s.angular.y + s.v.y * s.linear.x - s.v.x * s.linear.y;
      gravity = s.first_moment.y * s.gravity.x - s.first_moment.x * s.gravity.y;
    } else {
      momentum = s.linear.z;
      coriolis_transpose = s.omega.y * s.linear.x - s.omega.x * s.linear.y;
      gravity = -body.subtree_mass * s.gravity.z;
    }
    p[body.joint] = momentum + body.rotor_inertia * dq[body.joint];
    beta[body.joint] = gravity - coriolis_transpose;
    if (body.parent >= 0) {
      Sweep& parent = sweep[body.parent];
      const Vector3 linear = s.rotation.out(s.linear);
      parent.linear = parent.linear + linear;
      parent.angular = parent.angular + s.rotation.out(s.angular) + cross(s.origin, linear);
      parent.first_moment =
          parent.first_moment + s.rotation.out(s.first_moment) + body.subtree_mass * s.origin;
    }
  }
}

// In a loop of its own: the positions are independent of each other, unlike the links of a sweep.
void Angles::compute(std::span<const double> q) noexcept {
  for (std::size_t i = 0; i < q.size(); ++i) {
    sine[i] = std::sin(q[i]);
    cosine[i] = std::cos(q[i]);
  }
}

void Tree::momentum(std::span<const double> q, std::span<const double> dq, std::span<double> p,
                    std::span<double> beta) const noexcept {
  std::array<double, kMaxJoints> sine, cosine;  // left uninitialised: every one is written before it is read
  for (int i = 0; i < size(); ++i) {
    sine[i] = std::sin(q[i]);
    cosine[i] = std::cos(q[i]);
  }
  sweep(q, dq, sine, cosine, p, beta);
}

void Tree::momentum(std::span<const double> q, std::span<const double> dq, const Angles& angles, std::span<double> p,
                    std::span<double> beta) const noexcept {
  sweep(q, dq, angles.sine, angles.cosine, p, beta);
}

}  // namespace tauext
