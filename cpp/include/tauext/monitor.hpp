// The chain inside a control loop: one sample in, external torque, alarm and health out.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "tauext/bundle.hpp"
#include "tauext/estimate.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"
#include "tauext/wrench.hpp"

namespace tauext {

// step() is estimate(), which takes about a microsecond, and advance(), which prepares the next one. A caller in a hard
// loop sends its command between the two. Nothing here allocates, locks, logs, throws or calls the system once the
// monitor is made. One thread at a time.
class Monitor {
 public:
  // Throws Error where the bundle does not hold together.
  explicit Monitor(const Bundle& bundle, NetworkRate rate = NetworkRate::every_sample);
  Monitor(Monitor&&) noexcept;
  Monitor& operator=(Monitor&&) noexcept;
  ~Monitor();

  // --- A sample and its answer.

  // estimate() and advance() in one: the answer for this sample.
  const Estimate& step(const Sample& sample) noexcept {
    estimate(sample);
    advance();
    return last();
  }
  // The answer for this sample. Faults are answered, never skipped; after one the chain restarts with the next good
  // sample and is warming up until observer and window are full. An active alarm persists throughout.
  const Estimate& estimate(const Sample& sample) noexcept;
  // The work that can wait until the answer is out. estimate() does it first if the call was omitted.
  void advance() noexcept;
  // The loop ran and no sample came: stale for as long as samples are bridged (longest_bridged), then a fault.
  const Estimate& no_sample(std::int64_t now_ns) noexcept;
  // The last answer; the same object as estimate() returned, so the next call changes it.
  const Estimate& last() const noexcept { return *last_; }
  // Temperatures of the joints, [degC], NaN where one is not known, from the next sample on; for loops whose samples hold
  // none, since they change slowly. What was known before holds. false, and nothing changed, where they are not one a joint.
  bool set_temperature(std::span<const double> celsius) noexcept;

  // --- Alarm and limits.

  // Ends a latched alarm, and nothing else; one whose cause lasts comes back.
  void acknowledge() noexcept;
  // As acknowledge(), for an arm that nothing touches any more and that is to move on. A push leaves the static friction
  // of a joint at rest at a level that its position determines only roughly. So that of joints near stiction is unknown again,
  // as at the start: with a prior, their limits are higher at once by as much as it can hide, until the joints have slid.
  void resume() noexcept;
  // Limits are the bundle's times these, one a joint and each 0.1 to 10, from the next sample on: for phases of a task
  // that bear more contact, or less. false, and nothing changed, where they are not. What the drift learns from does not
  // depend on them. The limits' promise of false alarms holds at factors from 1 on.
  bool set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept;
  const LimitFactors& limit_factors() const noexcept;  // those that hold now

  // --- Loads: set, expected of a gripper, weighed.

  // What the arm carries from the next sample on, in the axes of load_settings().frame; mass 0: nothing. r continues from
  // its value. With since_ns, in the samples' time, r, prior and drift are what they would be had it been set then:
  // exactly within the last 10/K0 (8192 samples at most), all but e^-10 of the load's torques before that; drift
  // to a second, within the last minute. What is known of the time before is lost by restore_state() and by whatever breaks
  // the chain. Limits rise by the load's error_share of its torques. false, and nothing changed, where the load is
  // refused. Takes no longer than a microsecond or two for each sample since then.
  bool set_load(const Load& load, std::int64_t since_ns = kFromNow) noexcept;
  // It carries nothing more; true, and nothing happens, where none can be set.
  bool clear_load(std::int64_t since_ns = kFromNow) noexcept { return !load_settings().settable() || set_load({}, since_ns); }
  const Load& load() const noexcept;  // that holds now
  // Where the load is fixed, and bounds on loads.
  const LoadSettings& load_settings() const noexcept;
  // Why it would be refused.
  LoadFault load_fault(const Load& load, std::int64_t since_ns = kFromNow) const noexcept;
  // The same in a sentence; empty: it would be taken. Not for the loop: it allocates.
  std::string why_no_load(const Load& load, std::int64_t since_ns = kFromNow) const {
    return load_settings().words(load_fault(load, since_ns), load);
  }

