// Bundles: their settings, limits, reference and file.
#include "tauext/bundle.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"

namespace tauext::bindings {
namespace {

void bind_units(nb::module_& m) {
  nb::enum_<TorqueUnit>(m, "TorqueUnit", "Unit of tau.")
      .value("newton_metre", TorqueUnit::newton_metre)
      .value("ampere", TorqueUnit::ampere)
      .value("recorded", TorqueUnit::recorded);
  nb::class_<TorqueUnits>(m, "TorqueUnits", "Units of the input tau and of the estimates; see bundle.hpp.")
      .def(
          "__init__",
          [](TorqueUnits* u, TorqueUnit given, int relative_to) { new (u) TorqueUnits{given, relative_to}; },
          nb::arg("given") = TorqueUnit::newton_metre, nb::arg("relative_to") = -1)
      .def_ro("given", &TorqueUnits::given)
      .def_ro("relative_to", &TorqueUnits::relative_to);
}

void bind_error_settings(nb::module_& m) {
  nb::class_<DriftSettings>(m, "DriftSettings",
      "Settings of the tracker of slow changes; see settings.hpp. time_constant_s = 0: no tracker.")
      .def(nb::init<>())
      .def_rw("time_constant_s", &DriftSettings::time_constant_s)
      .def_rw("size_nm", &DriftSettings::size_nm)
      .def_rw("rate_share_per_s", &DriftSettings::rate_share_per_s)
      .def_rw("freeze_share", &DriftSettings::freeze_share)
      .def_rw("freeze_s", &DriftSettings::freeze_s)
      .def_rw("freeze_floor_nm", &DriftSettings::freeze_floor_nm)
      .def_rw("friction_share", &DriftSettings::friction_share);
  nb::enum_<MotionFeature>(m, "MotionFeature", "Features of the motion with which errors grow; see settings.hpp.")
      .value("constant", MotionFeature::constant)
      .value("speed", MotionFeature::speed)
      .value("acceleration", MotionFeature::acceleration)
      .value("jerk", MotionFeature::jerk)
      .value("standstill", MotionFeature::standstill)
      .value("arm_speed", MotionFeature::arm_speed)
      .value("arm_acceleration", MotionFeature::arm_acceleration)
      .value("arm_jerk", MotionFeature::arm_jerk);
  nb::class_<ErrorScaleSettings>(m, "ErrorScaleSettings",
      "How thresholds and standard error grow with the motion; no features: constant thresholds.")
      .def(nb::init<>())
      .def_rw("features", &ErrorScaleSettings::features)
      .def_rw("limit_weights", &ErrorScaleSettings::limit_weights)
      .def_rw("largest", &ErrorScaleSettings::largest)
      .def_rw("sigma_weights", &ErrorScaleSettings::sigma_weights)
      .def_rw("sigma_near_weights", &ErrorScaleSettings::sigma_near_weights)
      .def_rw("largest_sigma", &ErrorScaleSettings::largest_sigma)
      .def_prop_ro("on", &ErrorScaleSettings::on, "Whether there is a standard error.")
      .def_prop_ro("follows", &ErrorScaleSettings::follows, "Whether thresholds and standard error follow the motion.");
}

void bind_load_settings(nb::module_& m) {
  nb::class_<Load>(m, "Load", "A rigid body in the axes of the load frame; mass 0: no payload.")
      .def(
          "__init__",
          [](Load* load, double mass, const std::array<double, 3>& com, const std::array<double, 6>& inertia,
             double error_share) { new (load) Load{mass, com, inertia, error_share}; },
          nb::arg("mass") = 0.0, nb::arg("com") = std::array<double, 3>{}, nb::arg("inertia") = std::array<double, 6>{},
          nb::arg("error_share") = Load::kUsualError,
          "Mass [kg], centre of mass [m], inertia about it xx, yy, zz, xy, xz, yz [kg m^2], relative error of its\n"
          "torques (0 to 1).")
      .def_ro("mass", &Load::mass, "Mass, [kg].")
      .def_ro("com", &Load::com, "Centre of mass, [m].")
      .def_ro("inertia", &Load::inertia, "Inertia about the centre of mass, xx, yy, zz, xy, xz, yz, [kg m^2].")
      .def_ro("error_share", &Load::error_share, "Relative error of its torques: thresholds rise by this share of them.")
      .def("__eq__", [](const Load& a, const Load& b) { return a == b; }, nb::is_operator(),
           nb::sig("def __eq__(self, other: object, /) -> bool"));
  nb::class_<LoadSettings>(m, "LoadSettings", "Where a payload is fixed, and which payloads are accepted; see load.hpp.")
      .def(nb::init<>())
      .def_rw("frame", &LoadSettings::frame, "Name of the load frame.")
      .def_rw("link", &LoadSettings::link, "Index of the link that the frame is fixed to; -1: none.")
      .def_rw("rotation", &LoadSettings::rotation, "Rotation link from load frame, row-major.")
      .def_rw("translation", &LoadSettings::translation, "Origin of the frame in the link's frame, [m].")
      .def_rw("largest_mass_kg", &LoadSettings::largest_mass_kg, "Largest accepted mass, [kg].")
      .def_rw("largest_reach_m", &LoadSettings::largest_reach_m,
           "Largest accepted distance of the centre of mass from the frame's origin, [m].")
      .def_rw("refused", &LoadSettings::refused, "Reason for which no payload can be set; empty: payloads are accepted.")
      .def_prop_ro("settable", &LoadSettings::settable, "Whether a payload can be set at all.")
      .def("why_not", [](const LoadSettings& s, const Load& load) { return s.words(s.fault(load), load); },
           nb::arg("load"), "Reason for which this payload is refused; empty: accepted.")
      .def("merged", [](const LoadSettings& s, const Load& load, const Link& link) { return s.merged(load, link); },
           nb::arg("load"), nb::arg("link"), "The link and the payload as one body.");
}

std::vector<std::pair<int, int>> input_pairs(const std::vector<LstmInput>& inputs) {
  std::vector<std::pair<int, int>> pairs;
  for (const LstmInput& input : inputs) pairs.emplace_back(input.column, input.lag);
  return pairs;
}

std::vector<std::string> units(const Bundle& bundle, std::string (Bundle::*unit)(int) const) {
  std::vector<std::string> out;
  for (int j = 0; j < bundle.joints(); ++j) out.push_back((bundle.*unit)(j));
  return out;
}

// A member of a part of the bundle.
template <class Part, class T>
void bind_member(nb::class_<Bundle>& bundle, const char* name, Part Bundle::*part, T Part::*member, const char* doc) {
  bundle.def_prop_rw(
      name, [part, member](const Bundle& b) { return b.*part.*member; },
      [part, member](Bundle& b, T value) { b.*part.*member = std::move(value); }, doc);
}

// sliding_limit_nm, near_stiction_limit_nm and hold_s of the collision; the same with the prefix contact_.
void bind_level(nb::class_<Bundle>& cls, const std::string& prefix, Level Limits::*level) {
  const std::string what = prefix.empty() ? "collision" : "contact";
  const auto limit = [&what](const std::string& where) {
    return "Threshold of |tau_ext| per joint for a " + what + " " + where +
           ", [N m]; in usual motion if there is an error scale.";
  };
  cls.def_prop_rw(
         (prefix + "sliding_limit_nm").c_str(), [level](const Bundle& b) { return (b.limits.*level).sliding_nm; },
         [level](Bundle& b, std::vector<double> v) { (b.limits.*level).sliding_nm = std::move(v); },
         limit("while it slides").c_str())
      .def_prop_rw(
          (prefix + "near_stiction_limit_nm").c_str(),
          [level](const Bundle& b) { return (b.limits.*level).near_stiction_nm; },
          [level](Bundle& b, std::vector<double> v) { (b.limits.*level).near_stiction_nm = std::move(v); },
          limit("near stiction").c_str())
      .def_prop_rw(
          (prefix + "hold_s").c_str(), [level](const Bundle& b) { return (b.limits.*level).hold_s; },
          [level](Bundle& b, double v) { (b.limits.*level).hold_s = v; },
          ("Time above its threshold after which a joint raises a " + what + ", [s]; 0: at the first sample.").c_str());
}

void bind_settings(nb::class_<Bundle>& bundle) {
  bundle.def_rw("name", &Bundle::name, "Name of the bundle; its file may have another name.")
      .def_rw("provenance", &Bundle::provenance,
              "JSON text: command, versions, settings, recordings and results of the training. The core does not read it.")
      .def_rw("gravity", &Bundle::gravity, "Acceleration of free fall in the base frame, [m/s^2].")
      .def_rw("observer", &Bundle::observer,
              "Gain K0 [1/s], torque timing, sample period [ns], rate of the network; torque constants.")
      .def_rw("window_steps", &Bundle::window_steps, "Network steps in a window.")
      .def_rw("shape", &Bundle::shape, "Inputs, hidden units and outputs of the network; hidden = 0: no network.")
      .def_rw("units", &Bundle::units,
              "Units of the input tau and of the estimates; torque_units and estimate_units are their names.")
      .def_rw("load_settings", &Bundle::load, "Load frame, and bounds on payloads.")
      .def_rw("wrench_settings", &Bundle::wrench, "Error model of forces and moments at frames.")
      .def_rw("capsules", &Bundle::capsules, "Shapes of the links, from the robot file; empty: none.")
      .def_rw("servo", &Bundle::servo, "Computation of dq and tau from servo signals, before the chain; may be off.")
      .def_prop_rw(
          "inputs", [](const Bundle& b) { return input_pairs(b.inputs); },
          [](Bundle& b, const std::vector<std::pair<int, int>>& pairs) {
            b.inputs.clear();
            for (const auto& [column, lag] : pairs) b.inputs.push_back({column, lag});
          },
          "Inputs of a network step: pairs of a column (q, dq, then presliding states of every joint) and a lag in steps.")
      .def_prop_rw(  // def_rw would give references into the vector
          "links", [](const Bundle& b) { return b.links; }, [](Bundle& b, std::vector<Link> links) { b.links = std::move(links); },
          "Moving links of the estimated model with their joints. A copy: change it and assign it.")
      .def_rw("input_factors", &Bundle::input_factors,
              "Factor on each input column: 1 / its largest absolute value in training.")
      .def_rw("parameters", &Bundle::parameters, "Weights of the network, in the order of LstmShape.")
      .def_rw("prior", &Bundle::prior, "Prior of r: terms and their weights; no terms: no prior.")
      .def_rw("drift", &Bundle::drift, "Settings of the tracker of slow changes; time_constant_s = 0: no tracker.")
      .def_rw("error_scale", &Bundle::error_scale,
              "How thresholds and standard error follow the motion; no features: constant thresholds.")
      .def_rw("coverage", &Bundle::coverage,
              "Motion of the training recordings; empty: unknown, and all motion is familiar.")
      .def_rw("output_scale_nm", &Bundle::output_scale_nm,
              "Per joint: torque of a network output of 1, [N m]; 0: the network is switched off.");
}

void bind_facts(nb::class_<Bundle>& bundle) {
  bundle.def_prop_ro("joints", &Bundle::joints, "Number of joints.")
      .def_prop_ro("has_network", &Bundle::has_network, "Whether there is a network; False: observer and prior only.")
      .def_prop_ro(
          "monitored",
          [](const Bundle& b) {
            std::vector<bool> all;
            for (int j = 0; j < b.joints(); ++j) all.push_back(b.limits.monitors(j));
            return all;
          },
          "Whether each joint can raise an alarm; one that never moved in training has infinite thresholds and cannot.")
      .def_prop_ro(
          "in_newtons",
          [](const Bundle& b) {
            std::vector<bool> out;
            for (int j = 0; j < b.joints(); ++j) out.push_back(b.in_newtons(j));
            return out;
          },
          "Per joint: whether its estimates are in N m, N or W. Only these joints are used for payloads and forces.")
      .def("too_few_in_newtons", &Bundle::too_few_in_newtons, nb::arg("why"),
           "Empty if enough joints are in N m; else a sentence that ends with `why`.")
      .def_prop_ro("most_units_per_nm", &Bundle::most_units_per_nm,
                   "Per joint: bound on the change of its estimate, in its own unit, per N m of a payload; 0 for joints in N m.")
      .def_prop_ro("torque_units", [](const Bundle& b) { return units(b, &Bundle::torque_unit); },
                   "Unit of the input tau, per joint.")
      .def_prop_ro("estimate_units", [](const Bundle& b) { return units(b, &Bundle::estimate_unit); },
                   "Unit of the estimated torques, per joint.")
      .def_prop_ro(
          "reference_q",
          [](const Bundle& b) {
            const std::size_t n = std::min(b.links.size(), b.reference.q.size());
            return std::vector<double>(b.reference.q.begin(), b.reference.q.begin() + static_cast<std::ptrdiff_t>(n));
          },
          "Position of each joint at the reference's first sample, [rad] or [m]; empty: no reference.")
      .def_prop_ro("model_digest", &model_digest,
                   "Checksum of all that tau_ext is made of, drift excluded; bundles that differ in thresholds alone have the same.");
}

void bind_limits(nb::class_<Bundle>& bundle) {
  bind_level(bundle, "", &Limits::collision);
  bind_level(bundle, "contact_", &Limits::contact);
  bind_member(bundle, "contact_release_s", &Bundle::limits, &Limits::contact_release_s,
              "A contact ends when every joint has been below its contact threshold for this time, [s].");
  bind_member(bundle, "near_memory_s", &Bundle::limits, &Limits::near_memory_s,
              "Time after the start of sliding for which a joint counts as near stiction, [s].");
  bind_member(bundle, "after_contact_factor", &Bundle::limits, &Limits::after_contact_factor,
              "Factor on the thresholds of a joint that was pushed while stuck, until it has slid; 1: none.");
  bind_member(bundle, "declared_spread", &Bundle::limits, &Limits::declared_spread,
              "Standard errors by which what an expected contact explains may be wrong.");
  bind_member(bundle, "region_width", &Bundle::limits, &Limits::region_width,
              "Index of the presliding width that, beside the speed, defines near stiction; -1: speed only.");
  bind_member(bundle, "near_stiction_rad_s", &Bundle::limits, &Limits::near_stiction_rad_s,
              "A joint slower than this is near stiction, [rad/s].");
  bind_member(bundle, "torque_limit_nm", &Bundle::signals, &SignalRanges::torque_limit_nm,
              "Torque at which each drive saturates, [N m]; infinite: unknown.");
  bind_member(bundle, "largest_torque_nm", &Bundle::signals, &SignalRanges::largest_torque_nm,
              "Largest |tau| of each joint in training, [N m].");
  bind_member(bundle, "possible_torque_nm", &Bundle::signals, &SignalRanges::possible_torque_nm,
              "Per joint: a larger |tau| is a fault, [N m]; infinite: unknown.");
  bind_member(bundle, "possible_speed_rad_s", &Bundle::signals, &SignalRanges::possible_speed_rad_s,
              "Per joint: a larger |dq|, or a step of q that needs one, is a fault, [rad/s]; infinite: unknown.");
  bind_member(bundle, "rate_tolerance", &Bundle::signals, &SignalRanges::rate_tolerance,
              "Largest relative difference between mean step and sample period, 0.05 to 0.15.");
}

void bind_reference(nb::class_<Bundle>& bundle) {
  bundle.def("assume_load", &Bundle::assume_load, "Sets the default payload settings; see bundle.hpp.")
      .def(
          "drop_network",
          [](Bundle& b) {
            b.shape = {};
            b.inputs.clear();
            b.input_factors.clear();
            b.parameters.clear();
            b.output_scale_nm.clear();
            answer_reference(b);
          },
          "Removes the network; observer and prior remain. Raises CoreError without a reference.")
      .def(
          "set_reference",
          [](Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
             const Array<double, 2>& tau) {
            const RecordingView v = view(t_ns, q, dq, tau);
            const auto cells = static_cast<std::size_t>(v.samples) * v.joints;
            b.reference = {{v.t_ns, v.t_ns + v.samples}, {v.q, v.q + cells}, {v.dq, v.dq + cells},
                           {v.tau, v.tau + cells}, {}, {}, {}};
            answer_reference(b);
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"),
          "Stores this section of free motion with the chain's estimate at its last sample; loading a bundle replays it.")
      .def(
          "scale_reference",
          [](Bundle& b, const std::vector<double>& by) {
            if (by.size() != b.links.size()) throw Error("scale_reference takes one factor a joint");
            for (std::size_t k = 0; k < b.reference.tau.size(); ++k) b.reference.tau[k] *= by[k % by.size()];
            answer_reference(b);
          },
          nb::arg("by"), "Multiplies the reference's tau by one factor per joint and recomputes it.")
      .def("answer_reference", [](Bundle& b) { answer_reference(b); }, "Recomputes the reference after a change.");
}

void bind_file(nb::class_<Bundle>& bundle) {
  bundle.def("save", [](const Bundle& b, const std::string& path) { save_bundle(b, path); }, nb::arg("path"),
           "Writes the file to a temporary name and renames it. Raises CoreError with the invalid field or the write error.")
      .def_static("load", [](const std::string& path) {
                    const nb::gil_scoped_release released;
                    return load_bundle(path);
                  },
                  nb::arg("path"),
                  "Reads and checks the file and replays its reference. Raises CoreError with the reason of a refusal.")
      .def(
          "to_bytes",
          [](const Bundle& b) {
            const std::vector<char> bytes = to_bytes(b);
            return nb::bytes(bytes.data(), bytes.size());
          },
          "The content of the bundle's file.")
      .def_static(
          "from_bytes", [](nb::bytes bytes) { return from_bytes({bytes.c_str(), bytes.size()}); }, nb::arg("bytes"),
          "Reads the bytes of to_bytes(), with the checks of load().");
}

}  // namespace

void bind_bundle(nb::module_& m) {
  bind_units(m);
  bind_error_settings(m);
  bind_load_settings(m);
  nb::class_<Bundle> bundle(m, "Bundle", "A bundle: all settings and weights of the chain, in one file.");
  bundle.def(nb::init<>());
  bind_settings(bundle);
  bind_facts(bundle);
  bind_limits(bundle);
  bind_reference(bundle);
  bind_file(bundle);
}

}  // namespace tauext::bindings
