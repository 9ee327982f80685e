// The monitor that a controller uses.
#include "tauext/monitor.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <limits>
#include <optional>

#include "arrays.hpp"
#include "flights.hpp"

namespace tauext::bindings {
namespace {

nb::bytes bytes_of(const std::vector<std::byte>& state) {
  return nb::bytes(reinterpret_cast<const char*>(state.data()), state.size());
}

std::span<const std::byte> as_bytes(const nb::bytes& state) {
  return {reinterpret_cast<const std::byte*>(state.c_str()), state.size()};
}

using Temperature = std::optional<Array<double, 1>>;

template <std::size_t N>
std::array<double, N> listed(const Array<double, 1>& values, const char* name) {
  const auto& array = values.named(name);
  if (array.shape(0) != N)
    throw Error(std::string(name) + " has " + std::to_string(array.shape(0)) + " numbers; it must have " + std::to_string(N));
  std::array<double, N> out;
  std::copy_n(array.data(), N, out.begin());
  return out;
}

// One number for each joint. Throws Error.
std::span<const double> of_joints(const Array<double, 1>& values, const char* name, int joints) {
  const auto& array = values.named(name);
  if (array.shape(0) != static_cast<std::size_t>(joints))
    throw Error(std::string(name) + " has the shape (" + std::to_string(array.shape(0)) + ",); it must be (" +
                std::to_string(joints) + ",), one number for each joint");
  return span_of(values);
}

std::span<const double> temperatures_of(const Array<double, 1>& values, int joints) {
  const std::span<const double> celsius = of_joints(values, "temperature", joints);
  expect_temperatures(celsius, celsius.size());
  return celsius;
}

Sample sample_of(const Monitor& monitor, const Whole& t_ns, const Array<double, 1>& q, const Array<double, 1>& dq,
                 const Array<double, 1>& tau, const Temperature& temperature) {
  const int n = monitor.joints();
  Sample sample{t_ns.named("t_ns"), of_joints(q, "q", n), of_joints(dq, "dq", n), of_joints(tau, "tau", n)};
  if (temperature) sample.temperature = temperatures_of(*temperature, n);
  return sample;
}

std::vector<std::string> units(const Monitor& monitor, const std::string& (Monitor::*unit)(int) const) {
  std::vector<std::string> out;
  for (int j = 0; j < monitor.joints(); ++j) out.push_back((monitor.*unit)(j));
  return out;
}

// The monitor's estimates as columns, one row per sample.
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
    alarm_number_.push_back(e.alarm_number);
    touch_t_ns_.push_back(e.touch_t_ns);
    touch_over_.push_back(e.touch_over);
    touch_.push_back(static_cast<std::uint8_t>(e.touch));
    alarm_joint_.push_back(static_cast<std::int8_t>(e.alarm_joint));
    detection_.push_back(e.detection);
    load_kg_.push_back(e.load.mass);
    load_error_kg_.push_back(e.load_error_kg);
    load_phase_.push_back(static_cast<std::uint8_t>(e.load_phase));
    load_found_ns_.push_back(e.load_found_ns);
    declared_.push_back(static_cast<std::uint8_t>(e.declared));
    declared_contact_.push_back(static_cast<std::int8_t>(e.declared_contact));
    declared_size_.push_back(e.declared_size);
    declared_sigma_.push_back(e.declared_sigma);
    declared_moment_nm_.push_back(e.declared_moment_nm);
    declared_travel_m_.push_back(e.declared_travel_m);
  }
  // With torques that do not exist.
  void add_unknown(Estimate e) {
    for (const Torque& torque : kTorques) (e.*torque.values).fill(std::numeric_limits<double>::quiet_NaN());
    add(e);
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
    out["alarm_number"] = to_numpy(std::move(alarm_number_), {N});
    out["touch_t_ns"] = to_numpy(std::move(touch_t_ns_), {N});
    out["touch_over"] = to_numpy(std::move(touch_over_), {N});
    out["touch"] = to_numpy(std::move(touch_), {N});
    out["alarm_joint"] = to_numpy(std::move(alarm_joint_), {N});
    out["detection"] = to_numpy(std::move(detection_), {N});
    out["load_kg"] = to_numpy(std::move(load_kg_), {N});
    out["load_error_kg"] = to_numpy(std::move(load_error_kg_), {N});
    out["load_phase"] = to_numpy(std::move(load_phase_), {N});
    out["load_found_ns"] = to_numpy(std::move(load_found_ns_), {N});
    out["declared"] = to_numpy(std::move(declared_), {N});
    out["declared_contact"] = to_numpy(std::move(declared_contact_), {N});
    out["declared_size"] = to_numpy(std::move(declared_size_), {N});
    out["declared_sigma"] = to_numpy(std::move(declared_sigma_), {N});
    out["declared_moment_nm"] = to_numpy(std::move(declared_moment_nm_), {N});
    out["declared_travel_m"] = to_numpy(std::move(declared_travel_m_), {N});
    return out;
  }

