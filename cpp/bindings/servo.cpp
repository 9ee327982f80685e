// Computation of dq and tau from servo signals.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"
#include "tauext/servo_input.hpp"

namespace tauext::bindings {
namespace {

using Row = std::optional<Array<double, 1>>;
using Rows = std::optional<Array<double, 2>>;

std::span<const double> of(const Row& row, std::size_t joints, const char* what) {
  if (!row) return {};
  if (row->shape(0) != joints)
    throw Error(std::string(what) + " has " + std::to_string(row->shape(0)) + " values where " + std::to_string(joints) + " belong");
  return span_of(*row);
}

// Rows of a signal, one per sample; empty: not measured.
struct Column {
  const double* data = nullptr;
  std::size_t joints = 0;

  Column(const Rows& rows, std::size_t samples, std::size_t n, const char* what) : joints(n) {
    if (!rows) return;
    if (rows->shape(0) != samples || rows->shape(1) != n)
      throw Error(std::string(what) + " must have the shape (" + std::to_string(samples) + ", " + std::to_string(n) + ")");
    data = rows->data();
  }
  std::span<const double> at(std::size_t k) const noexcept {
    return data ? std::span(data + k * joints, joints) : std::span<const double>();
  }
};

std::vector<double> copied(std::span<const double> values) { return {values.begin(), values.end()}; }

// A servo input and its number of joints.
struct Input {
  std::size_t joints;
  ServoSettings settings;
  ServoInput input;
  explicit Input(const ServoSettings& s) : joints(s.joints.size()), settings(s), input(s) {}
};

void bind_settings(nb::module_& m) {
  nb::enum_<TorqueFrom>(m, "TorqueFrom", "Signal from which a servo's torque is computed; see settings.hpp.")
      .value("torque", TorqueFrom::torque)
      .value("phase_current", TorqueFrom::phase_current)
      .value("supply_current", TorqueFrom::supply_current)
      .value("duty", TorqueFrom::duty)
      .value("goal", TorqueFrom::goal);
  nb::class_<ServoConstants>(m, "ServoConstants",
      "Constants of a servo at the joint, behind its gear; see settings.hpp.")
      .def(
          "__init__",
          [](ServoConstants* c, double volts, double ohm, double back_emf_v_s, double nm_per_ampere, double duty_per_rad,
             double most_duty, double count_rad) {
            new (c) ServoConstants{volts, ohm, back_emf_v_s, nm_per_ampere, duty_per_rad, most_duty, count_rad};
          },
          nb::arg("volts") = 1.0, nb::arg("ohm") = 1.0, nb::arg("back_emf_v_s") = 0.0, nb::arg("nm_per_ampere") = 1.0,
          nb::arg("duty_per_rad") = 0.0, nb::arg("most_duty") = 1.0, nb::arg("count_rad") = 0.0)
      .def_ro("volts", &ServoConstants::volts, "Supply voltage if the samples contain none, [V].")
      .def_ro("ohm", &ServoConstants::ohm, "Resistance of the windings, [ohm].")
      .def_ro("back_emf_v_s", &ServoConstants::back_emf_v_s, "k_e, [V s/rad].")
      .def_ro("nm_per_ampere", &ServoConstants::nm_per_ampere, "k_t, [N m/A]; 1 if unknown.")
      .def_ro("duty_per_rad", &ServoConstants::duty_per_rad, "Gain of the position controller, duty per rad.")
      .def_ro("most_duty", &ServoConstants::most_duty, "Largest duty of the controller, 0 to 1.")
      .def_ro("count_rad", &ServoConstants::count_rad, "Resolution of the encoder, [rad]; 0: unknown.");
  nb::class_<ServoSettings>(m, "ServoSettings", "Computation of dq and tau from servo signals; off without joints.")
      .def(nb::init<>())
      .def(
          "__init__",
          [](ServoSettings* s, TorqueFrom torque_from, std::vector<ServoConstants> joints, int velocity_steps,
             std::int64_t sample_period_ns, std::int64_t goal_delay_ns) {
            ServoSettings settings{torque_from, velocity_steps, sample_period_ns, goal_delay_ns, std::move(joints)};
            settings.validate();
            new (s) ServoSettings(std::move(settings));
          },
          nb::arg("torque_from"), nb::arg("joints"), nb::arg("velocity_steps") = 0, nb::arg("sample_period_ns") = 0,
          nb::arg("goal_delay_ns") = 0)
      .def_ro("torque_from", &ServoSettings::torque_from, "Signal from which the torque is computed.")
      .def_ro("velocity_steps", &ServoSettings::velocity_steps,
           "Largest window of the velocity, in steps; 0: dq is used unchanged.")
      .def_ro("sample_period_ns", &ServoSettings::sample_period_ns, "Sample period, [ns].")
      .def_ro("goal_delay_ns", &ServoSettings::goal_delay_ns, "Time after which a goal acts, [ns].")
      .def_prop_ro("joints", [](const ServoSettings& s) { return s.joints; }, "Constants per joint.")
      .def_prop_ro("on", &ServoSettings::on, "Whether these are servos.");
}

}  // namespace

void bind_servo(nb::module_& m) {
  bind_settings(m);
  nb::class_<Input>(m, "ServoInput",
      "Computes dq and tau from servo signals, sample by sample; equations in servo_input.hpp.")
      .def(nb::init<const ServoSettings&>(), nb::arg("settings"))
      .def(
          "step",
          [](Input& s, std::int64_t t_ns, const Array<double, 1>& q, const Row& dq, const Row& tau, const Row& q_des,
             const Row& current, const Row& duty, const Row& voltage) {
            const std::size_t n = s.joints;
            s.input.step({t_ns, of(q, n, "q"), of(dq, n, "dq"), of(tau, n, "tau"), of(q_des, n, "q_des"),
                          of(current, n, "current"), of(duty, n, "duty"), of(voltage, n, "voltage")});
            return std::pair(to_numpy(copied(s.input.dq()), {n}), to_numpy(copied(s.input.tau()), {n}));
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq") = nb::none(), nb::arg("tau") = nb::none(),
          nb::arg("q_des") = nb::none(), nb::arg("current") = nb::none(), nb::arg("duty") = nb::none(),
          nb::arg("voltage") = nb::none(),
          "Returns dq [rad/s] and tau of the next sample. None: not measured. If a required signal is missing, they are NaN.")
      .def(
          "recording",
          [](const Input& s, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Rows& dq, const Rows& tau,
             const Rows& q_des, const Rows& current, const Rows& duty, const Rows& voltage) {
            const std::size_t N = t_ns.shape(0), n = s.joints;
            const Column of_q(q, N, n, "q"), of_dq(dq, N, n, "dq"), of_tau(tau, N, n, "tau"), of_goal(q_des, N, n,
                 "q_des"),
                of_current(current, N, n, "current"), of_duty(duty, N, n, "duty"), of_voltage(voltage, N, n, "voltage");
            std::vector<double> dq_out, tau_out;
            ServoInput fresh(s.settings);
            {
              nb::gil_scoped_release released;
              for (std::size_t k = 0; k < N; ++k) {
                fresh.step({t_ns.data()[k], of_q.at(k), of_dq.at(k), of_tau.at(k), of_goal.at(k), of_current.at(k),
                            of_duty.at(k), of_voltage.at(k)});
                dq_out.insert(dq_out.end(), fresh.dq().begin(), fresh.dq().end());
                tau_out.insert(tau_out.end(), fresh.tau().begin(), fresh.tau().end());
              }
            }
            return std::pair(to_numpy(std::move(dq_out), {N, n}), to_numpy(std::move(tau_out), {N, n}));
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq") = nb::none(), nb::arg("tau") = nb::none(),
          nb::arg("q_des") = nb::none(), nb::arg("current") = nb::none(), nb::arg("duty") = nb::none(),
          nb::arg("voltage") = nb::none(),
          "Returns dq and tau of a recording, (samples, joints), as a new input returns them step by step.")
      .def("reset", [](Input& s) { s.input.reset(); }, "Treats the next sample as the first one.");
}

}  // namespace tauext::bindings
