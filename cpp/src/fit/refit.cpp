#include "tauext/refit.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "bundle/linear.hpp"
#include "fit/regressors.hpp"
#include "stages/estimates.hpp"
#include "stages/observation.hpp"

namespace tauext {
// Rows one network period apart, of all sources in sequence. Each joint's columns are (rows).
struct RefitRows {
  struct Joint {
    std::vector<double> error;           // residual - prior - network
    std::vector<double> sigma;           // expected from the motion, or a quarter of the limit without an error scale
    std::vector<double> limit;           // collision limit for the motion, without doubt
    std::vector<double> doubt;
    std::vector<std::uint8_t> near_stiction;
    std::vector<std::uint8_t> shows;     // observable friction: it moved within the last kStoodS
    std::vector<double> network;         // network output; empty without a network
    double moved_s = 0;
  };
  std::vector<std::int64_t> t_ns;
  std::vector<int> source;
  std::vector<Joint> joints;
  std::vector<Term> terms;               // own terms of all joints, of variable kinds ...
  std::vector<std::size_t> places;       // ... and their indices in the prior
  std::vector<double> values;            // (rows, terms)
  double period_s = 0;
  bool has_sigma = false;

  std::size_t size() const noexcept { return t_ns.size(); }
};

// Terms of a single joint that model friction or may change with it.
bool may_change(const Term& term) noexcept;
// Throws Error if sources do not fit or hold too little data.
RefitRows refit_rows(const Bundle& bundle, std::span<const RefitSource> sources, int threads);

// First and end row of one of equally long stretches.
inline std::pair<std::size_t, std::size_t> block_of(std::size_t rows, int block, int blocks) noexcept {
  const auto at = [&](int b) { return rows * static_cast<std::size_t>(b) / static_cast<std::size_t>(blocks); };
  return {at(block), at(block + 1)};
}

// minimise |u|^2 + k sum_r t_r (y_r - a_r.u)^2 / s^2 over the unknowns u of RefitSettings, with y = error / sigma,
// a = terms' values by sigma, times the change of their weights per unit of u (of the trend: times the row's time). t:
// Tukey's weights; s: spread of the residual; k: share of independent rows.
class JointFit {
 public:
  JointFit(const Bundle& bundle, const RefitRows& rows, int joint, const RefitSettings& settings);

  // Factors and constant.
  void report(RefitJoint& out) const;
  // The joint's weights, and its network's scale.
  void put(Bundle& bundle) const;
  // Error of every row, fitted without its block, [N m].
  std::vector<double> left_out(int blocks) const;
  double memory_s() const noexcept { return memory_s_; }

 private:
  enum class Group : std::uint8_t { friction, viscous, constant, ripple, network };
  struct Column {
    Group group;
    std::size_t place;  // in the prior's terms
    double weight;      // the old one; 1 of a network
    std::vector<double> values;  // (rows)
  };

  void find_columns();
  void build(const RefitSettings& settings);
  void iterate();
  double spread_of(std::span<const double> rest) const;
  // Unknowns from the rows outside [first, end); their covariance on request.
  std::vector<double> solve(std::size_t first, std::size_t end, std::vector<double>* covariance) const;
  std::vector<double> left(std::span<const double> unknowns) const;
  double size_of(Group group) const;
  RefitFactor factor(Group group) const;
  double change(std::size_t column, std::span<const double> unknowns) const;

  const Bundle& bundle_;
  const RefitRows& rows_;
  std::size_t joint_;
  std::vector<Column> columns_;
  std::size_t unknowns_ = 0;
  double expected_ = 1;              // factor of friction expected before the motion is used
  double unseen_error_ = 0;          // of a factor that the motion does not determine
  std::vector<double> effect_;       // (columns, unknowns): change of a weight by a unit of an unknown
  std::vector<double> standard_;     // (rows, unknowns): a
  std::vector<double> given_;        // (rows): error / sigma beside what is expected
  std::vector<double> trust_;        // (rows): t
  double spread_ = 1, independent_ = 1, memory_s_ = 0;
  std::vector<double> found_, covariance_;
};

namespace {

constexpr double kLimitOverSigma = 4;  // limits of hours are 4 to 16 times it
// Pauses within a routine are shorter: the stop direction determines the friction. In longer ones the load creeps.
constexpr double kStoodS = 5;
// Motion in one direction, faster than near stiction, over at least 2 mrad: more than presliding and velocity noise.
constexpr double kMovesS = 0.1;

// The samples that a monitor would accept, as a recording; rejected ones would stay in the filters.
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
    joint.sigma.push_back(rows.has_sigma ? said.sigma_nm[cell] : limit / kLimitOverSigma);
    joint.limit.push_back(limit);
    joint.doubt.push_back(said.doubt[cell]);
    joint.near_stiction.push_back(said.near_stiction[cell]);
    if (bundle.has_network()) joint.network.push_back(said.network[cell]);
    if (std::fabs(r.dq[cell]) > bundle.limits.near_stiction_rad_s) joint.moved_s += rows.period_s;
  }
}

