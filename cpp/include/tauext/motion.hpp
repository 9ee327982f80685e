// What everything else follows from: a sample's place on the clock, p and beta of the estimated model, presliding states.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/presliding.hpp"
#include "tauext/sample_clock.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

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
    look(q, dq);
    presliding_.step(q);
    return tick;
  }
  // p and beta of a state; clock and presliding states stay as they are.
  void look(std::span<const double> q, std::span<const double> dq) noexcept {
    const auto n = static_cast<std::size_t>(tree_.size());
    tree_.momentum(q, dq, std::span(momentum_).first(n), std::span(beta_).first(n));
  }
  // The model carries this from now on (Tree::carry); look() again for its p and beta.
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
