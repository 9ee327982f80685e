// First half of the chain at the sample rate: residual, presliding states and prior.
#pragma once
#include <algorithm>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "chain/comparison_residuals.hpp"
#include "chain/momentum_observer.hpp"
#include "chain/motion.hpp"
#include "prior/prior.hpp"
#include "tauext/load.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Ring buffer; allocates only in the constructor.
class PastSamples {
 public:
  struct Row {
    // Per joint: the sample, and r, prior, doubt and load torque after it. Ends of the presliding states: per joint and
    // width.
    std::span<double> q, dq, tau, residual, prior, doubt, load, low, high;
  };

  PastSamples() = default;
  PastSamples(int joints, int states, std::size_t rows)
      : joints_(static_cast<std::size_t>(joints)),
        states_(static_cast<std::size_t>(states)),
        t_ns_(rows),
        raised_(rows),
        values_(rows * width()) {}

  void clear() noexcept { next_ = count_ = 0; }
  std::size_t size() const noexcept { return count_; }
  std::size_t capacity() const noexcept { return t_ns_.size(); }

  // Adds a sample, later than all before; replaces the oldest if full. raised: see Prior::State.
  Row push(std::int64_t t_ns, bool raised) noexcept {
    const std::size_t at = next_;
    t_ns_[at] = t_ns;
    raised_[at] = raised;
    next_ = next_ + 1 == capacity() ? 0 : next_ + 1;
    count_ = std::min(count_ + 1, capacity());
    return row(at);
  }

  // Index 0 is the oldest.
  Row operator[](std::size_t k) noexcept { return row(place(k)); }
  std::int64_t t_ns(std::size_t k) const noexcept { return t_ns_[place(k)]; }
  bool raised(std::size_t k) const noexcept { return raised_[place(k)] != 0; }
  // Index of the last sample not later than t_ns, else of the oldest. Must not be empty.
  std::size_t at_or_before(std::int64_t t) const noexcept {
    std::size_t low = 0, high = count_;
    while (high - low > 1) {
      const std::size_t middle = low + (high - low) / 2;
      (t_ns(middle) <= t ? low : high) = middle;
    }
    return low;
  }

 private:
  std::size_t width() const noexcept { return 7 * joints_ + 2 * states_; }
  std::size_t place(std::size_t k) const noexcept { return (next_ + capacity() - count_ + k) % capacity(); }
  Row row(std::size_t at) noexcept {
    const std::span<double> all = std::span(values_).subspan(at * width(), width());
    const auto joint_part = [&](std::size_t which) noexcept { return all.subspan(which * joints_, joints_); };
    return {joint_part(0), joint_part(1), joint_part(2), joint_part(3), joint_part(4), joint_part(5), joint_part(6),
            all.subspan(7 * joints_, states_), all.subspan(7 * joints_ + states_, states_)};
  }

  std::size_t joints_ = 0, states_ = 0;
  std::vector<std::int64_t> t_ns_;
  std::vector<std::uint8_t> raised_;
  std::vector<double> values_;
  std::size_t next_ = 0, count_ = 0;
};

// Motion, filtered residual and prior, one sample at a time. Torques in the unit of the answers.
class ResidualStage {
 public:
  // Samples kept for recomputing r: 10/K0 of them, the memory of r, but no more than these.
  static constexpr std::size_t kMostPast = 8192;

  // Throws Error if the settings do not fit, or if prior and residual are filtered differently.
  ResidualStage(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior);

