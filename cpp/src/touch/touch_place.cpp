#include "tauext/touch_place.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "bundle/linear.hpp"
#include "chain/vector3.hpp"
#include "touch/cone_fit.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

// Component of a mixture: f ~ N(mean n, P), 1 / P is `across` plus `more` along the normal n.
struct Size {
  double mean_n, across, more, weight;
};

constexpr std::size_t kSizes = PlaceModel::kSizes_n.size(), kWays = PlaceModel::kAcross.size(), kParts = kSizes * kWays + 1;

// Probability of each size.
std::array<double, kSizes> size_weights() noexcept {
  std::array<double, kSizes> weights{};
  double sum = 0;
  for (std::size_t k = 0; k < kSizes; ++k) {
    const double off = std::log(PlaceModel::kSizes_n[k] / PlaceModel::kMedian_n) / PlaceModel::kLogSpread;
    sum += weights[k] = std::pow(1 + off * off / PlaceModel::kFreedom, -0.5 * (PlaceModel::kFreedom + 1));
  }
  for (double& weight : weights) weight /= sum;
  return weights;
}
const std::array<double, kSizes> kSizeWeights = size_weights();

std::array<Size, kParts> mixture_of(double normal_error) noexcept {
  std::array<Size, kParts> all{};
  for (std::size_t k = 0; k < kSizes; ++k)
    for (std::size_t way = 0; way < kWays; ++way) {
      const double s = PlaceModel::kSizes_n[k], b = std::hypot(PlaceModel::kAcross[way], normal_error);
      const double along = 1 / (PlaceModel::kAlong * PlaceModel::kAlong * s * s), across = 1 / (b * b * s * s);
      all[k * kWays + way] = {s, across, along - across, (1 - PlaceModel::kHolds) / kWays * kSizeWeights[k]};
    }
  all[kParts - 1] = {0, 1 / (PlaceModel::kHolds_n * PlaceModel::kHolds_n), 0, PlaceModel::kHolds};
  return all;
}

const std::array<std::array<Size, kParts>, 2> kMixtures{mixture_of(PlaceModel::kNormalGiven), mixture_of(PlaceModel::kNormalGuessed)};

// Logarithm of |P|^-1/2 times exp(-m^T P^-1 m / 2) times the weight.
double before(const Size& size) noexcept {
  const double along = size.across + size.more;
  return std::log(size.weight) + 0.5 * std::log(size.across * size.across * along) - 0.5 * along * size.mean_n * size.mean_n;
}

struct Symmetric {
  double xx, yy, zz, xy, xz, yz;
};

// |K| and h^T K^-1 h.
struct Solved {
  double determinant, quadratic;
};

inline Solved solve(const Symmetric& k, double hx, double hy, double hz) noexcept {
  const double a = k.yy * k.zz - k.yz * k.yz, b = k.xz * k.yz - k.xy * k.zz, c = k.xy * k.yz - k.xz * k.yy;
  const double d = k.xx * k.zz - k.xz * k.xz, e = k.xy * k.xz - k.xx * k.yz, f = k.xx * k.yy - k.xy * k.xy;
  const double determinant = k.xx * a + k.xy * b + k.xz * c;
  const double sum = a * hx * hx + d * hy * hy + f * hz * hz + 2 * (b * hx * hy + c * hx * hz + e * hy * hz);
  return {determinant, sum / determinant};
}

// Likelihood of a force at a point, given tau_ext: exp(b^T f - f^T M f / 2).
struct SeenAt {
  Symmetric m;
  double bx, by, bz;
};
constexpr std::size_t kSeenAt = 9;  // number of values

// Each row of a matrix times [p]x from the right: a^T [p]x = (a x p)^T.
inline std::array<double, 9> rows_cross(const std::array<double, 9>& a, double x, double y, double z) noexcept {
  return {a[1] * z - a[2] * y, a[2] * x - a[0] * z, a[0] * y - a[1] * x, a[4] * z - a[5] * y, a[5] * x - a[3] * z,
          a[3] * y - a[4] * x, a[7] * z - a[8] * y, a[8] * x - a[6] * z, a[6] * y - a[7] * x};
}

