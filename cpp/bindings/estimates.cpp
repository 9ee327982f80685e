// The chain on whole recordings.
#include "stages/estimates.hpp"

#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>

#include "arrays.hpp"
#include "tauext/bundle.hpp"

namespace tauext::bindings {
namespace {

ArrayDict estimate_recording(const Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q,
                             const Array<double, 2>& dq, const Array<double, 2>& tau, int threads,
                             const Temperatures& temperature, const std::optional<Array<float, 2>>& outputs,
                             const std::vector<std::string>& torques,
                             const std::vector<std::tuple<NamedContact, std::int64_t, double>>& contacts) {
  const RecordingView recording = view(t_ns, q, dq, tau, temperature);
  std::vector<TimedContact> timed;
  for (const auto& [named, from_ns, seconds] : contacts)
    timed.push_back({contact_of(WrenchModel(b), named), from_ns, seconds});
  const auto known = outputs ? std::span<const float>(outputs->data(), outputs->size()) : std::span<const float>();
  Estimates e;
  {
    nb::gil_scoped_release released;
    e = estimate(b, recording, threads, known, torques, timed);
  }
  const std::size_t N = t_ns.shape(0), n = q.shape(1);
  ArrayDict out;
  for (const TorqueColumn& one : kTorqueColumns)
    if (torques.empty() || std::ranges::find(torques, one.name) != torques.end())
      out[one.name] = to_numpy(std::move(e.*one.column), {N, n});
  out["unfamiliar"] = to_numpy(std::move(e.unfamiliar), {N});
  out["unseen"] = to_numpy(std::move(e.unseen), {N});
  out["unseen_joint"] = to_numpy(std::move(e.unseen_joint), {N});
  out["unseen_other"] = to_numpy(std::move(e.unseen_other), {N});
  out["near_stiction"] = to_numpy(std::move(e.near_stiction), {N, n});
  out["health"] = to_numpy(std::move(e.health), {N});
  out["causes"] = to_numpy(std::move(e.causes), {N});
  out["cause_joint"] = to_numpy(std::move(e.cause_joint), {N});
  out["detection"] = to_numpy(std::move(e.detection), {N});
  out["alarm"] = to_numpy(std::move(e.alarm), {N});
  out["alarm_joint"] = to_numpy(std::move(e.alarm_joint), {N});
  out["held_alarm"] = to_numpy(std::move(e.held_alarm), {N});
  out["touch"] = to_numpy(std::move(e.touch), {N});
  out["declared"] = to_numpy(std::move(e.declared), {N});
  out["declared_contact"] = to_numpy(std::move(e.declared_contact), {N});
  out["declared_size"] = to_numpy(std::move(e.declared_size), {N});
  out["declared_sigma"] = to_numpy(std::move(e.declared_sigma), {N});
  out["entered"] = to_numpy(std::move(e.entered), {N});
  out["restarted"] = to_numpy(std::move(e.restarted), {N});
  return out;
}

void bind_errors_of_motion(nb::module_& m) {
  m.def(
      "motion_errors",
      [](const Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& dq,
         const Array<std::uint8_t, 2>& near_stiction, const Array<std::uint8_t, 1>& entered,
         const Array<std::uint8_t, 1>& restarted, const Array<std::int64_t, 1>& rows) {
        const std::size_t samples = dq.shape(0) * dq.shape(1), near = near_stiction.shape(0) * near_stiction.shape(1);
        MotionErrors e;
        {
          nb::gil_scoped_release released;
          e = motion_errors(b,
                            {span_of(t_ns), {dq.data(), samples}, {near_stiction.data(), near}, span_of(entered),
                             span_of(restarted)},
                            span_of(rows));
        }
        const std::size_t N = rows.shape(0), n = dq.shape(1);
        ArrayDict out;
        out["features"] = to_numpy(std::move(e.features), {N, n, b.error_scale.features.size()});
        out["scale"] = to_numpy(std::move(e.scale), {N, n});
        out["sigma_nm"] = to_numpy(std::move(e.sigma_nm), {N, n});
        return out;
      },
      nb::arg("bundle"), nb::arg("t_ns"), nb::arg("dq"), nb::arg("near_stiction"), nb::arg("entered"),
      nb::arg("restarted"), nb::arg("rows"),
      "Features, scale and standard error of the bundle's error scale at these rows of a motion; see estimates.hpp.");
  m.def(
      "errors_after",
      [](const Bundle& b, const std::vector<double>& speeds_rad_s, bool near_stiction) {
        const auto n = static_cast<std::size_t>(b.joints()), samples = speeds_rad_s.size();
        std::vector<std::int64_t> t_ns(samples);
        std::vector<double> dq;
        for (std::size_t k = 0; k < samples; ++k) {
          t_ns[k] = static_cast<std::int64_t>(k) * b.observer.sample_period_ns;
          dq.insert(dq.end(), n, speeds_rad_s[k]);
        }
        const std::vector<std::uint8_t> near(samples * n, near_stiction), entered(samples, 1), restarted(samples, 0);
        const std::int64_t last = static_cast<std::int64_t>(samples) - 1;
        const MotionErrors e = motion_errors(b, {t_ns, dq, near, entered, restarted}, {&last, 1});
        return std::pair(e.scale, e.sigma_nm);
      },
      nb::arg("bundle"), nb::arg("speeds_rad_s"), nb::arg("near_stiction"),
      "Scale and standard error of each joint at the end of a motion in which every joint has these speeds, one sample "
      "period apart. near_stiction: state at the end. Returns lists, so that NumPy is not loaded.");
}

}  // namespace

void bind_estimates(nb::module_& m) {
  m.def(
      "estimate", &estimate_recording,
      nb::arg("bundle"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("threads"),
      nb::arg("temperature") = nb::none(), nb::arg("outputs") = nb::none(),
      nb::arg("torques") = std::vector<std::string>(),
      nb::arg("contacts") = std::vector<std::tuple<NamedContact, std::int64_t, double>>(),
      "Runs the whole chain on a recording; the results equal those of run() of a new Monitor. outputs: those of "
      "network_outputs(), so that the network is not run again. torques: names of the torque columns that are returned; "
      "empty: all. contacts: expected contacts, from a time [ns] on, for seconds. Flags are uint8, 0 or 1: call "
      ".astype(bool) before ~ or a mask. See estimates.hpp.");
  m.def(
      "network_outputs",
      [](const Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
         const Array<double, 2>& tau, int threads, const Temperatures& temperature) {
        const RecordingView recording = view(t_ns, q, dq, tau, temperature);
        std::vector<float> outputs;
        {
          nb::gil_scoped_release released;
          outputs = network_outputs(b, recording, threads);
        }
        const std::size_t n = q.shape(1), judged = outputs.size() / n;
        return to_numpy(std::move(outputs), {judged, n});
      },
      nb::arg("bundle"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("threads"),
      nb::arg("temperature") = nb::none(),
      "The network's outputs for each judged sample of a recording, (judged, joints); none without a network.");
  bind_errors_of_motion(m);
}

}  // namespace tauext::bindings
