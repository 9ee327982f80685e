// Surfaces of links: those of given capsules, and guesses with a spread.
#include <algorithm>
#include <cmath>
#include <numbers>

#include "bundle/linear.hpp"
#include "chain/vector3.hpp"
#include "tauext/bundle.hpp"
#include "tauext/touch_place.hpp"

namespace tauext {
namespace {

constexpr double kPi = std::numbers::pi;

struct Line {
  Vector3 start, along;  // along: unit vector
  double length_m, radius_m;
};

Line line_between(Vector3 start, Vector3 end, double radius_m) {
  const Vector3 way = end - start;
  const double length = std::sqrt(dot(way, way));
  return {start, length > 0 ? (1 / length) * way : Vector3{0, 0, 1}, length, radius_m};
}

Vector3 nearest(const Line& line, Vector3 p) {
  return line.start + std::clamp(dot(p - line.start, line.along), 0.0, line.length_m) * line.along;
}

double area_of(const Line& line) { return 2 * kPi * line.radius_m * line.length_m + 4 * kPi * line.radius_m * line.radius_m; }

// Share of the radius inside which a point counts as covered: points on the surface never do, despite rounding.
constexpr double kWithin = 0.999;

bool hidden(const std::vector<Line>& lines, std::size_t own, Vector3 p) {
  for (std::size_t k = 0; k < lines.size(); ++k) {
    const Vector3 off = p - nearest(lines[k], p);
    if (k != own && std::sqrt(dot(off, off)) < kWithin * lines[k].radius_m) return true;
  }
  return false;
}

// Unit vectors across a unit vector and each other.
std::pair<Vector3, Vector3> across_of(Vector3 along) {
  const Vector3 aside = std::fabs(along.x) < 0.6 ? Vector3{1, 0, 0} : Vector3{0, 1, 0}, u = cross(along, aside);
  const Vector3 unit = (1 / std::sqrt(dot(u, u))) * u;
  return {unit, cross(along, unit)};
}

void add_point(Vector3 p, Vector3 inwards, double share, LinkSurface& into) {
  into.x.push_back(p.x);
  into.y.push_back(p.y);
  into.z.push_back(p.z);
  into.nx.push_back(inwards.x);
  into.ny.push_back(inwards.y);
  into.nz.push_back(inwards.z);
  into.share.push_back(share);
}

// Makes the shares sum to 1, and returns their sum before.
double even_out(LinkSurface& surface) {
  double sum = 0;
  for (double share : surface.share) sum += share;
  for (double& share : surface.share) share /= sum;
  return sum;
}

// Rows around the capsule, at equal arc steps from pole to pole; each row has as many points as steps fit its length.
void add_rows(const std::vector<Line>& lines, std::size_t own, double step_m, LinkSurface& into) {
  const Line& line = lines[own];
  const double r = line.radius_m, arc = line.length_m + kPi * r;
  const int rows = std::max(2, static_cast<int>(std::lround(arc / step_m)));
  const auto [u, v] = across_of(line.along);
  for (int row = 0; row < rows; ++row) {
    const double at = (row + 0.5) * arc / rows - 0.5 * kPi * r, over = at < 0 ? at : std::max(at - line.length_m, 0.0);
    const double along = std::clamp(at, 0.0, line.length_m) + r * std::sin(over / r), across = r * std::cos(over / r);
    const int around = std::max(3, static_cast<int>(std::lround(2 * kPi * across / step_m)));
    for (int k = 0; k < around; ++k) {
      const double turned = 2 * kPi * (k + 0.5 * (row % 2)) / around;
      const Vector3 p = line.start + along * line.along + across * (std::cos(turned) * u + std::sin(turned) * v);
      if (hidden(lines, own, p)) continue;
      const Vector3 inwards = (1 / r) * (nearest(line, p) - p);
      add_point(p, inwards, 2 * kPi * across * arc / rows / around, into);
    }
  }
}

}  // namespace

LinkSurface surface_of(std::span<const Capsule> capsules, int points) {
  std::vector<Line> lines;
  double area = 0;
  for (const Capsule& capsule : capsules) {
    lines.push_back(line_between(vector3(capsule.start), vector3(capsule.end), capsule.radius_m));
    area += area_of(lines.back());
  }
  LinkSurface surface;
  for (std::size_t k = 0; k < lines.size(); ++k) add_rows(lines, k, std::sqrt(area / points), surface);
  surface.area_m2 = even_out(surface);
  return surface;
}

namespace {

// --- Guessed shapes.

constexpr std::size_t kDraws = 10;                    // random numbers of a shape and a point on it
constexpr double kSlimmest = 0.02, kThickest = 0.08;  // radius, as a share of the arm's length
constexpr double kShortestArm_m = 0.1;
constexpr double kTool = 0.05;       // longest tool beyond the last frame, as a share of the arm's length
constexpr double kAtOrigin = 0.5;    // probability that a joint is at its frame's origin, not elsewhere on its axis
constexpr double kParallel = 0.25;   // axes count as parallel below this squared sine of their angle
constexpr double kMassWrong = 0.1;   // probability that the file's mass distribution contains nothing about the shape
constexpr double kMassOff_m = 0.03;  // standard error of a surface that follows from the mass distribution
constexpr double kUniform = 5;       // the surface of a uniform ellipsoid, in squared standard deviations of its mass

double length_of(Vector3 v) { return std::sqrt(dot(v, v)); }

// End of a link that carries no joint: the load frame, else the farthest frame that the robot file fixes to the link.
Vector3 end_of(const Bundle& bundle, int link) {
  if (bundle.load.link == link) return vector3(bundle.load.translation);
  Vector3 farthest{};
  for (const WrenchFrame& frame : bundle.wrench.frames)
    if (frame.link == link && length_of(vector3(frame.translation)) > length_of(farthest)) farthest = vector3(frame.translation);
  return farthest;
}

// Where a link's body meets the next axis: nearest points of the two axes, from the origin of each frame, [m].
struct Crossing {
  double on_parent = 0, on_own = 0;
};

// Crossing of a link's axis with its parent's. Parallel axes: as high on the parent's axis as its origin, the link's, or
// the parent's centre of mass, or between them, by u; on the base at its origin.
Crossing crossing(const Link& link, const Link* parent, double u) {
  const Vector3 origin = vector3(link.translation), axis = turn(link.rotation).z;
  const double cosine = axis.z, along = dot(origin, axis), squared_sine = 1 - cosine * cosine;
  if (parent == nullptr) return {0, -along};
  if (squared_sine >= kParallel) return {(origin.z - cosine * along) / squared_sine, (cosine * origin.z - along) / squared_sine};
  const auto [low, high] = std::minmax({0.0, origin.z, parent->mass > 0 ? parent->com[2] : 0.0});
  const double height = low + (high - low) * u;
  return {height, cosine * height - along};
}

// Where a joint is on its axis, between the parent's body and its own link's: at the frame's origin, or anywhere.
double joint_at(double from, double to, double u) {
  const auto [low, high] = std::minmax(from, to);
  return u < kAtOrigin ? std::clamp(0.0, low, high) : low + (high - low) * (u - kAtOrigin) / (1 - kAtOrigin);
}

// Point of an even sequence in the unit cube (Kronecker's, with powers of the generalised golden ratio).
std::array<double, kDraws> even(int point) {
  double ratio = 2;
  for (int k = 0; k < 60; ++k) ratio = std::pow(1 + ratio, 1.0 / (kDraws + 1));
  std::array<double, kDraws> u;
  double step = 1;
  for (double& value : u) {
    step /= ratio;
    value = std::fmod(0.5 + (point + 1) * step, 1.0);
  }
  return u;
}

struct Drawn {
  double area_m2, share;
};

// What the robot file contains about the shape of a link.
class Guess {
 public:
  Guess(const Bundle& bundle, int link) : links_(bundle.links), own_(links_[static_cast<std::size_t>(link)]) {
    for (int k = 0; k < bundle.joints(); ++k) {
      ends_.push_back(end_of(bundle, k));
      children_.emplace_back();
    }
    for (int k = 0; k < bundle.joints(); ++k)
      if (const int parent = links_[static_cast<std::size_t>(k)].parent; parent >= 0) children_[static_cast<std::size_t>(parent)].push_back(k);
    for (std::size_t k = 0; k < links_.size(); ++k)
      arm_m_ += length_of(vector3(links_[k].translation)) + (children_[k].empty() ? length_of(ends_[k]) : 0);
    arm_m_ = std::max(arm_m_, kShortestArm_m);
    link_ = static_cast<std::size_t>(link);
    if (own_.mass > 0) {
      const double half = 0.5 * (own_.inertia[0] + own_.inertia[1] + own_.inertia[2]);
      const auto variance = [&](std::size_t axis) { return (half - own_.inertia[axis]) / own_.mass + kMassOff_m * kMassOff_m; };
      const auto covariance = [&](std::size_t pair) { return -own_.inertia[pair] / own_.mass; };
      spread_ = {variance(0), 0, 0, covariance(3), variance(1), 0, covariance(4), covariance(5), variance(2)};
      const double slimmest = kSlimmest * arm_m_;  // a narrower distribution is a placeholder
      massive_ = half / own_.mass >= 0.5 * slimmest * slimmest && cholesky(spread_, 3);
    }
  }