// The wrench of a force f at p is (f, X f) with X = [p]x, so that M = ff + fm X + X^T mf + X^T mm X = ff + D X + (D X)^T with
// D = fm + X^T mm / 2.
template <typename Information>
inline SeenAt seen_at(const Information& of, double x, double y, double z) noexcept {
  const std::array<double, 9> half = rows_cross(of.mm, x, y, z);  // (X^T mm)^T
  std::array<double, 9> d;
  for (std::size_t r = 0; r < 3; ++r)
    for (std::size_t c = 0; c < 3; ++c) d[3 * r + c] = of.fm[3 * r + c] + 0.5 * half[3 * c + r];
  const std::array<double, 9> dx = rows_cross(d, x, y, z);
  return {{of.ff[0] + 2 * dx[0], of.ff[4] + 2 * dx[4], of.ff[8] + 2 * dx[8], of.ff[1] + dx[1] + dx[3], of.ff[2] + dx[2] + dx[6],
           of.ff[5] + dx[5] + dx[7]},
          of.f[0] + of.m[1] * z - of.m[2] * y,
          of.f[1] + of.m[2] * x - of.m[0] * z,
          of.f[2] + of.m[0] * y - of.m[1] * x};
}

// Adds a mixture component.
inline SeenAt with(const SeenAt& seen, const Size& size, double nx, double ny, double nz) noexcept {
  const double more = size.more, push = (size.across + size.more) * size.mean_n;
  return {{seen.m.xx + size.across + more * nx * nx, seen.m.yy + size.across + more * ny * ny,
           seen.m.zz + size.across + more * nz * nz, seen.m.xy + more * nx * ny, seen.m.xz + more * nx * nz,
           seen.m.yz + more * ny * nz},
          seen.bx + push * nx,
          seen.by + push * ny,
          seen.bz + push * nz};
}

double squared_distance(const LinkSurface& surface, std::size_t i, Vector3 to) noexcept {
  const Vector3 off = Vector3{surface.x[i], surface.y[i], surface.z[i]} - to;
  return dot(off, off);
}

std::vector<std::vector<std::uint32_t>> neighbours(const LinkSurface& surface, double within_m) {
  std::vector<std::vector<std::uint32_t>> all(surface.size());
  for (std::size_t i = 0; i < surface.size(); ++i)
    for (std::size_t k = 0; k < surface.size(); ++k)
      if (squared_distance(surface, k, {surface.x[i], surface.y[i], surface.z[i]}) < within_m * within_m)
        all[i].push_back(static_cast<std::uint32_t>(k));
  return all;
}

// Logarithm of the sum of the exponentials of log(0) to log(count - 1).
template <typename Log>
double log_sum(Log&& log, std::size_t count) noexcept {
  double most = -std::numeric_limits<double>::infinity(), sum = 0;
  for (std::size_t k = 0; k < count; ++k) most = std::max(most, log(k));
  for (std::size_t k = 0; k < count; ++k) sum += std::exp(log(k) - most);
  return most + std::log(sum);
}

constexpr double kFarBelow = -40;  // smaller exponentials do not change a sum of such terms
constexpr double kNoMatter = 1e-4, kNoPart = 0.01;  // less probable points, and components at a point, are left out

}  // namespace

void PlaceModel::ForceSizes::add(double n, double weight) noexcept {
  const double at = std::clamp(std::log(std::max(n, kLeast_n) / kLeast_n) / kStep, 0.0, static_cast<double>(probability.size() - 1));
  probability[static_cast<std::size_t>(at)] += weight;
}

double PlaceModel::ForceSizes::quantile(double share) const noexcept {
  double left = share * std::accumulate(probability.begin(), probability.end(), 0.0);
  std::size_t k = 0;
  while (k + 1 < probability.size() && left > probability[k]) left -= probability[k++];
  return kLeast_n * std::exp(kStep * (static_cast<double>(k) + (probability[k] > 0 ? left / probability[k] : 0)));
}

PlaceModel::PlaceModel(const Bundle& bundle) : wrench_(bundle) {
  const auto n = static_cast<std::size_t>(bundle.joints());
  double area_m2 = 0;
  for (int link = 0; link < bundle.joints(); ++link) {
    std::vector<Capsule> own;
    for (const Capsule& one : bundle.capsules)
      if (one.link == link) own.push_back(one);
    guessed_.push_back(own.empty());
    surfaces_.push_back(own.empty() ? guessed_surface(bundle, link, kGuessPoints) : surface_of(own, kPoints));
    near_.push_back(neighbours(surfaces_.back(), 0.5 * kApart_m));
    most_ = std::max(most_, surfaces_.back().size());
    area_m2 += surfaces_.back().area_m2;
  }
  for (const LinkSurface& surface : surfaces_) log_prior_.push_back(std::log(surface.area_m2 / area_m2));
  logs_.resize(n * most_);
  weights_.resize(n * most_);
  left_.resize(most_);
  seen_at_.resize(most_ * kSeenAt);
  quadratic_.resize(most_ * kParts);
  scale_.resize(most_ * kParts);
  seen_.resize(n);
  q_.resize(n);
}