 private:
  struct Torque {
    const char* name;
    JointVector Estimate::*values;
  };
  static constexpr std::array<Torque, 15> kTorques{{{"residual", &Estimate::residual},
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
                                                   {"load_nm", &Estimate::load_nm},
                                                   {"declared_nm", &Estimate::declared_nm}}};
  std::size_t joints_;
  std::array<std::vector<double>, kTorques.size()> torques_;
  std::vector<std::uint32_t> near_stiction_, drift_saturated_, causes_, alarm_number_;
  std::vector<double> unfamiliar_, load_kg_, load_error_kg_, declared_size_, declared_sigma_;
  std::vector<double> declared_moment_nm_, declared_travel_m_;
  std::vector<std::int64_t> load_found_ns_, touch_t_ns_;
  std::vector<std::uint8_t> health_, alarm_, held_alarm_, touch_over_, touch_, detection_, unseen_, load_phase_, declared_;
  std::vector<std::int8_t> alarm_joint_, cause_joint_, unseen_joint_, unseen_other_, declared_contact_;
};

// step() for many samples; signals are (samples, joints).
ArrayDict run(Monitor& monitor, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
              const Array<double, 2>& tau, FlightRecorder* recorder, const Temperatures& temperature) {
  const RecordingView r = view(t_ns, q, dq, tau, temperature, monitor.joints());
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

// no_sample(), or step() for a sample of the wrong size; the recorder stores a row of NaN.
ArrayDict run_without_values(Monitor& monitor, std::int64_t t_ns, bool came, FlightRecorder* recorder) {
  Columns said(1, static_cast<std::size_t>(monitor.joints()));
  const Sample empty{t_ns, {}, {}, {}};
  const Estimate& e = came ? monitor.step(empty) : monitor.no_sample(t_ns);
  if (recorder) recorder->push(empty, e);
  said.add(e);
  return said.take();
}

// A time of the samples; None: from now on. Throws Error for a later time than the last sample's.
std::int64_t since(const Monitor& monitor, const std::optional<Whole>& since_ns) {
  if (!since_ns) return kFromNow;
  const std::int64_t t_ns = since_ns->named("since_ns"), last_ns = monitor.last().t_ns;
  if (t_ns == kFromNow || (monitor.samples() > 0 && t_ns > last_ns))
    throw Error("since_ns = " + std::to_string(t_ns) + " is later than the last sample (t_ns = " + std::to_string(last_ns) +
                "); leave it out to set the payload from now on");
  return t_ns;
}

void set_load(Monitor& self, const Load& load, std::int64_t since_ns) {
  if (!self.set_load(load, since_ns)) throw Error(self.why_no_load(load, since_ns));
}

// What run() returns of one sample without a monitor: no torque is known.
ArrayDict no_estimate(int joints, Health health) {
  if (joints < 1 || joints > kMaxJoints) throw Error("joints must be 1 to " + std::to_string(kMaxJoints));
  Estimate e;
  e.joints = joints;
  e.health = health;
  Columns said(1, static_cast<std::size_t>(joints));
  said.add_unknown(e);
  return said.take();
}

using Signal = const Array<double, 1>&;

void bind_samples(nb::class_<Monitor>& monitor) {
  monitor.def(
          "step",
          [](Monitor& self, const Whole& t_ns, Signal q, Signal dq, Signal tau, const Temperature& temperature) {
            return self.step(sample_of(self, t_ns, q, dq, tau, temperature));
          },
          nb::arg("t_ns").none(), nb::arg("q").none(), nb::arg("dq").none(), nb::arg("tau").none(),
          nb::arg("temperature") = nb::none(), nb::sig("def step(self, t_ns: int, q: numpy.typing.ArrayLike, dq: numpy.typing.ArrayLike, "
                  "tau: numpy.typing.ArrayLike, temperature: numpy.typing.ArrayLike | None = None) -> Estimate"),
          "estimate() followed by advance(). temperature: of the joints, [degC]; NaN: unknown.")
      .def(
          "estimate",
          [](Monitor& self, const Whole& t_ns, Signal q, Signal dq, Signal tau, const Temperature& temperature) {
            return self.estimate(sample_of(self, t_ns, q, dq, tau, temperature));
          },
          nb::arg("t_ns").none(), nb::arg("q").none(), nb::arg("dq").none(), nb::arg("tau").none(),
          nb::arg("temperature") = nb::none(), nb::sig("def estimate(self, t_ns: int, q: numpy.typing.ArrayLike, dq: numpy.typing.ArrayLike, "
                  "tau: numpy.typing.ArrayLike, temperature: numpy.typing.ArrayLike | None = None) -> Estimate"),
          "Returns the estimate for this sample; advance() may follow later.")
      .def("advance", &Monitor::advance,
           "Does the work that can wait until the command is out. If omitted, the next estimate() does it first.")
      .def("no_sample", [](Monitor& self, const Whole& now_ns) { return self.no_sample(now_ns.named("now_ns")); }, nb::arg("now_ns"),
           "Reports that the loop ran without a sample: stale for up to a network period (below 300 Hz: three samples),\n"
           "then a fault.")
      .def(
          "run",
          [](Monitor& self, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
             const Array<double, 2>& tau, Recorder* recorder, const Temperatures& temperature) {
            return run(self, t_ns, q, dq, tau, recorder, temperature);
          },
          nb::arg("t_ns").none(), nb::arg("q").none(), nb::arg("dq").none(), nb::arg("tau").none(),
          nb::arg("recorder") = nb::none(), nb::arg("temperature") = nb::none(),
          nb::sig("def run(self, t_ns: numpy.typing.ArrayLike, q: numpy.typing.ArrayLike, dq: numpy.typing.ArrayLike, "
                  "tau: numpy.typing.ArrayLike, recorder: FlightRecorder | None = None, "
                  "temperature: numpy.typing.ArrayLike | None = None) -> dict[str, numpy.typing.NDArray[typing.Any]]"),
          "Calls step() for every row; returns a dict of arrays. Flags are uint8, 0 or 1: call .astype(bool) before ~ or a mask.")
      .def(
          "run_missing",
          [](Monitor& self, const Whole& now_ns, Recorder* recorder) {
            return run_without_values(self, now_ns.named("now_ns"), false, recorder);
          },
          nb::arg("now_ns"), nb::arg("recorder") = nb::none(), "Calls no_sample(); returns a single row as run() does.")
      .def(
          "run_wrong_size",
          [](Monitor& self, const Whole& t_ns, Recorder* recorder) {
            return run_without_values(self, t_ns.named("t_ns"), true, recorder);
          },
          nb::arg("t_ns"), nb::arg("recorder") = nb::none(),
          "Calls step() for a sample without one value for each joint, a fault; returns a single row as run() does.")
      .def_prop_ro("last", [](const Monitor& self) { return self.last(); }, "The last estimate.")
      .def(
          "set_temperature",
          [](Monitor& self, Signal celsius) {
            self.set_temperature(temperatures_of(celsius, self.joints()));
          },
          nb::arg("celsius"),
               "Sets the joint temperatures [degC] from the next sample on; NaN: unknown, the last known value "
               "remains in effect.")
      .def("reset", &Monitor::reset, "Returns to the state of a new monitor.");
}

void bind_alarms(nb::class_<Monitor>& monitor) {
  monitor.def("acknowledge", &Monitor::acknowledge,
           "Ends a latched alarm and does nothing else. If the cause persists, the alarm rises again.")
      .def_prop_rw("alarms", [](const Monitor& self) { return self.last().alarm_number; }, &Monitor::count_alarms_from,
                   "Number of the newest alarm; the next one has one more. Set it to continue a count.")
      .def("resume", &Monitor::resume,
           "Ends a latched alarm of an arm that nothing touches any more and that is about to move on. The static friction\n"
           "of joints near stiction becomes unknown; with a prior, their thresholds are higher until they have slid.")
      .def(
          "set_limit_factors",
          [](Monitor& self, Signal collision, Signal contact) {
            if (!self.set_limit_factors(of_joints(collision, "collision", self.joints()),
                                        of_joints(contact, "contact", self.joints())))
              throw Error("threshold factors must be " + std::to_string(self.joints()) + " numbers each for collision and " +
                          "contact, one a joint, from " + to_text(LimitFactors::kLowest) + " to " +
                          to_text(LimitFactors::kHighest));
          },
          nb::arg("collision"), nb::arg("contact"),
               "Multiplies the bundle's thresholds by one factor per joint, 0.1 to 10, from the next sample on. Raises "
               "CoreError, and\n"
          "changes nothing, for other values.")
      .def_prop_ro(
          "limit_factors",
          [](const Monitor& self) {
            const LimitFactors& factors = self.limit_factors();
            const auto listed = [&](const JointVector& all) { return std::vector(all.begin(), all.begin() + self.joints()); };
            return std::pair(listed(factors.collision), listed(factors.contact));
          },
          "Factors in effect on the thresholds, of collision and contact, one per joint.");
}

void bind_loads(nb::class_<Monitor>& monitor) {
  monitor.def(
          "set_load",
          [](Monitor& self, const Number& mass, Signal com, Signal inertia, const std::optional<Whole>& since_ns,
             const Number& error_share) {
            set_load(self, {mass.named("mass"), listed<3>(com, "com"), listed<6>(inertia, "inertia"), error_share.named("error_share")},
                     since(self, since_ns));
          },
          nb::arg("mass"), nb::arg("com") = std::array<double, 3>{}, nb::arg("inertia") = std::array<double, 6>{},
          nb::kw_only(), nb::arg("since_ns") = nb::none(), nb::arg("error_share") = Load::kUsualError,
          "Sets what the arm carries from the next sample on, or as if it had been set at since_ns: mass [kg], centre of\n"
          "mass [m] in load_settings.frame, inertia about it xx, yy, zz, xy, xz, yz [kg m^2]. Thresholds rise by error_share\n"
          "of its torques. Raises CoreError, and changes nothing, if the payload is refused.")
      .def("clear_load", [](Monitor& self, const std::optional<Whole>& since_ns) {
             if (self.load_settings().settable()) set_load(self, {}, since(self, since_ns));
           },
           nb::arg("since_ns") = nb::none(), "Removes the payload.")
      .def_prop_ro("load", [](const Monitor& self) { return self.load(); },
                   "Payload from the next sample on; mass 0: none.")
      .def_prop_ro("load_settings", [](const Monitor& self) { return self.load_settings(); },
                   "Load frame, and the largest accepted mass and reach.")
      .def(
          "why_no_load",
          [](const Monitor& self, const Load& load, const std::optional<Whole>& since_ns) {
            return self.why_no_load(load, since(self, since_ns));
          },
          nb::arg("load"), nb::arg("since_ns") = nb::none(), "Reason for which set_load() would refuse; empty: none.")
      .def(
          "expect_load",
          [](Monitor& self, double seconds, double at_most_kg) {
            if (!self.expect_load(seconds, at_most_kg)) throw Error(self.why_not_expected(seconds, at_most_kg));
          },
          nb::arg("seconds"), nb::arg("at_most_kg"),
          "Announces that the gripper closes or opens: for `seconds` (at most 60), the arm may come to carry up to\n"
          "at_most_kg in all. A step that fits is identified, set and reported; any other step raises the usual alarm.\n"
          "Raises CoreError, and changes nothing, if it is refused.")
      .def("why_not_expected", &Monitor::why_not_expected, nb::arg("seconds"), nb::arg("at_most_kg"),
           "Reason for which expect_load() would refuse; empty: none.");
}

void bind_weighing(nb::class_<Monitor>& monitor) {
  monitor.def(
          "start_weighing",
          [](Monitor& self, double reach_m) {
            if (self.start_weighing(reach_m)) return;
            const std::string reason = self.why_no_weighing();
            throw Error(reason.empty() ? "the reach of a payload = " + to_text(reach_m) + " m must be above 0" : reason);
          },
          nb::arg("reach_m") = kUsualReach_m,
          "Starts to identify what the arm carries beside the payload that is set, from the next sample on; drift does not learn\n"
          "meanwhile. reach_m: largest distance of the centre of mass from the load frame. Raises CoreError if refused.")
      .def("stop_weighing", &Monitor::stop_weighing, "Ends the identification; estimate_load() still returns the result.")
      .def_prop_ro("weighing", &Monitor::weighing, "Whether a payload identification is active.")
      .def("estimate_load", &Monitor::estimate_load, "Returns the result so far; its `load` is for set_load().")
      .def("why_no_weighing", &Monitor::why_no_weighing, "Reason for which start_weighing() would refuse; empty: none.");
}

void bind_contacts(nb::class_<Monitor>& monitor) {
  monitor.def(
          "expect_contact",
          [](Monitor& self, const NamedContact& named, double seconds) {
            const DeclaredContact contact = contact_of(self.wrench_model(), named);
            const int which = self.expect_contact(contact, seconds);
            if (which < 0) throw Error(self.why_no_contact(contact, seconds));
            return which;
          },
          nb::arg("contact"), nb::arg("seconds") = kAlways_s,
          "Announces a contact that the task needs, for `seconds` from the next sample on; without a time until end_contact().\n"
          "The alarm then uses only the part of tau_ext that nothing within its bounds explains; drift, payload identification and a refit learn\n"
          "nothing. Returns its number. Raises CoreError, and changes nothing, if it is refused.")
      .def("end_contact", &Monitor::end_contact, nb::arg("which"),
           "Ends an expected contact at once. False: there is none of this number.")
      .def(
          "why_no_contact",
          [](const Monitor& self, const NamedContact& named, double seconds) {
            try {
              return self.why_no_contact(contact_of(self.wrench_model(), named), seconds);
            } catch (const Error& error) {
              return std::string(error.what());
            }
          },
          nb::arg("contact"), nb::arg("seconds") = kAlways_s, "Reason for which expect_contact() would refuse; empty: none.")
      .def(
          "unmonitored", [](const Monitor& self, const NamedContact& named) { return self.unmonitored(contact_of(self.wrench_model(), named)); },
          nb::arg("contact"), "What is not monitored while the contact is in effect, as a sentence; empty: nothing.");
}

void bind_wrenches(nb::class_<Monitor>& monitor) {
  monitor.def(
          "tool_force",
          [](const Monitor& self, WrenchAxes axes) {
            FrameToolForce tool;
            static_cast<ToolForce&>(tool) = self.tool_force(axes);
            static_cast<Wrench&>(tool.at) = tool.wrench;
            tool.at.axes = axes;
            if (tool.frame >= 0) tool.at.frame = self.wrench_model().frame(tool.frame).name;
            return tool;
          },
          nb::arg("axes") = WrenchAxes::base,
          "The force that acts on the tool, at the last sample: at the expected contact in effect, else at the load frame; with\n"
          "covariance and its standard errors by cause.")
      .def(
          "wrench",
          [](const Monitor& self, const std::string& frame, WrenchAxes axes) {
            return FrameWrench{self.wrench(frame_of(self.wrench_model(), frame), axes), frame, axes, {}};
          },
          nb::arg("frame"), nb::arg("axes") = WrenchAxes::base,
          "Force and moment that the environment exerts on the arm at a frame, at the last sample. Frames: links by their\n"
          "joints, the load frame, frames of the robot file; see wrench_frames.")
      .def(
          "force",
          [](const Monitor& self, const std::string& frame, const std::array<double, 3>& point, WrenchAxes axes) {
            return FrameWrench{self.force(frame_of(self.wrench_model(), frame), point, axes), frame, axes, point};
          },
          nb::arg("frame"), nb::arg("point") = std::array<double, 3>{}, nb::arg("axes") = WrenchAxes::base,
          "Estimates a force without a moment at a point of the frame, [m] along the frame's own axes; more accurate than\n"
          "wrench().")
      .def_prop_ro(
          "wrench_frames",
          [](const Monitor& self) {
            std::vector<std::string> names;
            for (int k = 0; k < self.wrench_model().frames(); ++k) names.push_back(self.wrench_model().frame(k).name);
            return names;
          },
          "Names of the frames for wrench().")
      .def("why_no_wrench", &Monitor::why_no_wrench, "Reason for which there is no wrench; empty: none.");
}

void bind_refits(nb::class_<Monitor>& monitor) {
  monitor.def("reserve_refit", &Monitor::reserve_refit, nb::arg("seconds") = 60.0,
           "Reserves memory for `seconds` of motion (at most 600); call it before the loop. Discards stored motion.")
      .def(
          "start_refit",
          [](Monitor& self, double friction_share) {
            if (!self.start_refit(friction_share))
              throw Error("a refit needs reserve_refit(), a prior with friction, and a friction_share of 0 to 2, not " +
                          to_text(friction_share));
          },
          nb::arg("friction_share") = Monitor::kRefitFrictionShare,
          "Stores motion from the next sample on; meanwhile thresholds are higher by this share of the friction.")
      .def_prop_ro("refit_full", &Monitor::refit_full, "Whether the reserved memory is full.")
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
          "Restores the usual thresholds and returns the stored motion, for tauext.refit_motion.");
}

