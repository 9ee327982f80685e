// Validation of settings.hpp.
#include "tauext/settings.hpp"

#include <algorithm>
#include <cmath>

#include "bundle/bodies.hpp"
#include "bundle/linear.hpp"
#include "bundle/rules.hpp"
#include "bundle/terms.hpp"

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

// (joints, joints), positive definite with `more` on the diagonal.
void expect_correlation(const std::string& what, const std::vector<double>& values, std::size_t n, double more) {
  expect_size(what, values.size(), n * n);
  std::array<double, kMaxJoints * kMaxJoints> factor;
  std::ranges::copy(values, factor.begin());
  for (std::size_t i = 0; i < n; ++i) {
    factor[i * n + i] += more;
    for (std::size_t j = 0; j < n; ++j) {
      const double here = values[i * n + j];
      if (!(std::fabs(here) <= 1) || (i == j && here != 1) || here != values[j * n + i])
        throw Error(what + " must be symmetric, 1 on its diagonal, within -1 to 1 beside it");
    }
  }
  if (!cholesky(std::span(factor).first(n * n), n)) throw Error(what + " is not positive definite");
}

}  // namespace

const char* name(ResidualMethod method) noexcept {
  constexpr const char* names[] = {"momentum", "direct", "velocity", "energy"};
  return method <= ResidualMethod::energy ? names[static_cast<int>(method)] : "";
}

void ObserverSettings::validate_constants(int joints) const {
  if (nm_per_unit.empty()) {
    if (!unknown_constant.empty()) throw Error("unknown_constant needs torque constants, and there are none");
    return;
  }
  expect_size("nm_per_unit", nm_per_unit.size(), static_cast<std::size_t>(joints));
  if (!unknown_constant.empty()) expect_size("unknown_constant", unknown_constant.size(), static_cast<std::size_t>(joints));
  expect_each("unknown_constant", unknown_constant, [](int one) { return one <= 1; }, "0 or 1");
  expect_each("nm_per_unit", nm_per_unit, [](double k) { return k != 0 && std::isfinite(k); }, "finite and not 0");
}

void validate_presliding(int joints, std::span<const double> widths, std::span<const double> branches) {
  if (joints < 1 || joints > kMaxJoints)
    throw Error("presliding states need 1 to " + std::to_string(kMaxJoints) + " joints, not " + std::to_string(joints));
  if (widths.size() > kMaxWidths)
    throw Error("a joint has at most " + std::to_string(kMaxWidths) + " presliding states, not " +
                std::to_string(widths.size()));
  double before = 0;
  for (double width : widths) {
    if (!(width > before) || !std::isfinite(width))
      throw Error("presliding width " + to_text(width) + " rad must be > " + to_text(before));
    before = width;
  }
  if (branches.empty()) return;
  const std::size_t columns = static_cast<std::size_t>(joints) * widths.size();
  if (branches.size() != columns)
    throw Error("presliding branches are " + std::to_string(branches.size()) + " where " + std::to_string(columns) + " belong");
  for (std::size_t first = 0; first < columns; first += widths.size()) {
    double sum = 0;
    for (double share : branches.subspan(first, widths.size())) {
      if (!(share >= 0 && share <= 1)) throw Error("presliding branch " + to_text(share) + " must be 0 to 1");
      sum += share;
    }
    if (sum != 0 && !(std::fabs(sum - 1) <= 1e-6))
      throw Error("presliding branches of joint " + std::to_string(first / widths.size()) + " sum to " + to_text(sum) +
                  ", not to 1 or 0");
  }
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
  validate_presliding(joints, widths_rad, branches);
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
    if (t.kind == TermKind::local_memory) expect_term(!branches.empty(), m, "there is no branch to follow");
    if (has_width(t))
      expect_term(t.b >= 0 && t.b < static_cast<std::int32_t>(widths_rad.size()), m, "its presliding width does not exist");
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
      throw Error("thresholds of joint " + std::to_string(j) + " must all be finite, or all infinite (not monitored)");
  }
  bool any = false;
  for (int j = 0; j < joints; ++j) any = any || monitors(j);
  if (!any) throw Error("thresholds of every joint are infinite: nothing would be monitored");
  expect_time("limits.contact_release_s", contact_release_s);
  expect_time("limits.near_memory_s", near_memory_s);
  expect(within(1, LimitFactors::kHighest)(after_contact_factor), "limits.after_contact_factor", after_contact_factor,
         "1 to " + to_text(LimitFactors::kHighest));
  expect(within(0, 1e3)(declared_spread), "limits.declared_spread", declared_spread, "0 to 1000");
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
  expect(within(0, 9)(friction_share), "drift.friction_share", friction_share, "0 (not followed) to 9");
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
  expect(reach_together <= (empty() ? 0 : kMostReach), "coverage.reach_together", reach_together,
         empty() ? "0 where nothing is known" : "0 to 16");
  expect_size("coverage.seen_together", seen_together.size(), reach_together > 0 ? pairs * kPairCells : 0);
  expect_each("coverage.fastest_rad_s", fastest_rad_s, within(least, most), "1e-9 to 1e9");
  expect_each("coverage.span_rad", span_rad, within(least, most), "1e-9 to 1e9");
  expect_each("coverage.centre_rad", centre_rad, within(-most, most), "-1e9 to 1e9");
  expect_each("coverage.reach", reach, [](int cells) { return cells <= kMostReach; }, "0 to 16");
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