std::span<double> PlaceModel::of(std::size_t link, std::vector<double>& values) const noexcept {
  return std::span(values).subspan(link * most_, surfaces_[link].size());
}

// Integral over forces for each point, and the log of its sum over components. The loops have no branches or calls, so
// that compilers vectorise them.
double PlaceModel::evidence(std::size_t link) noexcept {
  const Information& information = seen_[link];
  const LinkSurface& surface = surfaces_[link];
  const std::array<Size, kParts>& mixture = kMixtures[guessed_[link]];
  const std::span<double> logs = of(link, logs_);
  const std::size_t points = surface.size();
  double* const seen = seen_at_.data();
  for (std::size_t i = 0; i < points; ++i) {
    const SeenAt at = seen_at(information, surface.x[i], surface.y[i], surface.z[i]);
    const double all[kSeenAt] = {at.m.xx, at.m.yy, at.m.zz, at.m.xy, at.m.xz, at.m.yz, at.bx, at.by, at.bz};
    for (std::size_t k = 0; k < kSeenAt; ++k) seen[k * points + i] = all[k];
  }
  for (std::size_t part = 0; part < kParts; ++part) {
    const Size size = mixture[part];
    double* const quadratic = quadratic_.data() + part * points;
    double* const scale = scale_.data() + part * points;
    for (std::size_t i = 0; i < points; ++i) {
      const SeenAt alone{{seen[i], seen[points + i], seen[2 * points + i], seen[3 * points + i], seen[4 * points + i],
                          seen[5 * points + i]},
                         seen[6 * points + i],
                         seen[7 * points + i],
                         seen[8 * points + i]};
      const SeenAt at = with(alone, size, surface.nx[i], surface.ny[i], surface.nz[i]);
      const Solved solved = solve(at.m, at.bx, at.by, at.bz);
      quadratic[i] = 0.5 * solved.quadratic;
      scale[i] = solved.determinant;
    }
  }
  std::array<double, kParts> start;
  for (std::size_t part = 0; part < kParts; ++part) start[part] = before(mixture[part]);
  double best = -std::numeric_limits<double>::infinity();
  for (std::size_t i = 0; i < points; ++i) {
    double most = -std::numeric_limits<double>::infinity(), sum = 0;
    for (std::size_t part = 0; part < kParts; ++part) most = std::max(most, start[part] + quadratic_[part * points + i]);
    for (std::size_t part = 0; part < kParts; ++part) {
      const double below = start[part] + quadratic_[part * points + i] - most;
      if (below > kFarBelow) sum += std::exp(below) / std::sqrt(scale_[part * points + i]);
    }
    logs[i] = most + std::log(sum * surface.share[i]);
    best = std::max(best, logs[i]);
  }
  double sum = 0;
  for (std::size_t i = 0; i < points; ++i)
    if (logs[i] - best > kFarBelow) sum += std::exp(logs[i] - best);
  return best + std::log(sum);
}