void bind_facts(nb::class_<Monitor>& monitor) {
  monitor.def_prop_ro("joints", &Monitor::joints, "Number of joints.")
      .def_prop_ro("joint_names",
                   [](const Monitor& self) {
                     std::vector<std::string> names;
                     for (int j = 0; j < self.joints(); ++j) names.push_back(self.joint_name(j));
                     return names;
                   },
                   "Names of the joints, in the order of q, dq and tau.")
      .def_prop_ro("torque_units", [](const Monitor& self) { return units(self, &Monitor::torque_unit); },
                   "Unit of the input tau, per joint.")
      .def_prop_ro("estimate_units", [](const Monitor& self) { return units(self, &Monitor::estimate_unit); },
                   "Unit of the estimated torques, per joint.")
      .def_prop_ro("sample_period_ns", &Monitor::sample_period_ns, "Sample period of the bundle, [ns].")
      .def_prop_ro("samples", &Monitor::samples, "Number of samples that entered the chain; faulty ones do not.")
      .def_prop_ro("bridged_ticks", &Monitor::bridged_ticks,
                   "Number of ticks of the regular clock without a sample, at which the previous sample was held.")
      .def_prop_ro("restarts", &Monitor::restarts, "Number of restarts of the chain after its first start.")
      .def_prop_ro("clock_jumps", &Monitor::clock_jumps,
                   "Restarts because the stamps jumped: back, by a gap of more than 10 s, or none newer in 100 samples. Everything\n"
                   "with a time ended then: expected contacts with a time, an expected payload, an identification, motion for a refit.");
}

