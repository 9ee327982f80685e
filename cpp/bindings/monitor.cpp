// The monitor and its flight recorder in Python: the same objects as a controller's.
#include "tauext/monitor.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <optional>

#include "arrays.hpp"
#include "tauext/flight_recorder.hpp"

namespace tauext::bindings {
namespace {

std::vector<std::string> cause_names(std::uint32_t causes) {
  std::vector<std::string> names;
  for (std::uint32_t k = 0; k < kCauseCount; ++k)
    if (causes >> k & 1) names.emplace_back(name(static_cast<Cause>(1u << k)));
  return names;
}

using Temperature = std::optional<Array<double, 1>>;

Sample sample_of(std::int64_t t_ns, const Array<double, 1>& q, const Array<double, 1>& dq, const Array<double, 1>& tau,
                 const Temperature& temperature) {
  Sample sample{t_ns, span_of(q), span_of(dq), span_of(tau)};
  if (temperature) sample.temperature = span_of(*temperature);
  return sample;
}

std::vector<std::uint8_t> bits(const std::vector<std::uint32_t>& words, std::size_t joints) {
  std::vector<std::uint8_t> out;
  for (std::uint32_t word : words)
    for (std::size_t j = 0; j < joints; ++j) out.push_back(word >> j & 1);
  return out;
}

std::vector<bool> joint_bits(std::uint32_t word, int joints) {
  std::vector<bool> out;
  for (int j = 0; j < joints; ++j) out.push_back(word >> j & 1);
  return out;
}

std::vector<std::string> units(const Monitor& monitor, const std::string& (Monitor::*unit)(int) const) {
  std::vector<std::string> out;
  for (int j = 0; j < monitor.joints(); ++j) out.push_back((monitor.*unit)(j));
  return out;
}

// The monitor's estimates, sample after sample, as columns.
class Columns {
 public:
  Columns(std::size_t samples, std::size_t joints) : joints_(joints) {
    for (auto& torque : torques_) torque.reserve(samples * joints);
  }
  void add(const Estimate& e) {
    for (std::size_t which = 0; which < kTorques.size(); ++which) {
      const double* values = (e.*kTorques[which].values).data();
      torques_[which].insert(torques_[which].end(), values, values + joints_);
    }
    near_stiction_.push_back(e.near_stiction);
    drift_saturated_.push_back(e.drift_saturated);
    unfamiliar_.push_back(e.unfamiliar);
    unseen_.push_back(static_cast<std::uint8_t>(e.unseen));
    unseen_joint_.push_back(static_cast<std::int8_t>(e.unseen_joint));
    unseen_other_.push_back(static_cast<std::int8_t>(e.unseen_other));
    health_.push_back(static_cast<std::uint8_t>(e.health));
    causes_.push_back(e.causes);
    cause_joint_.push_back(static_cast<std::int8_t>(e.cause_joint));
    alarm_.push_back(static_cast<std::uint8_t>(e.alarm));
    held_alarm_.push_back(static_cast<std::uint8_t>(e.held_alarm));
    touch_.push_back(static_cast<std::uint8_t>(e.touch));
    alarm_joint_.push_back(static_cast<std::int8_t>(e.alarm_joint));
    detection_.push_back(e.detection);
    load_kg_.push_back(e.load.mass);
    load_error_kg_.push_back(e.load_error_kg);
    load_phase_.push_back(static_cast<std::uint8_t>(e.load_phase));
    load_found_ns_.push_back(e.load_found_ns);
  }
  ArrayDict take() {
    const std::size_t N = health_.size(), n = joints_;
    ArrayDict out;
    for (std::size_t which = 0; which < kTorques.size(); ++which)
      out[kTorques[which].name] = to_numpy(std::move(torques_[which]), {N, n});
    out["near_stiction"] = to_numpy(bits(near_stiction_, n), {N, n});
    out["drift_saturated"] = to_numpy(bits(drift_saturated_, n), {N, n});
    out["unfamiliar"] = to_numpy(std::move(unfamiliar_), {N});
    out["unseen"] = to_numpy(std::move(unseen_), {N});
    out["unseen_joint"] = to_numpy(std::move(unseen_joint_), {N});
    out["unseen_other"] = to_numpy(std::move(unseen_other_), {N});
    out["health"] = to_numpy(std::move(health_), {N});
    out["causes"] = to_numpy(std::move(causes_), {N});
    out["cause_joint"] = to_numpy(std::move(cause_joint_), {N});
    out["alarm"] = to_numpy(std::move(alarm_), {N});
    out["held_alarm"] = to_numpy(std::move(held_alarm_), {N});
    out["touch"] = to_numpy(std::move(touch_), {N});
    out["alarm_joint"] = to_numpy(std::move(alarm_joint_), {N});
    out["detection"] = to_numpy(std::move(detection_), {N});
    out["load_kg"] = to_numpy(std::move(load_kg_), {N});
    out["load_error_kg"] = to_numpy(std::move(load_error_kg_), {N});
    out["load_phase"] = to_numpy(std::move(load_phase_), {N});
    out["load_found_ns"] = to_numpy(std::move(load_found_ns_), {N});
    return out;
  }

