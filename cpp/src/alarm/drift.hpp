// Tracks slow changes of friction and offset while nothing touches the arm: warm-up of gears, ageing grease, creep of
// torque sensors.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <span>
#include <vector>

#include "chain/step_share.hpp"
#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// drift_j = b_j . f_j, part of r beside prior and network. f_j are
//   phi_j = (1, tanh(dq_j / 0.05 rad/s), dq_j / (1 rad/s) clipped to +-1)
// passed through the observer's filter (mean over a step: trapezoid), in phase with r. The coefficients b_j [N m]
// follow by normalised least mean squares [Haykin2014]:
//   b_j += clip(dt / T * tau_ext_j f_j / max(|f_j|^2, 1), +-rate_share size_j dt),    |b_j| <= size_j.
// Learning stops, and the drift is still subtracted, (a) while the estimate is not trusted; (b) near stiction and for
// 3/K0 afterwards: static friction and pushes at rest are not drift; (c) for freeze_s after some joint's |tau_ext|
// exceeded its threshold plus doubt. The threshold is freeze_share of the lower limit, but at least freeze_floor, since
// low limits are passed often in easy motion.
class DriftTracker {
 public:
  static constexpr int kTerms = 3, kFriction = 1;  // constant, Coulomb, viscous; the first term of friction
  static constexpr double kCoulombSpeed = 0.05, kViscousSpeed = 1.0;  // [rad/s]
  static constexpr double kForgottenShare = 3;  // times 1/K0 after stiction: the observer's memory

  using Terms = std::array<JointVector, kTerms>;
  struct State {
    bool started = false;
    std::int64_t t_ns = 0, step_ns = 0;  // of the last sample, and since the one before; 0 after a restart
    StepShare share;
    std::int64_t touched_ns = 0;         // remaining freeze time after a touch
    std::array<std::int64_t, kMaxJoints> stuck_ns{};  // remaining time after stiction
    std::uint32_t saturated = 0;         // one bit per joint
    Terms phi{}, filtered{}, coefficients{};
  };

  // Throws Error if the settings do not fit.
  DriftTracker(const DriftSettings& settings, const Limits& limits, int joints, double gain_per_s);

  // After a gap or fault: restarts the filters and keeps the coefficients.
  void restart() noexcept { state_.started = false; }
  // Back to the state after construction.
  void reset() noexcept { state_ = {}; }

  // Processes one sample: writes the drift of every joint, [N m], with the coefficients learned before.
  void step(std::int64_t t_ns, std::span<const double> dq, std::span<double> drift) noexcept;
  // Learns from tau_ext of the current sample, drift subtracted. scale and doubt: as for the limits; near_stiction: one
  // bit per joint. If trusted is false, nothing is learned and freeze times stop.
  void learn(std::span<const double> tau_ext, std::span<const double> scale, std::span<const double> doubt,
             std::uint32_t near_stiction, bool trusted) noexcept;

  // Replaces the learned coefficients, within the bounds.
  void put_coefficients(const Terms& coefficients) noexcept {
    for (std::size_t m = 0; on() && m < coefficients.size(); ++m)
      for (std::size_t j = 0; j < settings_.size_nm.size(); ++j)
        state_.coefficients[m][j] = std::clamp(coefficients[m][j], -settings_.size_nm[j], settings_.size_nm[j]);
  }

  // One joint's part of the drift at the last sample, [N m].
  double part(int joint, int term) const noexcept { return state_.coefficients[term][joint] * state_.filtered[term][joint]; }
  // Reduces a coefficient by this share, since another part of the drift contains it now.
  void give(int joint, int term, double share) noexcept { state_.coefficients[term][joint] *= 1 - share; }

