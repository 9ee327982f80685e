// Runs a bundle in a control loop: one sample in; external torque, alarm and health out.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "tauext/bundle.hpp"
#include "tauext/declared_contact.hpp"
#include "tauext/estimate.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/servo_input.hpp"
#include "tauext/settings.hpp"
#include "tauext/wrench.hpp"

namespace tauext {

// Runs a bundle sample by sample in a control loop. step() is estimate(), which takes one to four microseconds for
// seven joints, followed by advance(), which prepares the next sample. A hard real-time loop sends its command
// between the two. After construction, a call allocates, locks, logs and throws nothing and makes no system call,
// unless its comment states otherwise. Use each monitor from one thread at a time.
class Monitor {
 public:
  // Throws Error if the bundle is inconsistent.
  explicit Monitor(const Bundle& bundle, NetworkRate rate = NetworkRate::every_sample);
  Monitor(Monitor&&) noexcept;
  Monitor& operator=(Monitor&&) noexcept;
  ~Monitor();

  // --- Samples and estimates.

  // estimate() followed by advance().
  const Estimate& step(const Sample& sample) noexcept {
    estimate(sample);
    advance();
    return last();
  }
  // Returns the estimate for this sample. Faulty samples are reported in health and never skipped. After a fault the
  // chain restarts with the next good sample, and health is warming_up until observer and window are full. A raised
  // alarm persists throughout.
  const Estimate& estimate(const Sample& sample) noexcept;
  // Does the work that can wait until the command is out. If the call is omitted, the next estimate() does this work
  // first.
  void advance() noexcept;
  // Reports that the loop ran without a sample. Health is stale for up to a network period (below 300 Hz: three
  // samples), then a fault.
  const Estimate& no_sample(std::int64_t now_ns) noexcept;
  // Returns the last estimate: the object that estimate() returned, which the next call overwrites.
  const Estimate& last() const noexcept { return *last_; }
  // Sets the joint temperatures [degC] from the next sample on, for loops whose samples contain none. NaN: unknown, the
  // last known value remains in effect. Returns false and changes nothing unless there is one value per joint.
  bool set_temperature(std::span<const double> celsius) noexcept;

  // --- Alarm and thresholds.

  // Ends a latched alarm and does nothing else. If the cause persists, the alarm rises again.
  void acknowledge() noexcept;
  // Ends a latched alarm of an arm that nothing touches any more and that is about to move on. A push changes the
  // static friction of a resting joint; the joint's position determines the new level only roughly. The state of joints
  // near stiction is therefore discarded, as at the start. With a prior, their thresholds rise at once by the friction that
  // could hide, until the joints have slid.
  void resume() noexcept;
  // Multiplies the bundle's thresholds by these factors from the next sample on: one per joint, each 0.1 to 10. Returns
  // false and changes nothing for other values. Drift learning does not depend on the factors. The calibrated false
  // alarm rate holds for factors from 1 on.
  bool set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept;
  const LimitFactors& limit_factors() const noexcept;  // factors in effect

  // --- Payloads: set, expected from a gripper, identified.

  // Sets what the arm carries from the next sample on, in the axes of load_settings().frame; mass 0: nothing. r
  // continues from its value. With since_ns, in sample time, r, prior and drift become what they would be if the payload
  // had been set then: r and prior exactly within the last 10/K0 (8192 samples at most), and with all but e^-10 of the
  // payload's torques for earlier times; drift to a second, within the last minute. restore_state() and every restart of
  // the chain discard the past samples that this needs. Thresholds rise by error_share of the payload's torques. Returns false
  // and changes nothing if the payload is refused. Takes at most one or two microseconds per sample since since_ns.
  bool set_load(const Load& load, std::int64_t since_ns = kFromNow) noexcept;
  // Removes the payload. Returns true and does nothing if the bundle accepts no payloads.
  bool clear_load(std::int64_t since_ns = kFromNow) noexcept { return !load_settings().settable() || set_load({}, since_ns); }
  const Load& load() const noexcept;  // payload in effect
  // Frame of the payload, and bounds on payloads.
  const LoadSettings& load_settings() const noexcept;
  // Reason for which set_load() would refuse this load.
  LoadFault load_fault(const Load& load, std::int64_t since_ns = kFromNow) const noexcept;
  // The same as a sentence; empty: the payload is accepted. Allocates: not for the loop.
  std::string why_no_load(const Load& load, std::int64_t since_ns = kFromNow) const {
    return load_settings().words(load_fault(load, since_ns), load);
  }