 private:
  struct Torque {
    const char* name;
    JointVector Estimate::*values;
  };
  static constexpr std::array<Torque, 14> kTorques{{{"residual", &Estimate::residual},
                                                   {"prior", &Estimate::prior},
                                                   {"network", &Estimate::network},
                                                   {"drift", &Estimate::drift},
                                                   {"uncertainty", &Estimate::uncertainty},
                                                   {"tau_ext", &Estimate::tau_ext},
                                                   {"doubt", &Estimate::doubt},
                                                   {"sigma_nm", &Estimate::sigma_nm},
                                                   {"contact_sigma_nm", &Estimate::contact_sigma_nm},
                                                   {"limit_scale", &Estimate::limit_scale},
                                                   {"limit_nm", &Estimate::limit_nm},
                                                   {"contact_limit_nm", &Estimate::contact_limit_nm},
                                                   {"margin_nm", &Estimate::margin_nm},
                                                   {"load_nm", &Estimate::load_nm}}};
  std::size_t joints_;
  std::array<std::vector<double>, kTorques.size()> torques_;
  std::vector<std::uint32_t> near_stiction_, drift_saturated_, causes_;
  std::vector<double> unfamiliar_, load_kg_, load_error_kg_;
  std::vector<std::int64_t> load_found_ns_;
  std::vector<std::uint8_t> health_, alarm_, held_alarm_, touch_, detection_, unseen_, load_phase_;
  std::vector<std::int8_t> alarm_joint_, cause_joint_, unseen_joint_, unseen_other_;
};

// step() for many samples; signals in rows of n joints.
ArrayDict run(Monitor& monitor, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
              const Array<double, 2>& tau, FlightRecorder* recorder, const Temperatures& temperature) {
  const RecordingView r = view(t_ns, q, dq, tau, temperature);
  if (r.joints != monitor.joints())
    throw Error("the monitor has " + std::to_string(monitor.joints()) + " joints, the samples " + std::to_string(r.joints));
  const auto N = static_cast<std::size_t>(r.samples), n = static_cast<std::size_t>(r.joints);
  Columns said(N, n);
  {
    nb::gil_scoped_release released;
    for (std::size_t k = 0; k < N; ++k) {
      const Sample sample = r.at(static_cast<std::int64_t>(k));
      const Estimate& e = monitor.step(sample);
      if (recorder) recorder->push(sample, e);
      said.add(e);
    }
  }
  return said.take();
}

// no_sample(); the recorder keeps a row of NaN.
ArrayDict run_missing(Monitor& monitor, std::int64_t now_ns, FlightRecorder* recorder) {
  Columns said(1, static_cast<std::size_t>(monitor.joints()));
  const Estimate& e = monitor.no_sample(now_ns);
  if (recorder) recorder->push({now_ns, {}, {}, {}}, e);
  said.add(e);
  return said.take();
}

// A value in the samples' time, or from now on.
std::int64_t since(const std::optional<std::int64_t>& since_ns) { return since_ns.value_or(kFromNow); }

void set_load(Monitor& self, const Load& load, std::int64_t since_ns) {
  if (!self.set_load(load, since_ns)) throw Error(self.why_no_load(load, since_ns));
}

// Mass, centre of mass and inertia of every sample, (samples, 10).
std::vector<double> load_rows(const std::vector<Load>& loads) {
  std::vector<double> rows;
  for (const Load& load : loads) {
    rows.push_back(load.mass);
    rows.insert(rows.end(), load.com.begin(), load.com.end());
    rows.insert(rows.end(), load.inertia.begin(), load.inertia.end());
  }
  return rows;
}

using FlightDict = nb::typed<nb::dict, nb::str, nb::any>;

std::optional<FlightDict> take(FlightRecorder& recorder, std::size_t n) {
  Flight f;
  {
    nb::gil_scoped_release released;
    if (!recorder.take(f)) return std::nullopt;
  }
  const std::size_t N = f.t_ns.size();
  FlightDict out;
  out["event_row"] = f.event_row;
  out["event"] = f.event;
  out["near_stiction"] = to_numpy(bits(f.near_stiction, n), {N, n});
  out["load"] = to_numpy(load_rows(f.load), {N, 10});
  out["t_ns"] = to_numpy(std::move(f.t_ns), {N});
  out["q"] = to_numpy(std::move(f.q), {N, n});
  out["dq"] = to_numpy(std::move(f.dq), {N, n});
  out["tau"] = to_numpy(std::move(f.tau), {N, n});
  out["residual"] = to_numpy(std::move(f.residual), {N, n});
  out["prior"] = to_numpy(std::move(f.prior), {N, n});
  out["network"] = to_numpy(std::move(f.network), {N, n});
  out["drift"] = to_numpy(std::move(f.drift), {N, n});
  out["tau_ext"] = to_numpy(std::move(f.tau_ext), {N, n});
  out["load_nm"] = to_numpy(std::move(f.load_nm), {N, n});
  out["sigma_nm"] = to_numpy(std::move(f.sigma_nm), {N, n});
  out["contact_sigma_nm"] = to_numpy(std::move(f.contact_sigma_nm), {N, n});
  out["limit_nm"] = to_numpy(std::move(f.limit_nm), {N, n});
  out["contact_limit_nm"] = to_numpy(std::move(f.contact_limit_nm), {N, n});
  out["causes"] = to_numpy(std::move(f.causes), {N});
  out["health"] = to_numpy(std::move(f.health), {N});
  out["alarm"] = to_numpy(std::move(f.alarm), {N});
  out["held_alarm"] = to_numpy(std::move(f.held_alarm), {N});
  out["touch"] = to_numpy(std::move(f.touch), {N});
  out["detection"] = to_numpy(std::move(f.detection), {N});
  return out;
}

void bind_estimate(nb::module_& m) {
  nb::enum_<Alarm>(m, "Alarm",
                   "Levels of an alarm. contact: over the contact limit for its hold time; it falls back by itself.\n"
                   "collision: over the collision limit for its hold time; it stays until acknowledged.")
      .value("none", Alarm::none)
      .value("contact", Alarm::contact)
      .value("collision", Alarm::collision);
  nb::enum_<Touch>(m, "Touch", "What kind of touch an alarm is.")
      .value("none", Touch::none, "No alarm stands.")
      .value("unknown", Touch::unknown, "Not decided yet, or none of the others.")
      .value("impact", Touch::impact, "It came and went within a bounce.")
      .value("push", Touch::push, "It yields.")
      .value("clamp", Touch::clamp, "It does not: the torque grows as the arm goes on, or on and on while it stands.")
      .value("load", Touch::load, "A weight at the load frame.");
  nb::enum_<LoadPhase>(m, "LoadPhase", "How far the monitor is with a load that is expected.")
      .value("none", LoadPhase::none, "Nothing is expected.")
      .value("expecting", LoadPhase::expecting, "Nothing has shown yet.")
      .value("deciding", LoadPhase::deciding, "An alarm is held back: what shows fits a load.")
      .value("found", LoadPhase::found, "One was set; more of it is taken until the window ends.")
      .value("weighing", LoadPhase::weighing, "The window is over and nothing is held back; the load is weighed on.");
  nb::enum_<Health>(m, "Health",
                    "Whether the torques of an answer can be trusted. warming_up: there are none yet. stale: nothing new for\n"
                    "as long as the clock bridges (a network period, or three samples\n"
                    "below 300 Hz), and those of the sample before are held. fault: the signals cannot be used,\n"
                    "and `causes` contains the reasons.")
      .value("warming_up", Health::warming_up)
      .value("ok", Health::ok)
      .value("stale", Health::stale)
      .value("fault", Health::fault);
  m.def("cause_names", &cause_names, nb::arg("causes"),
        "Names of the bits of `causes`, as Monitor.run() and Estimates have them: why health is not ok.");
  nb::class_<Estimate> estimate(m, "Estimate", "The monitor's estimate at one sample; torques that do not exist are NaN.");
  estimate.def_ro("t_ns", &Estimate::t_ns, "Stamp of the sample, [ns].")
      .def_ro("health", &Estimate::health,
              "Whether the torques can be trusted. warming_up: there are none yet, and tau_ext is NaN, for about a second\n"
              "after the start and after whatever `causes` names.")
      .def_prop_ro("causes", [](const Estimate& e) { return cause_names(e.causes); },
                   "Why health is not ok, or was not when the warm-up began, in words.")
      .def_ro("cause_joint", &Estimate::cause_joint, "Index of the first joint that a cause concerns; -1: none.")
      .def_ro("alarm", &Estimate::alarm, "The latched alarm: a collision stays until acknowledge() or resume().")
      .def_ro("held_alarm", &Estimate::held_alarm, "The level that some joint is over at this sample, its hold time past; no latch.")
      .def_ro("alarm_joint", &Estimate::alarm_joint, "Index of the joint that raised the alarm to its level; -1: no alarm.")
      .def_ro("alarm_t_ns", &Estimate::alarm_t_ns, "Stamp of the sample at which it did, [ns].")
      .def_ro("touch", &Estimate::touch,
              "What kind of touch the alarm is, as known after the sample before this one; updated as it goes on.")
      .def_ro("detection", &Estimate::detection,
              "Some |tau_ext| is over its collision limit at this sample; no hold time.")
      .def_prop_ro("clear", &Estimate::clear, "Healthy and no alarm: the only thing that means no collision.")
      .def_prop_ro("near_stiction", [](const Estimate& e) { return joint_bits(e.near_stiction, e.joints); },
                   "Whether each joint sticks or creeps, so that its limit near stiction holds.")
      .def_prop_ro("drift_saturated", [](const Estimate& e) { return joint_bits(e.drift_saturated, e.joints); },
                   "Whether each joint's drift is at its bound: the arm has changed and must be retrained.")
      .def_ro("unfamiliar", &Estimate::unfamiliar, "Distance of the motion from all training motion, 0 to 1.")
      .def_ro("unseen", &Estimate::unseen, "What of the motion is farthest from it: of unseen_joint, with unseen_other.")
      .def_ro("load", &Estimate::load, "What the arm is taken to carry; mass 0: nothing.")
      .def_ro("load_phase", &Estimate::load_phase, "Of a load that is expected.")
      .def_ro("load_found_ns", &Estimate::load_found_ns,
              "Stamp of the sample at which the last one that was expected was found, [ns]; 0: none.")
      .def_ro("load_error_kg", &Estimate::load_error_kg, "Standard error of its mass.")
      .def_ro("unseen_joint", &Estimate::unseen_joint, "Index of the joint whose motion is; -1: none.")
      .def_ro("unseen_other", &Estimate::unseen_other,
              "Index of the joint whose position never occurred in training together with that of unseen_joint; -1: none.");
  const auto bind_torques = [&](const char* torque, JointVector Estimate::*values, const char* doc) {
    estimate.def_prop_ro(
        torque,
        [values](const Estimate& e) {
          return std::vector<double>((e.*values).begin(), (e.*values).begin() + e.joints);
        },
        doc);
  };
  bind_torques("residual", &Estimate::residual, "r of the observer, [N m], a joint: dr/dt = K0 (tau_dist - r).");
  bind_torques("prior", &Estimate::prior,
               "What physics, fitted to the data, expects of r in free motion, [N m]; 0 without a prior.");
  bind_torques("network", &Estimate::network, "What the network expects of r beside the prior, [N m]; 0 without one.");
  bind_torques("load_nm", &Estimate::load_nm,
               "Part of tau_ext that is attributed to an expected load, [N m]; the alarm uses the rest. 0 while none"
               " is expected.");
  bind_torques("drift", &Estimate::drift,
               "What slow changes since training add to r, as the tracker has learned it, [N m]; 0 without one.");
  bind_torques("uncertainty", &Estimate::uncertainty,
               "The r that is expected in free motion: prior + network + drift, [N m].");
  bind_torques("tau_ext", &Estimate::tau_ext,
               "External torque, residual - uncertainty, [N m]: positive where the environment pushes the joint in its\n"
               "positive direction.");
  bind_torques("doubt", &Estimate::doubt,
               "How far the prior may be off while presliding states are unknown, [N m]; limits include it.");
  bind_torques("sigma_nm", &Estimate::sigma_nm,
               "Standard error of tau_ext in free motion as currently estimated, doubt included, [N m]; NaN without an\n"
               "error scale.");
  bind_torques("contact_sigma_nm", &Estimate::contact_sigma_nm,
               "Standard error of tau_ext, [N m], also while something touches the arm and after it: friction that a\n"
               "resting joint hides, gear friction under load and the observer's lag included. Equal to sigma_nm in free\n"
               "motion. For reports: limits use sigma_nm.");
  bind_torques("limit_scale", &Estimate::limit_scale, "What the motion multiplies the limits by; 1 in usual motion.");
  bind_torques("limit_nm", &Estimate::limit_nm,
               "What |tau_ext| must exceed for a collision at this sample, [N m]; scale and doubt included.");
  bind_torques("contact_limit_nm", &Estimate::contact_limit_nm, "The same for a contact.");
  bind_torques("margin_nm", &Estimate::margin_nm, "limit_nm - |tau_ext|: what is left, [N m]; negative at a detection.");
}

}  // namespace

void bind_monitor(nb::module_& m) {
  bind_estimate(m);
  struct Recorder : FlightRecorder {  // remembers how many joints it has
    std::size_t joints;
    Recorder(int n, std::int64_t period_ns, const FlightSettings& s)
        : FlightRecorder(n, period_ns, s), joints(static_cast<std::size_t>(n)) {}
  };
  nb::class_<Recorder>(m, "FlightRecorder", "The last seconds before an alarm or fault, for another thread to take.")
      .def(
          "__init__",
          [](Recorder* r, int joints, std::int64_t sample_period_ns, double before_s, double after_s, bool contacts) {
            new (r) Recorder(joints, sample_period_ns, {before_s, after_s, contacts});
          },
          nb::arg("joints"), nb::arg("sample_period_ns"), nb::arg("before_s") = 5.0, nb::arg("after_s") = 1.0,
          nb::arg("contacts") = false)
      .def("finish", [](Recorder& r) { return r.finish(); },
           "At the end: let an event go that still waits for what comes after it. False: the flight before must be taken\n"
           "first; call it again then.")
      .def("take", [](Recorder& r) { return take(r, r.joints); }, "A flight as arrays, oldest row first, or None.")
      .def_prop_ro("events", [](const Recorder& r) { return r.events(); },
                   "Events so far, those within another one's flight among them.")
      .def_prop_ro("missed", [](const Recorder& r) { return r.missed(); },
                   "Flights that were given up, since the one before was not taken in time.");

  using Signal = const Array<double, 1>&;
  nb::class_<Monitor>(m, "Monitor", "The chain inside a control loop: one sample in, torque, alarm and health out.")
      .def(
          "__init__",
          [](Monitor* monitor, const Bundle& bundle, bool own_rate) {
            new (monitor) Monitor(bundle, own_rate ? NetworkRate::network_period : NetworkRate::every_sample);
          },
          nb::arg("bundle"), nb::arg("own_rate") = false)
      .def(
          "step",
          [](Monitor& self, std::int64_t t_ns, Signal q, Signal dq, Signal tau, const Temperature& temperature) {
            return self.step(sample_of(t_ns, q, dq, tau, temperature));
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("temperature") = nb::none(),
          "estimate() and advance(). temperature: of the joints, [degC], where it is known; NaN where not.")
      .def(
          "estimate",
          [](Monitor& self, std::int64_t t_ns, Signal q, Signal dq, Signal tau, const Temperature& temperature) {
            return self.estimate(sample_of(t_ns, q, dq, tau, temperature));
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("temperature") = nb::none(),
          "The answer; advance() may follow later.")
      .def("advance", &Monitor::advance,
           "What need not be done before the answer is out; estimate() does it first where it was left out.")
      .def("no_sample", [](Monitor& self, std::int64_t now_ns) { return self.no_sample(now_ns); }, nb::arg("now_ns"),
           "The loop ran and no sample came: stale for as long as missing samples are bridged, then a fault.")
      .def("acknowledge", &Monitor::acknowledge, "End a latched alarm, and nothing else.")
      .def("resume", &Monitor::resume,
           "End a latched alarm where nothing touches the arm any more and it is to move on: the static friction of\n"
           "joints near stiction is unknown again, and with a prior raises their limits until they have slid.")
      .def(
          "set_limit_factors",
          [](Monitor& self, Signal collision, Signal contact) {
            if (!self.set_limit_factors(span_of(collision), span_of(contact)))
              throw Error("limit factors must be " + std::to_string(self.joints()) + " numbers each for collision and " +
                          "contact, one a joint, from " + to_text(LimitFactors::kLowest) + " to " +
                          to_text(LimitFactors::kHighest));
          },
          nb::arg("collision"), nb::arg("contact"), "Limits are the bundle's times these from the next sample on.")
      .def(
          "set_load",
          [](Monitor& self, double mass, const std::array<double, 3>& com, const std::array<double, 6>& inertia,
             const std::optional<std::int64_t>& since_ns, double error_share) {
            set_load(self, {mass, com, inertia, error_share}, since(since_ns));
          },
          nb::arg("mass"), nb::arg("com") = std::array<double, 3>{}, nb::arg("inertia") = std::array<double, 6>{},
          nb::kw_only(), nb::arg("since_ns") = nb::none(), nb::arg("error_share") = Load::kUsualError,
          "What the arm carries from the next sample on, or as if it had been set at since_ns: mass [kg], centre of\n"
          "mass [m] in load_settings.frame, inertia about it xx, yy, zz, xy, xz, yz [kg m^2]. Limits rise by error_share\n"
          "of its torques. Raises CoreError, and changes nothing, where it is refused.")
      .def("clear_load", [](Monitor& self, const std::optional<std::int64_t>& since_ns) {
             if (self.load_settings().settable()) set_load(self, {}, since(since_ns));
           },
           nb::arg("since_ns") = nb::none(), "The arm carries nothing.")
      .def(
          "expect_load",
          [](Monitor& self, double seconds, double at_most_kg) {
            if (!self.expect_load(seconds, at_most_kg)) throw Error(self.why_not_expected(seconds, at_most_kg));
          },
          nb::arg("seconds"), nb::arg("at_most_kg"),
          "The gripper closes or opens: for so long, what the arm carries may become anything up to at_most_kg in all. What\n"
          "fits that is weighed, set and reported, what does not is the usual alarm. Raises CoreError, and changes nothing,\n"
          "where it is refused.")
      .def("why_not_expected", &Monitor::why_not_expected, nb::arg("seconds"), nb::arg("at_most_kg"),
           "Why expect_load() would refuse it; empty: it would not.")
      .def_prop_ro("load", [](const Monitor& self) { return self.load(); },
                   "What the arm is taken to carry from the next sample on; mass 0: nothing.")
      .def_prop_ro("load_settings", [](const Monitor& self) { return self.load_settings(); },
                   "The frame that loads are given in, and the largest mass and reach that are accepted.")
      .def(
          "why_no_load",
          [](const Monitor& self, const Load& load, const std::optional<std::int64_t>& since_ns) {
            return self.why_no_load(load, since(since_ns));
          },
          nb::arg("load"), nb::arg("since_ns") = nb::none(), "Why set_load() would refuse it; empty: it would not.")
      .def(
          "set_temperature",
          [](Monitor& self, Signal celsius) {
            if (!self.set_temperature(span_of(celsius)))
              throw Error("temperatures must be " + std::to_string(self.joints()) + " numbers, one a joint");
          },
          nb::arg("celsius"), "Of the joints, [degC], NaN where it is not known, from the next sample on; it holds.")
      .def(
          "start_weighing",
          [](Monitor& self, double reach_m) {
            if (self.start_weighing(reach_m)) return;
            const std::string reason = self.why_no_weighing();
            throw Error(reason.empty() ? "the reach of a load = " + to_text(reach_m) + " m must be above 0" : reason);
          },
          nb::arg("reach_m") = kUsualReach_m,
          "Weigh what the arm carries beside the load that is set, from the next sample on; drift learns nothing meanwhile.\n"
          "reach_m: how far its centre of mass may be from the load frame.")
      .def("stop_weighing", &Monitor::stop_weighing, "What was found stays for estimate_load().")
      .def_prop_ro("weighing", &Monitor::weighing, "Whether it runs.")
      .def("estimate_load", &Monitor::estimate_load, "What was found so far; `load` of it is for set_load().")
      .def("why_no_weighing", &Monitor::why_no_weighing, "Why start_weighing() would refuse; empty: it would not.")
      .def(
          "wrench",
          [](const Monitor& self, const std::string& frame, WrenchAxes axes) {
            return self.wrench(frame_of(self.wrench_model(), frame), axes);
          },
          nb::arg("frame"), nb::arg("axes") = WrenchAxes::base,
          "Force and moment that the surroundings exert on the arm at a frame, at the last sample: a joint's link, the\n"
          "load's frame or one of the robot file's, by name; see wrench_frames.")
      .def(
          "force",
          [](const Monitor& self, const std::string& frame, const std::array<double, 3>& point, WrenchAxes axes) {
            return self.force(frame_of(self.wrench_model(), frame), point, axes);
          },
          nb::arg("frame"), nb::arg("point") = std::array<double, 3>{}, nb::arg("axes") = WrenchAxes::base,
          "Estimate of a force alone, that acts at this point of the frame, [m] along its own axes: better known.")
      .def_prop_ro(
          "wrench_frames",
          [](const Monitor& self) {
            std::vector<std::string> names;
            for (int k = 0; k < self.wrench_model().frames(); ++k) names.push_back(self.wrench_model().frame(k).name);
            return names;
          },
          "Names of frames that wrench() takes.")
      .def("why_no_wrench", &Monitor::why_no_wrench, "Why wrench() would refuse; empty: it would not.")
      .def("reset", &Monitor::reset, "As newly made.")
      .def("reserve_refit", &Monitor::reserve_refit, nb::arg("seconds") = 60.0,
           "Memory for so much motion, before the loop begins; what was kept is lost.")
      .def(
          "start_refit",
          [](Monitor& self, double friction_share) {
            if (!self.start_refit(friction_share))
              throw Error("a refit needs reserve_refit(), a prior that knows friction, and a friction_share of 0 to 2, not " +
                          to_text(friction_share));
          },
          nb::arg("friction_share") = Monitor::kRefitFrictionShare,
          "Keep motion from the next sample on, with limits higher by this share of the friction.")
      .def_prop_ro("refit_full", &Monitor::refit_full, "As much motion is kept as was reserved.")
      .def(
          "finish_refit",
          [](Monitor& self) {
            const RecordingView r = self.finish_refit();
            const auto N = static_cast<std::size_t>(r.samples), n = static_cast<std::size_t>(r.joints);
            const auto copy = [&](const double* from) { return to_numpy(std::vector(from, from + N * n), {N, n}); };
            ArrayDict out;
            out["t_ns"] = to_numpy(std::vector(r.t_ns, r.t_ns + N), {N});
            out["q"] = copy(r.q);
            out["dq"] = copy(r.dq);
            out["tau"] = copy(r.tau);
            return out;
          },
          "The usual limits again, and the motion that was kept: for tauext.refit_motion.")
      .def(
          "run",
          [](Monitor& self, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
             const Array<double, 2>& tau, Recorder* recorder, const Temperatures& temperature) {
            return run(self, t_ns, q, dq, tau, recorder, temperature);
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("recorder") = nb::none(),
          nb::arg("temperature") = nb::none(),
          "step() for every row; a dict of arrays.")
      .def(
          "run_missing",
          [](Monitor& self, std::int64_t now_ns, Recorder* recorder) { return run_missing(self, now_ns, recorder); },
          nb::arg("now_ns"), nb::arg("recorder") = nb::none(), "no_sample(), returned as run() returns a single row.")
      .def_prop_ro("last", [](const Monitor& self) { return self.last(); }, "The last answer.")
      .def_prop_ro("joints", &Monitor::joints, "How many joints a sample has.")
      .def_prop_ro("joint_names",
                   [](const Monitor& self) {
                     std::vector<std::string> names;
                     for (int j = 0; j < self.joints(); ++j) names.push_back(self.joint_name(j));
                     return names;
                   },
                   "Names of the joints, in the order of q, dq and tau.")
      .def_prop_ro("torque_units", [](const Monitor& self) { return units(self, &Monitor::torque_unit); },
                   "Unit of the tau that is to be given, a joint.")
      .def_prop_ro("estimate_units", [](const Monitor& self) { return units(self, &Monitor::estimate_unit); },
                   "Unit of the torques in the answers, a joint.")
      .def_prop_ro("sample_period_ns", &Monitor::sample_period_ns, "Sample period of the bundle, [ns].")
      .def_prop_ro("samples", &Monitor::samples, "Samples that went on the chain; those of faults did not.")
      .def_prop_ro("bridged_ticks", &Monitor::bridged_ticks,
                   "Ticks of the regular clock without a sample of their own, at which the one before was held.")
      .def_prop_ro("restarts", &Monitor::restarts, "How often the chain restarted after its first start.")
      .def("save_state",
           [](const Monitor& self) {
             std::vector<std::byte> state(self.state_bytes());
             self.save_state(state);
             return nb::bytes(reinterpret_cast<const char*>(state.data()), state.size());
           },
           "All that the monitor remembers, as bytes for restore_state(): of the same bundle, network rate and build.")
      .def(
          "restore_state",
          [](Monitor& self, nb::bytes state) {
            if (!self.restore_state({reinterpret_cast<const std::byte*>(state.c_str()), state.size()}))
              throw Error("the state is damaged, or of another bundle, network rate or build");
          },
          nb::arg("state"),
          "Go on where save_state() was called. CoreError where the state is damaged, or of another bundle or build.");
}

}  // namespace tauext::bindings
