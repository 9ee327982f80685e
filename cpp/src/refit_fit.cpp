#include "refit_fit.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {
namespace {

constexpr double kHuber = 1.345, kTukey = 4.0;  // times the spread: from there on a row counts less, and not at all
constexpr int kConvexRounds = 5, kRounds = 15;  // Huber's weights first: a start that no push leads astray
constexpr double kLeastSpread = 0.5;            // of sigma: no minute is known to be twice as quiet as training
constexpr double kFirstMemoryS = 0.3, kLongestMemoryS = 2;
constexpr double kCorrelated = 0.05;            // correlation below it is none
constexpr double kUnexcited = 1e-6;             // a term whose values stay below it was not seen
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

// Of motion, not of stamps, which tell nothing from one recording to the next; further back nothing is a line.
double minutes_before_end(const RefitRows& rows, std::size_t row) {
  return std::min(rows.period_s * static_cast<double>(rows.size() - 1 - row) / 60, kLongestTrendMin);
}

// Lower triangle L of 1 + G = L L^T, in place, with G positive semidefinite: no pivot is below 1 but by rounding.
void cholesky(std::vector<double>& a, std::size_t n) {
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j <= i; ++j) {
      double sum = a[i * n + j];
      for (std::size_t k = 0; k < j; ++k) sum -= a[i * n + k] * a[j * n + k];
      a[i * n + j] = i == j ? std::sqrt(std::max(sum, 1.0)) : sum / a[j * n + j];
    }
}

std::vector<double> substitute(const std::vector<double>& l, std::size_t n, std::vector<double> b) {
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t k = 0; k < i; ++k) b[i] -= l[i * n + k] * b[k];
    b[i] /= l[i * n + i];
  }
  for (std::size_t i = n; i-- > 0;) {
    for (std::size_t k = i + 1; k < n; ++k) b[i] -= l[k * n + i] * b[k];
    b[i] /= l[i * n + i];
  }
  return b;
}

// Rows for which what is left stays what it is: 1 + twice the sum of its correlations.
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

// RMS of what these terms say together, where the joint shows friction.
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
  cholesky(gram, unknowns_);
  if (covariance) {
    covariance->assign(unknowns_ * unknowns_, 0.0);
    for (std::size_t u = 0; u < unknowns_; ++u) {
      std::vector<double> unit(unknowns_);
      unit[u] = 1;
      const std::vector<double> column = substitute(gram, unknowns_, std::move(unit));
      std::copy(column.begin(), column.end(), covariance->begin() + static_cast<std::ptrdiff_t>(u * unknowns_));
    }
  }
  return substitute(gram, unknowns_, std::move(moment));
}

// Of the rows that show friction; as training left it where none does.
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

// Of today's sum of a group's terms by the old one, over today's motion: f = (x.w_old)(x.w) / (x.w_old)^2 summed over it.
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

void JointFit::tell(RefitJoint& out) const {
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

}  // namespace tauext
