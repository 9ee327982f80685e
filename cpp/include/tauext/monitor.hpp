// The chain inside a control loop: one sample in, external torque, alarm and health out.
#pragma once
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "tauext/alarm.hpp"
#include "tauext/bundle.hpp"
#include "tauext/drift.hpp"
#include "tauext/residual.hpp"
#include "tauext/signal_watch.hpp"
#include "tauext/sliding_lstm.hpp"
#include "tauext/types.hpp"

namespace tauext {

struct Sample {
  std::int64_t t_ns = 0;
  std::span<const double> q, dq, tau;  // a joint: [rad], [rad/s], [N m]
};

// Whether the estimate can be trusted; apart from the alarm, so that a fault never hides a collision.
enum class Health : std::uint8_t {
  warming_up,  // observer or window not full yet: there is no estimate
  ok,
  stale,       // no new sample, or an old one: the last estimate is held
  fault,       // the signals cannot be true or cannot be used
};

// Why health is not ok, or why it was not when the warm-up began; a bit each.
enum Cause : std::uint32_t {
  kNotFinite = 1,          // NaN or infinity in q, dq or tau, or so large that the chain overflows
  kWrongSize = 2,          // q, dq and tau hold not one value a joint
  kLateSample = 4,         // older than the newest one, by at most one network period: left out
  kTimeBackwards = 8,      // older by more: the clock was set back
  kMissingSample = 16,     // no_sample(): none came for at most one network period
  kGap = 32,               // none came for longer
  kWrongRate = 64,         // the samples' mean step is not the bundle's
  kTorqueSaturated = 128,  // a drive at its limit gives another torque than it is told
  kEncoderStill = 256,     // a position stands still while velocity or torque say otherwise
};
inline constexpr std::uint32_t kCauseCount = 9;

const char* name(Alarm alarm) noexcept;
const char* name(Health health) noexcept;
const char* name(Cause cause) noexcept;  // of a single bit: "not finite", ...

// What the monitor says of one sample. A torque that does not exist is NaN: tau_ext, uncertainty and margin exist where
// health is ok or stale, or kTorqueSaturated is all that is or was wrong.
struct Estimate {
  std::int64_t t_ns = 0;
  int joints = 0;
  Health health = Health::warming_up;
  std::uint32_t causes = 0;         // bits of Cause
  int cause_joint = -1;             // the first joint that a cause concerns
  Alarm alarm = Alarm::none;
  int alarm_joint = -1;             // that raised the alarm to its level
  std::int64_t alarm_t_ns = 0;      // when it did
  bool detection = false;           // some |tau_ext| over its collision limit, at this sample
  std::uint32_t near_stiction = 0;  // a bit a joint: which of its limits holds
  std::uint32_t drift_saturated = 0;  // a bit a joint: its drift is at the bound, and training anew is due
  JointVector residual{};           // r of the observer, [N m]
  JointVector prior{};              // what physics expects of r in free motion, [N m]
  JointVector drift{};              // what the tracker has learned since, [N m]; 0 without one
  JointVector uncertainty{};        // r expected in free motion: prior + network + drift, [N m]
  JointVector tau_ext{};            // residual - uncertainty, [N m]
  JointVector doubt{};              // how far the prior may be off while presliding states are unknown, [N m]
  JointVector limit_nm{};           // that |tau_ext| must exceed for a collision; doubt included
  JointVector margin_nm{};          // limit - |tau_ext|

  // The only thing that may be read as "no collision".
  bool clear() const noexcept { return health == Health::ok && alarm == Alarm::none; }
};

// step() is estimate(), which takes about a microsecond, and advance(), which prepares the next one. A caller in a hard
// loop sends its command between the two. Nothing here allocates, locks, logs, throws or calls the system once the
// monitor is made. One thread at a time.
class Monitor {
 public:
  // Throws Error where the bundle does not hold together.
  explicit Monitor(const Bundle& bundle, NetworkRate rate = NetworkRate::every_sample);

  const Estimate& step(const Sample& sample) noexcept {
    estimate(sample);
    advance();
    return estimate_;
  }
  // The answer for this sample. Faults are answered, never skipped; after one the chain begins anew with the next good
  // sample and is warming up until observer and window are full. A standing alarm outlives all of it.
  const Estimate& estimate(const Sample& sample) noexcept;
  // What need not be done before the answer is out. estimate() does it first where it was left out.
  void advance() noexcept;
  // The loop ran and no sample came: stale for one network period, then a fault.
  const Estimate& no_sample(std::int64_t now_ns) noexcept;

