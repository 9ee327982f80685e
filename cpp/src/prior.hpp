// What r is in free motion as far as physics can say it: friction, load, gravity and errors of the model, linear in
// coefficients that minutes of data determine.
#pragma once
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "momentum_observer.hpp"
#include "motion.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// What kind of term it is: of the load on the gear, of presliding states, of generalised momentum.
inline bool is_load(const Term& term) noexcept {
  return term.kind == TermKind::load || term.kind == TermKind::load_presliding;
}
inline bool is_presliding(const Term& term) noexcept {
  return term.kind == TermKind::presliding || term.kind == TermKind::load_presliding;
}
// It follows a presliding state, whatever that tells of.
inline bool has_width(const Term& term) noexcept { return is_presliding(term) || term.kind == TermKind::backlash; }
// Friction that grows with the force on a contact, whatever the speed.
inline bool is_coulomb(const Term& term) noexcept {
  return term.kind == TermKind::coulomb || term.kind == TermKind::local_memory || is_load(term) || is_presliding(term);
}
inline bool is_momentum(const Term& term) noexcept { return term.kind == TermKind::momentum; }

// Share of what weighs on a gear by which it adds to the friction of a joint, as the prior found it for the arm's own weight:
// the sum of its load terms' weights, turned, within 0 and kMostLoadFriction. A joint without load terms has the mean of the
// others: it weighs too little for its own to show. (joints)
inline constexpr double kMostLoadFriction = 0.15;  // of strain-wave gears: 0.02 to 0.1
std::vector<double> load_friction_shares(const PriorSettings& prior, int joints);
inline constexpr double kSignSpeed = 0.05;  // of what they are shares of, [rad/s], as in drift: what is slower has no direction

// Friction that a prior expects of a sliding joint, as a line: at_rest + per_speed |dq|, [N m] and [N m s/rad].
struct FrictionLine {
  double at_rest_nm = 0, per_speed = 0;
};
FrictionLine friction_line(const PriorSettings& prior, std::size_t joint);

// Terms of a prior at one sample after the other.
class PriorTerms {
 public:
  // Of settings that fit.
  PriorTerms(const PriorSettings& settings, const std::array<double, 3>& gravity);

  // One sample, with beta of the estimated model. All of it must stay where it is until the next one.
  void compute(std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
            std::span<const double> beta) noexcept;
  // Value of a term; those of momentum give their momentum.
  double value(std::size_t term) const noexcept;
  // How far from that the term may be while its presliding state is not determined.
  double doubt(std::size_t term) const noexcept;

  // The corrected model, where there is one.
  const std::optional<Tree>& corrected() const noexcept { return corrected_; }
  // The corrected model carries this from now on (Tree::carry); compute() again for its p and beta.
  void carry(int link, const Carried& what) noexcept {
    if (corrected_) corrected_->carry(link, what);
  }

  std::size_t size() const noexcept { return terms_.size(); }  // how many
  const Term& operator[](std::size_t term) const noexcept { return terms_[term]; }
  bool corrects_model() const noexcept { return corrected_.has_value(); }
  // What of |beta| of a joint is beyond the most that its load terms were fitted to, [N m]; 0 without such a bound.
  double beyond_nm(std::size_t joint) const noexcept;
  // p and beta of the corrected model, where there is one.
  std::span<const double> corrected_momentum() const noexcept { return {corrected_momentum_.data(), q_.size()}; }
  std::span<const double> corrected_beta() const noexcept { return {corrected_beta_.data(), q_.size()}; }

 private:
  // beta of the model that a term asks for; its size, within the bound of load terms.
  double weight_nm(const Term& term) const noexcept;
  double load_nm(const Term& term) const noexcept;

  std::vector<Term> terms_;
  std::vector<double> most_load_nm_;
  std::array<std::int32_t, kMaxJoints> load_form_{};  // of the load terms of a joint, or of any other
  std::optional<Tree> corrected_;
  JointVector corrected_momentum_{}, corrected_beta_{};
  std::span<const double> q_, dq_, beta_;
  const Presliding* presliding_ = nullptr;
};

