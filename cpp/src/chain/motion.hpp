// First part of the chain: sample clock, p and beta of the estimated model, presliding states.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "bundle/terms.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Most missing samples that the clock bridges: those of a network period; below 300 Hz up to three within 30 ms. There
// a network period is one or two samples, and 10 % lost samples would cause constant restarts.
int longest_bridged(std::int64_t sample_period_ns, int network_stride) noexcept;
inline constexpr int kMostBridged = 3;  // if a sample is longer than a third of a network period

// Maps jittering stamps to consecutive ticks. The rounding error is carried on, so that ticks follow time and not the
// sample count. Gaps of up to longest_bridged() samples are bridged: missing ticks hold the last sample. Longer gaps
// restart everything with memory.
class SampleClock {
 public:
  // Throws Error if the period or the stride is not positive.
  SampleClock(std::int64_t sample_period_ns, int network_stride);

  // A sample's place: first of a stretch, successor of the last one, or rejected.
  enum class Kind : std::uint8_t { restart, next, not_later };
  struct Tick {
    Kind kind;
    std::int64_t advance;  // ticks since the last sample, at least 1; 0 unless kind is next
  };

  // The next sample starts a stretch.
  void reset() noexcept { started_ = false; }
  // not_later, without any change, if t_ns is not later than the last sample; restart for the first sample.
  Tick step(std::int64_t t_ns) noexcept;

 private:
  std::int64_t sample_period_ns_;
  int longest_bridged_;
  bool started_ = false;
  std::int64_t t_ns_ = 0;
  double carry_ = 0;  // ticks by which the stamps lead the count, within +-1
};

// A bank of stop operators (Maxwell-slip elements) on each joint's displacement, for widths w:
//   z <- clip(z + (q_k - q_{k-1}), -w, w); the state is z / w, in [-1, 1].
// The state is -1 or 1 while the joint slides and between them while it is elastically bent. The initial state is
// unknown: its bounds, at first -w and w, move alike until they meet, at the latest after a travel of 2 w. Until then
// the state is their mean, and undetermined.
// Steps are samples: train and run a bank at the same rate.
//
// The bank remembers every open reversal (nonlocal memory, Maxwell slip [AlBender2005]). Friction after Dahl or LuGre
// has local memory: its slope depends on its value and direction only. Both agree for a reversal after sliding and
// differ for further reversals before sliding. A joint's branch is its friction after a reversal from sliding, over the
// travel x, relative to sliding friction:
//   f(x) = sum_w branch_w clip(-1 + x / w, -1, 1),  branch_w >= 0, sum 1.
// The state with local memory follows that branch from its current value; s = 1 or -1 is the direction:
//   z <- s f(f^-1(s z) + |q_k - q_{k-1}|),  0 at first.
class Presliding {
 public:
  struct State {
    bool started = false;
    JointVector q{};
    std::array<double, kMaxJoints * kMaxWidths> low{}, high{};  // (joint, width), in widths
    JointVector local{};  // states with local memory, -1 to 1
  };

  // widths [rad]: > 0 and rising. branches: (joints, widths), zeros for a joint without one; empty: no joint has one.
  // Throws Error as validate_presliding().
  Presliding(int joints, std::span<const double> widths, std::span<const double> branches = {});

  // After a gap: all states are undetermined.
  void reset() noexcept { state_.started = false; }
  // This joint's states are undetermined, as at the start, from its last position on.
  void forget(int joint) noexcept;
  // Processes one sample of finite positions.
  void step(std::span<const double> q) noexcept;

  int columns() const noexcept { return joints_ * width_count(); }  // states of all joints
  int width_count() const noexcept { return static_cast<int>(widths_.size()); }  // states of a joint
  // The state of a joint for a width.
  double value(int joint, int width) const noexcept {
    const std::size_t at = index(joint, width);
    return 0.5 * (state_.low[at] + state_.high[at]);
  }
  // Largest deviation from value(): 0 for a determined state, 1 for an unknown one.
  double doubt(int joint, int width) const noexcept {
    const std::size_t at = index(joint, width);
    return 0.5 * (state_.high[at] - state_.low[at]);
  }
  // Whether the two bounds have met.
  bool determined(int joint, int width) const noexcept {
    const std::size_t at = index(joint, width);
    return state_.low[at] == state_.high[at];
  }
  // The joint's state with local memory less the bank's value for the same branch, -2 to 2; 0 without a branch.
  double memory_gap(int joint) const noexcept { return gap_[static_cast<std::size_t>(joint)]; }
  bool has_branches() const noexcept { return !branches_.empty(); }
  // All states, joint by joint: columns() values.
  void write(std::span<double> states) const noexcept;