void bind_states(nb::class_<Monitor>& monitor) {
  monitor.def("save_state",
           [](const Monitor& self) {
             std::vector<std::byte> state(self.state_bytes());
             self.save_state(state);
             return bytes_of(state);
           },
           "The whole state as bytes, for restore_state() of a monitor of the same bundle, network rate and build.")
      .def(
          "restore_state",
          [](Monitor& self, const nb::bytes& state) {
            if (!self.restore_state(as_bytes(state)))
              throw Error("the state is damaged, or of another bundle, network rate or build");
          },
          nb::arg("state"),
          "Restores a state of save_state(). Raises CoreError if it is damaged, or of another bundle, network rate or build.")
      .def("carried",
           [](const Monitor& self) {
             std::vector<std::byte> carried(Monitor::carried_bytes());
             self.save_carried(carried);
             return bytes_of(carried);
           },
           "What another bundle's monitor can continue from, as bytes for carry() and carry_alarm().")
      .def(
          "carry",
          [](Monitor& self, const nb::bytes& carried) {
            if (!self.carry(as_bytes(carried))) throw Error("what was carried is damaged, of another build or arm, or holds a payload that is refused");
          },
          nb::arg("carried"),
          "Continues from threshold factors, payload and, if both bundles have the same model_digest, learned drift. Call it\n"
          "before the first sample. Raises CoreError, and changes nothing, if it does not fit.")
      .def(
          "carry_alarm",
          [](Monitor& self, const nb::bytes& carried) {
            if (!self.carry_alarm(as_bytes(carried))) throw Error("what was carried is damaged, or of another build or arm");
          },
          nb::arg("carried"),
          "Continues the alarm, its kind of touch and the joints pushed while stuck. Raises CoreError, and changes nothing,\n"
          "if it does not fit.");
}

}  // namespace