  // Announces that the gripper closes or opens: for `seconds` (at most 60) from the next sample on, the arm may come to
  // carry up to at_most_kg in all. A torque step that fits such a payload raises no alarm; the payload is identified, set and
  // reported (Estimate's load_phase, load_found_ns, load_error_kg). A step that does not fit raises the usual alarm. A
  // held-back step that does not become a payload raises the alarm about half a second after it has settled. Meanwhile
  // drift does not learn, and a sample takes about two microseconds longer. set_load(), clear_load() and reset() end
  // the expectation. Returns false and changes nothing if why_not_expected() returns a reason.
  bool expect_load(double seconds, double at_most_kg) noexcept;
  // Reason for which expect_load() would refuse; empty: none. Allocates: not for the loop.
  std::string why_not_expected(double seconds, double at_most_kg) const;
  // Starts to identify what the arm carries beside the payload that is set. From 10/K0 after the next sample on, advance()
  // sums healthy samples, one per network period. Drift does not learn until stop_weighing(), since it would absorb the
  // load. A second call and every set_load() restart the sums; reset() and restore_state() end weighing. reach_m:
  // largest distance of the centre of mass from the origin of the load frame. Returns false and changes nothing if
  // why_no_weighing() returns a reason or reach_m is not above 0.
  bool start_weighing(double reach_m = kUsualReach_m) noexcept;
  // Ends weighing. estimate_load() still returns the result until the next start.
  void stop_weighing() noexcept;
  bool can_weigh() const noexcept;  // start_weighing() accepts any reach above 0
  bool weighing() const noexcept;
  // Result of the sums so far, see LoadFound. Takes as long as about fifty samples (60 us for six joints on a desktop)
  // and changes nothing. A contact while weighing is not removed; the verdict is then not `load`.
  LoadFound estimate_load() const noexcept;
  // Reason for which start_weighing() would refuse; empty: none. Allocates: not for the loop.
  std::string why_no_weighing() const;

  // --- Contacts that the task means.

  // Declares a contact for `seconds` from the next sample on (kAlways_s: until end_contact()): the alarm uses only the part of
  // tau_ext that no force and moment within its bounds explains (Estimate's declared_*), and thresholds rise by the error of what is
  // explained. A force beyond the bounds is Declared::beyond; what is beyond them stays in the alarm. Meanwhile drift, weighing and
  // a refit learn nothing. The contact stays in effect for 5/K0 afterwards, since r still contains it. Of several contacts at
  // frames the last one counts, while no payload is expected; contacts of joints count beside it. A sample takes about two
  // microseconds longer. Returns the contact's number, or -1 and changes nothing if contact_fault() gives a reason.
  int expect_contact(const DeclaredContact& contact, double seconds) noexcept;
  // Ends an expected contact at once; false: there is none of this number.
  bool end_contact(int which) noexcept;
  // The expected contact of this number; null: none.
  const DeclaredContact* declared_contact(int which) const noexcept;
  // Reason for which expect_contact() would refuse.
  ContactFault contact_fault(const DeclaredContact& contact, double seconds) const noexcept;
  // The same as a sentence; empty: the contact is accepted. Allocates: not for the loop.
  std::string why_no_contact(const DeclaredContact& contact, double seconds) const;
  // What is not monitored while it is in effect, as a sentence; empty: nothing. Allocates: not for the loop.
  std::string unmonitored(const DeclaredContact& contact) const;
  // The force that acts on the tool, with covariance and its parts by cause: at the expected contact in effect, else at the load
  // frame. Along the declared line only, if it is one; a moment only if one is declared. Takes microseconds and changes nothing.
  ToolForce tool_force(WrenchAxes axes = WrenchAxes::base) const noexcept;

  // --- Forces and moments.

  // Force and moment that the environment exerts on the arm at a frame, at the last sample, with their covariance, see
  // Wrench. While a payload is expected, its part load_nm is excluded. Unknown while health is neither ok nor stale, and
  // after restore_state() until the next sample. Takes microseconds and changes nothing.
  Wrench wrench(int frame, WrenchAxes axes = WrenchAxes::base) const noexcept;
  // Estimates a force without a moment that acts at a known point of the frame, [m] along the frame's own axes.
  Wrench force(int frame, const std::array<double, 3>& point, WrenchAxes axes = WrenchAxes::base) const noexcept;
  // Model with the frames by name; refused() is the reason if there is no wrench.
  const WrenchModel& wrench_model() const noexcept;
  std::string why_no_wrench() const { return wrench_model().refused(); }

