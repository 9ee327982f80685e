// Physical model of r in free motion: friction, load, gravity and model errors. Linear in coefficients that minutes of
// data determine.
#pragma once
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "bundle/terms.hpp"
#include "chain/momentum_observer.hpp"
#include "chain/motion.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Per joint: increase of gear friction by load, as a share of the load. It is the sum of the load terms' weights, with
// opposite sign, clamped to 0 to kMostLoadFriction. Joints without load terms get the mean of the others.
inline constexpr double kMostLoadFriction = 0.15;  // strain-wave gears: 0.02 to 0.1
std::vector<double> load_friction_shares(const PriorSettings& prior, int joints);
inline constexpr double kSignSpeed = 0.05;  // [rad/s], as in drift: slower motion has no direction

// Friction of a sliding joint in the prior, as a line: at_rest + per_speed |dq|, [N m] and [N m s/rad].
struct FrictionLine {
  double at_rest_nm = 0, per_speed = 0;
};
FrictionLine friction_line(const PriorSettings& prior, std::size_t joint);
// Travel after a reversal from sliding at which the joint's friction passes through 0, [rad]; 0 if Coulomb terms hold at least
// half of its friction at rest, and without friction.
double turning_travel(const PriorSettings& prior, std::size_t joint);

// Evaluates the terms of a prior, sample by sample.
class PriorTerms {
 public:
  // The settings must be valid.
  PriorTerms(const PriorSettings& settings, const std::array<double, 3>& gravity);

  // Processes one sample; beta is of the estimated model. The arguments must stay alive until the next call.
  void compute(std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
               std::span<const double> beta) noexcept;
  // Value of a term; for momentum terms their momentum.
  double value(std::size_t term) const noexcept;
  // Largest deviation from it while its presliding state is undetermined.
  double doubt(std::size_t term) const noexcept;

  // The corrected model, if any.
  const std::optional<Tree>& corrected() const noexcept { return corrected_; }
  // Sets the load of the corrected model (Tree::carry); call compute() to update p and beta.
  void carry(int link, const Carried& what) noexcept {
    if (corrected_) corrected_->carry(link, what);
  }

  std::size_t size() const noexcept { return terms_.size(); }  // number of terms
  const Term& operator[](std::size_t term) const noexcept { return terms_[term]; }
  bool corrects_model() const noexcept { return corrected_.has_value(); }
  // Excess of a joint's |beta| over the range in which its load terms were fitted, [N m]; 0 without a bound.
  double beyond_nm(std::size_t joint) const noexcept;
  // p and beta of the corrected model, if any.
  std::span<const double> corrected_momentum() const noexcept { return {corrected_momentum_.data(), q_.size()}; }
  std::span<const double> corrected_beta() const noexcept { return {corrected_beta_.data(), q_.size()}; }

 private:
  // beta of the model that a term uses, and its magnitude within the bound of the load terms.
  double weight_nm(const Term& term) const noexcept;
  double load_nm(const Term& term) const noexcept;

  std::vector<Term> terms_;
  std::vector<double> most_load_nm_;
  std::array<std::int32_t, kMaxJoints> load_form_{};  // of the load terms of a joint, or of any other
  std::optional<Tree> corrected_;
  JointVector corrected_momentum_{}, corrected_beta_{};
  // tanh(dq / speed) of a joint, which several terms share.
  struct Slide {
    std::int32_t joint;
    double speed, value;
  };
  std::vector<Slide> slides_;
  std::vector<std::uint32_t> slide_of_;  // of each term that needs one
  std::span<const double> q_, dq_, beta_;
  bool uses_angles_ = false;
  Angles angles_;  // of q, if some term or the corrected model needs them
  const Presliding* presliding_ = nullptr;
};

