#include "tauext/refit.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <string>

#include "refit_fit.hpp"

namespace tauext {
namespace {

constexpr double kOneSigma = 0.6827;        // share of errors within one standard error: sigma was scaled to it
constexpr int kBlocks = 6;                  // left out one after the other: 10 s of a minute each
// Normal noise, whose tail is the thinnest that errors have, reaches in the worst of 20 minutes 0.74 times what it reaches
// in 112 h (a fourteenth of 8 h): one minute's largest error above that speaks against the limit.
constexpr double kMinuteReaches = 0.75;
constexpr double kApartS = 0.5;             // touches nearer than this are one
constexpr int kMostTouches = 3;             // of a joint: what comes more often is its error
constexpr double kMostTouched = 0.1;        // of the motion: likewise
constexpr double kLeastFactor = 0.2, kMostFactor = 5;
constexpr double kMostLeft = 5;             // times sigma: what stays so large is no friction, and no limit worth having

double quantile(std::vector<double> values, double share) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  const auto at = static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), values.begin() + at, values.end());
  return values[static_cast<std::size_t>(at)];
}

// |error| beyond the doubt by the collision limit, the least of the hold time before each row.
std::vector<double> held_shares(const Bundle& bundle, const RefitRows& rows, int joint, std::span<const double> left) {
  const RefitRows::Joint& of = rows.joints[static_cast<std::size_t>(joint)];
  std::vector<double> share(left.size()), held(left.size());
  for (std::size_t k = 0; k < left.size(); ++k)
    share[k] = std::max(std::fabs(left[k]) - of.doubt[k], 0.0) / of.limit[k];
  const auto back = static_cast<std::size_t>(bundle.limits.collision.hold_s / rows.period_s);
  for (std::size_t k = 0; k < left.size(); ++k) {
    held[k] = share[k];
    for (std::size_t b = 1; b <= std::min(back, k); ++b) held[k] = std::min(held[k], share[k - b]);
  }
  return held;
}

// Runs of rows over the limit, those nearer than kApartS as one.
std::vector<RefitTouch> touches_of(const RefitRows& rows, int joint, std::span<const double> share) {
  std::vector<RefitTouch> found;
  const auto apart_ns = static_cast<std::int64_t>(1e9 * kApartS);
  for (std::size_t k = 0; k < share.size(); ++k) {
    if (share[k] <= 1) continue;
    const bool goes_on = !found.empty() && found.back().source == rows.source[k] &&
                         rows.t_ns[k] - found.back().to_ns <= apart_ns;
    if (!goes_on) found.push_back({rows.source[k], joint, rows.t_ns[k], rows.t_ns[k], 0, false});
    found.back().to_ns = rows.t_ns[k];
    found.back().share = std::max(found.back().share, share[k]);
  }
  double touched_s = 0;
  for (const RefitTouch& one : found) touched_s += 1e-9 * static_cast<double>(one.to_ns - one.from_ns) + rows.period_s;
  const bool error = found.size() > kMostTouches || touched_s > kMostTouched * rows.period_s * static_cast<double>(share.size());
  for (RefitTouch& one : found) one.counted = error;
  return found;
}

// Rows that no touch is at or near, whichever joint shows it.
std::vector<std::uint8_t> free_rows(const RefitRows& rows, std::span<const RefitTouch> touches) {
  std::vector<std::uint8_t> free(rows.size(), 1);
  const auto near_ns = static_cast<std::int64_t>(1e9 * kApartS);
  for (const RefitTouch& one : touches) {
    if (one.counted) continue;
    for (std::size_t k = 0; k < free.size(); ++k)
      if (rows.source[k] == one.source && rows.t_ns[k] >= one.from_ns - near_ns && rows.t_ns[k] <= one.to_ns + near_ns)
        free[k] = 0;
  }
  return free;
}

void tell_error(const RefitRows& rows, int joint, std::span<const double> left, std::span<const std::uint8_t> free,
                RefitJoint& out) {
  const RefitRows::Joint& of = rows.joints[static_cast<std::size_t>(joint)];
  std::vector<double> all, of_blocks;
  for (int block = 0; block < kBlocks; ++block) {
    const auto [first, end] = block_of(rows.size(), block, kBlocks);
    std::vector<double> ratios;
    for (std::size_t k = first; k < end; ++k)
      if (free[k] && of.shows[k]) ratios.push_back(std::fabs(left[k]) / of.sigma[k]);
    all.insert(all.end(), ratios.begin(), ratios.end());
    if (!ratios.empty()) of_blocks.push_back(quantile(std::move(ratios), kOneSigma));
  }
  out.error_ratio = out.error_ratio_upper = std::numeric_limits<double>::quiet_NaN();
  if (!rows.knows_sigma || of_blocks.size() < 2) return;
  const double mean = std::accumulate(of_blocks.begin(), of_blocks.end(), 0.0) / static_cast<double>(of_blocks.size());
  double squares = 0;
  for (double one : of_blocks) squares += (one - mean) * (one - mean);
  const auto count = static_cast<double>(of_blocks.size());
  out.error_ratio = quantile(std::move(all), kOneSigma);
  out.error_ratio_upper = out.error_ratio + std::sqrt(squares / (count * (count - 1)));
}