// Adds the posterior of the force's size at a point, and returns the mean force. Sizes of a component of the mixture are
// taken as normal, at three sizes.
std::array<double, 3> PlaceModel::add_forces(std::size_t link, std::size_t point, double weight, ForceSizes& sizes) const noexcept {
  constexpr std::array<double, 3> kSpread{-1.2247, 0, 1.2247};  // has the normal distribution's variance
  const LinkSurface& surface = surfaces_[link];
  const std::array<Size, kParts>& mixture = kMixtures[guessed_[link]];
  const SeenAt alone = seen_at(seen_[link], surface.x[point], surface.y[point], surface.z[point]);
  std::array<double, kParts> logs;
  std::array<SeenAt, kParts> at;
  for (std::size_t part = 0; part < kParts; ++part) {
    at[part] = with(alone, mixture[part], surface.nx[point], surface.ny[point], surface.nz[point]);
    const Solved solved = solve(at[part].m, at[part].bx, at[part].by, at[part].bz);
    logs[part] = before(mixture[part]) + 0.5 * solved.quadratic - 0.5 * std::log(solved.determinant);
  }
  const double most = *std::ranges::max_element(logs);
  double sum = 0;
  for (double& log : logs) sum += log = std::exp(log - most);
  std::array<double, 3> mean{};
  for (std::size_t part = 0; part < kParts; ++part) {
    const double share = logs[part] / sum;
    if (share < kNoPart) continue;
    const Symmetric& m = at[part].m;
    const Symmetric3 covariance = Symmetric3{m.xx, m.yy, m.zz, m.xy, m.xz, m.yz}.inverse();
    const Vector3 f = covariance.times({at[part].bx, at[part].by, at[part].bz});
    const double size = std::sqrt(dot(f, f)), along = size > 0 ? dot(f, covariance.times(f)) / (size * size) : 0;
    const double across = covariance.xx + covariance.yy + covariance.zz - along, middle = std::sqrt(size * size + across);
    for (const double z : kSpread) sizes.add(middle + z * std::sqrt(along), weight * share / kSpread.size());
    mean = {mean[0] + share * f.x, mean[1] + share * f.y, mean[2] + share * f.z};
  }
  return mean;
}

void PlaceModel::rank(std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
                      std::span<const double> contact_sigma_nm, TouchPlaces& into, std::span<const double> dq) noexcept {
  const auto n = static_cast<std::size_t>(joints());
  into = {};
  into.consistent = log_elsewhere_ = std::numeric_limits<double>::quiet_NaN();
  bool sound = refused().empty() && wrench_.known(q, tau_ext, sigma_nm, contact_sigma_nm);
  for (const double value : dq) sound = sound && std::isfinite(value);
  if (!sound) return;
  std::array<double, kMaxJoints> y;
  std::ranges::copy(tau_ext.first(n), y.begin());
  std::array<double, kMaxJoints * kMaxJoints> s;
  wrench_.take_off_rubbing(WrenchKind::force, q, dq, sigma_nm, contact_sigma_nm, std::span(y).first(n), s);
  const std::size_t rows = wrench_.told().size();
  wrench_.keep_told(s, n, true);
  wrench_.keep_told(y, 1, false);
  tau_ = y;
  s_ = s;
  if (!cholesky(std::span(s).first(rows * rows), rows)) return;
  forward(s, rows, std::span(y).first(rows));
  std::array<double, kMaxJoints> logs{};
  for (std::size_t link = 0; link < n; ++link) {
    std::array<double, 6 * kMaxJoints> columns;
    wrench_.columns(static_cast<int>(link), q, {}, WrenchAxes::frame, columns);
    wrench_.keep_told(columns, 6, false);
    for (std::size_t i = 0; i < 6; ++i) forward(s, rows, std::span(columns).subspan(i * rows, rows));
    const auto times = [&](std::size_t a, std::size_t b) noexcept {
      return std::inner_product(&columns[a * rows], &columns[a * rows] + rows, &columns[b * rows], 0.0);
    };
    Information& of = seen_[link];
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        of.ff[3 * i + j] = times(i, j);
        of.fm[3 * i + j] = times(i, 3 + j);
        of.mm[3 * i + j] = times(3 + i, 3 + j);
      }
      of.f[i] = std::inner_product(&columns[i * rows], &columns[i * rows] + rows, y.data(), 0.0);
      of.m[i] = std::inner_product(&columns[(3 + i) * rows], &columns[(3 + i) * rows] + rows, y.data(), 0.0);
    }
    log_link_[link] = evidence(link);
    logs[link] = log_prior_[link] + kTrust * log_link_[link];
  }
  const double best = *std::max_element(logs.begin(), logs.begin() + static_cast<std::ptrdiff_t>(n));
  if (!std::isfinite(best)) return;
  double sum = 0;
  for (std::size_t link = 0; link < n; ++link) sum += into.probability[link] = std::exp(logs[link] - best);
  for (std::size_t link = 0; link < n; ++link) into.probability[link] /= sum;
  const std::span<std::int32_t> ranked = std::span(into.ranked).first(n);
  std::iota(ranked.begin(), ranked.end(), 0);
  std::ranges::sort(ranked, [&into](std::int32_t a, std::int32_t b) noexcept {
    const double pa = into.probability[static_cast<std::size_t>(a)], pb = into.probability[static_cast<std::size_t>(b)];
    return pa != pb ? pa > pb : a < b;
  });
  log_elsewhere_ = log_sum([&](std::size_t link) noexcept { return log_prior_[link] + log_link_[link]; }, n);
  std::ranges::copy(q.first(n), q_.begin());
  into.known = true;
}