  // Adds a point of a shape, both drawn by u; none if the point is inside the shape. Returns the shape's area, of which
  // nothing counts then, and the share of such shapes.
  Drawn draw(const std::array<double, kDraws>& u, LinkSurface& into) const {
    const double radius = arm_m_ * kSlimmest * std::pow(kThickest / kSlimmest, u[0]);
    const std::vector<Line> lines = lines_of(u, radius);
    double all = 0;
    for (const Line& line : lines) all += area_of(line);
    std::size_t part = 0;
    double area = u[6] * all;
    while (part + 1 < lines.size() && area > area_of(lines[part])) area -= area_of(lines[part++]);
    const Line& line = lines[part];
    // Equal steps along a capsule pass equal areas.
    const double at = u[7] * (line.length_m + 2 * radius) - radius, turned = 2 * kPi * u[8];
    const double foot = std::clamp(at, 0.0, line.length_m), rise = std::clamp((at - foot) / radius, -1.0, 1.0);
    const auto [a, b] = across_of(line.along);
    const Vector3 out = rise * line.along + std::sqrt(1 - rise * rise) * (std::cos(turned) * a + std::sin(turned) * b);
    const Vector3 p = line.start + foot * line.along + radius * out;
    const bool seen = !hidden(lines, part, p);
    if (seen) add_point(p, -1.0 * out, mass_allows(p), into);
    return {seen ? all : 0.0, mass_allows(p)};
  }

