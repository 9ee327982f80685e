// First half of the chain: sample -> residual, presliding states and prior, at the sample rate.
#pragma once
#include <algorithm>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "comparison_residuals.hpp"
#include "momentum_observer.hpp"
#include "motion.hpp"
#include "prior.hpp"
#include "tauext/load.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// A ring; nothing is allocated once it is made.
class PastSamples {
 public:
  struct Row {
    // A value a joint: the sample, where r, prior, doubt and the load's share stood after it; ends of the presliding
    // states, a value a joint and width.
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

  // Room for one more sample, later than those before; the oldest makes way. raised: see Prior::State.
  Row push(std::int64_t t_ns, bool raised) noexcept {
    const std::size_t at = next_;
    t_ns_[at] = t_ns;
    raised_[at] = raised;
    next_ = next_ + 1 == capacity() ? 0 : next_ + 1;
    count_ = std::min(count_ + 1, capacity());
    return row(at);
  }

  // 0 is the oldest.
  Row operator[](std::size_t k) noexcept { return row(place(k)); }
  std::int64_t t_ns(std::size_t k) const noexcept { return t_ns_[place(k)]; }
  bool raised(std::size_t k) const noexcept { return raised_[place(k)] != 0; }
  // The last one that is not later than t_ns; the oldest where all are. There must be one.
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
  // Of the last sample; zeros before the first one.
  std::span<const double> q() const noexcept { return {carrying_.q.data(), joints()}; }
  std::span<const double> dq() const noexcept { return {carrying_.dq.data(), joints()}; }
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
