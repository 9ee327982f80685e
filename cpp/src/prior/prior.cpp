#include "prior/prior.hpp"

#include <algorithm>
#include <bit>
#include <cmath>

namespace tauext {
std::vector<double> load_friction_shares(const PriorSettings& prior, int joints) {
  std::vector<double> shares(static_cast<std::size_t>(joints));
  std::uint32_t known = 0;
  for (std::size_t m = 0; m < prior.terms.size(); ++m) {
    const auto joint = static_cast<std::size_t>(prior.terms[m].a);
    if (!is_load(prior.terms[m])) continue;
    shares[joint] -= prior.weights[joint * prior.terms.size() + m];
    known |= std::uint32_t{1} << joint;
  }
  double sum = 0;
  for (double& share : shares) sum += share = std::clamp(share, 0.0, kMostLoadFriction);
  for (std::size_t j = 0; known != 0 && j < shares.size(); ++j)
    if (!(known >> j & 1)) shares[j] = sum / std::popcount(known);
  return shares;
}

PriorTerms::PriorTerms(const PriorSettings& settings, const std::array<double, 3>& gravity)
    : terms_(settings.terms), most_load_nm_(settings.most_load_nm) {
  for (const Term& t : terms_)
    if (is_load(t)) load_form_.fill(t.form);
  for (const Term& t : terms_)
    if (is_load(t)) load_form_[static_cast<std::size_t>(t.a)] = t.form;
  if (!settings.corrected_links.empty()) corrected_.emplace(settings.corrected_links, gravity);
  uses_angles_ = corrects_model() || std::ranges::any_of(terms_, [](const Term& t) {
    return t.kind == TermKind::gravity || t.kind == TermKind::quadratic || t.kind == TermKind::momentum;
  });
  for (const Term& t : terms_) {
    if (t.kind != TermKind::coulomb && t.kind != TermKind::load) {
      slide_of_.push_back(0);
      continue;
    }
    const auto same = std::ranges::find_if(slides_, [&](const Slide& one) { return one.joint == t.a && one.speed == t.speed; });
    slide_of_.push_back(static_cast<std::uint32_t>(same - slides_.begin()));
    if (same == slides_.end()) slides_.push_back({t.a, t.speed, 0.0});
  }
}

void PriorTerms::compute(std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
                         std::span<const double> beta) noexcept {
  q_ = q;
  dq_ = dq;
  beta_ = beta;
  if (uses_angles_) angles_.compute(q);
  presliding_ = &presliding;
  for (Slide& one : slides_) one.value = std::tanh(dq[static_cast<std::size_t>(one.joint)] / one.speed);
  if (corrected_)
    corrected_->momentum(q, dq, angles_, std::span(corrected_momentum_).first(q.size()),
                         std::span(corrected_beta_).first(q.size()));
}

double PriorTerms::weight_nm(const Term& t) const noexcept { return t.form == 0 ? beta_[t.a] : corrected_beta_[t.a]; }

double PriorTerms::load_nm(const Term& t) const noexcept {
  const double load = std::fabs(weight_nm(t));
  return most_load_nm_.empty() ? load : std::min(load, most_load_nm_[static_cast<std::size_t>(t.a)]);
}

double PriorTerms::beyond_nm(std::size_t joint) const noexcept {
  if (most_load_nm_.empty()) return 0.0;
  const double load = std::fabs(load_form_[joint] == 0 ? beta_[joint] : corrected_beta_[joint]);
  return std::max(load - most_load_nm_[joint], 0.0);
}

double PriorTerms::value(std::size_t term) const noexcept {
  const Term& t = terms_[term];
  const auto sine = [&](int joint) { return angles_.sine[static_cast<std::size_t>(joint)]; };
  const auto cosine = [&](int joint) { return angles_.cosine[static_cast<std::size_t>(joint)]; };
  switch (t.kind) {
    case TermKind::constant: return 1.0;
    case TermKind::viscous: return dq_[t.a];
    case TermKind::coulomb: return slides_[slide_of_[term]].value;
    case TermKind::presliding: return presliding_->value(t.a, t.b);
    case TermKind::load: return load_nm(t) * slides_[slide_of_[term]].value;
    case TermKind::load_presliding: return load_nm(t) * presliding_->value(t.a, t.b);
    case TermKind::ripple: return t.form == 0 ? std::sin(t.b * q_[t.a]) : std::cos(t.b * q_[t.a]);
    case TermKind::gravity: {
      if (t.form >= 6) {
        const int cosines = t.form - 6;
        const auto part = [&](int bit, int joint) { return cosines & bit ? cosine(joint) : sine(joint); };
        return part(4, t.a) * part(2, t.b) * part(1, t.c);
      }
      const double first = t.form == 0 || t.form == 2 || t.form == 3 ? sine(t.a) : cosine(t.a);
      if (t.form < 2) return first;
      return first * (t.form == 2 || t.form == 4 ? sine(t.b) : cosine(t.b));
    }
    case TermKind::quadratic: return dq_[t.a] * dq_[t.b] * (t.form == 0 ? sine(t.c) : cosine(t.c));
    case TermKind::momentum: return dq_[t.a] * (t.form == 0 ? 1.0 : t.form == 1 ? cosine(t.b) : sine(t.b));
    case TermKind::backlash: return weight_nm(t) * (1.0 - std::fabs(presliding_->value(t.a, t.b)));
    case TermKind::local_memory: return presliding_->memory_gap(t.a);
  }
  return 0.0;
}

double PriorTerms::doubt(std::size_t term) const noexcept {
  const Term& t = terms_[term];
  const double size = is_load(t) ? load_nm(t) : t.kind == TermKind::backlash ? std::fabs(weight_nm(t)) : 1.0;
  return size * presliding_->doubt(t.a, t.b);
}

Prior::Prior(const PriorSettings& settings, const std::array<double, 3>& gravity, int joints, double gain_per_s,
             std::uint32_t unknown)
    : joints_(joints),
      terms_((settings.validate(joints), settings), gravity),
      values_(settings.terms.size()),
      shares_(settings.most_load_nm.empty() ? std::vector<double>() : load_friction_shares(settings, joints)),
      temperature_(settings.temperature),
      has_presliding_(std::ranges::any_of(settings.terms, [](const Term& t) { return has_width(t) || t.kind == TermKind::local_memory; })),
      unknown_(unknown),
      state_{MomentumObserver(joints, gain_per_s, TorqueTiming::held),
             MomentumObserver(joints, gain_per_s, TorqueTiming::held), false, false, {}} {
  for (std::size_t m = 0; m < terms_.size(); ++m) {
    const Term& t = terms_[m];
    for (std::size_t i = 0; i < static_cast<std::size_t>(joints); ++i)
      if (const double weight = settings.weights[i * terms_.size() + m]; weight != 0) weights_.push_back({weight, static_cast<std::uint32_t>(i)});
    ends_.push_back(static_cast<std::uint32_t>(weights_.size()));
    const double weight = settings.weights[static_cast<std::size_t>(t.a) * terms_.size() + m];
    if ((is_coulomb(t) || t.kind == TermKind::viscous) && weight != 0)
      friction_.push_back({weight, static_cast<std::uint32_t>(m), static_cast<std::uint32_t>(t.a), t.kind == TermKind::viscous});
  }
}

void Prior::follow_temperature(std::span<const double> celsius) noexcept {
  if (!temperature_.on()) return;
  for (std::size_t i = 0; i < celsius.size(); ++i) {
    const double over = celsius[i] - temperature_.reference_c[i], reach = temperature_.reach_k[i];
    if (std::isfinite(over)) state_.warmth[i] = 0.1 * std::clamp(over, -reach, reach);
  }
}

void Prior::sum(std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
                std::span<const double> momentum, std::span<const double> beta, Sums& sums) noexcept {
  const auto n = static_cast<std::size_t>(joints_);
  auto& [p, v, unknown] = sums;
  for (std::size_t i = 0; i < n; ++i) p[i] = v[i] = unknown[i] = 0.0;
  terms_.compute(q, dq, presliding, beta);
  if (terms_.corrects_model())
    for (std::size_t i = 0; i < n; ++i) {
      if (unknown_ >> i & 1) continue;
      p[i] = momentum[i] - terms_.corrected_momentum()[i];
      v[i] = beta[i] - terms_.corrected_beta()[i];
    }
  const Weight* weight = weights_.data();
  for (std::size_t m = 0; m < terms_.size(); ++m) {
    const double value = values_[m] = terms_.value(m), off = has_width(terms_[m]) ? terms_.doubt(m) : 0.0;
    JointVector& to = is_momentum(terms_[m]) ? p : v;
    for (const Weight* end = weights_.data() + ends_[m]; weight != end; ++weight) {
      to[weight->joint] += weight->value * value;
      if (off > 0) unknown[weight->joint] += std::fabs(weight->value) * off;
    }
  }
  for (std::size_t i = 0; i < shares_.size(); ++i) {
    beyond_nm_[i] = -shares_[i] * terms_.beyond_nm(i) * std::tanh(dq[i] / kSignSpeed);
    v[i] += beyond_nm_[i];
  }
  if (temperature_.on()) {
    JointVector coulomb, viscous;
    sum_friction(std::span(coulomb).first(n), std::span(viscous).first(n));
    for (std::size_t i = 0; i < n; ++i)
      v[i] += state_.warmth[i] * (temperature_.coulomb_per_10k[i] * coulomb[i] + temperature_.viscous_per_10k[i] * viscous[i]);
  }
}

// The filter is linear and preserves signs: a filtered bound is a bound of the filtered value.
void Prior::filter(std::int64_t t_ns, const Sums& sums, bool raise, std::span<double> prior,
                   std::span<double> doubt) noexcept {
  const auto n = static_cast<std::size_t>(joints_);
  constexpr JointVector zero{};
  const auto of = [n](const JointVector& values) noexcept { return std::span(values).first(n); };
  state_.filter.step(t_ns, of(sums.p), of(sums.v), of(zero), prior);
  state_.doubt_filter.step(t_ns, of(zero), of(sums.unknown), of(zero), doubt);
  if (raise) state_.doubt_filter.raise(of(sums.unknown), doubt);
}

void Prior::step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
                 std::span<const double> momentum, std::span<const double> beta, std::span<double> prior,
                 std::span<double> doubt) noexcept {
  Sums sums;
  sum(q, dq, presliding, momentum, beta, sums);
  filter(t_ns, sums, state_.forgotten, prior, doubt);
  state_.raised = state_.forgotten;
  state_.forgotten = false;
}

