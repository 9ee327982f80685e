// Validation of settings.hpp.
#include "tauext/settings.hpp"

#include <algorithm>
#include <cmath>

#include "alarm/coverage.hpp"
#include "bundle/rules.hpp"
#include "chain/motion.hpp"
#include "prior/prior.hpp"

namespace tauext {
namespace {

constexpr double kLargestWeight = 1e200;  // its product with the largest features, summed, stays finite

auto within(double least, double most) noexcept {
  return [=](double value) { return value >= least && value <= most; };
}

void expect_time(const std::string& what, double seconds) {
  if (!within(0, 60)(seconds)) throw Error(what + " = " + to_text(seconds) + " s must be 0 to 60");
}

void expect_positive(const std::string& what, const std::vector<double>& values, std::size_t joints) {
  expect_size(what, values.size(), joints);
  expect_each(what, values, is_positive, "> 0");
}

void expect_weights(const std::string& what, const std::vector<double>& weights, std::size_t count, std::size_t features) {
  expect_size(what, weights.size(), count);
  expect_each(what, weights, within(0, kLargestWeight), "0 to 1e200");
  for (std::size_t row = 0; row < count; row += features)
    if (std::all_of(&weights[row], &weights[row] + features, [](double weight) { return weight == 0; }))
      throw Error(what + " of joint " + std::to_string(row / features) + " are all 0");
}

void expect_ceiling(const std::string& what, const std::vector<double>& values, std::size_t joints) {
  expect_size(what, values.size(), joints);
  expect_each(what, values, [](double value) { return value > 0 && value <= kLargestWeight; }, "above 0, at most 1e200");
}

}  // namespace

void ObserverSettings::validate_constants(int joints) const {
  if (nm_per_unit.empty()) return;
  expect_size("nm_per_unit", nm_per_unit.size(), static_cast<std::size_t>(joints));
  expect_each("nm_per_unit", nm_per_unit, [](double k) { return k != 0 && std::isfinite(k); }, "finite and not 0");
}

void FrictionTemperature::validate(int joints) const {
  if (!on()) return;
  const auto expect_within = [joints](const char* what, const std::vector<double>& values, double least, double most) {
    const std::string name = std::string("prior.temperature.") + what;
    expect_size(name, values.size(), static_cast<std::size_t>(joints));
    expect_each(name, values, within(least, most), to_text(least) + " to " + to_text(most));
  };
  expect_within("reference_c", reference_c, -273.15, 1000);
  expect_within("reach_k", reach_k, 0, 1000);
  expect_within("coulomb_per_10k", coulomb_per_10k, -10, 10);
  expect_within("viscous_per_10k", viscous_per_10k, -10, 10);
}

void PriorSettings::validate(int joints) const {
  constexpr int kMaxCycles = 10000;
  temperature.validate(joints);
  const Presliding probe(joints, widths_rad, branches);
  const auto n = static_cast<std::size_t>(joints);
  const auto expect_term = [](bool ok, std::size_t term, const char* rule) {
    if (!ok) throw Error("prior term " + std::to_string(term) + ": " + rule);
  };
  for (std::size_t m = 0; m < terms.size(); ++m) {
    const Term& t = terms[m];
    const auto joint = [joints](std::int32_t j) { return j >= 0 && j < joints; };
    expect_term(t.kind <= TermKind::local_memory, m, "its kind is unknown");
    expect_term(joint(t.a), m, "joint a does not exist");
    if (t.kind == TermKind::coulomb || t.kind == TermKind::load)
      expect_term(t.speed > 0 && std::isfinite(t.speed), m, "its speed must be > 0");
    if (t.kind == TermKind::local_memory) expect_term(probe.has_branches(), m, "there is no branch to follow");
    if (has_width(t))
      expect_term(t.b >= 0 && t.b < probe.width_count(), m, "its presliding width does not exist");
    if (t.kind == TermKind::gravity || t.kind == TermKind::quadratic || t.kind == TermKind::momentum)
      expect_term(joint(t.b), m, "joint b does not exist");
    if (t.kind == TermKind::quadratic || (t.kind == TermKind::gravity && t.form >= 6))
      expect_term(joint(t.c), m, "joint c does not exist");
    if (t.kind == TermKind::ripple) expect_term(t.b >= 1 && t.b <= kMaxCycles, m, "its cycles a turn are not 1 to 10000");
    const int forms = t.kind == TermKind::gravity    ? 14
                      : t.kind == TermKind::momentum ? 3
                      : t.kind == TermKind::quadratic || t.kind == TermKind::ripple ||
                              is_load(t) || t.kind == TermKind::backlash
                          ? 2
                          : 1;
    expect_term(t.form >= 0 && t.form < forms, m, "its form does not exist");
    if ((is_load(t) || t.kind == TermKind::backlash) && t.form == 1)
      expect_term(!corrected_links.empty(), m, "it asks for the load by the corrected model, and there is none");
  }
  expect_size("prior.weights", weights.size(), terms.size() * n);
  expect_finite("prior.weights", weights);
  if (!corrected_links.empty() && corrected_links.size() != n)
    throw Error("the prior's corrected model has " + std::to_string(corrected_links.size()) + " links where " +
                std::to_string(joints) + " belong");
  if (!most_load_nm.empty()) expect_size("prior.most_load_nm", most_load_nm.size(), n);
  expect_each("prior.most_load_nm", most_load_nm, [](double most) { return most >= 0 && std::isfinite(most); },
              ">= 0 and finite");
}

void Limits::validate(int joints, int widths) const {
  expect(region_width >= -1 && region_width < widths, "limits.region_width", region_width,
         "-1 or one of " + std::to_string(widths) + " presliding widths");
  expect(near_stiction_rad_s >= 0 && std::isfinite(near_stiction_rad_s), "limits.near_stiction_rad_s", near_stiction_rad_s, ">= 0");
  const auto expect_limits = [joints](const std::string& what, const std::vector<double>& limits) {
    expect_size(what, limits.size(), static_cast<std::size_t>(joints));
    expect_each(what, limits, [](double limit) { return limit > 0; }, "> 0");
  };
  for (const Level* level : {&collision, &contact}) {
    const std::string here = level == &collision ? "limits.collision." : "limits.contact.";
    expect_limits(here + "sliding_nm", level->sliding_nm);
    expect_limits(here + "near_stiction_nm", level->near_stiction_nm);
    expect_time(here + "hold_s", level->hold_s);
  }
  for (int j = 0; j < joints; ++j) {
    const auto at = static_cast<std::size_t>(j);
    const double all[] = {collision.sliding_nm[at], collision.near_stiction_nm[at], contact.sliding_nm[at], contact.near_stiction_nm[at]};
    const auto finite = std::ranges::count_if(all, [](double limit) { return std::isfinite(limit); });
    if (finite != 0 && finite != 4)
      throw Error("limits of joint " + std::to_string(j) + " must all be finite, or all infinite (not monitored)");
  }
  bool any = false;
  for (int j = 0; j < joints; ++j) any = any || monitors(j);
  if (!any) throw Error("limits of every joint are infinite: nothing would be monitored");
  expect_time("limits.contact_release_s", contact_release_s);
  expect_time("limits.near_memory_s", near_memory_s);
  expect(within(1, LimitFactors::kHighest)(after_contact_factor), "limits.after_contact_factor", after_contact_factor,
         "1 to " + to_text(LimitFactors::kHighest));
}

void DriftSettings::validate(int joints) const {
  constexpr double largest = 1e300;  // sums with r and prior stay finite
  expect(time_constant_s == 0 || within(1, 1e6)(time_constant_s), "drift.time_constant_s", time_constant_s,
         "0 (no tracker) or 1 to 1e6");
  if (!on()) return;
  expect_size("drift.size_nm", size_nm.size(), static_cast<std::size_t>(joints));
  expect_each("drift.size_nm", size_nm, within(0, largest), "0 to 1e300");
  expect(rate_share_per_s > 0 && rate_share_per_s <= 1, "drift.rate_share_per_s", rate_share_per_s, "above 0, at most 1");
  expect(within(0, 1)(freeze_share), "drift.freeze_share", freeze_share, "0 (never frozen by torque) to 1");
  expect(within(0, 60)(freeze_s), "drift.freeze_s", freeze_s, "0 to 60");
  if (!freeze_floor_nm.empty()) expect_size("drift.freeze_floor_nm", freeze_floor_nm.size(), size_nm.size());
  expect(within(0, 1)(friction_share), "drift.friction_share", friction_share, "0 (not followed) to 1");
  expect_each("drift.freeze_floor_nm", freeze_floor_nm, within(0, largest), "0 to 1e300");
}

void ErrorScaleSettings::validate(int joints) const {
  if (!on()) {
    if (!limit_weights.empty() || !largest.empty() || !sigma_weights.empty() || !sigma_near_weights.empty() ||
        !largest_sigma.empty())
      throw Error("error_scale has weights and no features");
    return;
  }
  const auto n = static_cast<std::size_t>(joints), count = n * features.size();
  for (std::size_t m = 0; m < features.size(); ++m)
    if (static_cast<int>(features[m]) >= kMotionFeatures || std::count(features.begin(), features.end(), features[m]) > 1)
      throw Error("error_scale: feature " + std::to_string(m) + " is unknown or stands there twice");
  expect_weights("error_scale.limit_weights", limit_weights, count, features.size());
  expect_weights("error_scale.sigma_weights", sigma_weights, count, features.size());
  expect_weights("error_scale.sigma_near_weights", sigma_near_weights, count, features.size());
  expect_ceiling("error_scale.largest", largest, n);
  expect_ceiling("error_scale.largest_sigma", largest_sigma, n);
}

void CoverageSettings::validate(int joints) const {
  constexpr double least = 1e-9, most = 1e9;  // of a speed or length
  const std::size_t n = empty() ? 0 : static_cast<std::size_t>(joints), pairs = n > 0 ? n * (n - 1) / 2 : 0;
  expect_size("coverage.fastest_rad_s", fastest_rad_s.size(), n);
  expect_size("coverage.turns", turns.size(), n);
  expect_size("coverage.centre_rad", centre_rad.size(), n);
  expect_size("coverage.span_rad", span_rad.size(), n);
  expect_size("coverage.seen", seen.size(), n);
  expect_size("coverage.reach", reach.size(), n);
  expect(reach_together <= (empty() ? 0 : Coverage::kMostReach), "coverage.reach_together", reach_together,
         empty() ? "0 where nothing is known" : "0 to 16");
  expect_size("coverage.seen_together", seen_together.size(), reach_together > 0 ? pairs * Coverage::kPairCells : 0);
  expect_each("coverage.fastest_rad_s", fastest_rad_s, within(least, most), "1e-9 to 1e9");
  expect_each("coverage.span_rad", span_rad, within(least, most), "1e-9 to 1e9");
  expect_each("coverage.centre_rad", centre_rad, within(-most, most), "-1e9 to 1e9");
  expect_each("coverage.reach", reach, [](int cells) { return cells <= Coverage::kMostReach; }, "0 to 16");
  expect_each("coverage.turns", turns, [](int turn) { return turn <= 1; }, "0 or 1");
}

void SignalRanges::validate(int joints) const {
  const auto n = static_cast<std::size_t>(joints);
  const auto above_0 = [](double value) { return value > 0; };
  expect_size("signals.torque_limit_nm", torque_limit_nm.size(), n);
  expect_each("signals.torque_limit_nm", torque_limit_nm, above_0, "> 0");
  expect_positive("signals.largest_torque_nm", largest_torque_nm, n);
  expect_size("signals.possible_torque_nm", possible_torque_nm.size(), n);
  expect_each("signals.possible_torque_nm", possible_torque_nm, above_0, "> 0");
  expect_size("signals.possible_speed_rad_s", possible_speed_rad_s.size(), n);
  expect_each("signals.possible_speed_rad_s", possible_speed_rad_s, above_0, "> 0");
  expect(within(kLeastRateTolerance, kMostRateTolerance)(rate_tolerance), "signals.rate_tolerance", rate_tolerance,
         to_text(kLeastRateTolerance) + " to " + to_text(kMostRateTolerance));
  for (std::size_t j = 0; j < n; ++j)
    expect(possible_torque_nm[j] >= largest_torque_nm[j], "signals.possible_torque_nm", possible_torque_nm[j],
           "at least largest_torque_nm = " + to_text(largest_torque_nm[j]));
}

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

}  // namespace tauext
