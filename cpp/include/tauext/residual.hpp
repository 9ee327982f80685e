// First half of the chain: sample -> residual, presliding states and prior, at the sample rate.
#pragma once
#include <algorithm>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "tauext/comparison_residuals.hpp"
#include "tauext/load.hpp"
#include "tauext/momentum_observer.hpp"
#include "tauext/motion.hpp"
#include "tauext/past_samples.hpp"
#include "tauext/prior.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// What training and monitor must share beside the model.
struct ObserverSettings {
  double gain_per_s = 0;              // K0, [1/s]
  TorqueTiming timing = TorqueTiming::held;  // what a sample of tau means
  std::int64_t sample_period_ns = 0;  // of the recording or the control loop
  int network_stride = 0;             // samples in a network period, the multiple of the sample period nearest 10 ms
  ResidualMethod method = ResidualMethod::momentum;  // what r is
  double high_pass_per_s = 0;         // filters on the residual, [1/s]; 0: none
  double low_pass_per_s = 0;
  // Torque constants, a joint: what is given as tau is multiplied by them before anything looks at it. Empty: tau is in
  // the unit of the answers already.
  std::vector<double> nm_per_unit = {};

  // The slower of K0 and the low-pass: 10 over this after something wrong, r has forgotten it.
  double slowest_per_s() const noexcept {
    return low_pass_per_s > 0 ? std::min(gain_per_s, low_pass_per_s) : gain_per_s;
  }
  // Throws Error where there are torque constants, and not one for each joint or one that is 0 or not finite.
  void validate_constants(int joints) const;
};

// Motion, residual with its filters, and prior together, one sample at a time; torques in the unit of the answers.
class ResidualStage {
 public:
  // 10/K0 of samples, what r remembers, but no more than these: so long finding r anew takes at most.
  static constexpr std::size_t kMostPast = 8192;

  // Throws Error where the settings do not fit, or a prior stands beside a residual that is not filtered like it.
  ResidualStage(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior);

  // residual, prior and the prior's doubt [N m; the energy observer's in W] are written; where the tick says restart,
  // all began anew with this sample.
  SampleClock::Tick step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                         std::span<const double> tau, std::span<double> residual, std::span<double> prior,
                         std::span<double> doubt) noexcept;
  const Presliding& presliding() const noexcept { return motion_.presliding(); }  // after the last sample
  std::span<const double> beta() const noexcept { return motion_.beta(); }  // of the estimated model, likewise
  bool warm() const noexcept { return filter_.warm(); }  // r has forgotten how it began
  // As Prior.
  void follow_temperature(std::span<const double> celsius) noexcept { prior_.follow_temperature(celsius); }
  void forget_temperature() noexcept { prior_.forget_temperature(); }
  // As Prior; of the last step.
  void friction(std::span<double> coulomb, std::span<double> viscous) const noexcept {
    prior_.friction(coulomb, viscous);
  }
  // Whether the prior follows from static friction, so that forgetting it raises a doubt.
  bool tells_friction() const noexcept { return prior_.has_presliding(); }
  // What the motion of a joint told of its static friction holds no longer. Nothing happens where no prior follows from
  // it: there would be no doubt to raise the limits.
  void forget_friction(int joint) noexcept {
    if (!tells_friction()) return;
    keep();  // as it was
    motion_.forget_friction(joint);
    prior_.forget();
  }
  // The next sample starts anew, whenever it comes.
  void reset() noexcept;

  // Loads may be set from here on. Allocates; before the first sample.
  // units_per_nm: Bundle::most_units_per_nm(); the doubt of a joint rises by so much of a load's torque. None: all in N m.
  void allow_loads(const LoadSettings& settings, std::span<const double> units_per_nm = {});
  // Whether a load can be set from an earlier time on: r of the momentum observer without filters can be found anew.
  bool can_go_back() const noexcept { return past_.capacity() > 0; }
  // A load that the settings take, in the place of the one before; a mass of 0 takes it off. From the next step on r and
  // prior follow the arm with it, and go on from where they would be had it been carried since `since_ns`: since the
  // oldest sample kept where that is earlier.
  void set_load(const Load& load, std::int64_t since_ns) noexcept;
  const Load& load() const noexcept { return carrying_.load; }
  // Keeps the last sample, for set_load; once is enough. step() needs the sample before to be kept.
  void keep() noexcept;

  // What the arm carries, and the last sample with it.
  struct Carrying {
    Load load;
    bool seen = false, kept = true;  // there is a last sample; it is among those kept
    bool follows = false;  // torques of the load where it may be wrong, or of one that was taken off and still shows in r
    double error_share = 0;          // of them, by which limits rise
    std::int64_t t_ns = 0;
    JointVector q{}, dq{};
    MomentumObserver torques;  // of the load as r shows them
    explicit Carrying(const MomentumObserver& none) noexcept : torques(none) {}
  };
  struct State {
    MotionStage::State motion;
    MomentumObserver observer;
    ComparisonResidual comparison;
    ResidualFilter filter;
    Prior::State prior;
    Carrying carrying;
  };
  // All that it remembers; restore() goes on from there, in a stage of the same settings.
  State state() const noexcept {
    return {motion_.state(), observer_, comparison_, filter_, prior_.state(), carrying_};
  }
  void restore(const State& state) noexcept;

 private:
  MotionStage motion_;
  ResidualMethod method_;
  MomentumObserver observer_;
  ComparisonResidual comparison_;  // unless the method is momentum
  ResidualFilter filter_;
  Prior prior_;
  bool has_prior_;

  static constexpr double kFadedNm = 1e-6;  // of a load taken off: less than any torque is known to

  void carry(const Load& load) noexcept;
  void look_again() noexcept;
  void go_back(std::size_t first) noexcept;
  void push_past() noexcept;
  void load_torques(std::span<const double> q, std::span<const double> dq, JointVector& p, JointVector& beta) noexcept;
  void begin_load_torques(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                          std::span<const double> least) noexcept;
  void step_load_torques(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq) noexcept;
  void forget_load_torques() noexcept;
  std::span<const double> q() const noexcept { return {carrying_.q.data(), joints()}; }
  std::span<const double> dq() const noexcept { return {carrying_.dq.data(), joints()}; }
  std::size_t joints() const noexcept { return static_cast<std::size_t>(motion_.tree().size()); }

  double gain_per_s_;
  std::int64_t sample_period_ns_;
  bool unfiltered_;
  std::optional<LoadSettings> loads_;
  std::optional<Tree> bare_;  // without the load, of the model that carries it
  JointVector units_per_nm_{};
  bool model_carries_ = false, other_units_ = false;
  PastSamples past_;
  std::optional<Presliding> past_presliding_;
  Carrying carrying_;
};

}  // namespace tauext