  bool on() const noexcept { return settings_.on(); }
  // One bit per joint: a coefficient is at its bound. Retraining is due.
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

// The prior's friction has two parts per joint, f = (f_c, f_v), Coulomb (with load and presliding) and viscous,
// filtered as r. If the true parts are (1 + x_c) and (1 + x_v) times these, tau_ext contains x . f. A stroke is sliding
// in one direction. The normal equations of the last strokes are kept, with the prior term P = sigma^2 kMemory_s ((1,
// 0; 0, 1) + (1, -1; -1, 1) / kApart^2): both parts change together.
//   x = (sum f f' dt + P)^-1 sum f e dt,    e: tau_ext at x = 0
// The factors move towards x, rate-limited, if
//   - it fits: RMS(e - x f) <= kFits times the RMS standard error, or a tenth of RMS(x f);
//   - the strokes of all other joints that moved recently fit too;
//   - the friction is within its bounds: 1 / (1 + share) to 1 + share times that of the prior.
// A change of kFound standard errors (RMS) is taken over at once. Of a smaller one the Kalman gain s^2 / (s^2 + v): v is
// the variance of one stroke's factor, s the standard error of the factors, which grows with time.
// Forces that are constant, act in one direction or in some poses only, or oppose the tool's velocity do not fit. If a
// joint moves alone, a force that opposes its motion both ways at a constant lever looks like friction. It is learned
// within the bounds, and nothing of a larger force.
//
// s also raises the limits, by kWide times what exceeds its usual value: friction may have changed since the last
// stroke. Each stroke lowers s to what it shows of the friction, whether or not the factors move. A joint at rest keeps
// the friction with which it stopped, so its limits rise when it moves.
//
// After each stroke, a part of a factor that the slow tracker has learned with the opposite sign is cancelled in both.
// Else, every cold start would add to the factors, and every warm-up would subtract it in the slow tracker: the sum is
// right in motion, but at rest the slow tracker's part vanishes and the factors' remains.
class FrictionFactors {
 public:
  static constexpr int kParts = 2;               // Coulomb, viscous
  static constexpr int kStrokes = 6;             // kept per joint
  static constexpr int kLeast = 3;               // a reversal may be the end of a push; two are not
  static constexpr int kTouched = 2;             // of the strokes may be left out: something touched the arm
  static constexpr double kLeastSeconds = 0.1;   // of a stroke; r needs about 1/K0
  static constexpr double kLeastTravel = 0.1;    // [rad or m]
  static constexpr double kOld_s = 120;          // older strokes are ignored
  static constexpr double kFits = 1.25;          // ordinary motion reaches 0.4 to 1.1
  static constexpr double kFound = 3;            // half of a usual contact limit: undetected pushes are not learned
  static constexpr double kFitsShare = 0.1;      // friction changes its shape as it grows
  static constexpr double kMemory_s = 0.3;       // correlation time of the errors
  static constexpr double kApart = 0.2;          // usual difference of the two factors
  static constexpr double kGlidePerSecond = 0.2; // rate limit of a factor
  static constexpr double kForgottenShare = 3;   // times 1/K0 after stiction: the observer's memory
  static constexpr double kCancel_s = 10;        // of sliding: short against the slow tracker's minutes
  static constexpr double kWorth = 0.1;          // of the joint's friction, RMS: with a smaller part nothing is cancelled
  static constexpr double kStart = 0.15;         // standard error of the factors before the first stroke
  static constexpr double kMost = 0.75;          // most that it grows to after a long rest
  static constexpr double kChanges_s = 2.5e-5;   // growth of its square per second: 4 % in a minute, 30 % in an hour
  static constexpr double kUsual = 0.03;         // standard error that limits contain already
  static constexpr double kWide = 2;             // standard errors by which limits are raised
  static constexpr double kMoves = 0.005;        // [rad/s or m/s]: a slower joint rests
  static constexpr double kBent = 0.1;           // change of friction that limits near stiction contain
  static constexpr double kStiff = 0.5;          // share of the error by which breaking away is uncertain after a rest
  static constexpr double kRunsIn_s = 60;        // of sliding, until it no longer is

  using Parts = std::array<double, kParts>;
  // Sums over one stroke, times dt.
  struct Stroke {
    std::int64_t end_ns = 0;
    double seconds = 0, travel = 0;  // 0 s: empty
    double cc = 0, cv = 0, vv = 0;   // of f f'
    double ce = 0, ve = 0, ee = 0;   // of f e and e e
    Parts slow{};                    // of f times the slow tracker's part, Coulomb and viscous
    double sigma2 = 0;
  };
  // What has been learned of a joint.
  struct Factor {
    Parts wanted{};            // factors less 1
    double error = 0;          // their standard error
    bool moved = false;        // `error` holds
    std::int64_t since_ns = 0; // from this time
  };
  struct Joint {
    std::array<Stroke, kStrokes> strokes{};
    Stroke open{};
    int next = 0;               // index of the next stroke
    std::int64_t stuck_ns = 0;  // remaining time after stiction
    Parts now{}, filtered{};    // friction at the last sample, [N m]
    Parts factors{};            // less 1, as applied
    bool near = true;           // near stiction at the last sample
    Factor known;               // the target of the factors
    double stiff = 0;           // share by which breaking away is uncertain
    double level = 0;           // friction in the last stroke, RMS, [N m]
  };
  struct State {
    bool started = false;
    std::int64_t t_ns = 0, step_ns = 0;  // of the last sample, and since the one before; 0 after a restart
    StepShare share;
    std::uint32_t saturated = 0;         // one bit per joint: friction is off by more than `share`
    std::array<Joint, kMaxJoints> joints{};
  };

