#include "tauext/wrench.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <span>

#include "bundle/linear.hpp"
#include "bundle/terms.hpp"
#include "chain/load_regressor.hpp"
#include "chain/vector3.hpp"
#include "prior/prior.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

// Largest size of an unknown; a standard error above it counts as unknown, [N]; moments times this length, [m].
struct WrenchScale {
  double largest_n, length_m, blind_n;
};

constexpr std::size_t kMost = Wrench::kMost;
using Square = std::array<double, kMost * kMost>;

// Eigenvalues onto the diagonal of `a` (m, m), symmetric; eigenvectors are the columns of `vectors`. Jacobi's rotations.
void eigen(Square& a, Square& vectors, std::size_t m) noexcept {
  vectors.fill(0);
  for (std::size_t i = 0; i < m; ++i) vectors[i * m + i] = 1;
  for (int sweep = 0; sweep < 30; ++sweep) {
    double off = 0, on = 0;
    for (std::size_t i = 0; i < m; ++i)
      for (std::size_t j = 0; j < m; ++j) (i == j ? on : off) += a[i * m + j] * a[i * m + j];
    if (off <= 1e-24 * on) return;
    for (std::size_t p = 0; p < m; ++p)
      for (std::size_t r = p + 1; r < m; ++r) {
        if (a[p * m + r] == 0) continue;
        const double theta = (a[r * m + r] - a[p * m + p]) / (2 * a[p * m + r]);
        const double t = std::copysign(1 / (std::fabs(theta) + std::hypot(theta, 1.0)), theta);
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (std::size_t k = 0; k < m; ++k) {
          const double x = a[k * m + p], y = a[k * m + r];
          a[k * m + p] = c * x - s * y;
          a[k * m + r] = s * x + c * y;
        }
        for (std::size_t k = 0; k < m; ++k) {
          const double x = a[p * m + k], y = a[r * m + k];
          a[p * m + k] = c * x - s * y;
          a[r * m + k] = s * x + c * y;
        }
        for (std::size_t k = 0; k < m; ++k) {
          const double x = vectors[k * m + p], y = vectors[k * m + r];
          vectors[k * m + p] = c * x - s * y;
          vectors[k * m + r] = s * x + c * y;
        }
      }
  }
}

// Normal equations in units of each unknown's largest size: products of the columns, and with the torques.
struct Seen {
  Square products{};
  double shown[kMost] = {}, size[kMost] = {}, whole = 0;
  std::size_t m = 0;
};

// Inverse of a matrix given by its lower Cholesky factor, (m, m).
void invert_lower(std::span<const double> factor, std::size_t m, Square& inverse) noexcept {
  Square lower{};
  for (std::size_t e = 0; e < m; ++e) {
    double column[kMost] = {};
    column[e] = 1;
    forward(factor, m, std::span(column).first(m));
    for (std::size_t i = 0; i < m; ++i) lower[i * m + e] = column[i];
  }
  for (std::size_t i = 0; i < m; ++i)
    for (std::size_t j = 0; j < m; ++j) {
      double sum = 0;
      for (std::size_t k = std::max(i, j); k < m; ++k) sum += lower[k * m + i] * lower[k * m + j];
      inverse[i * m + j] = sum;
    }
}

// Fast path without eigenvectors: no direction is blind if the trace of the relative covariance is below blind_share.
// Returns false otherwise.
bool solve_seen(const Seen& seen, double blind_share, std::size_t n, std::array<double, kMost>& w, Wrench& found) noexcept {
  const std::size_t m = seen.m;
  Square alone = seen.products, with_prior = seen.products;
  for (std::size_t i = 0; i < m; ++i) with_prior[i * m + i] += 1;
  if (n < m || !cholesky(std::span(alone).first(m * m), m) || !cholesky(std::span(with_prior).first(m * m), m)) return false;
  Square inverse;
  invert_lower(with_prior, m, inverse);
  double trace = 0;
  for (std::size_t i = 0; i < m; ++i) trace += inverse[i * m + i];
  if (!(trace < blind_share)) return false;
  found.blind = 0;
  found.chi_square = seen.whole;
  found.freedom = static_cast<int>(n - m);
  double explained[kMost];
  std::copy_n(seen.shown, m, explained);
  forward(alone, m, std::span(explained).first(m));
  for (std::size_t i = 0; i < m; ++i) {
    found.chi_square -= explained[i] * explained[i];
    for (std::size_t j = 0; j < m; ++j) {
      w[i] += seen.size[i] * inverse[i * m + j] * seen.shown[j];
      found.covariance[i * m + j] = seen.size[i] * seen.size[j] * inverse[i * m + j];
    }
  }
  return true;
}

