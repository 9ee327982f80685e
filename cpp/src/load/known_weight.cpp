#include "load/known_weight.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <string>

#include "bundle/linear.hpp"
#include "bundle/terms.hpp"
#include "load/weighing.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

using Vec3 = std::array<double, 3>;

constexpr double kLeastSpread = 1e-3;  // least relative standard deviation of a joint's constant about the common factor; also by
                                       // what it may change until the next weight
constexpr double kAny = 0.5;           // of the common factor, which is unknown
constexpr double kComKnown_m = 0.005;  // standard deviation of a centre of mass that is given
constexpr double kWell = 0.03;  // largest relative error of the common factor: masses of robot files are no better
constexpr double kOfItsOwn = 0.7;  // largest error of a constant, over its prior error, at which it counts as found
constexpr int kSteps = 6;

double squared(double x) noexcept { return x * x; }

// Unknowns: the load's first moment h (3), then a of each joint.
struct Fit {
  Vec3 h;
  std::vector<double> a, covariance;  // (n), (3 + n, 3 + n)
};

// Relative errors of the a_j before the weighing.
struct Before {
  bool common_known;                // by an earlier weight; else the mean of all is free
  std::vector<double> information;  // (n, n)
};

Before before_weight(const Bundle& bundle) {
  const auto n = static_cast<std::size_t>(bundle.joints());
  Before out{!bundle.wrench.torque_factor.empty(), std::vector<double>(n * n)};
  std::vector<double> covariance(n * n);
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j) {
      const double own = i == j ? squared(std::max(bundle.wrench.own_share(j), kLeastSpread)) : 0.0;
      covariance[i * n + j] = out.common_known ? bundle.wrench.constants_covariance(i, j) + (i == j ? squared(kLeastSpread) : 0.0)
                                               : own + squared(kAny);
    }
  if (!cholesky(covariance, n)) throw Error("the errors of the torque constants are not positive definite");
  invert(covariance, n, out.information);
  return out;
}

void add_prior(const KnownLoad& known, const Before& before, double mean, std::span<double> information, std::span<double> moment) {
  const std::size_t size = moment.size(), n = size - 3;
  const double h_size = known.com_m ? known.mass_kg * kComKnown_m : std::max(known.mass_kg, kLeastMass_kg) * known.reach_m / 2;
  for (std::size_t i = 0; i < 3; ++i) {
    information[i * size + i] = 1 / squared(h_size);
    if (known.com_m) moment[i] = known.mass_kg * (*known.com_m)[i] / squared(h_size);
  }
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j) {
      information[(3 + i) * size + 3 + j] = before.information[i * n + j] / squared(mean);
      moment[3 + i] += before.information[i * n + j] / mean;
    }
}

// A joint's sums with other columns: a in the place of the mass and the target in that of tau_ext, linear about the fit.
LoadSums::Square turned(const LoadSums::Square& gram, double mass_kg, double a, const Vec3& h, const LoadSums::Row& target) {
  constexpr std::array<std::size_t, 7> at{LoadSums::kLoad,     LoadSums::kLoad + 1, LoadSums::kLoad + 2, LoadSums::kLoad + 3,
                                          LoadSums::kOffset, LoadSums::kCoulomb,  LoadSums::kTauExt};
  std::array<LoadSums::Row, at.size()> columns{};
  columns[0][LoadSums::kLoad] = mass_kg;
  columns[4][LoadSums::kOffset] = columns[5][LoadSums::kCoulomb] = 1;
  columns[6] = target;
  for (std::size_t i = 0; i < 3; ++i) {
    columns[0][LoadSums::kLoad + 1 + i] = h[i];
    columns[1 + i][LoadSums::kLoad + 1 + i] = a;
    columns[6][LoadSums::kLoad + 1 + i] += a * h[i];
  }
  LoadSums::Square out{};
  for (std::size_t k = 0; k < at.size(); ++k)
    for (std::size_t c = 0; c < LoadSums::kColumns; ++c) {
      const double product = LoadSums::product(gram, c, columns[k]);
      for (std::size_t i = 0; i <= k; ++i) out[at[i] * LoadSums::kColumns + at[k]] += columns[i][c] * product;
    }
  return out;
}

// tau_ext itself, as a sum of columns.
constexpr LoadSums::Row tau_ext() noexcept {
  LoadSums::Row row{};
  row[LoadSums::kTauExt] = 1;
  return row;
}