void PlaceModel::locate(TouchPlaces& into, int given) noexcept {
  const auto n = static_cast<std::size_t>(joints());
  into.places = 0;
  into.best = -1;
  if (!into.known) return;
  ForceSizes sizes;
  for (std::size_t link = 0; link < n; ++link)
    if (given < 0 || given == static_cast<int>(link)) place_on(link, given < 0 ? into.probability[link] : 1.0, sizes, into);
  if (into.places == 0) return;
  bound(given, sizes, into);
  // Chi-square left by the first place, whose point is wrong by kOff_m along each axis.
  const TouchPlace& first = into.place[0];
  std::array<double, 6 * kMaxJoints> columns;
  wrench_.columns(first.link, q_, first.on_link, WrenchAxes::base, columns);
  wrench_.keep_told(columns, 6, false);
  const std::span<const std::size_t> told = wrench_.told();
  const std::size_t rows = told.size();
  const Vector3 f = vector3(first.force);
  const double moment_nm = kOff_m * std::sqrt(dot(f, f));
  std::array<double, kMaxJoints> left = tau_;
  std::array<double, kMaxJoints * kMaxJoints> s = s_;
  for (std::size_t j = 0; j < rows; ++j) {
    for (std::size_t i = 0; i < 3; ++i) left[j] -= columns[i * rows + j] * first.force[i];
    for (std::size_t k = 0; k < rows; ++k)
      for (std::size_t i = 3; i < 6; ++i) s[j * rows + k] += moment_nm * moment_nm * columns[i * rows + j] * columns[i * rows + k];
  }
  if (!cholesky(std::span(s).first(rows * rows), rows)) return;
  forward(s, rows, std::span(left).first(rows));
  double chi_square = std::inner_product(left.begin(), left.begin() + static_cast<std::ptrdiff_t>(rows), left.begin(), 0.0);
  // Three unknowns of the force and two of the point, as far as the joints below the point can determine them.
  const auto on_the_way = std::ranges::count_if(told, [&first](std::size_t j) noexcept { return static_cast<int>(j) <= first.link; });
  const int freedom = static_cast<int>(told.size()) - std::min(static_cast<int>(on_the_way), 5);
  chi_square /= wrench_.settings().residual_radius[static_cast<std::size_t>(WrenchKind::force)];
  into.consistent = freedom > 0 ? chi_square_beyond(chi_square, freedom) : 1.0;
}

// Clusters of points: the densest one with all points within kApart_m, then the same for the rest.
void PlaceModel::place_on(std::size_t link, double probability, ForceSizes& sizes, TouchPlaces& into) noexcept {
  const LinkSurface& surface = surfaces_[link];
  const std::size_t points = surface.size();
  const std::span<const double> logs = of(link, logs_);
  const std::span<double> weights = of(link, weights_);
  for (std::size_t i = 0; i < points; ++i) {
    left_[i] = weights[i] = std::exp(logs[i] - log_link_[link]);
    if (weights[i] * probability >= kNoMatter) add_forces(link, i, weights[i] * probability, sizes);
  }
  const auto at = [&surface](std::size_t i) noexcept { return Vector3{surface.x[i], surface.y[i], surface.z[i]}; };
  const auto [rotation, origin] = wrench_.pose(static_cast<int>(link), q_);
  const Turn out = turn(rotation);
  for (double left = 1; left * probability >= kLeast;) {
    std::size_t densest = 0;
    double most = 0;
    for (std::size_t i = 0; i < points; ++i) {
      double near = 0;
      for (const std::uint32_t k : near_[link][i]) near += left_[k];
      if (near > most) {
        most = near;
        densest = i;
      }
    }
    const auto grouped = [&](std::size_t i) noexcept { return squared_distance(surface, i, at(densest)) < kApart_m * kApart_m; };
    Vector3 mean{};
    double mass = 0;
    for (std::size_t i = 0; i < points; ++i)
      if (grouped(i)) {
        mass += left_[i];
        mean = mean + left_[i] * at(i);
      }
    if (!(mass > 0)) return;
    mean = (1 / mass) * mean;
    std::size_t nearest = densest;
    for (std::size_t i = 0; i < points; ++i)
      if (grouped(i) && squared_distance(surface, i, mean) < squared_distance(surface, nearest, mean)) nearest = i;
    double spread = 0;
    for (std::size_t i = 0; i < points; ++i)
      if (grouped(i)) {
        spread += left_[i] * squared_distance(surface, i, at(nearest));
        left_[i] = 0;
      }
    ForceSizes unused;
    const Vector3 p = vector3(origin) + out.out(at(nearest)), f = out.out(vector3(add_forces(link, nearest, 0, unused)));
    add({static_cast<int>(link), mass * probability, {p.x, p.y, p.z},
         {surface.x[nearest], surface.y[nearest], surface.z[nearest]}, {f.x, f.y, f.z}, std::sqrt(spread / mass),
         guessed(static_cast<int>(link))},
        into);
    left -= mass;
  }
}

