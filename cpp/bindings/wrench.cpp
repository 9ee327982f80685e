// Forces and moments at frames of the arm.
#include "tauext/wrench.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "arrays.hpp"
#include "tauext/bundle.hpp"

namespace tauext::bindings {
namespace {

nb::ndarray<nb::numpy, double> covariance(const FrameWrench& w) {
  const auto m = static_cast<std::size_t>(w.unknowns);
  return to_numpy(std::vector(w.covariance.begin(), w.covariance.begin() + static_cast<std::ptrdiff_t>(m * m)), {m, m});
}

nb::ndarray<nb::numpy, double> blind(const FrameWrench& w) {
  const auto m = static_cast<std::size_t>(w.unknowns), rows = static_cast<std::size_t>(w.blind);
  std::vector<double> out;
  for (std::size_t k = 0; k < rows; ++k)
    out.insert(out.end(), w.blind_directions[k].begin(), w.blind_directions[k].begin() + static_cast<std::ptrdiff_t>(m));
  return to_numpy(std::move(out), {rows, m});
}

// A value and its standard error, both with the decimals that show two digits of the error: "12.3 ± 1.5".
std::string with_error(double value, double error) {
  const bool usable = error > 0 && std::isfinite(error);
  const int decimals = usable ? std::clamp(1 - static_cast<int>(std::floor(std::log10(error))), 0, 6) : 3;
  char text[80];
  std::snprintf(text, sizeof text, "%.*f ± %.*f", decimals, value, decimals, error);
  return text;
}

// Three components from `first` on, with the square roots of the covariance's diagonal.
std::string three(const Wrench& w, const std::array<double, 3>& values, std::size_t first) {
  const auto m = static_cast<std::size_t>(w.unknowns);
  std::string out;
  for (std::size_t k = 0; k < 3; ++k) {
    const std::size_t at = first + k;
    out += (k ? ", " : "") + with_error(values[k], std::sqrt(w.covariance[at * m + at]));
  }
  return "(" + out + ")";
}

std::string repr(const FrameWrench& w) {
  std::string out = "<Wrench at " + w.frame;
  if (w.point) out += " (" + to_text((*w.point)[0]) + ", " + to_text((*w.point)[1]) + ", " + to_text((*w.point)[2]) + ") m";
  out += w.axes == WrenchAxes::base ? ", axes of the base: " : ", axes of the frame: ";
  if (!w.known) return out + "unknown>";
  out += "force " + three(w, w.force, 0) + " N";
  if (w.unknowns == 6) out += ", moment " + three(w, w.moment, 3) + " N m";
  if (w.blind > 0) out += ", " + std::to_string(w.blind) + (w.blind == 1 ? " blind direction" : " blind directions");
  return out + ">";
}

struct Signals {
  std::size_t samples, joints;
  const double *q, *tau_ext, *sigma_nm;
  std::span<const double> row(const double* of, std::size_t k) const { return {of + k * joints, joints}; }
};

Signals expect(const WrenchModel& model, const Array<double, 2>& q, const Array<double, 2>& tau_ext,
               const Array<double, 2>& sigma_nm) {
  const std::size_t N = q.shape(0), n = static_cast<std::size_t>(model.joints());
  for (const Array<double, 2>* one : {&q, &tau_ext, &sigma_nm})
    if (one->shape(0) != N || one->shape(1) != n)
      throw Error("q, tau_ext and sigma_nm must have the shape (samples, " + std::to_string(n) + ")");
  return {N, n, q.data(), tau_ext.data(), sigma_nm.data()};
}

int expect_frame(const WrenchModel& model, const std::string& name) {
  const int frame = model.find(name);
  if (frame >= 0) return frame;
  std::string known;
  for (int k = 0; k < model.frames(); ++k) known += (k ? ", " : "") + model.frame(k).name;
  throw Error("frame = '" + name + "' must be one of " + known);
}

void expect_positions(const WrenchModel& model, const std::vector<double>& q) {
  if (q.size() != static_cast<std::size_t>(model.joints()))
    throw Error("q must hold " + std::to_string(model.joints()) + " values");
}

nb::ndarray<nb::numpy, double> columns(const WrenchModel& model, const std::string& frame, const std::vector<double>& q,
                                       const std::array<double, 3>& point, WrenchAxes axes) {
  expect_positions(model, q);
  std::vector<double> out(6 * q.size());
  model.columns(expect_frame(model, frame), q, point, axes, out);
  return to_numpy(std::move(out), {6, q.size()});
}

std::pair<nb::ndarray<nb::numpy, double>, nb::ndarray<nb::numpy, double>> pose(
    const WrenchModel& model, const std::string& frame, const std::vector<double>& q) {
  expect_positions(model, q);
  const auto [rotation, origin] = model.pose(expect_frame(model, frame), q);
  return {to_numpy(std::vector(rotation.begin(), rotation.end()), {3, 3}),
          to_numpy(std::vector(origin.begin(), origin.end()), {3})};
}

nb::ndarray<nb::numpy, double> covariance_of_joints(const WrenchModel& model, bool force_alone,
                                                    const std::vector<double>& tau_ext, const std::vector<double>& sigma_nm,
                                                    const std::vector<double>& contact_sigma_nm) {
  const auto n = static_cast<std::size_t>(model.joints());
  if (tau_ext.size() != n || sigma_nm.size() != n || (!contact_sigma_nm.empty() && contact_sigma_nm.size() != n))
    throw Error("tau_ext, sigma_nm and contact_sigma_nm must hold " + std::to_string(n) + " values");
  std::vector<double> out(n * n);
  model.covariance(force_alone ? WrenchKind::force : WrenchKind::wrench, tau_ext, sigma_nm, contact_sigma_nm, out);
  return to_numpy(std::move(out), {n, n});
}

ArrayDict wrenches(const WrenchModel& model, const std::string& name, const Array<double, 2>& q,
                   const Array<double, 2>& tau_ext, const Array<double, 2>& sigma_nm,
                   const std::optional<std::array<double, 3>>& point, WrenchAxes axes,
                   const std::optional<Array<double, 2>>& contact_sigma_nm, const std::optional<Array<double, 2>>& dq) {
  if (!model.refused().empty()) throw Error("no wrench: " + model.refused());
  const int frame = expect_frame(model, name);
  const Signals s = expect(model, q, tau_ext, sigma_nm);
  const std::size_t m = point ? 3 : 6;
  const auto expect_shape = [&s](const std::optional<Array<double, 2>>& of, const char* name) {
    if (of && (of->shape(0) != s.samples || of->shape(1) != s.joints)) throw Error(std::string(name) + " must have the shape of q");
  };
  expect_shape(contact_sigma_nm, "contact_sigma_nm");
  expect_shape(dq, "dq");
  std::vector<double> force, moment, covariances, chi_square, consistent, directions(s.samples * m * m, 0.0);
  std::vector<std::int32_t> blind_count, freedom;
  {
    nb::gil_scoped_release released;
    for (std::size_t k = 0; k < s.samples; ++k) {
      const auto at = [&](const double* of) { return s.row(of, k); };
      const auto if_given = [&](const std::optional<Array<double, 2>>& of) {
        return of ? at(of->data()) : std::span<const double>();
      };
      const std::span<const double> sigma = if_given(contact_sigma_nm), speed = if_given(dq);
      const Wrench w = point ? model.force(frame, *point, at(s.q), at(s.tau_ext), at(s.sigma_nm), axes, sigma, speed)
                             : model.wrench(frame, at(s.q), at(s.tau_ext), at(s.sigma_nm), axes, sigma, speed);
      force.insert(force.end(), w.force.begin(), w.force.end());
      moment.insert(moment.end(), w.moment.begin(), w.moment.end());
      covariances.insert(covariances.end(), w.covariance.begin(), w.covariance.begin() + static_cast<std::ptrdiff_t>(m * m));
      blind_count.push_back(w.blind);
      for (std::size_t b = 0; b < static_cast<std::size_t>(w.blind); ++b)
        std::copy_n(w.blind_directions[b].begin(), m, directions.begin() + static_cast<std::ptrdiff_t>((k * m + b) * m));
      chi_square.push_back(w.chi_square);
      freedom.push_back(w.freedom);
      consistent.push_back(w.consistent);
    }
  }
  ArrayDict out;
  out["force"] = to_numpy(std::move(force), {s.samples, 3});
  out["moment"] = to_numpy(std::move(moment), {s.samples, 3});
  out["covariance"] = to_numpy(std::move(covariances), {s.samples, m, m});
  out["blind"] = to_numpy(std::move(blind_count), {s.samples});
  out["blind_directions"] = to_numpy(std::move(directions), {s.samples, m, m});
  out["chi_square"] = to_numpy(std::move(chi_square), {s.samples});
  out["freedom"] = to_numpy(std::move(freedom), {s.samples});
  out["consistent"] = to_numpy(std::move(consistent), {s.samples});
  return out;
}

void bind_settings(nb::module_& m) {
  nb::enum_<WrenchAxes>(m, "WrenchAxes",
      "Axes of force and moment. The moment is about the frame's origin in both cases.")
      .value("base", WrenchAxes::base)
      .value("frame", WrenchAxes::frame);
  nb::class_<WrenchFrame>(m, "WrenchFrame",
      "A frame fixed to a link, relative to the link's frame; rotation link from frame.")
      .def(
          "__init__",
          [](WrenchFrame* f, std::string name, int link, std::array<double, 9> rotation, std::array<double, 3> translation) {
            new (f) WrenchFrame{std::move(name), link, rotation, translation};
          },
          nb::arg("name"), nb::arg("link"), nb::arg("rotation") = WrenchFrame().rotation,
          nb::arg("translation") = WrenchFrame().translation)
      .def_ro("name", &WrenchFrame::name)
      .def_ro("link", &WrenchFrame::link)
      .def_ro("rotation", &WrenchFrame::rotation)
      .def_ro("translation", &WrenchFrame::translation);
  nb::class_<WrenchSettings>(m, "WrenchSettings", "Model of the errors of tau_ext across the joints; see settings.hpp.")
      .def(nb::init<>())
      .def_rw("frames", &WrenchSettings::frames, "Frames of the robot file.")
      .def_rw("correlation", &WrenchSettings::correlation,
           "Correlation of the errors in free motion, (joints, joints); empty: independent.")
      .def_rw("torque_share", &WrenchSettings::torque_share,
           "Relative standard error of each torque constant; empty: 0.05.")
      .def_rw("common_share", &WrenchSettings::common_share,
           "Relative standard error of a factor common to all joints.")
      .def_rw("torque_factor", &WrenchSettings::torque_factor,
           "Torque of a payload or force as each joint measures it, over the true one, by a known weight; empty: 1.")
      .def_rw("torque_correlation", &WrenchSettings::torque_correlation,
           "Correlation of the constants' errors beside the common one, (joints, joints); empty: independent.")
      .def("own_share", &WrenchSettings::own_share, nb::arg("joint"),
           "Relative standard error of a joint's torque constant beside the common factor.")
      .def_rw("radius", &WrenchSettings::radius, "Factors on the variances of free motion: for a wrench, for a force.")
      .def_rw("residual_radius", &WrenchSettings::residual_radius,
           "Factors on the chi-square of the remainder: for a wrench, for a force.");
}

void bind_result(nb::module_& m) {
  nb::class_<FrameWrench>(m, "Wrench",
      "Force and moment that the environment exerts on the arm at a frame, with covariance.")
      .def("__repr__", &repr)
      .def_ro("frame", &FrameWrench::frame, "Name of the frame.")
      .def_ro("axes", &FrameWrench::axes, "Axes of force and moment.")
      .def_ro("point", &FrameWrench::point,
              "Point of a force without a moment, [m] along the frame's own axes; None: force and moment.")
      .def_ro("known", &Wrench::known,
           "Whether the sample had torques with a standard error; otherwise all values are NaN.")
      .def_ro("unknowns", &Wrench::unknowns, "6: force, then moment; 3: force only.")
      .def_ro("force", &Wrench::force, "Force, [N].")
      .def_ro("moment", &Wrench::moment,
           "Moment about the frame's origin, [N m]; with 3 unknowns the moment of the force.")
      .def_prop_ro("covariance", &covariance, "Covariance (6, 6) of force and moment, or (3, 3) of a force.",
                   nb::rv_policy::move)
      .def_prop_ro("blind", &blind,
                   "Directions that this pose cannot show, (count, 6 or 3): unit vectors of N and of N m / 0.1 m.",
                   nb::rv_policy::move)
      .def_ro("chi_square", &Wrench::chi_square, "Chi-square of the part of tau_ext that the wrench does not explain.")
      .def_ro("freedom", &Wrench::freedom,
           "Degrees of freedom of chi_square; 0: some wrench at this frame explains any torques.")
      .def_ro("consistent", &Wrench::consistent,
           "Probability of such a chi_square or a larger one for a touch at this frame.");
}

}  // namespace

int frame_of(const WrenchModel& model, const std::string& name) {
  if (!model.refused().empty()) throw Error("no wrench: " + model.refused());
  return expect_frame(model, name);
}

void bind_wrench(nb::module_& m) {
  bind_settings(m);
  bind_result(m);
  nb::class_<WrenchModel>(m, "WrenchModel",
      "Estimates wrenches at the frames of a bundle's arm; equations in wrench.hpp.")
      .def(nb::init<const Bundle&>(), nb::arg("bundle"), nb::call_guard<nb::gil_scoped_release>())
      .def_prop_ro("refused", &WrenchModel::refused, "Reason for which there is no wrench; empty: none.")
      .def_prop_ro(
          "left_out",
          [](const WrenchModel& self) {
            std::vector<std::string> out;
            for (std::size_t j = 0; j < self.links().size(); ++j)
              if (!std::ranges::binary_search(self.told(), j)) out.push_back(self.links()[j].joint_name);
            return out;
          },
          "Joints whose estimates are not in N m: their torques are not used.")
      .def_prop_ro(
          "frames",
          [](const WrenchModel& self) {
            std::vector<WrenchFrame> out;
            for (int k = 0; k < self.frames(); ++k) out.push_back(self.frame(k));
            return out;
          },
          "Links by the names of their joints, then the load frame, then frames of the robot file.")
      .def(
          "columns", &columns,
          nb::arg("frame"), nb::arg("q"), nb::arg("point") = std::array<double, 3>{}, nb::arg("axes") = WrenchAxes::base,
          "Joint torques of a unit force, then of a unit moment, (6, joints): the Jacobian of the frame's point.")
      .def(
          "pose", &pose,
          nb::arg("frame"), nb::arg("q"),
               "Pose of a frame: rotation base from frame (3, 3), and origin in the base's frame (3,), [m].")
      .def(
          "covariance", &covariance_of_joints,
          nb::arg("force_alone"), nb::arg("tau_ext"), nb::arg("sigma_nm"),
          nb::arg("contact_sigma_nm") = std::vector<double>(),
          "Covariance S of tau_ext at a sample, (joints, joints). contact_sigma_nm: of the estimate; empty: free motion.")
      .def("wrenches", &wrenches, nb::arg("frame"), nb::arg("q"), nb::arg("tau_ext"), nb::arg("sigma_nm"),
           nb::arg("point").none() = nb::none(), nb::arg("axes") = WrenchAxes::base,
           nb::arg("contact_sigma_nm").none() = nb::none(), nb::arg("dq").none() = nb::none(),
           "Wrenches of many samples: force, moment, covariance, blind (count), blind_directions, chi_square, freedom, "
           "consistent. point: estimate only a force that acts there, [m] along the frame's own axes; None: force and "
           "moment.");
  m.def("chi_square_beyond", &chi_square_beyond, nb::arg("value"), nb::arg("freedom"),
        "Probability that a chi-square with this many degrees of freedom (at least 1) is at least `value`.");
}

}  // namespace tauext::bindings