// A direction is unobservable if a force of largest_n shows as less than a tenth of a standard error.
constexpr double kExplains = 0.01;

void solve_by_directions(Seen& seen, double blind_share, std::size_t n, std::array<double, kMost>& w, Wrench& found) noexcept {
  const std::size_t m = seen.m;
  Square vectors;
  eigen(seen.products, vectors, m);
  found.blind = 0;
  found.chi_square = seen.whole;
  found.freedom = static_cast<int>(n);
  for (std::size_t e = 0; e < m; ++e) {
    const double value = std::max(seen.products[e * m + e], 0.0);
    double along = 0;
    for (std::size_t i = 0; i < m; ++i) along += vectors[i * m + e] * seen.shown[i];
    if (value > kExplains) {
      found.chi_square -= along * along / value;
      --found.freedom;
    }
    for (std::size_t i = 0; i < m; ++i) {
      w[i] += seen.size[i] * vectors[i * m + e] * along / (value + 1);
      for (std::size_t j = 0; j < m; ++j)
        found.covariance[i * m + j] += seen.size[i] * vectors[i * m + e] * seen.size[j] * vectors[j * m + e] / (value + 1);
    }
    if (blind_share * (value + 1) >= 1) continue;
    auto& direction = found.blind_directions[static_cast<std::size_t>(found.blind++)];
    for (std::size_t i = 0; i < m; ++i) direction[i] = vectors[i * m + e];
  }
}

// s: (n, n) and columns: (unknowns, n) are overwritten. Fills `found` except unknowns, moment of a force, consistent
// and known. Returns false if s is not positive definite.
bool solve_wrench(std::span<double> s, std::span<double> columns, std::span<const double> tau_ext, const WrenchScale& scale,
                  Wrench& found) noexcept {
  const std::size_t n = tau_ext.size(), m = columns.size() / n;
  if (!cholesky(s, n)) return false;
  std::array<double, kMaxJoints> y;
  std::ranges::copy(tau_ext, y.begin());
  forward(s, n, std::span(y).first(n));
  Seen seen;
  seen.m = m;
  for (std::size_t k = 0; k < n; ++k) seen.whole += y[k] * y[k];
  for (std::size_t i = 0; i < m; ++i) {
    seen.size[i] = scale.largest_n * (i < 3 ? 1.0 : scale.length_m);
    const std::span<double> column = columns.subspan(i * n, n);
    for (double& value : column) value *= seen.size[i];
    forward(s, n, column);
    for (std::size_t k = 0; k < n; ++k) seen.shown[i] += column[k] * y[k];
    for (std::size_t j = 0; j <= i; ++j) {
      double sum = 0;
      for (std::size_t k = 0; k < n; ++k) sum += column[k] * columns[j * n + k];
      seen.products[i * m + j] = seen.products[j * m + i] = sum;
    }
  }
  const double blind_share = std::pow(scale.blind_n / scale.largest_n, 2);
  std::array<double, kMost> w{};
  found.covariance.fill(0);
  if (!solve_seen(seen, blind_share, n, w, found)) solve_by_directions(seen, blind_share, n, w, found);
  found.chi_square = std::max(found.chi_square, 0.0);
  found.freedom = std::max(found.freedom, 0);
  for (std::size_t i = 0; i < 3; ++i) {
    found.force[i] = w[i];
    if (m == kMost) found.moment[i] = w[3 + i];
  }
  return true;
}



std::string why_none(const Bundle& bundle) {
  if (std::ranges::none_of(bundle.links, [](const Link& link) { return link.mass > 0; }))
    return "the bundle has no model of the arm (case none): the places of its links are unknown";
  if (!bundle.error_scale.on()) return "the bundle has no error scale, and so no errors of tau_ext";
  if (bundle.observer.high_pass_per_s > 0 || bundle.observer.low_pass_per_s > 0)
    return "its residual is filtered, which turns the direction of a touch; train one without filters (recipe observer or prior)";
  if (bundle.observer.method == ResidualMethod::energy) return "the bundle answers in W, and a force is in newtons";
  return bundle.too_few_in_newtons("a force is in newtons");
}

