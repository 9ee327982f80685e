#include "refit_rows.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include "tauext/estimates.hpp"
#include "tauext/observation.hpp"

namespace tauext {
namespace {

constexpr double kLimitOverSigma = 4;  // limits of hours are 4 to 16 times it
// Pauses of a routine are shorter, and how the joint came to rest says what holds it; later its load has crept elsewhere.
constexpr double kStoodS = 5;
// In one direction, faster than near stiction: 2 mrad at least, which is a gear's presliding, and no noise of a velocity.
constexpr double kMovesS = 0.1;

// A recording's samples that a monitor would take, as a recording of their own: what it refuses would stay in the filters.
struct Entered {
  std::vector<std::int64_t> t_ns, from;
  std::vector<double> q, dq, tau;
};

Entered entered_samples(const RecordingView& r, const Estimates& said) {
  Entered out;
  const auto n = static_cast<std::size_t>(r.joints);
  for (std::size_t k = 0; k < said.entered.size(); ++k) {
    if (!said.entered[k]) continue;
    const Sample s = r.at(static_cast<std::int64_t>(k));
    out.t_ns.push_back(s.t_ns);
    out.from.push_back(static_cast<std::int64_t>(k));
    out.q.insert(out.q.end(), s.q.begin(), s.q.begin() + n);
    out.dq.insert(out.dq.end(), s.dq.begin(), s.dq.begin() + n);
    out.tau.insert(out.tau.end(), s.tau.begin(), s.tau.begin() + n);
  }
  return out;
}

PriorSettings changeable(const Bundle& bundle, std::span<const Term> terms) {
  PriorSettings prior;
  prior.widths_rad = bundle.prior.widths_rad;
  prior.branches = bundle.prior.branches;
  prior.terms.assign(terms.begin(), terms.end());
  prior.weights.assign(terms.size() * bundle.links.size(), 0.0);
  prior.corrected_links = bundle.prior.corrected_links;
  return prior;
}

void add_row(RefitRows& rows, const Bundle& bundle, const Estimates& said, const RecordingView& r, std::size_t k) {
  const std::size_t n = bundle.links.size();
  for (std::size_t j = 0; j < n; ++j) {
    const std::size_t cell = k * n + j;
    RefitRows::Joint& joint = rows.joints[j];
    const double limit = bundle.limits.limit_nm(bundle.limits.collision, static_cast<int>(j), said.near_stiction[cell]) *
                         said.limit_scale[cell];
    joint.error.push_back(said.residual[cell] - said.prior[cell] - said.network[cell]);
    joint.sigma.push_back(rows.knows_sigma ? said.sigma_nm[cell] : limit / kLimitOverSigma);
    joint.limit.push_back(limit);
    joint.doubt.push_back(said.doubt[cell]);
    joint.near_stiction.push_back(said.near_stiction[cell]);
    if (bundle.has_network()) joint.network.push_back(said.network[cell]);
    if (std::fabs(r.dq[cell]) > bundle.limits.near_stiction_rad_s) joint.moved_s += rows.period_s;
  }
}

constexpr std::int64_t kNever = std::numeric_limits<std::int64_t>::min();
constexpr auto kStoodNs = static_cast<std::int64_t>(1e9 * kStoodS), kMovesNs = static_cast<std::int64_t>(1e9 * kMovesS);

// When a joint last moved, as far as it has been told.
struct LastMotion {
  std::int64_t since_ns = kNever, moved_ns = kNever;  // begin of what may be one, and its last sample that was one
  double direction = 0;

  void take(std::int64_t t_ns, double speed, double least) noexcept {
    if (std::fabs(speed) <= least || speed * direction <= 0) since_ns = t_ns;
    direction = speed;
    if (std::fabs(speed) > least && t_ns - since_ns >= kMovesNs) moved_ns = t_ns;
  }
  bool shows(std::int64_t t_ns) const noexcept { return moved_ns != kNever && t_ns - moved_ns <= kStoodNs; }
};

}  // namespace

bool may_change(const Term& term) noexcept {
  switch (term.kind) {
    case TermKind::constant:
    case TermKind::viscous:
    case TermKind::coulomb:
    case TermKind::presliding:
    case TermKind::load:
    case TermKind::load_presliding:
    case TermKind::ripple:
    case TermKind::backlash:
      return true;
    default:
      return false;
  }
}

RefitRows refit_rows(const Bundle& bundle, std::span<const RefitSource> sources, int threads) {
  RefitRows rows;
  rows.joints.resize(bundle.links.size());
  rows.knows_sigma = bundle.error_scale.on();
  rows.period_s = 1e-9 * static_cast<double>(bundle.observer.sample_period_ns) * bundle.observer.network_stride;
  for (std::size_t m = 0; m < bundle.prior.terms.size(); ++m)
    if (may_change(bundle.prior.terms[m])) {
      rows.terms.push_back(bundle.prior.terms[m]);
      rows.places.push_back(m);
    }
  if (rows.terms.empty())
    throw Error("the bundle has no prior whose friction could be brought up to date; train one with recipe tauext or prior");
  Bundle plain = bundle;
  plain.drift = {};  // what it would take off is to be learned
  const PriorSettings prior = changeable(bundle, rows.terms);
  const Tree tree(bundle.links, bundle.gravity);
  const auto stride = static_cast<std::size_t>(bundle.observer.network_stride);
  for (std::size_t number = 0; number < sources.size(); ++number) {
    const RefitSource& source = sources[number];
    const RecordingView& r = source.recording;
    if (!source.use.empty() && source.use.size() != static_cast<std::size_t>(r.samples))
      throw Error("a refit's source has " + std::to_string(r.samples) + " samples, and says of " +
                  std::to_string(source.use.size()) + " whether they are used");
    const Estimates said = estimate(plain, r, threads);
    const Entered kept = entered_samples(r, said);
    const RecordingView clean{static_cast<std::int64_t>(kept.t_ns.size()), r.joints, kept.t_ns.data(), kept.q.data(),
                              kept.dq.data(), kept.tau.data()};
    std::vector<std::int64_t> at;
    std::vector<LastMotion> motion(bundle.links.size());
    for (std::size_t k = 0; k < kept.from.size(); k += stride) {
      const auto from = static_cast<std::size_t>(kept.from[k]);
      for (std::size_t j = 0; j < motion.size(); ++j)
        motion[j].take(kept.t_ns[k], r.dq[from * motion.size() + j], bundle.limits.near_stiction_rad_s);
      const bool used = source.use.empty() || source.use[from];
      if (!used || said.health[from] != static_cast<std::uint8_t>(Health::ok) ||
          said.unfamiliar[from] >= Coverage::kWorthTelling)
        continue;
      at.push_back(static_cast<std::int64_t>(k));
      rows.t_ns.push_back(kept.t_ns[k]);
      rows.source.push_back(static_cast<int>(number));
      add_row(rows, bundle, said, r, from);
      for (std::size_t j = 0; j < motion.size(); ++j) rows.joints[j].shows.push_back(motion[j].shows(kept.t_ns[k]));
    }
    if (at.empty()) continue;
    const std::vector<double> values = prior_regressors(tree, bundle.observer, prior, clean, at);
    rows.values.insert(rows.values.end(), values.begin(), values.end());
  }
  const double seconds = static_cast<double>(rows.size()) * rows.period_s;
  if (seconds < kRefitLeastS)
    throw Error("a refit needs " + to_text(kRefitLeastS) + " s of motion that can be trusted, not " + to_text(seconds) +
                " s: 30 to 60 s of the arm's ordinary motion");
  return rows;
}

}  // namespace tauext
