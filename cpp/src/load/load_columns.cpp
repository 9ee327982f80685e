#include "load/load_columns.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <type_traits>

namespace tauext {
namespace {

constexpr std::size_t kLoads = LoadColumns::kParameters, kOffset = kLoads, kFrame = kOffset + 1, kBase = kFrame + 3,
                      kCoulomb = kBase + 3, kFilters = kCoulomb + 1;

bool goes_by_corrected(const PriorSettings& prior) {
  return std::ranges::any_of(prior.terms, [](const Term& term) { return (is_load(term) || term.kind == TermKind::backlash) && term.form == 1; });
}

}  // namespace

LoadColumns::LoadColumns(const Tree& tree, const PriorSettings& prior, const LoadFrame& frame, double gain_per_s)
    : joints_(tree.size()),
      regressor_(tree, frame),
      shares_((prior.validate(tree.size()), load_friction_shares(prior, tree.size()))),
      filters_(kFilters, MomentumObserver(tree.size(), gain_per_s, TorqueTiming::held)) {
  if (goes_by_corrected(prior)) corrected_.emplace(prior.corrected_links, tree.gravity());
}

void LoadColumns::reset() noexcept {
  for (MomentumObserver& one : filters_) one.reset();
}

void LoadColumns::filter(std::size_t which, std::int64_t t_ns, const JointVector& p, const JointVector& v,
                         JointVector& out) noexcept {
  constexpr JointVector zero{};
  const auto n = static_cast<std::size_t>(joints_);
  filters_[which].step(t_ns, std::span(p).first(n), std::span(v).first(n), std::span(zero).first(n),
                             std::span(out).first(n));
  if (!settled_) return;
  out = v;
  filters_[which].go_back(t_ns, std::span(p).first(n), std::span(v).first(n), std::span(zero).first(n),
                                std::span(v).first(n));
}

void LoadColumns::begin(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                        std::span<const double> beta, std::span<const double> phi) noexcept {
  settled_ = true;
  step(t_ns, q, dq, beta, phi);
  settled_ = false;
}

std::size_t LoadColumns::state_bytes() const noexcept { return filter_bytes() + sizeof shown_; }

void LoadColumns::save(std::span<std::byte> to) const noexcept {
  static_assert(std::is_trivially_copyable_v<MomentumObserver> && std::is_trivially_copyable_v<Shown>);
  std::memcpy(to.data(), filters_.data(), filter_bytes());
  std::memcpy(to.data() + filter_bytes(), &shown_, sizeof shown_);
}

void LoadColumns::restore(std::span<const std::byte> from) noexcept {
  std::memcpy(static_cast<void*>(filters_.data()), from.data(), filter_bytes());
  std::memcpy(&shown_, from.data() + filter_bytes(), sizeof shown_);
}

void LoadColumns::step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                       std::span<const double> beta, std::span<const double> phi) noexcept {
  constexpr JointVector zero{};
  const auto n = static_cast<std::size_t>(joints_);
  regressor_.compute(q, dq);
  JointVector corrected_momentum, corrected_beta, rubbing{}, offset{}, coulomb{};
  if (corrected_) {
    corrected_->momentum(q, dq, std::span(corrected_momentum).first(n), std::span(corrected_beta).first(n));
    beta = std::span<const double>(corrected_beta).first(n);
  }
  for (std::size_t j = 0; j < n; ++j) {
    double loaded = beta[j];
    for (std::size_t k = 0; k < kLoads; ++k) loaded += regressor_.beta()[k][j] * phi[k];
    const double side = std::copysign(1.0, loaded);
    coulomb[j] = std::tanh(dq[j] / kSignSpeed);
    rubbing[j] = -shares_[j] * coulomb[j] * side;
    offset[j] = -shares_[j] * coulomb[j] * (side * beta[j] - std::fabs(beta[j]));
  }
  for (std::size_t k = 0; k < kLoads; ++k) {
    JointVector p, v;
    for (std::size_t j = 0; j < n; ++j) {
      p[j] = -regressor_.momentum()[k][j];
      v[j] = (rubbing[j] - 1) * regressor_.beta()[k][j];
    }
    filter(k, t_ns, p, v, shown_.load[k]);
  }
  filter(kOffset, t_ns, zero, offset, shown_.offset);
  for (std::size_t k = 0; k < 3; ++k) {
    filter(kFrame + k, t_ns, zero, regressor_.frame_forces()[k], shown_.frame_forces[k]);
    filter(kBase + k, t_ns, zero, regressor_.base_forces()[k], shown_.base_forces[k]);
  }
  filter(kCoulomb, t_ns, zero, coulomb, shown_.coulomb);
}

LoadSums::Row LoadColumns::row(int joint, double tau_ext) const noexcept {
  const auto j = static_cast<std::size_t>(joint);
  LoadSums::Row row{};
  for (std::size_t k = 0; k < kLoads; ++k) row[LoadSums::kLoad + k] = shown_.load[k][j];
  row[LoadSums::kOffset] = 1.0;
  row[LoadSums::kCoulomb] = shown_.coulomb[j];
  for (std::size_t k = 0; k < 3; ++k) {
    row[LoadSums::kBase + k] = shown_.base_forces[k][j];
    row[LoadSums::kFrame + k] = shown_.frame_forces[k][j];
  }
  row[LoadSums::kGear] = shown_.offset[j];
  row[LoadSums::kTauExt] = tau_ext;
  return row;
}

}  // namespace tauext
