#include "tauext/load.hpp"

#include <algorithm>
#include <cmath>
#include <span>

#include "bundle/bodies.hpp"
#include "bundle/rules.hpp"

namespace tauext {
namespace {

constexpr double kLargest = 1e6;           // largest mass [kg] or length [m] of a load
constexpr double kInertiaTolerance = 0.01;  // of the trace: published inertias are often rounded to two digits

using Vec3 = std::array<double, 3>;

Vec3 turned(const std::array<double, 9>& r, const Vec3& v) noexcept {
  return {r[0] * v[0] + r[1] * v[1] + r[2] * v[2], r[3] * v[0] + r[4] * v[1] + r[5] * v[2],
          r[6] * v[0] + r[7] * v[1] + r[8] * v[2]};
}

bool all_finite(std::span<const double> values) noexcept {
  return std::ranges::all_of(values, [](double value) { return std::isfinite(value); });
}

// The second moments of a body (half the trace less the inertia) must be positive semidefinite. Checked by a Cholesky
// factorisation with a small tolerance.
bool is_of_a_body(const std::array<double, 6>& inertia) noexcept {
  const double trace = inertia[0] + inertia[1] + inertia[2];
  if (trace == 0) return std::ranges::all_of(inertia, [](double value) { return value == 0; });
  if (!(trace > 0)) return false;
  const double more = 0.5 * trace + kInertiaTolerance * trace;
  const double xx = more - inertia[0], yy = more - inertia[1], zz = more - inertia[2];
  const double xy = -inertia[3], xz = -inertia[4], yz = -inertia[5];
  const double second = xx * yy - xy * xy;
  const double third = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
  return xx >= 0 && second >= 0 && third >= 0;
}

int depth(const std::vector<Link>& links, std::size_t link) {
  int steps = 0;
  for (int parent = links[link].parent; parent >= 0 && steps <= kMaxJoints; ++steps)
    parent = links[static_cast<std::size_t>(parent)].parent;
  return steps;
}

double total_mass(const std::vector<Link>& links) {
  double sum = 0;
  for (const Link& link : links) sum += std::max(link.mass, 0.0);
  return sum;
}

}  // namespace

void LoadSettings::validate(int joints) const {
  if (!settable()) return;
  if (link < 0 || link >= joints)
    throw Error("load.link = " + std::to_string(link) + " must be one of " + std::to_string(joints) + " links");
  for (const auto& [what, value] : {std::pair("largest_mass_kg", largest_mass_kg), {"largest_reach_m", largest_reach_m}})
    if (!(value > 0 && value <= kLargest))
      throw Error("load." + std::string(what) + " = " + to_text(value) + " must be above 0, at most 1e6");
  if (!is_rotation(rotation))
    throw Error("load.rotation is none: orthonormal, right-handed");
  for (double value : translation)
    if (!(std::fabs(value) <= kLargest)) throw Error("load.translation = " + to_text(value) + " must be within +-1e6 m");
}

LoadFault LoadSettings::fault(const Load& load) const noexcept {
  if (!settable()) return LoadFault::not_settable;
  const double scalars[] = {load.mass, load.error_share};
  if (!all_finite(scalars) || !all_finite(load.com) || !all_finite(load.inertia)) return LoadFault::not_finite;
  if (load.mass < 0) return LoadFault::negative_mass;
  if (load.error_share < 0 || load.error_share > 1) return LoadFault::error_share;
  if (load.mass > largest_mass_kg) return LoadFault::too_heavy;
  if (!is_of_a_body(load.inertia)) return LoadFault::impossible_inertia;
  const double trace = load.inertia[0] + load.inertia[1] + load.inertia[2];
  if (load.mass == 0) return trace > 0 ? LoadFault::too_wide : LoadFault::none;
  if (length(load.com) > largest_reach_m) return LoadFault::too_far;
  if (0.5 * trace > load.mass * largest_reach_m * largest_reach_m) return LoadFault::too_wide;
  return LoadFault::none;
}

std::string LoadSettings::words(LoadFault fault, const Load& load) const {
  const double trace = load.inertia[0] + load.inertia[1] + load.inertia[2];
  switch (fault) {
    case LoadFault::none: return "";
    case LoadFault::not_settable: return "no payload can be set: " + refused;
    case LoadFault::not_finite: return "a number of the payload is not finite";
    case LoadFault::negative_mass: return "the payload's mass = " + to_text(load.mass) + " kg must be >= 0";
    case LoadFault::too_heavy:
      return "the payload's mass = " + to_text(load.mass) + " kg must be at most " + to_text(largest_mass_kg) +
             " kg, what this arm can carry where its training was";
    case LoadFault::too_far:
      return "the payload's centre of mass is " + to_text(length(load.com)) + " m from the origin of " + frame +
             " and must be at most " + to_text(largest_reach_m) + " m";
    case LoadFault::impossible_inertia:
      return "no body has the payload's inertia: it must be positive semidefinite, and no principal moment more than the "
             "sum of the other two";
    case LoadFault::too_wide:
      return "a payload of " + to_text(load.mass) + " kg cannot have a sum of moments of inertia of " + to_text(trace) +
             " kg m^2: at most twice its mass times the square of " + to_text(largest_reach_m) + " m";
    case LoadFault::error_share:
      return "the payload's error_share = " + to_text(load.error_share) + " must be 0 to 1";
    case LoadFault::no_past:
      return "the payload can only be set from now on: r of this bundle's residual cannot be computed again since an earlier time";
  }
  return "";
}

Carried LoadSettings::in_link(const Load& load) const noexcept {
  Vec3 c = turned(rotation, load.com);
  for (std::size_t i = 0; i < 3; ++i) c[i] += translation[i];
  const double m = load.mass;
  const auto& r = rotation;
  const std::array<double, 6>& in = load.inertia;
  const Vec3 columns[3] = {turned(r, {in[0], in[3], in[4]}), turned(r, {in[3], in[1], in[5]}),
                           turned(r, {in[4], in[5], in[2]})};  // of R I
  const auto entry = [&](std::size_t i, std::size_t j) noexcept {  // of R I R^T
    return columns[0][i] * r[3 * j] + columns[1][i] * r[3 * j + 1] + columns[2][i] * r[3 * j + 2];
  };
  const std::array<double, 6> far = point_inertia(m, c);
  return {m,
          {m * c[0], m * c[1], m * c[2]},
          {entry(0, 0) + far[0], entry(1, 1) + far[1], entry(2, 2) + far[2], entry(0, 1) + far[3], entry(0, 2) + far[4],
           entry(1, 2) + far[5]}};
}

Link LoadSettings::merged(const Load& load, const Link& own) const {
  const Carried added = in_link(load);
  Link whole = own;
  const double mass = own.mass + load.mass;
  if (!(mass > 0)) return whole;
  Vec3 com;
  for (std::size_t i = 0; i < 3; ++i) com[i] = (whole.mass * whole.com[i] + added.first_moment[i]) / mass;
  const std::array<double, 6> own_far = point_inertia(own.mass, own.com), far = point_inertia(mass, com);
  for (std::size_t k = 0; k < far.size(); ++k) whole.inertia[k] = whole.inertia[k] + own_far[k] + added.inertia[k] - far[k];
  whole.mass = mass;
  whole.com = com;
  return whole;
}

LoadSettings assumed_load_settings(const std::vector<Link>& links, const std::vector<Link>& corrected) {
  LoadSettings settings;
  const bool model = total_mass(links) > 0;
  if (!model) {
    settings.refused = "the bundle has no model of the arm, and ";
    settings.refused += corrected.empty() ? "none was found in its motion"
                                          : "nobody checked how well the one found in its motion is known";
    return settings;
  }
  int deepest = -1, leaves = 0;
  double reach = 0;
  for (std::size_t k = 0; k < links.size(); ++k) {
    const bool leaf = std::ranges::none_of(links, [k](const Link& link) { return link.parent == static_cast<int>(k); });
    leaves += leaf;
    if (leaf && (settings.link < 0 || depth(links, k) > deepest)) {
      deepest = depth(links, k);
      settings.link = static_cast<int>(k);
    }
    reach += length(links[k].translation);
  }
  settings.largest_mass_kg = std::min(0.5 * total_mass(links), kLargest);
  settings.largest_reach_m = std::clamp(0.5 * reach, 0.3, kLargest);
  if (leaves > 1) {
    settings.link = -1;
    settings.refused = "the arm branches into " + std::to_string(leaves) +
                       " ends, and the bundle does not name the one that carries a payload";
    return settings;
  }
  settings.frame = "link of " + links[static_cast<std::size_t>(settings.link)].joint_name;
  settings.refused.clear();
  return settings;
}

}  // namespace tauext