void Prior::friction(std::span<double> coulomb, std::span<double> viscous) const noexcept {
  sum_friction(coulomb, viscous);
  for (std::size_t i = 0; temperature_.on() && i < coulomb.size(); ++i) {
    coulomb[i] *= 1 + state_.warmth[i] * temperature_.coulomb_per_10k[i];
    viscous[i] *= 1 + state_.warmth[i] * temperature_.viscous_per_10k[i];
  }
}

// At the reference temperature.
void Prior::sum_friction(std::span<double> coulomb, std::span<double> viscous) const noexcept {
  for (std::size_t i = 0; i < coulomb.size(); ++i) {
    coulomb[i] = beyond_nm_[i];
    viscous[i] = 0.0;
  }
  for (const Friction& f : friction_) (f.viscous ? viscous : coulomb)[f.joint] += f.weight * values_[f.term];
}

void Prior::step_again(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
                       std::span<const double> momentum, std::span<const double> beta,
                       bool raised) noexcept {
  Sums sums;
  JointVector prior, doubt;
  sum(q, dq, presliding, momentum, beta, sums);
  filter(t_ns, sums, raised, prior, doubt);
}

void Prior::go_back(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
                    std::span<const double> momentum, std::span<const double> beta,
                    std::span<const double> prior, std::span<const double> doubt) noexcept {
  const auto n = static_cast<std::size_t>(joints_);
  Sums sums;
  constexpr JointVector zero{};
  const auto of = [n](const JointVector& values) noexcept { return std::span(values).first(n); };
  sum(q, dq, presliding, momentum, beta, sums);
  state_.filter.go_back(t_ns, of(sums.p), of(sums.v), of(zero), prior);
  state_.doubt_filter.go_back(t_ns, of(zero), of(sums.unknown), of(zero), doubt);
}