// The columns of WrenchModel::columns(), along the chain from the frame to the base; returns the base.
LinkSeen see(const std::vector<Link>& links, const WrenchFrame& frame, std::span<const double> q,
         const std::array<double, 3>& point, WrenchAxes axes, std::span<double> into) noexcept {
  const auto n = links.size();
  std::fill_n(into.begin(), 6 * n, 0.0);
  const auto put = [&](std::size_t part, std::size_t j, Vector3 v) noexcept {
    into[3 * part * n + j] = v.x;
    into[(3 * part + 1) * n + j] = v.y;
    into[(3 * part + 2) * n + j] = v.z;
  };
  LinkSeen seen(frame.rotation, frame.translation);
  for (int at = frame.link; at >= 0;) {
    const auto j = static_cast<std::size_t>(at);
    const Link& link = links[j];
    const bool revolute = link.type == JointType::revolute;
    put(0, j, revolute ? cross(seen.axes.z, vector3(point) - seen.origin) : seen.axes.z);
    if (revolute) put(1, j, seen.axes.z);
    seen.pass(link, q[j]);
    at = link.parent;
  }
  if (axes == WrenchAxes::base)
    for (std::size_t j = 0; j < n; ++j)
      for (std::size_t part : {0u, 1u})
        put(part, j, seen.axes.back({into[3 * part * n + j], into[(3 * part + 1) * n + j], into[(3 * part + 2) * n + j]}));
  return seen;
}

}  // namespace

WrenchModel::WrenchModel(const Bundle& bundle)
    : refused_(why_none(bundle)),
      links_(bundle.links),
      settings_(bundle.wrench),
      tree_(bundle.prior.corrected_links.empty() ? bundle.links : bundle.prior.corrected_links, bundle.gravity),
      rubbing_(links_.size()) {
  const std::vector<double> shares = load_friction_shares(bundle.prior, bundle.joints());
  for (const Term& term : bundle.prior.terms)
    if (is_load(term)) rubbing_[static_cast<std::size_t>(term.a)] = shares[static_cast<std::size_t>(term.a)];
  for (std::size_t j = 0; j < links_.size(); ++j)
    if (bundle.in_newtons(static_cast<int>(j))) told_.push_back(j);
  for (std::size_t j = 0; j < links_.size(); ++j)
    frames_.push_back({links_[j].joint_name, static_cast<std::int32_t>(j), WrenchFrame{}.rotation, {}});
  if (bundle.load.link >= 0) frames_.push_back({bundle.load.frame, bundle.load.link, bundle.load.rotation, bundle.load.translation});
  for (const WrenchFrame& one : settings_.frames)
    if (find(one.name) < 0) frames_.push_back(one);
}

int WrenchModel::find(std::string_view name) const noexcept {
  for (std::size_t k = 0; k < frames_.size(); ++k)
    if (frames_[k].name == name) return static_cast<int>(k);
  return -1;
}

WrenchModel::Pose WrenchModel::columns(int frame, std::span<const double> q, const std::array<double, 3>& point, WrenchAxes axes,
                                       std::span<double> into) const noexcept {
  const LinkSeen base = see(links_, frames_[static_cast<std::size_t>(frame)], q, point, axes, into);
  const Vector3 at = -1.0 * base.axes.back(base.origin);
  return {{base.axes.x.x, base.axes.x.y, base.axes.x.z, base.axes.y.x, base.axes.y.y, base.axes.y.z, base.axes.z.x, base.axes.z.y,
           base.axes.z.z},
          {at.x, at.y, at.z}};
}

WrenchModel::Pose WrenchModel::pose(int frame, std::span<const double> q) const noexcept {
  std::array<double, 6 * kMaxJoints> all;
  return columns(frame, q, {}, WrenchAxes::frame, all);
}

namespace {

// From the size of a force along a direction to its three components.
void spread_along(const std::array<double, 3>& direction, Wrench& found) noexcept {
  const double size = found.force[0], variance = found.covariance[0];
  for (std::size_t i = 0; i < 3; ++i) {
    found.force[i] = size * direction[i];
    for (std::size_t k = 0; k < 3; ++k) found.covariance[3 * i + k] = variance * direction[i] * direction[k];
  }
  if (found.blind > 0) found.blind_directions[0] = {direction[0], direction[1], direction[2]};
}

// Variance that a contact adds to a joint's torque, without that of its constant, which covariance() has for all joints.
double of_contact(const WrenchSettings& settings, std::size_t joint, double tau_ext, double sigma_nm, double contact_sigma_nm) noexcept {
  const double constant = settings.share(joint) * tau_ext;
  return std::max(contact_sigma_nm * contact_sigma_nm - sigma_nm * sigma_nm - constant * constant, 0.0);
}

}  // namespace

