// Friction that is off by a factor, and at once: gears that are cold at switch-on, or have been since the arm was
// trained. Found from strokes to and fro, since what opposes both directions of motion alike is friction.
#pragma once
#include <array>
#include <cstdint>
#include <span>

#include "tauext/types.hpp"

namespace tauext {

// Friction as the prior knows it has two parts a joint, f = (f_c, f_v): all that is Coulomb's (load and presliding
// included) and what is viscous, both through the observer's filter. If the joint's friction is (1 + x_c) and (1 + x_v)
// times that, tau_ext shows x . f. A stroke is a stretch of sliding one way; of each joint's last strokes, to and fro,
// the normal equations are kept, with P = sigma^2 kMemory_s ((1, 0; 0, 1) + (1, -1; -1, 1) / kApart^2) for what is known
// beforehand: that parts move together.
//   x = (sum f f' dt + P)^-1 sum f e dt,    e: what tau_ext would be at x = 0
// x is taken, and glided to, where
//   - it fits: RMS(e - x f) <= kFits times the RMS standard error, or a tenth of RMS(x f);
//   - no other joint that moved lately says that something else is at work: its strokes fit too;
//   - it is worth it: the change explains kFound times the standard error or more, RMS;
//   - it is no more than friction changes by: RMS(x f) <= share RMS(f_c + f_v).
// A constant force, one that acts in one direction only or in some poses, and one that opposes the tool's velocity rather
// than a joint's (its torques follow the Jacobian and the other joints' speeds) leave what does not fit. On a joint that
// moves alone, a force that opposes the motion both ways at a constant lever is friction to everyone: of it at most
// `share` of the joint's friction is learned, and nothing where it is larger.
class FrictionFactors {
 public:
  static constexpr int kParts = 2;               // Coulomb's, viscous
  static constexpr int kStrokes = 6;             // kept of a joint
  static constexpr int kLeast = 3;               // a reversal may be a push that ended; two are not
  static constexpr double kLeastSeconds = 0.1;   // of a stroke; r needs some 1/K0 to show it
  static constexpr double kLeastTravel = 0.1;    // [rad or m]: another place
  static constexpr double kOld_s = 120;          // an older stroke says nothing
  static constexpr double kFits = 1.25;          // ordinary motion shows 0.4 to 1.1
  static constexpr double kFound = 3;            // half of a usual contact limit: of a push that is not seen nothing is learned
  static constexpr double kFitsShare = 0.1;      // friction changes its shape as it grows
  static constexpr double kMemory_s = 0.3;       // errors so close together are one
  static constexpr double kApart = 0.2;          // how far the two factors usually differ
  static constexpr double kGlidePerSecond = 0.2; // of a factor on its way
  static constexpr double kForgottenShare = 3;   // times 1/K0 after stiction: so long the observer still shows it

  using Parts = std::array<double, kParts>;
  // Sums over sliding one way, times dt.
  struct Stroke {
    std::int64_t end_ns = 0;
    double seconds = 0, travel = 0;  // 0 s: none
    double cc = 0, cv = 0, vv = 0;   // of f f'
    double ce = 0, ve = 0, ee = 0;   // of f e and e e
    double sigma2 = 0;
  };
  struct Joint {
    std::array<Stroke, kStrokes> strokes{};
    Stroke open{};
    int next = 0;               // where the next stroke goes
    std::int64_t stuck_ns = 0;  // left of the time after stiction
    Parts now{}, filtered{};    // of friction at the last sample, [N m]
    Parts factors{}, wanted{};  // of the friction, less 1: as taken off, and where they glide
  };
  struct State {
    bool started = false;
    std::int64_t t_ns = 0, step_ns = 0;  // of the last sample, and since the one before; 0 where it began anew
    std::uint32_t saturated = 0;         // a bit a joint: friction is off by more than `share`
    std::array<Joint, kMaxJoints> joints{};
  };

  // share: the most that friction may be off by, 0: nothing is followed.
  FrictionFactors(double share, int joints, double gain_per_s);

  bool on() const noexcept { return share_ > 0; }
  // After a gap or a fault: filters and strokes begin anew, what was learned stays.
  void restart() noexcept;
  // As newly made.
  void reset() noexcept { state_ = {}; }
  // The arm became another one: what was seen of its strokes says nothing more, what was learned stays.
  void forget_strokes() noexcept;

  // Of a joint's friction, less 1.
  using Learned = std::array<Parts, kMaxJoints>;
  Learned learned() const noexcept;
  // The factors are those at once, and what was seen of strokes is forgotten.
  void put_learned(const Learned& factors) noexcept;

  // One sample, later than the last, with the friction that the prior expects before the observer's filter: adds to the
  // drift of every joint, [N m], what is known of its factors.
  void step(std::int64_t t_ns, std::span<const double> coulomb, std::span<const double> viscous,
            std::span<double> drift) noexcept;
  // Learns from tau_ext of the sample just stepped, drift taken off. trusted = false ends the strokes: what cannot be
  // seen may be anything.
  void learn(std::span<const double> dq, std::span<const double> tau_ext, std::span<const double> sigma,
             std::span<const double> doubt, std::uint32_t near_stiction, bool trusted) noexcept;

  // A bit a joint: its friction is off by more than may be learned. Training anew is due.
  std::uint32_t saturated() const noexcept { return state_.saturated; }
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  // What the strokes of a joint say.
  struct Evidence {
    int strokes = 0, forward = 0;
    bool fits = false;
    Parts factors{};
    double change2 = 0, whole2 = 0, friction2 = 0, sigma2 = 0;  // mean squares of change, x f, friction and sigma
  };

  void add(Joint& joint, double dq, double tau_ext, double sigma) noexcept;
  void close(int joint) noexcept;
  Evidence look(const Joint& joint) const noexcept;
  void conclude(int joint) noexcept;

  double share_;
  int joints_;
  double gain_per_s_;
  std::int64_t forget_ns_;
  State state_;
};

}  // namespace tauext