void LstmShape::validate() const {
  if (inputs < 1 || inputs > kMaxLstmInputs)
    throw Error("an LSTM has 1 to " + std::to_string(kMaxLstmInputs) + " inputs, not " + std::to_string(inputs));
  if (hidden < 1 || hidden > kMaxLstmHidden)
    throw Error("an LSTM has 1 to " + std::to_string(kMaxLstmHidden) + " hidden units, not " + std::to_string(hidden));
  if (outputs < 1 || outputs > kMaxJoints)
    throw Error("an LSTM has 1 to " + std::to_string(kMaxJoints) + " outputs, not " + std::to_string(outputs));
}

void WrenchSettings::validate(int joints) const {
  const auto n = static_cast<std::size_t>(joints);
  constexpr std::size_t kMostFrames = 1000;
  if (frames.size() > kMostFrames) throw Error("wrench.frames are " + std::to_string(frames.size()) + ", at most 1000");
  for (const WrenchFrame& one : frames) {
    if (one.name.empty()) throw Error("a frame for wrenches has no name");
    const bool near = std::ranges::all_of(one.translation, [](double value) { return std::fabs(value) <= kFarthestFrame_m; });
    if (one.link < 0 || one.link >= joints || !is_rotation(one.rotation) || !near)
      throw Error("frame '" + one.name + "' for wrenches must be fixed to one of the " + std::to_string(joints) +
                  " links, by a rotation and within 1000 m");
  }
  if (!correlation.empty()) expect_correlation("wrench.correlation", correlation, n, 0);
  const auto is_share = [](double value) { return value >= 0 && value <= 1; };
  if (torque_factor.empty() != torque_correlation.empty()) throw Error("wrench.torque_factor and torque_correlation belong together");
  if (!torque_factor.empty()) {
    expect_size("wrench.torque_factor", torque_factor.size(), n);
    expect_each("wrench.torque_factor", torque_factor, [](double value) { return value >= 0.01 && value <= 100; }, "0.01 to 100");
    expect_correlation("wrench.torque_correlation", torque_correlation, n, 1e-6);  // the errors beside a common one are singular
  }
  if (!torque_share.empty()) expect_size("wrench.torque_share", torque_share.size(), n);
  expect_each("wrench.torque_share", torque_share, is_share, "0 to 1");
  expect(is_share(common_share), "wrench.common_share", common_share, "0 to 1");
  for (const auto* list : {&radius, &residual_radius})
    expect_each("wrench.radius", *list, [](double value) { return value > 0 && value <= 1e6; }, "above 0, at most 1e6");
}

void ServoSettings::validate() const {
  if (joints.empty() || joints.size() > static_cast<std::size_t>(kMaxJoints))
    throw Error("servo.joints has " + std::to_string(joints.size()) + " entries, must be 1 to " + std::to_string(kMaxJoints));
  if (torque_from > TorqueFrom::goal)
    throw Error("servo.torque_from is none of torque, phase_current, supply_current, duty, goal");
  expect(velocity_steps >= 0 && velocity_steps <= kMostSteps, "servo.velocity_steps", velocity_steps,
         "0 to " + std::to_string(kMostSteps));
  expect(sample_period_ns >= (velocity_steps > 0 ? 1 : 0), "servo.sample_period_ns", sample_period_ns, "> 0");
  const std::int64_t most_ns = ServoSettings::kMostDelay * sample_period_ns;
  expect(goal_delay_ns >= 0 && goal_delay_ns <= most_ns, "servo.goal_delay_ns", goal_delay_ns,
         "0 to " + std::to_string(most_ns) + ", " + std::to_string(kMostDelay) + " sample periods");
  for (const ServoConstants& joint : joints) {
    const auto expect_finite = [](bool ok, const char* what, double value, const char* rule) {
      expect(ok && std::isfinite(value), std::string("servo.") + what, value, rule);
    };
    expect_finite(joint.volts > 0, "volts", joint.volts, "> 0");
    expect_finite(joint.ohm > 0, "ohm", joint.ohm, "> 0");
    expect_finite(joint.back_emf_v_s >= 0, "back_emf_v_s", joint.back_emf_v_s, ">= 0");
    expect_finite(joint.nm_per_ampere != 0, "nm_per_ampere", joint.nm_per_ampere, "not 0");
    const bool steers = torque_from == TorqueFrom::goal;
    expect_finite(steers ? joint.duty_per_rad > 0 : joint.duty_per_rad >= 0, "duty_per_rad", joint.duty_per_rad,
                  steers ? "> 0, since torque comes from the goal" : ">= 0");
    expect_finite(joint.most_duty > 0 && joint.most_duty <= 1, "most_duty", joint.most_duty, "> 0, at most 1");
    expect_finite(joint.count_rad >= 0, "count_rad", joint.count_rad, ">= 0");
  }
}

}  // namespace tauext
