#include "chain/load_regressor.hpp"

#include <cmath>

#include "bundle/bodies.hpp"
#include "bundle/rules.hpp"
#include "chain/vector3.hpp"

namespace tauext {
namespace {

// A twist, a momentum or a wrench: the part along and the part about the frame's axes, at its origin.
struct Screw {
  Vector3 angular, linear;
};

double dot(const Screw& a, const Screw& b) noexcept {
  return tauext::dot(a.angular, b.angular) + tauext::dot(a.linear, b.linear);
}
Screw operator+(const Screw& a, const Screw& b) noexcept { return {a.angular + b.angular, a.linear + b.linear}; }
Screw operator*(double s, const Screw& a) noexcept { return {s * a.angular, s * a.linear}; }
// Of twists: v x s.
Screw cross(const Screw& v, const Screw& s) noexcept {
  return {tauext::cross(v.angular, s.angular),
          tauext::cross(v.angular, s.linear) + tauext::cross(v.linear, s.angular)};
}

using Screws = std::array<Screw, LoadRegressor::kParameters>;

// Momentum of a unit parameter that moves with v; with v = (0, g) its weight.
Screws momenta(const Screw& v) noexcept {
  const Vector3 w = v.angular, u = v.linear;
  const Vector3 axes[] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  Screws h{};
  h[0].linear = u;
  for (std::size_t k = 0; k < 3; ++k)
    h[1 + k] = {tauext::cross(axes[k], u), tauext::cross(w, axes[k])};
  h[4].angular = {w.x, 0, 0};
  h[5].angular = {0, w.y, 0};
  h[6].angular = {0, 0, w.z};
  h[7].angular = {w.y, w.x, 0};
  h[8].angular = {w.z, 0, w.x};
  h[9].angular = {0, w.z, w.y};
  return h;
}

}  // namespace

void LoadFrame::validate(int links) const {
  if (link < 0 || link >= links)
    throw Error("a payload is fixed to link " + std::to_string(link) + ", which must be one of the " +
                std::to_string(links) + " links");
  for (double value : translation)
    if (!(std::fabs(value) <= kFarthestFrame_m)) throw Error("the payload's frame must lie within 1000 m of its link");
  if (!is_rotation(rotation)) throw Error("the rotation of the payload's frame is not one: orthonormal, right-handed");
}

LoadRegressor::LoadRegressor(const Tree& tree, const LoadFrame& frame)
    : links_(tree.links()), gravity_(tree.gravity()), frame_(frame) {
  frame.validate(tree.size());
  for (int at = frame.link; at >= 0; at = links_[static_cast<std::size_t>(at)].parent) chain_.push_back(at);
}

void LoadRegressor::compute(std::span<const double> q, std::span<const double> dq) noexcept {
  std::array<Screw, kMaxJoints> twist;  // of the chain, for a unit speed
  LinkSeen seen(frame_.rotation, frame_.translation);
  const Turn& axes = seen.axes;
  Screw whole{};
  for (std::size_t k = 0; k < chain_.size(); ++k) {
    const auto j = static_cast<std::size_t>(chain_[k]);
    const Link& link = links_[j];
    twist[k] = link.type == JointType::revolute ? Screw{axes.z, cross(seen.origin, axes.z)} : Screw{{}, axes.z};
    whole = whole + dq[j] * twist[k];
    seen.pass(link, q[j]);
  }

  const Screws momentum = momenta(whole), weight = momenta({{}, axes.out(vector3(gravity_))});
  Screw before = whole;  // of the joints between the base and the one that is passed
  for (std::size_t k = 0; k < chain_.size(); ++k) {
    const auto j = static_cast<std::size_t>(chain_[k]);
    before = before + -dq[j] * twist[k];
    const Screw turned = cross(before, twist[k]);
    for (std::size_t m = 0; m < kParameters; ++m) {
      momentum_[m][j] = dot(twist[k], momentum[m]);
      beta_[m][j] = -dot(twist[k], weight[m]) - dot(turned, momentum[m]);
    }
    const Vector3 u = twist[k].linear;
    const double forces[] = {u.x, u.y, u.z}, base[] = {dot(u, axes.x), dot(u, axes.y), dot(u, axes.z)};
    for (std::size_t m = 0; m < 3; ++m) {
      frame_forces_[m][j] = forces[m];
      base_forces_[m][j] = base[m];
    }
  }
}

}  // namespace tauext