  // Ends a latched alarm, and nothing else; one whose cause lasts comes back.
  void acknowledge() noexcept;
  // As acknowledge(), for an arm that nothing touches any more and that is to move on. A push leaves the static friction
  // of a joint at rest at a level that its position tells only roughly. So that of joints near stiction is unknown again,
  // as at the start: with a prior, their limits are higher at once by as much as it can hide, until the joints have slid.
  void resume() noexcept;
  // Limits are the bundle's times these, one a joint and each 0.1 to 10, from the next sample on: for phases of a task
  // that bear more contact, or less. false, and nothing changed, where they are not. What the drift learns from does not
  // depend on them. The limits' promise of false alarms holds at factors from 1 on.
  bool set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept {
    return alarm_.set_factors(collision, contact);
  }
  const LimitFactors& limit_factors() const noexcept { return alarm_.factors(); }
  // As newly made.
  void reset() noexcept;

  const Estimate& last() const noexcept { return estimate_; }
  int joints() const noexcept { return joints_; }
  const std::string& joint_name(int joint) const { return joint_names_.at(static_cast<std::size_t>(joint)); }
  std::int64_t sample_period_ns() const noexcept { return sample_period_ns_; }
  std::uint64_t samples() const noexcept { return counters_.samples; }
  std::uint64_t bridged_ticks() const noexcept { return counters_.bridged; }  // ticks without a sample of their own
  std::uint64_t restarts() const noexcept { return counters_.restarts; }      // after the first start

  // The whole state, to go on in another monitor of the same bundle, rate, build and kind of processor.
  std::size_t state_bytes() const noexcept;
  // false, and nothing changed, where the size is wrong or, in restore(), the bytes are of another monitor or damaged.
  bool save_state(std::span<std::byte> state) const noexcept;
  bool restore_state(std::span<const std::byte> state) noexcept;

 private:
  struct Counters {
    std::uint64_t samples = 0, bridged = 0, restarts = 0;
    bool started = false;          // a stretch is running or is to be continued
    bool restart_next = false;     // a fault broke the chain
    std::uint32_t causes = 0;      // of the warm-up that is running
    int cause_joint = -1;
    std::int64_t t_ns = 0;         // of the last sample that was used
    std::int64_t saturated_ns = 0;  // last sample with a drive at its limit
    bool saturated = false;        // and the observer has not forgotten it
  };
  // What was found wrong at one sample, and whether tau_ext can be judged.
  struct Findings {
    std::uint32_t causes = 0;
    int joint = -1;  // the first one concerned
    bool trusted = true;
    void add(Cause cause, int which) noexcept {
      causes |= cause;
      if (joint < 0) joint = which;
    }
  };

  bool refused(const Sample& sample) noexcept;
  std::int64_t observe(const Sample& sample) noexcept;
  bool predict(const Sample& sample, std::int64_t ticks) noexcept;
  Findings examine(const Sample& sample) noexcept;
  void judge(const Sample& sample, bool full, Findings& findings) noexcept;
  void conclude(const Findings& findings) noexcept;

  void refuse(std::int64_t t_ns, Health health, std::uint32_t cause, int joint) noexcept;
  void hold(std::int64_t t_ns, std::uint32_t cause) noexcept;
  void blank(bool also_residual) noexcept;
  void report_alarm() noexcept;
  std::span<double> first_joints(JointVector& values) const noexcept {
    return std::span(values).first(static_cast<std::size_t>(joints_));
  }

  int joints_;
  std::vector<std::string> joint_names_;
  std::int64_t sample_period_ns_, network_period_ns_;
  double slowest_per_s_;
  std::uint32_t fingerprint_;  // CRC-32 of the bundle and of what else a state depends on
  ResidualStage residual_;
  SignalWatch watch_;
  std::optional<SlidingLstm> network_;
  std::vector<float> input_factors_, row_, network_out_;
  std::vector<double> output_scale_nm_, states_;
  Limits limits_;
  AlarmStage alarm_;
  DriftTracker drift_;
  Counters counters_;
  Estimate estimate_;
};

}  // namespace tauext