// Limits grow with the friction, since what a prior leaves of it is a share of it; with the error; and with the largest.
void raise(Bundle& bundle, int joint, RefitJoint& out) {
  const auto j = static_cast<std::size_t>(joint);
  const double friction = out.coulomb.value + out.coulomb.error;
  out.limit_factor = std::max({1.0, friction, out.largest_share / kMinuteReaches});
  if (std::isfinite(out.error_ratio_upper)) {
    out.limit_factor = std::max(out.limit_factor, out.error_ratio_upper);
    out.sigma_factor = std::max(1.0, out.error_ratio);
  }
  for (Level* level : {&bundle.limits.collision, &bundle.limits.contact}) {
    level->sliding_nm[j] *= out.limit_factor;
    level->near_stiction_nm[j] *= out.limit_factor;
  }
  ErrorScaleSettings& scale = bundle.error_scale;
  if (!scale.on()) return;
  const std::size_t count = scale.features.size();
  for (std::vector<double>* weights : {&scale.sigma_weights, &scale.sigma_near_weights})
    for (std::size_t m = 0; m < count; ++m) (*weights)[j * count + m] *= out.sigma_factor;
  scale.largest_sigma[j] *= out.sigma_factor;
}

void expect_friction(const Bundle& bundle, int joint, const RefitFactor& factor) {
  if (factor.value >= kLeastFactor && factor.value <= kMostFactor) return;
  throw Error("joint '" + bundle.links[static_cast<std::size_t>(joint)].joint_name + "': its friction would be " +
              to_text(factor.value) + " times the old one, and " + to_text(kLeastFactor) + " to " + to_text(kMostFactor) +
              " can be; are these recordings of the bundle's arm, and tau in its unit? Else train anew");
}

void expect_explained(const Bundle& bundle, int joint, double error_ratio) {
  if (!(error_ratio > kMostLeft)) return;
  throw Error("joint '" + bundle.links[static_cast<std::size_t>(joint)].joint_name + "': what no friction explains is " +
              to_text(error_ratio) + " times the error that training left, and " + to_text(kMostLeft) +
              " is the most; does the arm carry another load or tool, or was it touched throughout? Else train anew");
}

}  // namespace

void RefitSettings::validate(int joints) const {
  for (double one : {common, apart, single, constant, ripple, trend, network})
    if (!(one >= 0 && one <= 10)) throw Error("a refit's standard deviation of " + to_text(one) + " must be 0 to 10");
  const auto count = static_cast<std::size_t>(joints);
  if (expected.size() != expected_error.size() || (!expected.empty() && expected.size() != count))
    throw Error("a refit's expectations must be one a joint, with their standard deviations");
  for (std::size_t j = 0; j < expected.size(); ++j)
    if (!(expected[j] >= kLeastFactor && expected[j] <= kMostFactor && expected_error[j] > 0 && expected_error[j] <= 10))
      throw Error("a refit's expected factor of " + to_text(expected[j]) + " with a standard deviation of " +
                  to_text(expected_error[j]) + " must be " + to_text(kLeastFactor) + " to " + to_text(kMostFactor) +
                  ", and above 0 to 10");
}

Refit refit(const Bundle& bundle, std::span<const RefitSource> sources, const RefitSettings& settings, int threads) {
  bundle.validate();
  settings.validate(bundle.joints());
  const RefitRows rows = refit_rows(bundle, sources, threads);
  Refit out;
  out.bundle = bundle;
  out.used_s = static_cast<double>(rows.size()) * rows.period_s;
  const int n = bundle.joints();
  std::vector<std::vector<double>> left;
  std::vector<std::vector<double>> shares;
  for (int j = 0; j < n; ++j) {
    const JointFit fit(bundle, rows, j, settings);
    RefitJoint& joint = out.joints.emplace_back();
    fit.tell(joint);
    expect_friction(bundle, j, joint.coulomb);
    fit.put(out.bundle);
    out.memory_s = std::max(out.memory_s, fit.memory_s());
    left.push_back(fit.left_out(kBlocks));
    shares.push_back(held_shares(bundle, rows, j, left.back()));
    for (const RefitTouch& one : touches_of(rows, j, shares.back())) out.touches.push_back(one);
  }
  const std::vector<std::uint8_t> free = free_rows(rows, out.touches);
  out.left_out = {rows.t_ns, free, {}, {}};
  for (std::size_t k = 0; k < rows.size(); ++k)
    for (std::size_t j = 0; j < shares.size(); ++j) {
      out.left_out.share.push_back(shares[j][k]);
      out.left_out.near_stiction.push_back(rows.joints[j].near_stiction[k]);
    }
  for (int j = 0; j < n; ++j) {
    const auto at = static_cast<std::size_t>(j);
    for (std::size_t k = 0; k < rows.size(); ++k)
      if (free[k]) out.joints[at].largest_share = std::max(out.joints[at].largest_share, shares[at][k]);
    tell_error(rows, j, left[at], free, out.joints[at]);
    expect_explained(bundle, j, out.joints[at].error_ratio);
    raise(out.bundle, j, out.joints[at]);
  }
  answer_reference(out.bundle);
  return out;
}

}  // namespace tauext