// The best place, how far from it the touch may be, and how large its force.
void PlaceModel::bound(int given, const ForceSizes& sizes, TouchPlaces& into) const noexcept {
  into.best = 0;
  for (int k = into.places; k-- > 0;)
    if (into.place[static_cast<std::size_t>(k)].link == into.ranked[0]) into.best = k;
  const TouchPlace& best = into.place[static_cast<std::size_t>(into.best)];
  into.force_n = sizes.quantile(0.5);
  into.force_low_n = sizes.quantile(0.5 - 0.5 * TouchPlaces::kStated);
  into.force_high_n = sizes.quantile(0.5 + 0.5 * TouchPlaces::kStated);
  constexpr double kStep_m = 0.01;
  std::array<double, 400> by_distance{};
  for (std::size_t link = 0; link < surfaces_.size(); ++link) {
    const double probability = given < 0 ? into.probability[link] : given == static_cast<int>(link) ? 1.0 : 0.0;
    if (probability < kNoMatter) continue;
    const auto [rotation, origin] = wrench_.pose(static_cast<int>(link), q_);
    const Vector3 from = turn(rotation).back(vector3(best.point) - vector3(origin));
    for (std::size_t i = 0; i < surfaces_[link].size(); ++i) {
      const double far = std::sqrt(squared_distance(surfaces_[link], i, from)) / kStep_m;
      by_distance[static_cast<std::size_t>(std::min(far, static_cast<double>(by_distance.size() - 1)))] += probability * weights_[link * most_ + i];
    }
  }
  double left = TouchPlaces::kStated * std::accumulate(by_distance.begin(), by_distance.end(), 0.0);
  std::size_t k = 0;
  while (k + 1 < by_distance.size() && left > by_distance[k]) left -= by_distance[k++];
  into.within_m = kStep_m * static_cast<double>(k + 1);
}

double PlaceModel::at_frame(int frame) const noexcept {
  if (std::isnan(log_elsewhere_) || frame < 0 || frame >= wrench_.frames()) return std::numeric_limits<double>::quiet_NaN();
  const WrenchFrame& at = wrench_.frame(frame);
  const SeenAt alone = seen_at(seen_[static_cast<std::size_t>(at.link)], at.translation[0], at.translation[1], at.translation[2]);
  std::array<double, kSizes_n.size()> logs;
  for (std::size_t k = 0; k < kSizes_n.size(); ++k) {
    const double across = 3 / (kSizes_n[k] * kSizes_n[k]);  // the same size over all directions
    const Size size{0, across, 0, kSizeWeights[k]};
    const SeenAt here = with(alone, size, 0, 0, 1);
    const Solved solved = solve(here.m, here.bx, here.by, here.bz);
    logs[k] = before(size) + 0.5 * solved.quadratic - 0.5 * std::log(solved.determinant);
  }
  return 1 / (1 + std::exp(log_elsewhere_ - log_sum([&](std::size_t k) noexcept { return logs[k]; }, logs.size())));
}

void PlaceModel::add(const TouchPlace& place, TouchPlaces& into) const noexcept {
  if (place.probability < kLeast) return;
  int at = into.places;
  while (at > 0 && into.place[static_cast<std::size_t>(at - 1)].probability < place.probability) --at;
  if (at >= TouchPlaces::kMost) return;
  into.places = std::min(into.places + 1, TouchPlaces::kMost);
  for (int k = into.places - 1; k > at; --k) into.place[static_cast<std::size_t>(k)] = into.place[static_cast<std::size_t>(k - 1)];
  into.place[static_cast<std::size_t>(at)] = place;
}

}  // namespace tauext