// What the fit leaves of a joint's target.
LoadSums::Row left_of(LoadSums::Row target, double mass_kg, double a, const Vec3& h, const OwnUnknowns& own) noexcept {
  const auto unknowns = own.at(std::array{a, h[0], h[1], h[2]});
  target[LoadSums::kLoad] -= a * mass_kg;
  for (std::size_t i = 0; i < 3; ++i) target[LoadSums::kLoad + 1 + i] -= a * h[i];
  target[LoadSums::kOffset] = -unknowns[0];
  target[LoadSums::kCoulomb] = -unknowns[1];
  return target;
}

// Gauss-Newton in h and every a_j about the load phi.
Fit solve(const LoadSums& sums, const LoadParameters& phi, const WeighSettings& settings, const KnownLoad& known,
          const Before& before, Fit fit) {
  const std::size_t n = fit.a.size(), size = 3 + n;
  const double mean = before.common_known ? 1.0 : std::accumulate(fit.a.begin(), fit.a.end(), 0.0) / static_cast<double>(n);
  std::vector<LoadSums::Row> targets, residuals(n);
  for (double a : fit.a) targets.push_back(load_target(phi, a));
  LoadNoise noise = LoadNoise::unknown();
  for (int step = 0; step < kSteps; ++step) {
    std::vector<double> information(size * size), moment(size);
    add_prior(known, before, mean, information, moment);
    std::vector<OwnUnknowns> own;
    for (std::size_t j = 0; j < n; ++j) {
      LoadEquations one;
      const double weight = 1 / (squared(noise.scale[j]) * noise.correlation);
      own.push_back(eliminate(turned(sums.joint(static_cast<int>(j)).whole, known.mass_kg, fit.a[j], fit.h, targets[j]),
                              LoadSums::kLoad, 4, tau_ext(), weight, {settings.offset_nm[j], settings.coulomb_nm[j]}, one));
      const std::array<std::size_t, 4> at{3 + j, 0, 1, 2};
      for (std::size_t i = 0; i < 4; ++i) {
        moment[at[i]] += one.moment[i];
        for (std::size_t k = 0; k < 4; ++k) information[at[i] * size + at[k]] += one.information[4 * i + k];
      }
    }
    if (!cholesky(information, size)) throw Error("the motion does not determine the torque constants");
    fit.covariance.resize(size * size);
    invert(information, size, fit.covariance);
    substitute(information, size, moment);
    std::copy_n(moment.begin(), 3, fit.h.begin());
    fit.a.assign(moment.begin() + 3, moment.end());
    for (std::size_t j = 0; j < n; ++j) residuals[j] = left_of(targets[j], known.mass_kg, fit.a[j], fit.h, own[j]);
    noise = noise_of(sums, residuals);
  }
  return fit;
}

// Factors 1 / a, each with its error; the common one is their mean, weighted by the inverse of the covariance.
KnownWeight factors_of(const Fit& fit, double mass_kg, const Bundle& bundle, const std::vector<bool>& skipped) {
  const std::size_t n = fit.a.size(), size = 3 + n;
  if (std::ranges::any_of(fit.a, [](double a) { return !(a > 0); }))
    throw Error("the known weight acts upwards at a joint: is the sign of its torque right (tauext check)?");
  KnownWeight out{{}, {}, std::vector<double>(n * n), {}, 0, 0, {fit.h[0] / mass_kg, fit.h[1] / mass_kg, fit.h[2] / mass_kg}};
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j) out.covariance[i * n + j] = fit.covariance[(3 + i) * size + 3 + j] / (fit.a[i] * fit.a[j]);
  std::vector<double> factor = out.covariance, weight(n, 1.0);
  if (!cholesky(factor, n)) throw Error("the motion does not determine the torque constants");
  substitute(factor, n, weight);
  const double whole = std::accumulate(weight.begin(), weight.end(), 0.0), error = 1 / std::sqrt(whole);
  if (!(error <= kWell))
    throw Error("the motion does not determine the torque constants: their common factor only to " +
                std::to_string(std::lround(100 * error)) + "%, where " + std::to_string(std::lround(100 * kWell)) +
                "% is needed; move more, with the weight farther from the joints");
  const bool again = !bundle.wrench.torque_factor.empty();
  double log = 0;
  for (std::size_t j = 0; j < n; ++j) {
    const double own_error = std::sqrt(out.covariance[j * (n + 1)]);
    out.factors.push_back(1 / (bundle.wrench.factor(j) * fit.a[j]));
    out.errors.push_back(own_error * out.factors[j]);
    out.shows.push_back(!skipped[j] && (again || own_error <= kOfItsOwn * std::hypot(bundle.wrench.own_share(j), error)));
    log += weight[j] / whole * std::log(out.factors[j]);
  }
  out.common = std::exp(log);
  out.common_error = error * out.common;
  return out;
}