namespace {

// For a joint sliding at this speed, with presliding states of 1.
double friction_nm(const PriorSettings& prior, std::size_t joint, double speed) {
  double sum = 0;
  for (std::size_t m = 0; m < prior.terms.size(); ++m) {
    const Term& term = prior.terms[m];
    if (static_cast<std::size_t>(term.a) != joint) continue;
    const double weight = prior.weights[joint * prior.terms.size() + m];
    if (term.kind == TermKind::coulomb) sum += weight * std::tanh(speed / term.speed);
    if (term.kind == TermKind::presliding) sum += weight;
    if (term.kind == TermKind::viscous) sum += weight * speed;
  }
  return std::fabs(sum);
}

}  // namespace

// Line through the friction at a slow and at a usual speed.
FrictionLine friction_line(const PriorSettings& prior, std::size_t joint) {
  constexpr double slow = 0.15, usual = 0.5;  // [rad/s]: where Coulomb terms have levelled off
  const double at_slow = friction_nm(prior, joint, slow), at_usual = friction_nm(prior, joint, usual);
  const double slope = std::max((at_usual - at_slow) / (usual - slow), 0.0);
  return {std::max(at_usual - slope * usual, 0.0), slope};
}

double turning_travel(const PriorSettings& prior, std::size_t joint) {
  std::vector<double> parts(prior.widths_rad.size());  // of each width, [N m]
  double at_once = friction_line(prior, joint).at_rest_nm;
  for (std::size_t m = 0; m < prior.terms.size(); ++m) {
    const Term& term = prior.terms[m];
    if (term.kind != TermKind::presliding || static_cast<std::size_t>(term.a) != joint) continue;
    const double part = -prior.weights[joint * prior.terms.size() + m];
    parts[static_cast<std::size_t>(term.b)] += part;
    at_once -= part;
  }
  const auto friction_after = [&](double travel) {
    double sum = std::max(at_once, 0.0);
    for (std::size_t w = 0; w < parts.size(); ++w) sum += parts[w] * std::min(travel / prior.widths_rad[w] - 1, 1.0);
    return sum;
  };
  double from = 0, before = friction_after(0);
  if (before >= 0) return 0;
  for (const double width : prior.widths_rad) {  // the friction is linear between the travels 2 w
    const double to = 2 * width, after = friction_after(to);
    if (after >= 0) return from + (to - from) * before / (before - after);
    from = to;
    before = after;
  }
  return 0;
}

}  // namespace tauext