// Evaluates terms and passes their weighted sum through the observer's own filter, so that it stands beside r:
//   d_k = (P_k - P_{k-1})/dt + mean over the step of v,  a = exp(-K0 dt),  prior_k = a prior_{k-1} + (1 - a) d_k
// with v the sum of the terms that act as torque and P of those that act as momentum; to both the corrected model adds
// what the estimated one has too much: p - p_corrected and beta - beta_corrected.
class Prior {
 public:
  struct State {
    MomentumObserver filter, doubt_filter;
    bool forgotten = false;  // presliding states were, since the last sample
    bool raised = false;     // the doubt was at the last sample, as they had been forgotten before it
    JointVector warmth{};    // the temperature over its reference, [10 K]
  };
  // A sample's part of the sums that the filters see, a joint.
  struct Sums {
    JointVector p, v, unknown;
  };

  // Throws Error where the settings do not fit.
  Prior(const PriorSettings& settings, const std::array<double, 3>& gravity, int joints, double gain_per_s);

  // The next sample starts anew, with a prior of 0.
  void reset() noexcept {
    state_.filter.reset();
    state_.doubt_filter.reset();
    state_.forgotten = state_.raised = false;
  }
  bool has_presliding() const noexcept { return has_presliding_; }  // some term follows from presliding states
  // Presliding states were forgotten: at the next sample the doubt stands where it would after a long rest, and not where
  // its filter has come to, since what it covers has been there before.
  void forget() noexcept { state_.forgotten = true; }
  // Temperatures of the joints, [degC], from the next sample on; of those that are NaN what was known holds.
  void follow_temperature(std::span<const double> celsius) noexcept;
  // None is known any more.
  void forget_temperature() noexcept { state_.warmth = {}; }
  // One sample: momentum and beta are those of the estimated model. Writes the prior of every joint, and how far the
  // truth may lie from it because of presliding states that are not determined yet, both [N m].
  void step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
            std::span<const double> momentum, std::span<const double> beta, std::span<double> prior,
            std::span<double> doubt) noexcept;
  // What of the last step's prior is friction of each joint's own motion, before the filter, [N m]: Coulomb's with what
  // load and presliding states add to it, and the viscous one.
  void friction(std::span<double> coulomb, std::span<double> viscous) const noexcept;

  // The model changed, and maybe the last sample is an earlier one: the filters stand there as they did (prior, doubt),
  // and go on with p and beta by the new model. `momentum` and `beta` as in step().
  void go_back(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
               std::span<const double> momentum, std::span<const double> beta, std::span<const double> prior,
               std::span<const double> doubt) noexcept;
  // A step over a sample that has been seen before, by the new model.
  void step_again(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                  const Presliding& presliding, std::span<const double> momentum, std::span<const double> beta,
                  bool raised) noexcept;
  // To carry a load.
  PriorTerms& terms() noexcept { return terms_; }

  // All that it remembers; restore() goes on from there, in another one of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  void sum(std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
           std::span<const double> momentum, std::span<const double> beta, Sums& sums) noexcept;
  void filter(std::int64_t t_ns, const Sums& sums, bool raise, std::span<double> prior, std::span<double> doubt) noexcept;
  void sum_friction(std::span<double> coulomb, std::span<double> viscous) const noexcept;

  int joints_;
  PriorTerms terms_;
  std::vector<double> weights_;
  std::vector<double> values_;  // of the terms at the last step
  std::vector<double> shares_;  // load_friction_shares(); empty: no bound of load terms
  JointVector beyond_nm_{};     // friction at the last step of what is beyond that bound
  struct Friction {
    double weight;
    std::uint32_t term, joint;
    bool viscous;
  };
  std::vector<Friction> friction_;  // the terms that are friction of a joint's own motion
  FrictionTemperature temperature_;
  bool has_presliding_;
  State state_;
};

}  // namespace tauext