  // --- Motion for a refit.

  static constexpr double kRefitFrictionShare = 0.4;  // default of start_refit()
  // Reserves memory for `seconds` of samples for a refit (refit.hpp). Allocates: call it before the loop. Throws Error
  // unless the time is above 0 and at most 600 s.
  void reserve_refit(double seconds);
  // Stores motion from the next sample on until the memory is full. Meanwhile, thresholds are higher by friction_share of
  // the friction that the prior expects of the joint at its speed: 0.4 covers friction of 0.6 to 1.4 times the old one.
  // A push beyond these thresholds still raises an alarm. Returns false and changes nothing without reserved memory,
  // without friction in the prior, or for a share outside 0 to 2. reset() and restore_state() end it.
  bool start_refit(double friction_share = kRefitFrictionShare) noexcept;
  // Whether the reserved memory is full.
  bool refit_full() const noexcept;
  // Restores the usual thresholds. The stored motion remains until the next start, so that another thread can pass it to
  // refit() while the loop continues.
  RecordingView finish_refit() noexcept;
  // The motion stored so far.
  RecordingView refit_motion() const noexcept;

  // --- State.

  // Returns to the state of a new monitor.
  void reset() noexcept;
  // Size of the whole state, for another monitor of the same bundle, network rate, build and type of processor.
  std::size_t state_bytes() const noexcept;
  // Copy the state. Both return false and change nothing if the size is wrong; restore_state() also if the bytes are
  // damaged or belong to another monitor.
  bool save_state(std::span<std::byte> state) const noexcept;
  bool restore_state(std::span<const std::byte> state) noexcept;

  // Carry to a monitor of another bundle for the same arm, in a loop that exchanges its bundle without a gap: make the
  // new monitor, carry(), pass it the samples since then, then carry_alarm() what the old one holds by now. Size of what
  // is carried: the same for all bundles of a build.
  static std::size_t carried_bytes() noexcept;
  // Copies what can be carried; call it between advance() and the next sample. Returns false if the size is wrong.
  bool save_carried(std::span<std::byte> carried) const noexcept;
  // Continues from threshold factors, payload and, if both bundles have the same model_digest(), learned drift: a new prior has
  // learned what the old drift made up for. Call it before the first sample. Returns false and changes nothing if the
  // bytes are damaged or of another build or number of joints, or the bundle refuses the payload.
  bool carry(std::span<const std::byte> carried) noexcept;
  // Continues the alarm: its number, level, joint, time and kind of touch, and the joints pushed while stuck. An alarm that this
  // monitor raised itself ends. Returns false and changes nothing if the bytes are damaged or of another build or number
  // of joints.
  bool carry_alarm(std::span<const std::byte> carried) noexcept;
  // Numbers the next alarm by one more than this, so that numbers continue over a restart.
  void count_alarms_from(std::uint32_t number) noexcept;

  // --- Properties and counters.

  int joints() const noexcept { return last().joints; }  // number of joints
  // Joint name, in the order of q, dq and tau. Throws std::out_of_range for an unknown joint.
  const std::string& joint_name(int joint) const;
  // Units of the input tau and of the estimated torques. Both throw std::out_of_range for an unknown joint.
  const std::string& torque_unit(int joint) const;
  const std::string& estimate_unit(int joint) const;
  std::int64_t sample_period_ns() const noexcept;  // of the bundle, [ns]
  // Counted since construction or reset().
  std::uint64_t samples() const noexcept;  // samples that entered the chain
  std::uint64_t bridged_ticks() const noexcept;  // ticks of the regular clock without a sample of their own
  std::uint64_t restarts() const noexcept;       // restarts of the chain after its first start
  // Restarts because the stamps jumped: they went back, stood still for 100 samples, or a gap exceeded 10 s. Times from before do
  // not count in the new clock, so everything with a time ends: expected contacts with a time, an expected payload (an alarm that was
  // held back for it is raised), weighing, and the motion of a refit. Ask for it again.
  std::uint64_t clock_jumps() const noexcept;

 private:
  struct Chain;
  std::unique_ptr<Chain> chain_;
  const Estimate* last_;  // owned by the chain
};

}  // namespace tauext