  // Writes residual, prior and the prior's doubt [N m; the energy observer's in W]. If the tick is a restart, all
  // filters restarted at this sample.
  SampleClock::Tick step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                         std::span<const double> tau, std::span<double> residual, std::span<double> prior,
                         std::span<double> doubt) noexcept;
  const Presliding& presliding() const noexcept { return motion_.presliding(); }  // after the last sample
  std::span<const double> beta() const noexcept { return motion_.beta(); }  // of the estimated model
  bool warm() const noexcept { return filter_.warm(); }  // the start of r has decayed
  // Of the last sample; zeros before the first.
  std::span<const double> q() const noexcept { return {carrying_.q.data(), joints()}; }
  std::span<const double> dq() const noexcept { return {carrying_.dq.data(), joints()}; }
  // See Prior.
  void follow_temperature(std::span<const double> celsius) noexcept { prior_.follow_temperature(celsius); }
  void forget_temperature() noexcept { prior_.forget_temperature(); }
  // See Prior; of the last step.
  void friction(std::span<double> coulomb, std::span<double> viscous) const noexcept {
    prior_.friction(coulomb, viscous);
  }
  // Whether the prior models static friction, so that forgetting it raises the doubt.
  bool models_friction() const noexcept { return prior_.has_presliding(); }
  // Discards the presliding state of a joint. No effect if the prior does not model static friction: no doubt would
  // then raise the limits.
  void forget_friction(int joint) noexcept {
    if (!models_friction()) return;
    keep();  // the state before
    motion_.forget_friction(joint);
    prior_.forget();
  }
  // Restarts at the next sample, whatever its time.
  void reset() noexcept;

  // Enables set_load(). Allocates; call before the first sample.
  // units_per_nm: Bundle::most_units_per_nm(); adds this share of a load's torque to the doubt. Empty: all in N m.
  void allow_loads(const LoadSettings& settings, std::span<const double> units_per_nm = {});
  // Whether a load can be set retroactively: only for the unfiltered momentum observer.
  bool can_go_back() const noexcept { return past_.capacity() > 0; }
  // Replaces the load; a mass of 0 removes it. From the next step on, r and prior are as if the load had been carried
  // since since_ns, or since the oldest kept sample if that is later.
  void set_load(const Load& load, std::int64_t since_ns) noexcept;
  const Load& load() const noexcept { return carrying_.load; }
  // Stores the last sample for set_load(); needed once per sample, before the next step().
  void keep() noexcept;

  // Load and last sample.
  struct Carrying {
    Load load;
    bool seen = false, kept = true;  // a last sample exists; it is stored in past_
    bool follows = false;  // load torques are tracked: uncertain load, or a removed one still in r
    double error_share = 0;          // relative error of these torques; raises the limits
    std::int64_t t_ns = 0;
    JointVector q{}, dq{};
    MomentumObserver torques;  // of the load, filtered as r
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
  // Complete state; restore() continues from it in a stage of the same settings.
  State state() const noexcept {
    return {motion_.state(), observer_, comparison_, filter_, prior_.state(), carrying_};
  }
  void restore(const State& state) noexcept;

 private:
  MotionStage motion_;
  ResidualMethod method_;
  MomentumObserver observer_;
  ComparisonResidual comparison_;  // used unless the method is momentum
  ResidualFilter filter_;
  Prior prior_;
  bool has_prior_;

  static constexpr double kFadedNm = 1e-6;  // below this a removed load has decayed: far below the torque error

  // p and beta of the model at the state for which it was last computed; 0 where the torque constant is unknown.
  struct ModelRows {
    std::span<const double> momentum, beta;
  };
  ModelRows model_rows() noexcept {
    if (unknown_ == 0) [[likely]] return {motion_.momentum(), motion_.beta()};
    return known_rows();
  }
  ModelRows known_rows() noexcept;

  void carry(const Load& load) noexcept;
  void recompute() noexcept;
  void go_back(std::size_t first) noexcept;
  void push_past() noexcept;
  void load_torques(std::span<const double> q, std::span<const double> dq, JointVector& p, JointVector& beta) noexcept;
  void begin_load_torques(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq,
                          std::span<const double> least) noexcept;
  void step_load_torques(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq) noexcept;
  void forget_load_torques() noexcept;
  std::size_t joints() const noexcept { return static_cast<std::size_t>(motion_.tree().size()); }

  std::uint32_t unknown_;  // joints whose torque constant is unknown, one bit each
  JointVector momentum_{}, beta_{};  // model_rows(), if there are such joints
  double gain_per_s_;
  std::int64_t sample_period_ns_;
  bool unfiltered_;
  std::optional<LoadSettings> loads_;
  std::optional<Tree> bare_;  // the model without the load
  JointVector units_per_nm_{};
  bool model_carries_ = false, other_units_ = false;
  PastSamples past_;
  std::optional<Presliding> past_presliding_;
  Carrying carrying_;
};

}  // namespace tauext