  // share: friction is within 1 / (1 + share) and 1 + share times that of the prior; 0 turns tracking off.
  FrictionFactors(double share, int joints, double gain_per_s);

  bool on() const noexcept { return share_ > 0; }
  // After a gap or fault: restarts filters and strokes, keeps the factors.
  void restart() noexcept;
  // Back to the state after construction.
  void reset() noexcept { state_ = {}; }
  // For a changed load: discards all strokes, keeps the factors.
  void forget_strokes() noexcept;

  using Learned = std::array<Factor, kMaxJoints>;
  Learned learned() const noexcept;
  // Applies these factors at once, within the bounds, and discards all strokes.
  void put_learned(const Learned& factors) noexcept;

  // Processes one sample with the prior's friction before the observer's filter. Adds the correction by the learned
  // factors to each joint's drift, [N m].
  void step(std::int64_t t_ns, std::span<const double> coulomb, std::span<const double> viscous,
            std::span<double> drift) noexcept;
  // Learns from tau_ext of the current sample, drift subtracted, and from the slow tracker after its step(). If trusted
  // is false, the open strokes are discarded.
  void learn(std::span<const double> dq, std::span<const double> tau_ext, std::span<const double> sigma,
             std::span<const double> doubt, std::uint32_t near_stiction, bool trusted, DriftTracker& slow) noexcept;

  // Raises each joint's limits by how much its friction may be off at the last sample beside the usual, [N m].
  void raise(std::span<const double> dq, std::span<double> limit_nm) const noexcept;
  // Adds to each joint's standard error, in squares, what is unknown of its friction at the last sample. NaN stays NaN.
  void spread(std::span<double> sigma_nm) const noexcept;

  // One bit per joint: friction is off by more than may be learned. Retraining is due.
  std::uint32_t saturated() const noexcept { return state_.saturated; }
  const State& state() const noexcept { return state_; }
  void restore(const State& state) noexcept { state_ = state; }

 private:
  // Fit over a joint's strokes.
  struct Evidence {
    int strokes = 0, forward = 0;
    bool fits = false;
    Parts factors{};
    // Mean squares of change, friction, sigma, and of what x f leaves; mean product of x f and friction.
    double change2 = 0, friction2 = 0, sigma2 = 0, left2 = 0, along = 0;
    double seconds = 0;
    std::size_t worst = 0;  // index of the stroke that fits worst
  };

  void add(int joint, double dq, double tau_ext, double sigma, const DriftTracker& slow) noexcept;
  void close(int joint, DriftTracker& slow) noexcept;
  void cancel(int joint, const Stroke& ended, DriftTracker& slow) noexcept;
  Evidence evidence(const Joint& joint) const noexcept;
  Evidence evidence(const Joint& joint, const std::array<bool, kStrokes>& counts) const noexcept;
  void conclude(int joint, double variance, std::span<const Evidence> found) noexcept;
  double grown(const Joint& joint) const noexcept;
  double least() const noexcept { return 1 / (1 + share_) - 1; }  // of a factor less 1

  double share_;
  int joints_;
  double gain_per_s_;
  std::int64_t forget_ns_;
  State state_;
};

// One state per second of the last minute. In a second a tracker learns at most a sixtieth of its size.
class DriftHistory {
 public:
  static constexpr std::size_t kKept = 60;
  static constexpr std::int64_t kStepNs = 1'000'000'000;

  // Allocates; nothing is kept before.
  void begin() { kept_.resize(kKept); }
  void clear() noexcept { next_ = count_ = 0; }

  // Call at any interval: stores the state once a second has passed, or if time went backwards.
  void keep(std::int64_t t_ns, const DriftTracker& tracker, const FrictionFactors& factors) noexcept {
    if (kept_.empty() || !tracker.on()) return;
    if (count_ > 0 && t_ns >= last().t_ns && elapsed_ns(t_ns, last().t_ns) < kStepNs) return;
    kept_[next_] = {t_ns, tracker.state().coefficients, factors.learned()};
    next_ = (next_ + 1) % kKept;
    count_ = std::min(count_ + 1, kKept);
  }
  // Restores the newest state that is not later than t_ns, else the oldest. No effect if none is stored.
  void go_back(std::int64_t t_ns, DriftTracker& tracker, FrictionFactors& factors) noexcept {
    if (count_ == 0) return;
    while (count_ > 1 && last().t_ns > t_ns) {  // later states learned from the load
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
