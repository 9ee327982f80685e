// Slow changes of friction and offset, tracked while nothing touches the arm: gears warm up, grease thins, torque
// measurements creep.
#pragma once
#include <algorithm>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "step_share.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// drift_j = b_j . f_j, what r shows beside prior and network: f_j are
//   phi_j = (1, tanh(dq_j / 0.05 rad/s), dq_j / (1 rad/s) clipped to +-1)
// passed through the observer's own filter (mean over a step: trapezoid), so that they stand beside r. The coefficients
// b_j [N m] follow by normalised least mean squares [Haykin2014]:
//   b_j += clip(dt / T * tau_ext_j f_j / max(|f_j|^2, 1), +-rate_share size_j dt),    |b_j| <= size_j.
// Frozen, and still taken off, while the estimate cannot be trusted, while the joint is near stiction and for 3/K0
// afterwards (static friction is no drift, and a push on a standing arm is not to be learned), and for freeze_s after any
// joint's |tau_ext| was over freeze_share of the lower of its limits, but at least over freeze_floor, plus its doubt.
// (Limits that follow the error are low in easy motion: half of one is passed all the time. An alarm that is held below
// the floor freezes nothing.)
class DriftTracker {
 public:
  static constexpr int kTerms = 3;  // constant, Coulomb, viscous
  static constexpr double kCoulombSpeed = 0.05, kViscousSpeed = 1.0;  // [rad/s]
  static constexpr double kForgottenShare = 3;  // times 1/K0 after stiction: so long the observer still shows it

  using Terms = std::array<JointVector, kTerms>;
  struct State {
    bool started = false;
    std::int64_t t_ns = 0, step_ns = 0;  // of the last sample, and since the one before; 0 where it began anew
    StepShare share;
    std::int64_t touched_ns = 0;         // left of the time to be frozen after a touch
    std::array<std::int64_t, kMaxJoints> stuck_ns{};  // and after stiction
    std::uint32_t saturated = 0;         // a bit a joint
    Terms phi{}, filtered{}, coefficients{};
  };

  // Throws Error where the settings do not fit.
  DriftTracker(const DriftSettings& settings, const Limits& limits, int joints, double gain_per_s);

  // After a gap or a fault: the filters begin anew, coefficients stay, since drift does not vanish with a lost sample.
  void restart() noexcept { state_.started = false; }
  // As newly made.
  void reset() noexcept { state_ = {}; }

  // One sample, later than the last: writes the drift of every joint, [N m], from what was learned before it.
  void step(std::int64_t t_ns, std::span<const double> dq, std::span<double> drift) noexcept;
  // Learns from tau_ext of the sample just stepped, drift taken off; scale and doubt as for the limits, near_stiction a
  // bit a joint. With trusted = false nothing is learned, and the time after a touch stands still: what cannot be seen has
  // not gone.
  void learn(std::span<const double> tau_ext, std::span<const double> scale, std::span<const double> doubt,
             std::uint32_t near_stiction, bool trusted) noexcept;

  // As if so much had been learned until now.
  void put_coefficients(const Terms& coefficients) noexcept { state_.coefficients = coefficients; }

  bool on() const noexcept { return settings_.on(); }
  // A bit a joint: one of its coefficients is at its bound. Training anew is due.
  std::uint32_t saturated() const noexcept { return state_.saturated; }
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  bool touched(std::span<const double> tau_ext, std::span<const double> scale, std::span<const double> doubt,
               std::uint32_t near_stiction) const noexcept;
  void follow(int joint, double error, double dt) noexcept;

  DriftSettings settings_;
  Limits limits_;
  int joints_;
  double gain_per_s_;
  std::int64_t freeze_ns_, forget_ns_;
  State state_;
};

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
    StepShare share;
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

// One state a second of the last minute: what a tracker learns in a second is a sixtieth of its size at most.
class DriftHistory {
 public:
  static constexpr std::size_t kKept = 60;
  static constexpr std::int64_t kStepNs = 1'000'000'000;

  // Allocates; nothing is kept before.
  void begin() { kept_.resize(kKept); }
  void clear() noexcept { next_ = count_ = 0; }

  // Once a sample, or seldom: keeps the state when a second has passed, or where time went backwards.
  void keep(std::int64_t t_ns, const DriftTracker& tracker, const FrictionFactors& factors) noexcept {
    if (kept_.empty() || !tracker.on()) return;
    if (count_ > 0 && t_ns >= last().t_ns && elapsed_ns(t_ns, last().t_ns) < kStepNs) return;
    kept_[next_] = {t_ns, tracker.state().coefficients, factors.learned()};
    next_ = (next_ + 1) % kKept;
    count_ = std::min(count_ + 1, kKept);
  }
  // The trackers know what they knew then, by the newest state that is not later, or the oldest; nothing happens where none
  // is kept.
  void go_back(std::int64_t t_ns, DriftTracker& tracker, FrictionFactors& factors) noexcept {
    if (count_ == 0) return;
    while (count_ > 1 && last().t_ns > t_ns) {  // what came later was learned of the load
      next_ = (next_ + kKept - 1) % kKept;
      --count_;
    }
    tracker.put_coefficients(last().coefficients);
    factors.put_learned(last().factors);
  }

 private:
  struct Then {
    std::int64_t t_ns = 0;
    DriftTracker::Terms coefficients{};
    FrictionFactors::Learned factors{};
  };
  const Then& last() const noexcept { return kept_[(next_ + kKept - 1) % kKept]; }

  std::vector<Then> kept_;
  std::size_t next_ = 0, count_ = 0;
};

}  // namespace tauext
