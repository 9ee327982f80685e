// The monitor's answer to a sample.
#include "tauext/estimate.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"

namespace tauext::bindings {
namespace {

std::vector<std::string> cause_names(std::uint32_t causes) {
  std::vector<std::string> names;
  for (std::uint32_t k = 0; k < kCauseCount; ++k)
    if (causes >> k & 1) names.emplace_back(name(static_cast<Cause>(1u << k)));
  return names;
}

std::vector<bool> joint_bits(std::uint32_t word, int joints) {
  std::vector<bool> out;
  for (int j = 0; j < joints; ++j) out.push_back(word >> j & 1);
  return out;
}

void bind_levels(nb::module_& m) {
  nb::enum_<Alarm>(m, "Alarm",
                   "Alarm levels. contact: over the contact threshold for the hold time; ends by itself. collision: over the\n"
                   "collision threshold for the hold time; latched until acknowledged.")
      .value("none", Alarm::none)
      .value("contact", Alarm::contact)
      .value("collision", Alarm::collision);
  nb::enum_<Touch>(m, "Touch", "Kind of touch behind an alarm.")
      .value("none", Touch::none, "No alarm.")
      .value("unknown", Touch::unknown, "Not known yet, or none of the other kinds.")
      .value("impact", Touch::impact, "The torque came and went within a bounce.")
      .value("push", Touch::push, "The contact yields.")
      .value("clamp", Touch::clamp,
           "It does not yield: the torque grows as the arm moves on, or keeps growing at rest.")
      .value("load", Touch::load, "A weight at the load frame.");
  nb::enum_<LoadPhase>(m, "LoadPhase", "Progress of an expected payload.")
      .value("none", LoadPhase::none, "No payload is expected.")
      .value("expecting", LoadPhase::expecting, "No payload detected yet.")
      .value("deciding", LoadPhase::deciding, "An alarm is held back: the torque fits a payload.")
      .value("found", LoadPhase::found, "A payload was set; more mass is added until the window ends.")
      .value("weighing", LoadPhase::weighing, "The window is over and no alarm is held back; the identification continues.");
  nb::enum_<Health>(m, "Health",
                    "Whether the torques can be trusted. warming_up: no torques yet. stale: no new sample for up to a network\n"
                    "period (below 300 Hz: three samples); the last torques are held. fault: the signals cannot be used;\n"
                    "`causes` contains the reasons.")
      .value("warming_up", Health::warming_up)
      .value("ok", Health::ok)
      .value("stale", Health::stale)
      .value("fault", Health::fault);
}

void bind_signals(nb::class_<Estimate>& estimate) {
  estimate.def_ro("t_ns", &Estimate::t_ns, "Time stamp of the sample, [ns].")
      .def_ro("health", &Estimate::health,
              "Whether the torques can be trusted. warming_up: tau_ext is NaN, for about a second after the start and after\n"
              "a restart, whose cause is in `causes`.")
      .def_prop_ro("causes", [](const Estimate& e) { return cause_names(e.causes); },
                   "Names of the causes of a health that is not ok, or of the current warm-up.")
      .def_ro("cause_joint", &Estimate::cause_joint, "Index of the first joint that a cause concerns; -1: none.")
      .def_ro("alarm", &Estimate::alarm, "The latched alarm: a collision stays until acknowledge() or resume().")
      .def_ro("held_alarm", &Estimate::held_alarm, "Level exceeded at this sample, after its hold time; not latched.")
      .def_ro("alarm_joint", &Estimate::alarm_joint,
           "Index of the joint that raised the alarm to its level; -1: no alarm.")
      .def_ro("alarm_t_ns", &Estimate::alarm_t_ns, "Time at which the alarm rose to its level, [ns].")
      .def_ro("alarm_number", &Estimate::alarm_number,
              "Number of the newest alarm, which stands if one does; 0: there was none.")
      .def_ro("touch_t_ns", &Estimate::touch_t_ns,
              "Last sample at which some joint was over a threshold, [ns]; 0: none since the last alarm.")
      .def_ro("touch_over", &Estimate::touch_over,
              "No alarm, or all torques within their thresholds, and known, for contact_release_s of the bundle.")
      .def_ro("touch", &Estimate::touch,
              "Kind of touch behind the alarm, as of the previous sample.")
      .def_ro("detection", &Estimate::detection,
              "Whether some |tau_ext| exceeds its collision threshold at this sample; no hold time.")
      .def_prop_ro("clear", &Estimate::clear, "Healthy and no alarm: the only condition that means no collision.")
      .def_prop_ro("near_stiction", [](const Estimate& e) { return joint_bits(e.near_stiction, e.joints); },
                   "Per joint: whether its threshold near stiction applies.")
      .def_prop_ro("drift_saturated", [](const Estimate& e) { return joint_bits(e.drift_saturated, e.joints); },
                   "Per joint: whether its drift has reached the bound; retrain.")
      .def_ro("unfamiliar", &Estimate::unfamiliar, "Distance of the motion from the training motion, 0 to 1.")
      .def_ro("unseen", &Estimate::unseen,
           "Main difference from the training motion, of unseen_joint and unseen_other.")
      .def_ro("load", &Estimate::load, "Payload that the model carries; mass 0: none.")
      .def_ro("load_phase", &Estimate::load_phase, "Phase of an expected payload.")
      .def_ro("load_found_ns", &Estimate::load_found_ns,
              "Time at which the last expected payload was found, [ns]; 0: none.")
      .def_ro("load_error_kg", &Estimate::load_error_kg, "Standard error of its mass, [kg].")
      .def_ro("unseen_joint", &Estimate::unseen_joint, "Index of the joint of `unseen`; -1: none.")
      .def_ro("unseen_other", &Estimate::unseen_other,
              "Index of the joint whose position did not occur in training together with that of unseen_joint; -1: none.");
}

void bind_declared(nb::class_<Estimate>& estimate) {
  estimate.def_ro("declared", &Estimate::declared, "State of the expected contact in effect.")
      .def_ro("declared_contact", &Estimate::declared_contact, "Its number, of Monitor.expect_contact(); -1: none is in effect.")
      .def_ro("declared_size", &Estimate::declared_size,
              "Its force within the cone, however large, [N]; of a joint the torque, in its unit.")
      .def_ro("declared_sigma", &Estimate::declared_sigma, "Standard error of declared_size.")
      .def_ro("declared_moment_nm", &Estimate::declared_moment_nm, "Its moment, [N m].")
      .def_ro("declared_travel_m", &Estimate::declared_travel_m,
              "Way of its point along the axis since the contact began, [m].");
}

// A torque of every joint.
void bind_torque(nb::class_<Estimate>& estimate, const char* name, JointVector Estimate::*values, const char* doc) {
  estimate.def_prop_ro(
      name,
      [values](const Estimate& e) { return std::vector<double>((e.*values).begin(), (e.*values).begin() + e.joints); },
      doc);
}

void bind_torques(nb::class_<Estimate>& estimate) {
  bind_torque(estimate, "residual", &Estimate::residual, "r of the observer, [N m]: dr/dt = K0 (tau_dist - r).");
  bind_torque(estimate, "prior", &Estimate::prior,
               "r that the prior expects in free motion, [N m]; 0 without a prior.");
  bind_torque(estimate, "network", &Estimate::network, "What the network adds to the prior, [N m]; 0 without a network.");
  bind_torque(estimate, "load_nm", &Estimate::load_nm,
               "Part of tau_ext attributed to an expected payload, [N m]; the alarm uses the rest. 0 if none is expected.");
  bind_torque(estimate, "declared_nm", &Estimate::declared_nm,
               "Part of tau_ext that expected contacts explain, [N m]; the alarm uses the rest.");
  bind_torque(estimate, "drift", &Estimate::drift,
               "Slow changes of r since training, from the tracker, [N m]; 0 without a tracker.");
  bind_torque(estimate, "uncertainty", &Estimate::uncertainty,
               "r expected in free motion: prior + network + drift, [N m].");
  bind_torque(estimate, "tau_ext", &Estimate::tau_ext,
               "External torque, residual - uncertainty, [N m]: positive where the environment pushes the joint in its\n"
               "positive direction.");
  bind_torque(estimate, "doubt", &Estimate::doubt,
               "Possible error of the prior while presliding states are unknown, and of the payload's torques, [N m]; thresholds\n"
               "include it.");
  bind_torque(estimate, "sigma_nm", &Estimate::sigma_nm,
               "Standard error of tau_ext in free motion, doubt included, [N m]; NaN without an error scale.");
  bind_torque(estimate, "contact_sigma_nm", &Estimate::contact_sigma_nm,
               "Standard error of tau_ext during and after a contact, [N m]. Includes friction that a resting joint hides,\n"
               "gear friction under load and the observer's lag. Equal to sigma_nm in free motion. Thresholds use sigma_nm.");
  bind_torque(estimate, "limit_scale", &Estimate::limit_scale, "Factor of the motion on the thresholds; 1 in usual motion.");
  bind_torque(estimate, "limit_nm", &Estimate::limit_nm,
               "Collision threshold of |tau_ext| at this sample, scale and doubt included, [N m].");
  bind_torque(estimate, "contact_limit_nm", &Estimate::contact_limit_nm,
       "Contact threshold of |tau_ext| at this sample, scale and doubt included, [N m].");
  bind_torque(estimate, "margin_nm", &Estimate::margin_nm, "limit_nm - |tau_ext - load_nm - declared_nm|, [N m]; negative at a detection.");
}

}  // namespace

void bind_estimate(nb::module_& m) {
  bind_levels(m);
  m.def("cause_names", &cause_names, nb::arg("causes"),
        "Names of the bits of `causes` of Monitor.run() and Estimates: why health is not ok.");
  nb::class_<Estimate> estimate(m, "Estimate",
      "The monitor's result for one sample; torques that do not exist are NaN.");
  bind_signals(estimate);
  bind_declared(estimate);
  bind_torques(estimate);
}

}  // namespace tauext::bindings