  // From the next sample on, for so many seconds (60 at most): the gripper closes or opens, and what the arm carries may
  // become anything up to at_most_kg in all. A step that fits that is no alarm: it is weighed, set and reported
  // (Estimate's load_phase, load_found_ns, load_error_kg); one that does not fit is the usual alarm. What would have been an
  // alarm and does not become a load within about half a second of settling is one late. Meanwhile
  // drift learns nothing, and a sample takes about two microseconds longer. A load that is set or cleared ends it, and reset().
  // false, and nothing changed, where why_not_expected() returns a reason.
  bool expect_load(double seconds, double at_most_kg) noexcept;
  // Empty: it would be. Not for the loop: it allocates.
  std::string why_not_expected(double seconds, double at_most_kg) const;
  // What is it carrying? From the next sample on, what the arm carries beside the load that is set now is weighed: sums of
  // healthy samples a network period apart, from 10/K0 on, in advance(). Until stop_weighing() the trackers of drift learn
  // nothing, else they would learn the load away. Sums restart where it runs already, and with every set_load(); reset()
  // and restore_state() end it. reach_m: how far the centre of mass may be from the origin of the load frame. false, and
  // nothing changed: why_no_weighing() is not empty, or a reach that is not above 0.
  bool start_weighing(double reach_m = kUsualReach_m) noexcept;
  // What was found until now stays, for estimate_load(), until the next start.
  void stop_weighing() noexcept;
  bool can_weigh() const noexcept;  // start_weighing() refuses no reach above 0
  bool weighing() const noexcept;
  // Result of the sums: see LoadFound. The call takes as long as some fifty samples (60 us for six joints on a desktop);
  // nothing is changed. A contact while weighing is not cut out, but reported: the verdict is then not `load`.
  LoadFound estimate_load() const noexcept;
  // Empty: it can be weighed. Allocates.
  std::string why_no_weighing() const;

  // --- Forces and moments.

  // Force and moment that the surroundings exert on the arm at a frame, at the last sample, and how sure that is: see
  // Wrench. While a load is expected, what is taken for that load (load_nm) is no part of them. Not known while health is
  // not ok or stale, or after restore_state() until the next sample. Microseconds, and nothing is changed.
  Wrench wrench(int frame, WrenchAxes axes = WrenchAxes::base) const noexcept;
  // Estimate of a force alone, that acts at this point of the frame, [m] along its own axes.
  Wrench force(int frame, const std::array<double, 3>& point, WrenchAxes axes = WrenchAxes::base) const noexcept;
  // Frames by name, and why there is no wrench: refused().
  const WrenchModel& wrench_model() const noexcept;
  std::string why_no_wrench() const { return wrench_model().refused(); }

  // --- Motion for a refit.

  static constexpr double kRefitFrictionShare = 0.4;  // usual
  // A refit's morning routine (refit.hpp). Outside the loop, since it allocates: memory for so many seconds of samples.
  // Throws Error where they are not above 0 and at most 600.
  void reserve_refit(double seconds);
  // From the next sample on, motion is kept until that memory is full, and limits are higher by this share of the friction
  // that the prior expects of the joint at its speed: 0.4 covers friction of 0.6 to 1.4 times the old one. No alarm that a
  // push beyond that would raise is held back. false, and nothing changed: no memory, no friction in the prior, or a share
  // outside 0 to 2. reset() and restore_state() end it.
  bool start_refit(double friction_share = kRefitFrictionShare) noexcept;
  // So much motion is kept.
  bool refit_full() const noexcept;
  // Limits are the usual ones again. What was kept stays until the next start, so that another thread can give it to refit()
  // while the loop continues.
  RecordingView finish_refit() noexcept;
  // What is kept.
  RecordingView refit_motion() const noexcept;

  // --- State.

  // As newly made.
  void reset() noexcept;
  // Size of the whole state, to go on in another monitor of the same bundle, rate, build and kind of processor.
  std::size_t state_bytes() const noexcept;
  // false, and nothing changed, where the size is wrong or, in restore(), the bytes are of another monitor or damaged.
  bool save_state(std::span<std::byte> state) const noexcept;
  bool restore_state(std::span<const std::byte> state) noexcept;

  // --- What it is, and how far.

  int joints() const noexcept { return last().joints; }  // how many
  // Of the bundle, in the order of q, dq and tau. Throws std::out_of_range where there is no such joint.
  const std::string& joint_name(int joint) const;
  // The bundle's units: of the tau to be given, and of the torques in the answer. Throw std::out_of_range, too.
  const std::string& torque_unit(int joint) const;
  const std::string& estimate_unit(int joint) const;
  std::int64_t sample_period_ns() const noexcept;  // of the bundle
  // Counted since it was made or reset: samples that went on the chain, ticks of the clock that were bridged, restarts.
  std::uint64_t samples() const noexcept;
  std::uint64_t bridged_ticks() const noexcept;  // without a sample of their own
  std::uint64_t restarts() const noexcept;       // after the first start

 private:
  struct Chain;
  std::unique_ptr<Chain> chain_;
  const Estimate* last_;  // of the chain
};

}  // namespace tauext