 private:
  Crossing crossing_of(std::size_t link, double u) const {
    const int parent = links_[link].parent;
    return crossing(links_[link], parent < 0 ? nullptr : &links_[static_cast<std::size_t>(parent)], u);
  }

  // Axis of a shape's parts: from the link's joint along its axis to the next axis, and there to the next joint or to the
  // end. Both joints are drawn, and how far the shape extends beyond them.
  std::vector<Line> lines_of(const std::array<double, kDraws>& u, double radius) const {
    const auto child_of = [&](std::size_t link) {
      const std::vector<int>& all = children_[link];
      return all.empty() ? -1 : all[std::min(static_cast<std::size_t>(u[1] * static_cast<double>(all.size())), all.size() - 1)];
    };
    const auto leaves_axis = [&](std::size_t link) {
      const int child = child_of(link);
      return child < 0 ? ends_[link].z : crossing_of(static_cast<std::size_t>(child), u[9]).on_parent;
    };
    const double leaves = leaves_axis(link_);
    std::vector<Vector3> path{{0, 0, joint_at(crossing_of(link_, u[9]).on_own, leaves, u[2])}, {0, 0, leaves}};
    double beyond = radius * (2 * u[5] - 1);
    if (const int child = child_of(link_); child < 0) {
      path.push_back(ends_[link_]);
      beyond += kTool * arm_m_ * u[5];
    } else {
      const Link& next = links_[static_cast<std::size_t>(child)];
      const Vector3 origin = vector3(next.translation), axis = turn(next.rotation).z;
      const double reaches = crossing_of(static_cast<std::size_t>(child), u[9]).on_own;
      path.push_back(origin + reaches * axis);
      path.push_back(origin + joint_at(reaches, leaves_axis(static_cast<std::size_t>(child)), u[3]) * axis);
    }
    std::vector<Line> lines;
    for (std::size_t k = 0; k + 1 < path.size(); ++k)
      if (const Line line = line_between(path[k], path[k + 1], radius); line.length_m > kShortest_m) lines.push_back(line);
    if (lines.empty()) lines.push_back(line_between(path[0], path[0], radius));
    lengthen(lines.front(), -1, radius * (2 * u[4] - 1));
    lengthen(lines.back(), 1, beyond);
    return lines;
  }

  // Lengthens a line at its start (side -1) or end (1); at most to nothing where `by` is negative.
  static void lengthen(Line& line, int side, double by) {
    const double change = std::max(by, -line.length_m);
    if (side < 0) line.start = line.start - change * line.along;
    line.length_m += change;
  }

  // Share of the shapes with this point on their surface that agree with the mass distribution: a uniform ellipsoid with
  // the file's centre of mass and inertia ends near there, or farther out.
  double mass_allows(Vector3 p) const {
    if (!massive_) return 1;
    const Vector3 off = p - vector3(own_.com);
    std::array<double, 3> x{off.x, off.y, off.z};
    forward(spread_, 3, x);
    const double outside = std::max(std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]) - std::sqrt(kUniform), 0.0);
    return kMassWrong + (1 - kMassWrong) * std::exp(-outside * outside);
  }

  static constexpr double kShortest_m = 1e-6;  // of a part with a direction

  const std::vector<Link>& links_;
  const Link& own_;
  std::size_t link_ = 0;
  std::vector<std::vector<int>> children_;  // per link
  std::vector<Vector3> ends_;               // per link
  double arm_m_ = 0;                        // sum of the distances from joint to joint, and to the end
  bool massive_ = false;
  std::array<double, 9> spread_{};          // factor of the mass distribution's covariance, [m^2]
};

}  // namespace

LinkSurface guessed_surface(const Bundle& bundle, int link, int points) {
  const Guess guess(bundle, link);
  LinkSurface surface;
  double shapes = 0;
  for (int point = 0; point < points; ++point) {
    const Drawn drawn = guess.draw(even(point), surface);
    surface.area_m2 += drawn.share * drawn.area_m2;
    shapes += drawn.share;
  }
  surface.area_m2 /= shapes;
  even_out(surface);
  return surface;
}

}  // namespace tauext
