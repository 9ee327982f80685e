// Flight recorder.
#include "flights.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"

namespace tauext::bindings {
namespace {

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
  out["declared_nm"] = to_numpy(std::move(f.declared_nm), {N, n});
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

}  // namespace

void bind_flights(nb::module_& m) {
  nb::class_<Recorder>(m, "FlightRecorder", "Keeps the last seconds before an alarm or fault for another thread.")
      .def(
          "__init__",
          [](Recorder* r, int joints, std::int64_t sample_period_ns, double before_s, double after_s, bool contacts) {
            new (r) Recorder(joints, sample_period_ns, {before_s, after_s, contacts});
          },
          nb::arg("joints"), nb::arg("sample_period_ns"), nb::arg("before_s") = 5.0, nb::arg("after_s") = 1.0,
          nb::arg("contacts") = false)
      .def("finish", [](Recorder& r) { return r.finish(); },
           "Hands over an event whose later samples are incomplete; call it at the end. False: take the previous flight\n"
           "first, then call it again.")
      .def("take", [](Recorder& r) { return take(r, r.joints); },
           "Returns a flight as arrays, oldest row first, or None.")
      .def_prop_ro("events", [](const Recorder& r) { return r.events(); },
                   "Number of events, including those within the flight of another event.")
      .def_prop_ro("missed", [](const Recorder& r) { return r.missed(); },
                   "Number of flights discarded because the previous one was not taken in time.");
}

}  // namespace tauext::bindings