void scale(std::vector<double>& values, double factor) {
  for (double& value : values) value *= factor;
}

void scale(std::vector<Link>& links, double factor) {
  for (Link& link : links) {
    link.mass *= factor;
    link.rotor_inertia *= factor;
    for (double& moment : link.inertia) moment *= factor;
  }
}

}  // namespace

KnownWeight weigh_known(const Bundle& bundle, const LoadFrame& frame, std::span<const WeighedMotion> motions,
                        const KnownLoad& known, const LoadParameters& first, const std::vector<bool>& skipped) {
  const auto n = static_cast<std::size_t>(bundle.joints());
  const WeighSettings settings = Weighing::settings_of(bundle);
  const double common = first[0] / known.mass_kg;
  const Before before = before_weight(bundle);
  Fit fit{{first[1] / common, first[2] / common, first[3] / common}, std::vector(n, common), {}};
  for (int round = 0; round < kLoadRounds; ++round) {
    const LoadParameters phi = beside({known.mass_kg, fit.h[0], fit.h[1], fit.h[2]}, {}, known.reach_m);
    fit = solve(load_sums(bundle, frame, phi, motions), phi, settings, known, before, fit);
  }
  return factors_of(fit, known.mass_kg, bundle, skipped);
}

void scale_torques(Bundle& bundle, double factor) {
  if (bundle.observer.nm_per_unit.empty()) bundle.observer.nm_per_unit.assign(bundle.links.size(), 1.0);
  bundle.units.relative_to = -1;  // a weight in kg defines the N m
  scale(bundle.links, factor);
  scale(bundle.prior.corrected_links, factor);
  const std::size_t terms = bundle.prior.terms.size();
  for (std::size_t k = 0; k < bundle.prior.weights.size(); ++k)
    if (!is_load(bundle.prior.terms[k % terms])) bundle.prior.weights[k] *= factor;  // of a load: a share of its torque
  Limits& limits = bundle.limits;
  SignalRanges& signals = bundle.signals;
  for (std::vector<double>* torques :
       {&bundle.observer.nm_per_unit, &bundle.prior.most_load_nm, &limits.collision.sliding_nm,
        &limits.collision.near_stiction_nm, &limits.contact.sliding_nm, &limits.contact.near_stiction_nm,
        &bundle.output_scale_nm, &signals.torque_limit_nm, &signals.largest_torque_nm, &signals.possible_torque_nm,
        &bundle.drift.size_nm, &bundle.drift.freeze_floor_nm, &bundle.error_scale.sigma_weights,
        &bundle.error_scale.sigma_near_weights, &bundle.error_scale.largest_sigma})
    scale(*torques, factor);
}

void correct_torques(Bundle& bundle, const KnownWeight& known) {
  scale_torques(bundle, known.common);
  const std::size_t n = bundle.links.size();
  WrenchSettings& wrench = bundle.wrench;
  wrench.common_share = known.common_error / known.common;
  const double common = squared(wrench.common_share);
  wrench.torque_share.clear();
  wrench.torque_factor.clear();
  for (std::size_t j = 0; j < n; ++j) {
    wrench.torque_share.push_back(std::min(std::sqrt(std::max(known.covariance[j * (n + 1)] - common, 0.0)), 1.0));
    wrench.torque_factor.push_back(known.common / known.factors[j]);
  }
  wrench.torque_correlation.assign(n * n, 0.0);
  for (std::size_t i = 0; i < n; ++i) {
    wrench.torque_correlation[i * (n + 1)] = 1;
    for (std::size_t j = 0; j < i; ++j) {
      const double both = wrench.torque_share[i] * wrench.torque_share[j];
      const double alike = both > 0 ? std::clamp((known.covariance[i * n + j] - common) / both, -1.0, 1.0) : 0.0;
      wrench.torque_correlation[i * n + j] = wrench.torque_correlation[j * n + i] = alike;
    }
  }
}

}  // namespace tauext
