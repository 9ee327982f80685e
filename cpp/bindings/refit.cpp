// Refit and its results.
#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "tauext/refit.hpp"

namespace tauext::bindings {
namespace {

using Source = std::tuple<Array<std::int64_t, 1>, Array<double, 2>, Array<double, 2>, Array<double, 2>,
                          std::optional<Array<std::uint8_t, 1>>>;

Refit refit_sources(const Bundle& bundle, const std::vector<Source>& sources, const std::optional<RefitSettings>& settings, int threads) {
  std::vector<RefitSource> views;
  for (const auto& [t_ns, q, dq, tau, use] : sources) {
    RefitSource source{view(t_ns, q, dq, tau), {}};
    if (source.recording.joints != bundle.joints())
      throw Error("the bundle has " + std::to_string(bundle.joints()) + " joints, the recording " +
                  std::to_string(source.recording.joints));
    if (use) source.use = span_of(*use);
    views.push_back(source);
  }
  nb::gil_scoped_release released;
  return refit(bundle, views, settings.value_or(RefitSettings{}), threads);
}

ArrayDict left_out(const Refit& found) {
  const RefitErrors& e = found.left_out;
  const std::size_t N = e.t_ns.size(), n = found.joints.size();
  ArrayDict out;
  out["t_ns"] = to_numpy(std::vector(e.t_ns), {N});
  out["free"] = to_numpy(std::vector(e.free), {N});
  out["share"] = to_numpy(std::vector(e.share), {N, n});
  out["near_stiction"] = to_numpy(std::vector(e.near_stiction), {N, n});
  return out;
}

}  // namespace

void bind_refit(nb::module_& m) {
  nb::class_<RefitSettings>(m, "RefitSettings", "Standard deviations of the changes since training; see refit.hpp.")
      .def(nb::init<>())
      .def_rw("common", &RefitSettings::common)
      .def_rw("apart", &RefitSettings::apart)
      .def_rw("single", &RefitSettings::single)
      .def_rw("constant", &RefitSettings::constant)
      .def_rw("ripple", &RefitSettings::ripple)
      .def_rw("trend", &RefitSettings::trend)
      .def_rw("network", &RefitSettings::network)
      .def_rw("expected", &RefitSettings::expected)
      .def_rw("expected_error", &RefitSettings::expected_error);
  const auto pair = [](const RefitFactor& factor) { return std::pair(factor.value, factor.error); };
  nb::class_<RefitJoint>(m, "RefitJoint", "A refit's result for one joint; see refit.hpp.")
      .def_prop_ro("coulomb", [pair](const RefitJoint& j) { return pair(j.coulomb); },
           "Factor of the Coulomb friction, and its standard error.")
      .def_prop_ro("viscous", [pair](const RefitJoint& j) { return pair(j.viscous); },
           "Factor of the viscous friction, and its standard error.")
      .def_ro("constant_nm", &RefitJoint::constant_nm)
      .def_ro("constant_error_nm", &RefitJoint::constant_error_nm)
      .def_ro("moved_s", &RefitJoint::moved_s)
      .def_ro("error_ratio", &RefitJoint::error_ratio)
      .def_ro("error_ratio_upper", &RefitJoint::error_ratio_upper)
      .def_ro("largest_share", &RefitJoint::largest_share)
      .def_ro("limit_factor", &RefitJoint::limit_factor)
      .def_ro("sigma_factor", &RefitJoint::sigma_factor);
  nb::class_<RefitTouch>(m, "RefitTouch", "Time in which no friction explains the torques; see refit.hpp.")
      .def_ro("source", &RefitTouch::source)
      .def_ro("joint", &RefitTouch::joint)
      .def_ro("from_ns", &RefitTouch::from_ns)
      .def_ro("to_ns", &RefitTouch::to_ns)
      .def_ro("share", &RefitTouch::share)
      .def_ro("counted", &RefitTouch::counted);
  nb::class_<Refit>(m, "Refit", "The new bundle and how it differs from the old one.")
      .def_ro("bundle", &Refit::bundle)
      .def_ro("joints", &Refit::joints)
      .def_ro("touches", &Refit::touches)
      .def_ro("used_s", &Refit::used_s)
      .def_ro("memory_s", &Refit::memory_s)
      .def_prop_ro("left_out", &left_out, "Errors on held-out motion: t_ns, free, share, near_stiction.");
  m.def("refit", &refit_sources, nb::arg("bundle"), nb::arg("sources"), nb::arg("settings") = nb::none(),
        nb::arg("threads") = 1,
        "Updates the friction of a bundle from today's motion. sources: tuples (t_ns, q, dq, tau, use); use: 0 leaves a\n"
        "sample out, None: all are used. Raises CoreError if the motion does not suffice; see refit.hpp.");
}

}  // namespace tauext::bindings
