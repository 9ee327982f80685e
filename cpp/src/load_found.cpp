#include "tauext/load_found.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

namespace tauext {
namespace {

// Aluminium: a load's inertia about its own centre is taken to be that of a ball of it, little beside m c^2.
constexpr double kDensity = 2700.0;      // [kg/m^3]
constexpr double kLeastMass = 0.1;       // [kg], whose first moment is believed at least
constexpr double kUsualMass = 2;         // [kg]: what arms of this size are given to carry
constexpr double kShows = 3.0;           // standard errors between a mass and 0
// By which another explanation must be cheaper: odds of 90 to 1 and more, in a comparison of independent errors; and by a
// share, since errors of the model are not independent, and cost each explanation something else.
constexpr double kBetter = 9.0, kByHowMuch = 1.3;
constexpr double kDown = 0.95;           // cosine of the angle to gravity, 18 degrees, within which a force is a weight
// Squared standard errors a row that a load may leave: twice the usual error. Some arms are off by that; a wrench that
// moves about on the arm leaves more, and then a load must explain this share of what shows.
constexpr double kPoor = 4.0, kExplains = 0.5;
// Errors are compared as the bundle knows them where the load leaves more: else a contact would be taken for a large error.
constexpr double kMostScale = 1.5;
// A direction of the centre of mass is not seen where its standard error is more than half of what was assumed before.
constexpr double kUnseenShare = 0.5;
constexpr double kMassUnseen = 0.25, kMassSeen_kg = 0.05;  // a mass is not told whose standard error is a quarter of it
constexpr double kUsualLever_m = 0.5;    // as Load::kUsualError has it
constexpr double kErrorsOfLoad = 2.0;    // standard errors of its torques: nineteen of twenty loads are within

using Vec3 = std::array<double, 3>;

double length(const Vec3& v) noexcept { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// xx, yy, zz, xy, xz, yz of m (c.c 1 - c c^T)
std::array<double, 6> about_origin(double m, const Vec3& c) noexcept {
  return {m * (c[1] * c[1] + c[2] * c[2]), m * (c[0] * c[0] + c[2] * c[2]), m * (c[0] * c[0] + c[1] * c[1]),
          -m * c[0] * c[1],                -m * c[0] * c[2],                -m * c[1] * c[2]};
}

// Drawn to the origin as far as the reach asks.
Vec3 within(const Vec3& com, double reach_m) noexcept {
  const double share = std::min(1.0, reach_m / std::max(length(com), 1e-12));
  return {share * com[0], share * com[1], share * com[2]};
}

// What the arm carries in all where another load is set than it carries.
Load corrected(const std::array<double, 4>& found, const Load& set, double reach_m) noexcept {
  const double mass = set.mass + found[0];
  if (!(mass > 0)) return {};
  Vec3 com, added{};
  for (std::size_t i = 0; i < 3; ++i) com[i] = (set.mass * set.com[i] + found[1 + i]) / mass;
  for (std::size_t i = 0; i < 3 && found[0] > 0; ++i) added[i] = found[1 + i] / found[0];
  if (found[0] > 0 && length(added) <= reach_m) return together(set, ball(found[0], added));
  Load whole = set;
  whole.mass = mass;
  whole.com = within(com, std::max(reach_m, length(set.com)));
  for (double& moment : whole.inertia) moment *= mass / set.mass;
  return whole;
}

// Whether a force along the base's axes pulls down (or, where a load is set, up): where nothing speeds up, that is a load.
bool along(const LoadFit& force, const Vec3& gravity, bool either_way) noexcept {
  const Vec3 f{force.values[0], force.values[1], force.values[2]};
  const double dot = f[0] * gravity[0] + f[1] * gravity[1] + f[2] * gravity[2];
  return (either_way ? std::fabs(dot) : dot) > kDown * length(f) * length(gravity);
}

const LoadFit& fit_of(const LoadFound& found, LoadCause cause) noexcept {
  return found.fits[static_cast<std::size_t>(cause)];
}

LoadVerdict verdict(const LoadFound& found, double mass_kg, const Load& set, const Vec3& gravity) noexcept {
  const LoadFit &load = fit_of(found, LoadCause::load), &nothing = fit_of(found, LoadCause::nothing);
  const LoadFit& base = fit_of(found, LoadCause::base_force);
  double other = fit_of(found, LoadCause::frame_force).cost;
  if (!along(base, gravity, set.mass > 0)) other = std::min(other, base.cost);
  if (nothing.cost - std::min(load.cost, other) < kBetter) return LoadVerdict::nothing;
  if (kByHowMuch * other + kBetter < load.cost) return LoadVerdict::contact;
  if (mass_kg + set.mass < -kShows * found.mass_error_kg) return LoadVerdict::lifts;
  if (load.misfit > kPoor && nothing.cost - load.cost < kExplains * nothing.cost) return LoadVerdict::unclear;
  const bool shows = std::fabs(mass_kg) > kShows * found.mass_error_kg || nothing.cost - load.cost >= kBetter;
  return shows ? LoadVerdict::load : LoadVerdict::nothing;
}

// Mass, centre of mass, their errors and what is not seen.
void tell(const LoadFit& fit, const LoadParameters& phi, double reach_m, LoadFound& out) noexcept {
  out.phi = phi;
  out.covariance = fit.covariance;
  out.mass_kg = phi[0];
  out.mass_error_kg = std::sqrt(std::max(fit.covariance[0], 0.0));
  const double divisor = std::copysign(std::max(std::fabs(phi[0]), 1e-6), phi[0]);
  for (std::size_t i = 0; i < 3; ++i) out.com_m[i] = phi[1 + i] / divisor;
  std::array<std::array<double, 4>, 3> slope{};  // of the centre of mass with (m, h)
  for (std::size_t i = 0; i < 3; ++i) {
    slope[i][0] = -out.com_m[i] / divisor;
    slope[i][1 + i] = 1 / divisor;
  }
  for (std::size_t i = 0; i < 3; ++i)
    for (std::size_t j = 0; j < 3; ++j) {
      double sum = 0;
      for (std::size_t a = 0; a < 4; ++a)
        for (std::size_t b = 0; b < 4; ++b) sum += slope[i][a] * fit.covariance[4 * a + b] * slope[j][b];
      out.com_covariance[3 * i + j] = sum;
    }
  for (std::size_t i = 0; i < 3; ++i) out.com_error_m[i] = std::sqrt(std::max(out.com_covariance[4 * i], 0.0));
  const SymmetricAxes axes = symmetric_axes(out.com_covariance, 3);
  const double seen = kUnseenShare * reach_m / 2;
  for (std::size_t m = 0; m < 3; ++m)
    if (axes.values[m] > seen * seen)
      out.unseen[static_cast<std::size_t>(out.unseen_count++)] = {axes.axes[m][0], axes.axes[m][1], axes.axes[m][2]};
  out.mass_seen = out.mass_error_kg <= std::max(kMassUnseen * std::fabs(out.mass_kg), kMassSeen_kg);
}

// Of the torques of a load in poses that this motion did not show: of its weight at a usual lever and of its first moment
// in any direction.
double error_share(const LoadFound& found, double mass_kg) noexcept {
  if (!(mass_kg > 0)) return Load::kUsualError;
  const double lever2 = kUsualLever_m * kUsualLever_m;
  const double square = lever2 * found.covariance[0] +
                        (found.covariance[5] + found.covariance[10] + found.covariance[15]) / 3;
  const double share = kErrorsOfLoad * std::sqrt(std::max(square, 0.0)) / (kUsualLever_m * mass_kg);
  return std::clamp(share, Load::kUsualError, 1.0);
}

}  // namespace

Load ball(double mass, const Vec3& com) noexcept {
  const double radius = std::cbrt(3 * mass / (4 * std::numbers::pi * kDensity)), own = 0.4 * mass * radius * radius;
  return {mass, com, {own, own, own, 0, 0, 0}, 0};
}

const char* name(LoadVerdict verdict) noexcept {
  constexpr const char* names[] = {"too little", "nothing", "load", "contact", "lifts", "unclear"};
  return verdict <= LoadVerdict::unclear ? names[static_cast<int>(verdict)] : "";
}

LoadBefore before_weighing(const WeighSettings& settings, double mass_kg) noexcept {
  return {settings.offset_nm, settings.coulomb_nm, std::max(mass_kg, kLeastMass) * settings.reach_m / 2};
}

LoadParameters beside(const std::array<double, 4>& found, const Load& set, double reach_m) noexcept {
  LoadParameters phi{};
  if (set.mass > 0) {
    const LoadParameters whole = parameters_of(corrected(found, set, reach_m)), before = parameters_of(set);
    for (std::size_t k = 0; k < phi.size(); ++k) phi[k] = whole[k] - before[k];
    return phi;
  }
  if (!(found[0] > 0)) return phi;
  return parameters_of(ball(found[0], within({found[1] / found[0], found[2] / found[0], found[3] / found[0]}, reach_m)));
}

LoadFound weigh(const LoadSums& sums, const WeighSettings& settings, const Load& set, const LoadParameters& phi,
                int rounds) noexcept {
  LoadFound out;
  out.seconds = sums.rows() * settings.row_s;
  out.reach_m = settings.reach_m;
  out.load = set;
  out.phi = phi;
  if (!(sums.rows() >= kLeastLoadRows)) return out;
  const auto before = [&](double mass_kg) noexcept {
    return before_weighing(settings, set.mass > 0 ? std::fabs(mass_kg) : mass_kg);
  };
  LoadParameters now = phi, about = phi;
  LoadFit fit;
  LoadBefore last;
  for (int round = 0; round < rounds; ++round) {
    about = now;
    // Where nothing is known a light load's short levers would hold a heavy one down, for good.
    fit = fit_load(sums, LoadCause::load, about, before(about[0] == 0 ? kUsualMass : about[0]));
    last = before(fit.values[0]);
    fit = fit_load(sums, LoadCause::load, about, last);
    now = beside(fit.values, set, settings.reach_m);
  }
  LoadNoise noise = fit.noise;
  for (double& scale : noise.scale) scale = std::min(scale, kMostScale);
  for (int cause = 0; cause < kLoadCauses; ++cause)
    out.fits[static_cast<std::size_t>(cause)] = solve_load(sums, static_cast<LoadCause>(cause), about, last, noise);
  tell(fit, now, settings.reach_m, out);
  out.misfit = fit_of(out, LoadCause::load).misfit;
  LoadParameters whole = parameters_of(set);
  for (std::size_t k = 0; k < whole.size(); ++k) whole[k] += now[k];
  out.load = load_of(whole, error_share(out, whole[0]));
  out.at_bound = length(set.mass > 0 ? out.load.com : out.com_m) >= settings.reach_m * (1 - 1e-9);
  out.verdict = verdict(out, fit.values[0], set, settings.gravity);
  return out;
}

LoadParameters parameters_of(const Load& load) noexcept {
  const std::array<double, 6> far = about_origin(load.mass, load.com);
  LoadParameters phi{load.mass, load.mass * load.com[0], load.mass * load.com[1], load.mass * load.com[2]};
  for (std::size_t k = 0; k < 6; ++k) phi[4 + k] = load.inertia[k] + far[k];
  return phi;
}

Load load_of(const LoadParameters& phi, double error_share) noexcept {
  if (!(phi[0] > 0)) return {};
  Load load{phi[0], {phi[1] / phi[0], phi[2] / phi[0], phi[3] / phi[0]}, {}, error_share};
  const std::array<double, 6> far = about_origin(load.mass, load.com);
  for (std::size_t k = 0; k < 6; ++k) load.inertia[k] = phi[4 + k] - far[k];
  return load;
}

Load together(const Load& a, const Load& b) noexcept {
  const double mass = a.mass + b.mass;
  if (!(mass > 0)) return {};
  const LoadParameters of_a = parameters_of(a), of_b = parameters_of(b);
  LoadParameters sum;
  for (std::size_t k = 0; k < sum.size(); ++k) sum[k] = of_a[k] + of_b[k];
  return load_of(sum, (a.mass * a.error_share + b.mass * b.error_share) / mass);
}

}  // namespace tauext
