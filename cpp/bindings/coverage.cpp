// Coverage: motion of the training recordings, and the distance of other motion from it.
#include "alarm/coverage.hpp"

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"

namespace tauext::bindings {
namespace {

std::size_t expect_joints(const CoverageSettings& settings, const Array<double, 2>& q) {
  const std::size_t n = q.shape(1);
  if (n < 1 || n > kMaxJoints) throw Error("recordings have 1 to 32 joints, not " + std::to_string(n));
  settings.validate(static_cast<int>(n));
  return n;
}

ArrayDict evaluate(const CoverageSettings& settings, const Array<double, 2>& q, const Array<double, 2>& dq) {
  const std::size_t n = expect_joints(settings, q), N = q.shape(0);
  if (dq.shape(0) != N || dq.shape(1) != n)
    throw Error("dq must have the shape (" + std::to_string(N) + ", " + std::to_string(n) + ")");
  std::vector<double> share(N);
  std::vector<std::uint8_t> what(N);
  std::vector<std::int8_t> joint(N), other(N);
  {
    nb::gil_scoped_release released;
    const Coverage coverage(static_cast<int>(n), settings, 1.0);
    for (std::size_t k = 0; k < N; ++k) {
      const Unfamiliar u = coverage.evaluate({q.data() + k * n, n}, {dq.data() + k * n, n});
      share[k] = u.share;
      what[k] = static_cast<std::uint8_t>(u.what);
      joint[k] = static_cast<std::int8_t>(u.joint);
      other[k] = static_cast<std::int8_t>(u.other);
    }
  }
  ArrayDict out;
  out["share"] = to_numpy(std::move(share), {N});
  out["what"] = to_numpy(std::move(what), {N});
  out["joint"] = to_numpy(std::move(joint), {N});
  out["other"] = to_numpy(std::move(other), {N});
  return out;
}

}  // namespace

void bind_coverage(nb::module_& m) {
  nb::enum_<Unseen>(m, "Unseen", "Part of a motion that did not occur in training.")
      .value("nothing", Unseen::nothing)
      .value("speed", Unseen::speed)
      .value("position", Unseen::position)
      .value("positions", Unseen::positions);
  nb::class_<CoverageSettings> settings(m, "CoverageSettings",
                                        "Motion of the training recordings: speeds, and positions in cells; see settings.hpp.");
  settings.def(nb::init<>())
      .def_rw("fastest_rad_s", &CoverageSettings::fastest_rad_s)
      .def_rw("turns", &CoverageSettings::turns)
      .def_rw("centre_rad", &CoverageSettings::centre_rad)
      .def_rw("span_rad", &CoverageSettings::span_rad)
      .def_rw("seen", &CoverageSettings::seen)
      .def_rw("reach", &CoverageSettings::reach)
      .def_rw("seen_together", &CoverageSettings::seen_together)
      .def_rw("reach_together", &CoverageSettings::reach_together)
      .def_prop_ro("empty", &CoverageSettings::empty)
      .def(
          "see",
          [](CoverageSettings& s, const Array<double, 2>& q) {
            const std::size_t n = expect_joints(s, q);
            if (s.empty()) throw Error("coverage: set speeds and cells before see()");
            nb::gil_scoped_release released;
            for (std::size_t k = 0; k < q.shape(0); ++k) s.see({q.data() + k * n, n});
          },
          nb::arg("q"), "Marks the cells of positions (samples, joints) as seen.")
      .def("look", &evaluate, nb::arg("q"), nb::arg("dq"),
           "Distance of each sample from the training motion: share (0 to 1), what (Unseen), joint, other (-1: none).");
  settings.attr("CELLS") = CoverageSettings::kCells;
  settings.attr("PAIR_CELLS") = CoverageSettings::kPairCells;
  settings.attr("WORTH_TELLING") = Coverage::kWorthReporting;
}

}  // namespace tauext::bindings