void WrenchModel::covariance(WrenchKind kind, std::span<const double> tau_ext, std::span<const double> sigma_nm,
                             std::span<const double> contact_sigma_nm, std::span<double> into) const noexcept {
  const auto n = links_.size();
  const double radius = settings_.radius[static_cast<std::size_t>(kind)];
  const bool together = !settings_.correlation.empty();
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j) {
      const double alike = together ? settings_.correlation[i * n + j] : (i == j ? 1.0 : 0.0);
      into[i * n + j] = radius * sigma_nm[i] * sigma_nm[j] * alike + settings_.constants_covariance(i, j) * tau_ext[i] * tau_ext[j];
    }
  for (std::size_t i = 0; i < contact_sigma_nm.size(); ++i)
    into[i * n + i] += of_contact(settings_, i, tau_ext[i], sigma_nm[i], contact_sigma_nm[i]);
}

void WrenchModel::take_off_rubbing(WrenchKind kind, std::span<const double> q, std::span<const double> dq,
                                   std::span<const double> sigma_nm, std::span<const double> contact_sigma_nm,
                                   std::span<double> tau_ext, std::span<double> into) const noexcept {
  constexpr std::array<double, kMaxJoints> still{};
  std::array<double, kMaxJoints> taken{};
  const auto n = links_.size();
  for (std::size_t j = 0; j < n; ++j) tau_ext[j] /= settings_.factor(j);
  if (!dq.empty()) {
    std::array<double, kMaxJoints> momentum, weight;
    tree_.momentum(q, std::span(still).first(n), std::span(momentum).first(n), std::span(weight).first(n));
    for (std::size_t j = 0; j < n; ++j) {
      const double more = std::fabs(weight[j] - tau_ext[j]) - std::fabs(weight[j]);
      taken[j] = rubbing_[j] * std::tanh(dq[j] / kSignSpeed) * more;
      tau_ext[j] += taken[j];
    }
  }
  covariance(kind, tau_ext, sigma_nm, contact_sigma_nm, into);
  for (std::size_t j = 0; j < contact_sigma_nm.size(); ++j) {
    const double contact = of_contact(settings_, j, tau_ext[j], sigma_nm[j], contact_sigma_nm[j]);
    into[j * n + j] -= std::min(contact, (1 - kRubbingDoubt * kRubbingDoubt) * taken[j] * taken[j]);
  }
}

bool WrenchModel::known(std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
                        std::span<const double> contact_sigma_nm) const noexcept {
  for (std::size_t j = 0; j < links_.size(); ++j)
    if (!std::isfinite(q[j])) return false;
  return std::ranges::all_of(told_, [&](std::size_t j) noexcept {
    if (!contact_sigma_nm.empty() && !(contact_sigma_nm[j] >= sigma_nm[j] && std::isfinite(contact_sigma_nm[j]))) return false;
    return std::isfinite(tau_ext[j]) && sigma_nm[j] > 0 && std::isfinite(sigma_nm[j]);
  });
}

// Each value moves towards the front, past values already moved.
void WrenchModel::keep_told(std::span<double> values, std::size_t count, bool square) const noexcept {
  const std::size_t n = links_.size(), rows = told_.size();
  if (rows == n) return;
  for (std::size_t i = 0; i < (square ? rows : count); ++i)
    for (std::size_t k = 0; k < rows; ++k) values[i * rows + k] = values[(square ? told_[i] : i) * n + told_[k]];
}