void bind_monitor(nb::module_& m) {
  m.def("no_estimate", &no_estimate, nb::arg("joints"), nb::arg("health"),
        "What Monitor.run() returns of one sample where nothing is monitored: torques are NaN, no alarm.");
  nb::class_<Monitor> monitor(m, "Monitor",
      "Runs a bundle in a control loop: one sample in; external torque, alarm and health out.");
  monitor.def(
          "__init__",
          [](Monitor* self, nb::handle given, bool own_rate) {
            if (!nb::isinstance<Bundle>(given))
              throw Error("bundle is of type " + type_of(given) +
                          "; it must be a Bundle, as load_bundle() returns it");
            const auto& bundle = nb::cast<const Bundle&>(given);
            const nb::gil_scoped_release released;
            new (self) Monitor(bundle, own_rate ? NetworkRate::network_period : NetworkRate::every_sample);
          },
          nb::arg("bundle").none(), nb::arg("own_rate") = false,
          nb::sig("def __init__(self, bundle: Bundle, own_rate: bool = False) -> None"));
  bind_samples(monitor);
  bind_alarms(monitor);
  bind_loads(monitor);
  bind_weighing(monitor);
  bind_contacts(monitor);
  bind_wrenches(monitor);
  bind_refits(monitor);
  bind_facts(monitor);
  bind_states(monitor);
}

}  // namespace tauext::bindings
