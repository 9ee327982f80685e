// What everything else follows from: a sample's place on the clock, p and beta of the estimated model, presliding states.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Missing samples that the clock bridges at most: those of a network period, and below 300 Hz up to three within 30 ms.
// There a network period is a sample or two, and a log that loses one sample in ten would restart for every second pair.
int longest_bridged(std::int64_t sample_period_ns, int network_stride) noexcept;
inline constexpr int kMostBridged = 3;  // of samples that are longer than a third of a network period

// Jittering stamps fall on consecutive ticks; the rounding error is carried on, so that ticks count time and not
// samples. A gap of at most longest_bridged() missing samples is bridged: the ticks in between hold the last sample. A
// longer gap restarts everything that looks back in time.
class SampleClock {
 public:
  // Throws Error where the period or the stride is not positive.
  SampleClock(std::int64_t sample_period_ns, int network_stride);

  // Where a sample stands: at the start of a stretch, after the last one, or nowhere.
  enum class Kind : std::uint8_t { restart, next, not_later };
  struct Tick {
    Kind kind;
    std::int64_t advance;  // ticks since the last sample, at least 1; 0 unless kind is next
  };

  // The next sample is a first one.
  void reset() noexcept { started_ = false; }
  // not_later, which changes nothing, where t_ns is not later than the last sample; restart for the first sample.
  Tick step(std::int64_t t_ns) noexcept;

 private:
  std::int64_t sample_period_ns_;
  int longest_bridged_;
  bool started_ = false;
  std::int64_t t_ns_ = 0;
  double carry_ = 0;  // ticks that the stamps are ahead of the count, within +-1
};

inline constexpr int kMaxWidths = 8;  // of a bank

// A bank of stop operators (Maxwell-slip elements) on each joint's displacement, for widths w:
//   z <- clip(z + (q_k - q_{k-1}), -w, w); the state is z / w, in [-1, 1].
// It is -1 or 1 where the joint has slid on, and between them while it is still being bent. Where it begins is unknown:
// the two ends of what is possible, -w and w at first, move alike until they meet, which they do as soon as the joint has
// travelled 2 w; until then the state is their mean, and undetermined.
// Steps are those of the sample rate: a bank is trained and run at one rate.
//
// The bank remembers every reversal that was not yet passed (nonlocal memory, as of Maxwell slip [AlBender2005]). Friction
// after Dahl or LuGre has local memory instead: its slope follows from its own value and the direction alone. Both agree
// where a joint reverses after sliding, and differ where it reverses again before it slides. The branch of a joint is the
// friction since a reversal from sliding, over the travel x, as a share of the sliding friction:
//   f(x) = sum_w branch_w clip(-1 + x / w, -1, 1),  branch_w >= 0, sum 1.
// The state with local memory follows that branch in either direction from wherever it is, s = 1 or -1 the direction:
//   z <- s f(f^-1(s z) + |q_k - q_{k-1}|),  0 at first.
class Presliding {
 public:
  struct State {
    bool started = false;
    JointVector q{};
    std::array<double, kMaxJoints * kMaxWidths> low{}, high{};  // (joint, width), in widths
    JointVector local{};  // with local memory, -1 to 1
  };

  // widths [rad], 0 to kMaxWidths of them, > 0 and rising. branches: (joints, widths), a row of zeros for a joint without
  // one; empty: no joint has one. Throws Error otherwise.
  Presliding(int joints, std::span<const double> widths, std::span<const double> branches = {});

  // Nothing is known any more: after a gap.
  void reset() noexcept { state_.started = false; }
  // Nothing is known any more of this joint: as at the start, from its last position on.
  void forget(int joint) noexcept;
  // One sample of finite positions.
  void step(std::span<const double> q) noexcept;

  int columns() const noexcept { return joints_ * width_count(); }  // states of all joints
  int width_count() const noexcept { return static_cast<int>(widths_.size()); }  // states of a joint
  // The state of a joint for a width.
  double value(int joint, int width) const noexcept {
    const std::size_t at = index(joint, width);
    return 0.5 * (state_.low[at] + state_.high[at]);
  }
  // How far from value() the state may be: 0 once it is determined, 1 where nothing is known.
  double doubt(int joint, int width) const noexcept {
    const std::size_t at = index(joint, width);
    return 0.5 * (state_.high[at] - state_.low[at]);
  }
  // Whether the two ends have met.
  bool determined(int joint, int width) const noexcept {
    const std::size_t at = index(joint, width);
    return state_.low[at] == state_.high[at];
  }
  // The joint's state with local memory less what the bank has for the same branch, -2 to 2; 0 without a branch.
  double memory_gap(int joint) const noexcept { return gap_[static_cast<std::size_t>(joint)]; }
  bool has_branches() const noexcept { return !branches_.empty(); }
  // All of them, in rows of one joint: columns() values.
  void write(std::span<double> states) const noexcept;

  // Both ends of what is possible and the states with local memory, kept_columns() each, to be given back later for the
  // same joints and widths; the positions stay those of the last sample.
  int kept_columns() const noexcept { return columns() + (has_branches() ? joints_ : 0); }
  void write_ends(std::span<double> low, std::span<double> high) const noexcept;
  void read_ends(std::span<const double> low, std::span<const double> high) noexcept;

  // All that it remembers; restore() goes on from there, in another one of the same settings.
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
  JointVector gap_{};  // follows from the state
};

// What the chain begins with.
class MotionStage {
 public:
  // Throws Error where the clock's or the presliding settings do not fit.
  MotionStage(const Tree& tree, std::int64_t sample_period_ns, int network_stride, std::span<const double> widths_rad,
              std::span<const double> branches = {})
      : tree_(tree), clock_(sample_period_ns, network_stride), presliding_(tree.size(), widths_rad, branches) {}

  // One sample of finite values. Where the tick says restart, presliding states began anew with it; where it says
  // not_later, nothing changed.
  SampleClock::Tick step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq) noexcept {
    const SampleClock::Tick tick = clock_.step(t_ns);
    if (tick.kind == SampleClock::Kind::not_later) return tick;
    if (tick.kind == SampleClock::Kind::restart) presliding_.reset();
    compute(q, dq);
    presliding_.step(q);
    return tick;
  }
  // p and beta of a state; clock and presliding states stay as they are.
  void compute(std::span<const double> q, std::span<const double> dq) noexcept {
    const auto n = static_cast<std::size_t>(tree_.size());
    tree_.momentum(q, dq, std::span(momentum_).first(n), std::span(beta_).first(n));
  }
  // The model carries this from now on (Tree::carry); compute() again for its p and beta.
  void carry(int link, const Carried& what) noexcept { tree_.carry(link, what); }

  const Tree& tree() const noexcept { return tree_; }
  // Of the last sample, one value a joint: [N m s] and [N m].
  std::span<const double> momentum() const noexcept { return {momentum_.data(), static_cast<std::size_t>(tree_.size())}; }
  std::span<const double> beta() const noexcept { return {beta_.data(), static_cast<std::size_t>(tree_.size())}; }
  const Presliding& presliding() const noexcept { return presliding_; }  // after the last sample
  // Nothing is known any more of what this joint's motion told of its static friction.
  void forget_friction(int joint) noexcept { presliding_.forget(joint); }
  // The next sample starts anew, whenever it comes.
  void reset() noexcept { clock_.reset(); }

  struct State {
    SampleClock clock;
    Presliding::State presliding;
  };
  // All that it remembers; restore() goes on from there.
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