Wrench WrenchModel::of_columns(WrenchKind kind, std::span<const double> columns, std::span<const double> q,
                               std::span<const double> tau_ext, std::span<const double> sigma_nm,
                               std::span<const double> contact_sigma_nm, std::span<const double> dq,
                               const std::array<double, 3>* direction) const noexcept {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  const auto n = links_.size(), unknowns = static_cast<std::size_t>(kind == WrenchKind::wrench ? 6 : 3);
  Wrench found;
  found.unknowns = static_cast<int>(unknowns);
  found.force = found.moment = {nan, nan, nan};
  found.covariance.fill(nan);
  found.chi_square = found.consistent = nan;
  bool sound = refused_.empty() && known(q, tau_ext, sigma_nm, contact_sigma_nm);
  for (double value : columns) sound = sound && std::isfinite(value);
  for (double value : dq) sound = sound && std::isfinite(value);
  if (!sound) return found;

  std::array<double, kMaxJoints> pushed;
  std::ranges::copy(tau_ext.first(n), pushed.begin());
  std::array<double, kMaxJoints * kMaxJoints> s;
  std::array<double, 6 * kMaxJoints> all;
  std::ranges::copy(columns.first(unknowns * n), all.begin());
  take_off_rubbing(kind, q, dq, sigma_nm, contact_sigma_nm, std::span(pushed).first(n), s);
  const WrenchScale scale{WrenchModel::kLargestForce_n, WrenchModel::kLength_m, WrenchModel::kBlindForce_n};
  keep_told(s, n, true);
  keep_told(all, unknowns, false);
  keep_told(pushed, 1, false);
  const std::size_t rows = told_.size();
  if (direction)  // the only unknown: its size
    for (std::size_t j = 0; j < rows; ++j)
      all[j] = (*direction)[0] * all[j] + (*direction)[1] * all[rows + j] + (*direction)[2] * all[2 * rows + j];
  const std::size_t columns_used = direction ? 1 : unknowns;
  if (!solve_wrench(std::span(s).first(rows * rows), std::span(all).first(columns_used * rows), std::span(pushed).first(rows), scale, found))
    return found;
  if (direction) spread_along(*direction, found);
  found.chi_square /= settings_.residual_radius[static_cast<std::size_t>(kind)];
  found.consistent = found.freedom > 0 ? chi_square_beyond(found.chi_square, found.freedom) : 1.0;
  found.known = true;
  return found;
}

Wrench WrenchModel::solve(WrenchKind kind, int frame, const std::array<double, 3>& point, std::span<const double> q,
                          std::span<const double> tau_ext, std::span<const double> sigma_nm, WrenchAxes axes,
                          std::span<const double> contact_sigma_nm, std::span<const double> dq) const noexcept {
  const bool sound = refused_.empty() && frame >= 0 && frame < frames() && known(q, tau_ext, sigma_nm, contact_sigma_nm);
  std::array<double, 6 * kMaxJoints> all;
  const std::span columns = std::span(all).first(6 * links_.size());
  Turn base{};
  if (sound)
    base = see(links_, frames_[static_cast<std::size_t>(frame)], q, point, axes, columns).axes;
  else
    std::ranges::fill(columns, std::numeric_limits<double>::quiet_NaN());
  Wrench found = of_columns(kind, columns, q, tau_ext, sigma_nm, contact_sigma_nm, dq);
  if (found.known && kind == WrenchKind::force) {
    Vector3 lever = vector3(point);
    if (axes == WrenchAxes::base) lever = base.back(lever);
    const Vector3 moment = cross(lever, vector3(found.force));
    found.moment = {moment.x, moment.y, moment.z};
  }
  return found;
}

Wrench WrenchModel::wrench(int frame, std::span<const double> q, std::span<const double> tau_ext,
                           std::span<const double> sigma_nm, WrenchAxes axes, std::span<const double> contact_sigma_nm,
                           std::span<const double> dq) const noexcept {
  return solve(WrenchKind::wrench, frame, {}, q, tau_ext, sigma_nm, axes, contact_sigma_nm, dq);
}

Wrench WrenchModel::force(int frame, const std::array<double, 3>& point, std::span<const double> q,
                          std::span<const double> tau_ext, std::span<const double> sigma_nm, WrenchAxes axes,
                          std::span<const double> contact_sigma_nm, std::span<const double> dq) const noexcept {
  return solve(WrenchKind::force, frame, point, q, tau_ext, sigma_nm, axes, contact_sigma_nm, dq);
}

double chi_square_beyond(double value, int freedom) noexcept {
  // Q(k + 2) = Q(k) + half^(k/2) exp(-half) / gamma(k/2 + 1)
  const double half = std::max(value, 0.0) / 2;
  const bool odd = freedom % 2 != 0;
  double beyond = odd ? std::erfc(std::sqrt(half)) : std::exp(-half);
  double more = odd ? 2 * std::sqrt(half / 3.14159265358979323846) * std::exp(-half) : half * std::exp(-half);
  for (int k = odd ? 1 : 2; k < freedom; k += 2) {
    beyond += more;
    more *= half / (0.5 * k + 1);
  }
  return std::min(beyond, 1.0);
}

}  // namespace tauext