constexpr std::int64_t kNever = std::numeric_limits<std::int64_t>::min();
constexpr auto kStoodNs = static_cast<std::int64_t>(1e9 * kStoodS), kMovesNs = static_cast<std::int64_t>(1e9 * kMovesS);

// When a joint last moved.
struct LastMotion {
  std::int64_t since_ns = kNever, moved_ns = kNever;  // start of a possible motion, and last sample of an actual one
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
  rows.has_sigma = bundle.error_scale.on();
  rows.period_s = 1e-9 * static_cast<double>(bundle.observer.sample_period_ns) * bundle.observer.network_stride;
  for (std::size_t m = 0; m < bundle.prior.terms.size(); ++m)
    if (may_change(bundle.prior.terms[m])) {
      rows.terms.push_back(bundle.prior.terms[m]);
      rows.places.push_back(m);
    }
  if (rows.terms.empty())
    throw Error("the bundle has no prior whose friction could be brought up to date; train one with recipe tauext or prior");
  Bundle plain = bundle;
  plain.drift = {};  // its correction is to be learned
  const PriorSettings prior = changeable(bundle, rows.terms);
  const Tree tree(bundle.links, bundle.gravity);
  const auto stride = static_cast<std::size_t>(bundle.observer.network_stride);
  for (std::size_t number = 0; number < sources.size(); ++number) {
    const RefitSource& source = sources[number];
    const RecordingView& r = source.recording;
    if (!source.use.empty() && source.use.size() != static_cast<std::size_t>(r.samples))
      throw Error("a refit's source has " + std::to_string(r.samples) + " samples, and flags for " +
                  std::to_string(source.use.size()) + " of them");
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
          said.unfamiliar[from] >= Coverage::kWorthReporting)
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
                " s: record 30 to 60 s of the arm's ordinary motion");
  return rows;
}