  // Reads or writes bounds and states with local memory, kept_columns() values each, of the same joints and widths. The
  // last positions stay.
  int kept_columns() const noexcept { return columns() + (has_branches() ? joints_ : 0); }
  void write_ends(std::span<double> low, std::span<double> high) const noexcept;
  void read_ends(std::span<const double> low, std::span<const double> high) noexcept;

  // Complete state; restore() continues from it in a bank of the same settings.
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept {
    state_ = state;
    for (int j = 0; j < joints_; ++j) find_gap(j);
  }

 private:
  std::size_t index(int joint, int width) const noexcept {
    return static_cast<std::size_t>(joint) * widths_.size() + static_cast<std::size_t>(width);
  }
  void bend_local(int joint, double moved) noexcept;
  void find_gap(int joint) noexcept {
    if (!has_branches()) return;
    double bank = 0;
    for (int w = 0; w < width_count(); ++w) bank += branches_[index(joint, w)] * value(joint, w);
    gap_[static_cast<std::size_t>(joint)] = state_.local[static_cast<std::size_t>(joint)] - bank;
  }

  int joints_;
  std::vector<double> widths_;
  std::vector<double> branches_;       // (joint, width)
  std::vector<double> edges_, slopes_; // (joint, width): f at a travel of twice the width, and its slope up to there
  State state_;
  JointVector gap_{};  // derived from the state
};

// First part of the chain.
class MotionStage {
 public:
  // Throws Error if the clock's or the presliding settings do not fit.
  MotionStage(const Tree& tree, std::int64_t sample_period_ns, int network_stride, std::span<const double> widths_rad,
              std::span<const double> branches = {})
      : tree_(tree), clock_(sample_period_ns, network_stride), presliding_(tree.size(), widths_rad, branches) {}

  // Processes one sample of finite values. After a restart tick, the presliding states restarted; after not_later,
  // nothing changed.
  SampleClock::Tick step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq) noexcept {
    const SampleClock::Tick tick = clock_.step(t_ns);
    if (tick.kind == SampleClock::Kind::not_later) return tick;
    if (tick.kind == SampleClock::Kind::restart) presliding_.reset();
    compute(q, dq);
    presliding_.step(q);
    return tick;
  }
  // Computes p and beta of a state; clock and presliding states stay.
  void compute(std::span<const double> q, std::span<const double> dq) noexcept {
    const auto n = static_cast<std::size_t>(tree_.size());
    tree_.momentum(q, dq, std::span(momentum_).first(n), std::span(beta_).first(n));
  }
  // Sets the load of the model (Tree::carry); call compute() to update p and beta.
  void carry(int link, const Carried& what) noexcept { tree_.carry(link, what); }

  const Tree& tree() const noexcept { return tree_; }
  // Of the last sample, one value per joint: [N m s] and [N m].
  std::span<const double> momentum() const noexcept { return {momentum_.data(), static_cast<std::size_t>(tree_.size())}; }
  std::span<const double> beta() const noexcept { return {beta_.data(), static_cast<std::size_t>(tree_.size())}; }
  const Presliding& presliding() const noexcept { return presliding_; }  // after the last sample
  // The presliding states of this joint become undetermined.
  void forget_friction(int joint) noexcept { presliding_.forget(joint); }
  // Restarts at the next sample, whatever its time.
  void reset() noexcept { clock_.reset(); }

  struct State {
    SampleClock clock;
    Presliding::State presliding;
  };
  // Complete state; restore() continues from it.
  State state() const noexcept { return {clock_, presliding_.state()}; }
  void restore(const State& state) noexcept {
    clock_ = state.clock;
    presliding_.restore(state.presliding);
  }

 private:
  Tree tree_;
  SampleClock clock_;
  Presliding presliding_;
  JointVector momentum_{}, beta_{};
};

}  // namespace tauext
