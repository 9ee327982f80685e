#include "tauext/link_surface.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "tauext/bundle.hpp"
#include "vector3.hpp"

namespace tauext {
namespace {

constexpr double kPi = std::numbers::pi;

struct Line {
  Vector3 start, along;  // along: unit vector
  double length_m, radius_m;
};

Line line_of(const Capsule& capsule) {
  const Vector3 start = vector3(capsule.start), way = vector3(capsule.end) - start;
  const double length = std::sqrt(dot(way, way));
  return {start, length > 0 ? (1 / length) * way : Vector3{0, 0, 1}, length, capsule.radius_m};
}

Vector3 nearest(const Line& line, Vector3 p) {
  return line.start + std::clamp(dot(p - line.start, line.along), 0.0, line.length_m) * line.along;
}

double area_of(const Line& line) { return 2 * kPi * line.radius_m * line.length_m + 4 * kPi * line.radius_m * line.radius_m; }

// Points on a capsule's surface share it with itself to rounding.
constexpr double kWithin = 0.999;

bool hidden(const std::vector<Line>& lines, std::size_t own, Vector3 p) {
  for (std::size_t k = 0; k < lines.size(); ++k) {
    const Vector3 off = p - nearest(lines[k], p);
    if (k != own && std::sqrt(dot(off, off)) < kWithin * lines[k].radius_m) return true;
  }
  return false;
}

// Rows around the capsule at steps of the arc from one pole to the other, as many points in each as its length holds steps.
void add_rows(const std::vector<Line>& lines, std::size_t own, double step_m, LinkSurface& into) {
  const Line& line = lines[own];
  const double r = line.radius_m, arc = line.length_m + kPi * r;
  const int rows = std::max(2, static_cast<int>(std::lround(arc / step_m)));
  const Vector3 aside = std::fabs(line.along.x) < 0.6 ? Vector3{1, 0, 0} : Vector3{0, 1, 0};
  Vector3 u = cross(line.along, aside);
  u = (1 / std::sqrt(dot(u, u))) * u;
  const Vector3 v = cross(line.along, u);
  for (int row = 0; row < rows; ++row) {
    const double at = (row + 0.5) * arc / rows - 0.5 * kPi * r, over = at < 0 ? at : std::max(at - line.length_m, 0.0);
    const double along = std::clamp(at, 0.0, line.length_m) + r * std::sin(over / r), across = r * std::cos(over / r);
    const int around = std::max(3, static_cast<int>(std::lround(2 * kPi * across / step_m)));
    for (int k = 0; k < around; ++k) {
      const double turned = 2 * kPi * (k + 0.5 * (row % 2)) / around;
      const Vector3 p = line.start + along * line.along + across * (std::cos(turned) * u + std::sin(turned) * v);
      if (hidden(lines, own, p)) continue;
      const Vector3 inwards = (1 / r) * (nearest(line, p) - p);
      into.x.push_back(p.x);
      into.y.push_back(p.y);
      into.z.push_back(p.z);
      into.nx.push_back(inwards.x);
      into.ny.push_back(inwards.y);
      into.nz.push_back(inwards.z);
      into.share.push_back(2 * kPi * across * arc / rows / around);
    }
  }
}

// What a link reaches to, in its own frame.
std::vector<std::array<double, 3>> ends_of(const Bundle& bundle, int link) {
  std::vector<std::array<double, 3>> ends;
  for (const Link& other : bundle.links)
    if (other.parent == link) ends.push_back(other.translation);
  if (!ends.empty()) return ends;
  if (bundle.load.link == link) return {bundle.load.translation};
  std::array<double, 3> furthest{};
  for (const WrenchFrame& frame : bundle.wrench.frames)
    if (frame.link == link && dot(vector3(frame.translation), vector3(frame.translation)) > dot(vector3(furthest), vector3(furthest)))
      furthest = frame.translation;
  return {furthest};
}

}  // namespace

void validate_capsules(std::span<const Capsule> capsules, int joints) {
  constexpr std::size_t most = 1000;
  if (capsules.size() > most) throw Error("there are " + std::to_string(capsules.size()) + " capsules, at most 1000");
  for (const Capsule& one : capsules) {
    const std::string what = "a capsule of link " + std::to_string(one.link);
    if (one.link < 0 || one.link >= joints)
      throw Error(what + ": the bundle has links 0 to " + std::to_string(joints - 1));
    for (const auto* end : {&one.start, &one.end})
      for (double value : *end)
        if (!(std::fabs(value) <= 1000)) throw Error(what + " ends " + to_text(value) + " m away, at most 1000");
    if (!(one.radius_m >= 1e-4 && one.radius_m <= 10))
      throw Error(what + ": its radius_m = " + to_text(one.radius_m) + " must be 0.0001 to 10");
  }
}

LinkSurface surface_of(std::span<const Capsule> capsules, int points) {
  std::vector<Line> lines;
  double area = 0;
  for (const Capsule& capsule : capsules) {
    lines.push_back(line_of(capsule));
    area += area_of(lines.back());
  }
  LinkSurface surface;
  for (std::size_t k = 0; k < lines.size(); ++k) add_rows(lines, k, std::sqrt(area / points), surface);
  double sum = 0;
  for (double share : surface.share) sum += share;
  for (double& share : surface.share) share /= sum;
  return surface;
}

std::vector<Capsule> capsules_or_guess(const Bundle& bundle) {
  std::vector<Capsule> all = bundle.capsules;
  for (int link = 0; link < bundle.joints(); ++link) {
    if (std::ranges::any_of(bundle.capsules, [link](const Capsule& one) { return one.link == link; })) continue;
    for (const std::array<double, 3>& end : ends_of(bundle, link)) all.push_back({link, {}, end, kGuessedRadius_m});
  }
  return all;
}

}  // namespace tauext