namespace {

constexpr double kHuber = 1.345, kTukey = 4.0;  // times the spread: from there weights fall, and are 0
constexpr int kConvexRounds = 5, kRounds = 15;  // Huber's weights first: a robust starting point
constexpr double kLeastSpread = 0.5;            // of sigma: errors are not assumed below half of training's
constexpr double kFirstMemoryS = 0.3, kLongestMemoryS = 2;
constexpr double kCorrelated = 0.05;            // smaller correlations count as 0
constexpr double kUnexcited = 1e-6;             // a term with smaller values is not excited
constexpr double kMedianOfNormal = 0.6745;
constexpr double kLongestTrendMin = 2;
constexpr std::size_t kTrend = 3, kShared = 4;  // unknowns before those of single terms

// Of the rows that count.
double rms(std::span<const double> values, std::span<const std::uint8_t> counts) {
  double squares = 0, rows = 0;
  for (std::size_t r = 0; r < values.size(); ++r)
    if (counts[r]) squares += values[r] * values[r], ++rows;
  return rows > 0 ? std::sqrt(squares / rows) : 0;
}

double median_size(std::vector<double> values) {
  for (double& one : values) one = std::fabs(one);
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// By motion, not by time stamps, which are unrelated between recordings; without a trend over longer motion.
double minutes_before_end(const RefitRows& rows, std::size_t row) {
  return std::min(rows.period_s * static_cast<double>(rows.size() - 1 - row) / 60, kLongestTrendMin);
}

// Correlation length of the residual in rows: 1 + twice the sum of its correlations.
double memory_rows(std::span<const double> left, std::size_t most) {
  double variance = 0;
  for (double one : left) variance += one * one;
  double sum = 1;
  for (std::size_t lag = 1; lag < std::min(most, left.size()) && variance > 0; ++lag) {
    double product = 0;
    for (std::size_t k = lag; k < left.size(); ++k) product += left[k] * left[k - lag];
    if (product < kCorrelated * variance) break;
    sum += 2 * product / variance;
  }
  return sum;
}

}  // namespace

JointFit::JointFit(const Bundle& bundle, const RefitRows& rows, int joint, const RefitSettings& settings)
    : bundle_(bundle), rows_(rows), joint_(static_cast<std::size_t>(joint)), trust_(rows.size(), 1.0) {
  find_columns();
  build(settings);
  iterate();
}

void JointFit::find_columns() {
  const std::size_t M = bundle_.prior.terms.size(), T = rows_.terms.size();
  for (std::size_t t = 0; t < T; ++t) {
    const Term& term = rows_.terms[t];
    if (static_cast<std::size_t>(term.a) != joint_) continue;
    Column column{Group::friction, rows_.places[t], bundle_.prior.weights[joint_ * M + rows_.places[t]], {}};
    if (term.kind == TermKind::viscous) column.group = Group::viscous;
    if (term.kind == TermKind::constant) column.group = Group::constant;
    if (term.kind == TermKind::ripple) column.group = Group::ripple;
    for (std::size_t r = 0; r < rows_.size(); ++r) column.values.push_back(rows_.values[r * T + t]);
    columns_.push_back(std::move(column));
  }
  const RefitRows::Joint& of = rows_.joints[joint_];
  if (!of.network.empty() && bundle_.output_scale_nm[joint_] != 0)
    columns_.push_back({Group::network, 0, 1.0, of.network});
}

// RMS of the sum of these terms, over rows with observable friction.
double JointFit::size_of(Group group) const {
  std::vector<double> sum(rows_.size());
  for (const Column& column : columns_)
    for (std::size_t r = 0; column.group == group && r < sum.size(); ++r) sum[r] += column.weight * column.values[r];
  return rms(sum, rows_.joints[joint_].shows);
}

void JointFit::build(const RefitSettings& settings) {
  const std::size_t C = columns_.size();
  unknowns_ = kShared + C;
  const bool known = !settings.expected.empty();
  expected_ = known ? settings.expected[joint_] : 1.0;
  const double common = known ? settings.expected_error[joint_] : settings.common;
  const double apart = known && settings.common > 0 ? settings.apart * common / settings.common : settings.apart;
  unseen_error_ = std::hypot(common, apart);
  effect_.assign(C * unknowns_, 0.0);
  const double friction = std::hypot(size_of(Group::friction), size_of(Group::viscous));
  for (std::size_t c = 0; c < C; ++c) {
    const Column& column = columns_[c];
    const double shown = rms(column.values, rows_.joints[joint_].shows);
    double* row = &effect_[c * unknowns_];
    double own = 0;
    switch (column.group) {
      case Group::friction:
      case Group::viscous:
        row[0] = common * column.weight;
        row[column.group == Group::friction ? 1 : 2] = apart * column.weight;
        own = settings.single * friction / std::max(shown, kUnexcited);
        break;
      case Group::constant: own = settings.constant * friction; break;
      case Group::ripple: own = settings.ripple * column.weight; break;
      case Group::network: own = settings.network * column.weight; break;
    }
    row[kShared + c] = shown < kUnexcited ? 0.0 : own;
  }
  standard_.assign(rows_.size() * unknowns_, 0.0);
  const std::vector<double>&sigma = rows_.joints[joint_].sigma, &error = rows_.joints[joint_].error;
  for (std::size_t r = 0; r < rows_.size(); ++r) {
    given_.push_back(error[r] / sigma[r]);
    for (const Column& column : columns_)
      if (column.group == Group::friction || column.group == Group::viscous)
        given_.back() -= (expected_ - 1) * column.weight * column.values[r] / sigma[r];
  }
  for (std::size_t r = 0; r < rows_.size(); ++r)
    for (std::size_t c = 0; c < C; ++c) {
      const double value = columns_[c].values[r] / sigma[r];
      for (std::size_t u : {std::size_t{0}, std::size_t{1}, std::size_t{2}, kShared + c})
        standard_[r * unknowns_ + u] += value * effect_[c * unknowns_ + u];
      if (columns_[c].group == Group::friction || columns_[c].group == Group::viscous)
        standard_[r * unknowns_ + kTrend] -= value * columns_[c].weight * settings.trend * minutes_before_end(rows_, r);
    }
}

std::vector<double> JointFit::left(std::span<const double> unknowns) const {
  std::vector<double> out = given_;
  for (std::size_t r = 0; r < out.size(); ++r)
    for (std::size_t u = 0; u < unknowns_; ++u) out[r] -= standard_[r * unknowns_ + u] * unknowns[u];
  return out;
}

std::vector<double> JointFit::solve(std::size_t first, std::size_t end, std::vector<double>* covariance) const {
  std::vector<double> gram(unknowns_ * unknowns_), moment(unknowns_);
  for (std::size_t u = 0; u < unknowns_; ++u) gram[u * unknowns_ + u] = 1;
  for (std::size_t r = 0; r < rows_.size(); ++r) {
    if ((r >= first && r < end) || trust_[r] == 0) continue;
    const double weight = independent_ * trust_[r] / (spread_ * spread_), y = given_[r];
    const double* a = &standard_[r * unknowns_];
    for (std::size_t i = 0; i < unknowns_; ++i) {
      const double scaled = weight * a[i];
      moment[i] += scaled * y;
      for (std::size_t j = 0; j <= i; ++j) gram[i * unknowns_ + j] += scaled * a[j];
    }
  }
  cholesky(gram, unknowns_, 1.0);  // of 1 + G, with G positive semidefinite: no pivot is below 1 but by rounding
  if (covariance) {
    covariance->resize(unknowns_ * unknowns_);
    invert(gram, unknowns_, *covariance);
  }
  substitute(gram, unknowns_, moment);
  return moment;
}

// Over rows with observable friction; training's value if there are none.
double JointFit::spread_of(std::span<const double> rest) const {
  std::vector<double> shown;
  for (std::size_t r = 0; r < rest.size(); ++r)
    if (rows_.joints[joint_].shows[r]) shown.push_back(rest[r]);
  return shown.empty() ? 1.0 : std::max(kLeastSpread, median_size(std::move(shown)) / kMedianOfNormal);
}

void JointFit::iterate() {
  const std::vector<std::uint8_t>& shows = rows_.joints[joint_].shows;
  independent_ = std::min(1.0, rows_.period_s / kFirstMemoryS);
  found_.assign(unknowns_, 0.0);
  std::vector<double> rest = left(found_);
  spread_ = spread_of(rest);
  for (int round = 0; round < kRounds; ++round) {
    for (std::size_t r = 0; r < rest.size(); ++r) {
      const double size = std::fabs(rest[r]) / spread_, tukey = 1 - size * size / (kTukey * kTukey);
      trust_[r] = !shows[r] ? 0 : round < kConvexRounds ? std::min(1.0, kHuber / std::max(size, kHuber)) : size < kTukey ? tukey * tukey : 0;
    }
    found_ = solve(0, 0, nullptr);
    rest = left(found_);
    spread_ = spread_of(rest);
    if (round < kConvexRounds) continue;
    std::vector<double> counted(rest.size());
    for (std::size_t r = 0; r < rest.size(); ++r) counted[r] = trust_[r] > 0 ? rest[r] : 0.0;
    const double memory = memory_rows(counted, static_cast<std::size_t>(kLongestMemoryS / rows_.period_s));
    independent_ = 1 / memory;
    memory_s_ = memory * rows_.period_s;
  }
  found_ = solve(0, 0, &covariance_);
}

double JointFit::change(std::size_t column, std::span<const double> unknowns) const {
  const Column& of = columns_[column];
  double sum = of.group == Group::friction || of.group == Group::viscous ? (expected_ - 1) * of.weight : 0;
  for (std::size_t u = 0; u < unknowns_; ++u) sum += effect_[column * unknowns_ + u] * unknowns[u];
  return sum;
}

std::vector<double> JointFit::left_out(int blocks) const {
  std::vector<double> out(rows_.size());
  const RefitRows::Joint& of = rows_.joints[joint_];
  for (int block = 0; block < blocks; ++block) {
    const auto [first, end] = block_of(rows_.size(), block, blocks);
    const std::vector<double> rest = left(solve(first, end, nullptr));
    for (std::size_t r = first; r < end; ++r) out[r] = rest[r] * of.sigma[r];
  }
  return out;
}

// Factor of a group of terms over this motion: f = (x.w_old)(x.w) / (x.w_old)^2, summed over the motion.
RefitFactor JointFit::factor(Group group) const {
  std::vector<double> old(rows_.size());
  for (const Column& column : columns_)
    for (std::size_t r = 0; column.group == group && r < old.size(); ++r) old[r] += column.weight * column.values[r];
  double squares = 0;
  for (double one : old) squares += one * one;
  if (squares <= 0) return {expected_, unseen_error_};
  std::vector<double> slope(unknowns_);  // of the factor by the unknowns
  for (std::size_t c = 0; c < columns_.size(); ++c) {
    if (columns_[c].group != group) continue;
    double product = 0;
    for (std::size_t r = 0; r < old.size(); ++r) product += old[r] * columns_[c].values[r];
    for (std::size_t u = 0; u < unknowns_; ++u) slope[u] += product / squares * effect_[c * unknowns_ + u];
  }
  double value = expected_, variance = 0;
  for (std::size_t i = 0; i < unknowns_; ++i) {
    value += slope[i] * found_[i];
    for (std::size_t k = 0; k < unknowns_; ++k) variance += slope[i] * covariance_[i * unknowns_ + k] * slope[k];
  }
  return {value, std::sqrt(std::max(variance, 0.0))};
}

void JointFit::report(RefitJoint& out) const {
  out.coulomb = factor(Group::friction);
  out.viscous = factor(Group::viscous);
  out.moved_s = rows_.joints[joint_].moved_s;
  for (std::size_t c = 0; c < columns_.size(); ++c) {
    if (columns_[c].group != Group::constant) continue;
    out.constant_nm = change(c, found_);
    out.constant_error_nm = effect_[c * unknowns_ + kShared + c] * std::sqrt(covariance_[(kShared + c) * unknowns_ + kShared + c]);
  }
}

void JointFit::put(Bundle& bundle) const {
  const std::size_t M = bundle.prior.terms.size();
  for (std::size_t c = 0; c < columns_.size(); ++c) {
    const double by = change(c, found_);
    if (columns_[c].group == Group::network)
      bundle.output_scale_nm[joint_] *= std::max(1 + by, 0.0);
    else
      bundle.prior.weights[joint_ * M + columns_[c].place] += by;
  }
}

namespace {

constexpr double kOneSigma = 0.6827;        // share of errors within one standard error: sigma was scaled to it
constexpr int kBlocks = 6;                  // left out in turn: 10 s of a minute each
// For normal noise, the thinnest possible tail, the largest error in one minute is 0.74 times that in 112 h (worst of
// 20; a fourteenth of 8 h). A larger one contradicts the limit.
constexpr double kMinuteReaches = 0.75;
constexpr double kApartS = 0.5;             // touches closer than this count as one
constexpr int kMostTouches = 3;             // per joint: more frequent ones are errors
constexpr double kMostTouched = 0.1;        // of the motion: a larger share is error
constexpr double kLeastFactor = 0.2, kMostFactor = 5;
constexpr double kMostLeft = 5;             // times sigma: larger residuals are not friction and give no useful limit

double quantile(std::vector<double> values, double share) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  const auto at = static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), values.begin() + at, values.end());
  return values[static_cast<std::size_t>(at)];
}