// Evaluates the terms and passes their weighted sum through the observer's filter, in phase with r:
//   d_k = (P_k - P_{k-1})/dt + mean over the step of v,  a = exp(-K0 dt),  prior_k = a prior_{k-1} + (1 - a) d_k
// v is the sum of the torque terms, P that of the momentum terms. Both include the error of the estimated model: p -
// p_corrected and beta - beta_corrected.
class Prior {
 public:
  struct State {
    MomentumObserver filter, doubt_filter;
    bool forgotten = false;  // presliding states were forgotten since the last sample
    bool raised = false;     // the doubt was raised for this at the last sample
    JointVector warmth{};    // (temperature - reference) / 10 K
  };
  // One sample's contribution to the filtered sums, per joint.
  struct Sums {
    JointVector p, v, unknown;
  };

  // unknown: joints whose torque constant is unknown, one bit each; no corrected model, in N m, is part of their prior.
  // Throws Error if the settings do not fit.
  Prior(const PriorSettings& settings, const std::array<double, 3>& gravity, int joints, double gain_per_s,
        std::uint32_t unknown = 0);

  // Restarts at the next sample with a prior of 0.
  void reset() noexcept {
    state_.filter.reset();
    state_.doubt_filter.reset();
    state_.forgotten = state_.raised = false;
  }
  bool has_presliding() const noexcept { return has_presliding_; }  // some term depends on presliding states
  // Call after presliding states were forgotten. At the next sample the doubt is set to its value after a long rest,
  // skipping its filter: the uncertainty existed before.
  void forget() noexcept { state_.forgotten = true; }
  // Joint temperatures, [degC], from the next sample on; a NaN keeps the joint's previous value.
  void follow_temperature(std::span<const double> celsius) noexcept;
  // Clears the temperatures.
  void forget_temperature() noexcept { state_.warmth = {}; }
  // Processes one sample; momentum and beta are of the estimated model. Writes each joint's prior and its possible
  // error due to undetermined presliding states, both [N m].
  void step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
            std::span<const double> momentum, std::span<const double> beta, std::span<double> prior,
            std::span<double> doubt) noexcept;
  // Friction of each joint's own motion in the last prior, before the filter, [N m]: Coulomb friction (with load and
  // presliding) and viscous friction.
  void friction(std::span<double> coulomb, std::span<double> viscous) const noexcept;

  // Goes back to a sample, with a changed model: sets the filters to prior and doubt, then continues with the new p and
  // beta. `momentum` and `beta` as in step().
  void go_back(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
               std::span<const double> momentum, std::span<const double> beta, std::span<const double> prior,
               std::span<const double> doubt) noexcept;
  // Repeats the step over an earlier sample, with the new model.
  void step_again(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                  const Presliding& presliding, std::span<const double> momentum, std::span<const double> beta,
                  bool raised) noexcept;
  // For setting a load.
  PriorTerms& terms() noexcept { return terms_; }

  // Complete state; restore() continues from it in a prior of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  void sum(std::span<const double> q, std::span<const double> dq, const Presliding& presliding,
           std::span<const double> momentum, std::span<const double> beta, Sums& sums) noexcept;
  void filter(std::int64_t t_ns, const Sums& sums, bool raise, std::span<double> prior, std::span<double> doubt) noexcept;
  void sum_friction(std::span<double> coulomb, std::span<double> viscous) const noexcept;

  int joints_;
  PriorTerms terms_;
  struct Weight {
    double value;
    std::uint32_t joint;
  };
  std::vector<Weight> weights_;      // other than 0, term by term
  std::vector<std::uint32_t> ends_;  // of each term's weights
  std::vector<double> values_;  // of the terms at the last step
  std::vector<double> shares_;  // load_friction_shares(); empty: load terms have no bound
  JointVector beyond_nm_{};     // friction at the last step from load beyond that bound
  struct Friction {
    double weight;
    std::uint32_t term, joint;
    bool viscous;
  };
  std::vector<Friction> friction_;  // terms that model friction of a joint's own motion
  FrictionTemperature temperature_;
  bool has_presliding_;
  std::uint32_t unknown_;
  State state_;
};

}  // namespace tauext