// |error| beyond the doubt over the collision limit; minimum over the hold time before each row.
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

// Runs of rows over the limit; gaps below kApartS are closed.
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

// Rows without a touch on any joint, with a margin.
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

void report_error(const RefitRows& rows, int joint, std::span<const double> left, std::span<const std::uint8_t> free,
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
  if (!rows.has_sigma || of_blocks.size() < 2) return;
  const double mean = std::accumulate(of_blocks.begin(), of_blocks.end(), 0.0) / static_cast<double>(of_blocks.size());
  double squares = 0;
  for (double one : of_blocks) squares += (one - mean) * (one - mean);
  const auto count = static_cast<double>(of_blocks.size());
  out.error_ratio = quantile(std::move(all), kOneSigma);
  out.error_ratio_upper = out.error_ratio + std::sqrt(squares / (count * (count - 1)));
}

// Limits scale with the friction (prior errors are proportional to it), the error and the largest error.
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
              to_text(factor.value) + " times the old one, but must be " + to_text(kLeastFactor) + " to " + to_text(kMostFactor) +
              "; check that the recordings are of the bundle's arm and tau is in its unit, or train again");
}

void expect_explained(const Bundle& bundle, int joint, double error_ratio) {
  if (!(error_ratio > kMostLeft)) return;
  throw Error("joint '" + bundle.links[static_cast<std::size_t>(joint)].joint_name + "': the error that friction does not explain is " +
              to_text(error_ratio) + " times the error that training left, at most " + to_text(kMostLeft) +
              " is allowed; check for another payload or tool and for long contacts, or train again");
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
    fit.report(joint);
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
    report_error(rows, j, left[at], free, out.joints[at]);
    expect_explained(bundle, j, out.joints[at].error_ratio);
    raise(out.bundle, j, out.joints[at]);
  }
  answer_reference(out.bundle);
  return out;
}

}  // namespace tauext
