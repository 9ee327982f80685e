// Contact places: which link is touched, and where.
#include "tauext/touch_place.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"
#include "tauext/bundle.hpp"

namespace tauext::bindings {
namespace {

// Result of find(), which owns its values.
struct Found {
  int joints;
  TouchPlaces told;
  double at_frame;
};

void check(const PlaceModel& model, const std::vector<double>& q, const std::vector<double>& tau_ext,
           const std::vector<double>& sigma_nm) {
  if (!model.refused().empty()) throw Error("no contact places: " + model.refused());
  const auto n = static_cast<std::size_t>(model.joints());
  for (const auto* one : {&q, &tau_ext, &sigma_nm})
    if (one->size() != n) throw Error("q, tau_ext and sigma_nm must hold " + std::to_string(n) + " values");
}

void check_points(int points) {
  if (points < 1 || points > 100'000) throw Error("points = " + std::to_string(points) + " must be 1 to 100000");
}

ArrayDict arrays_of(LinkSurface surface) {
  ArrayDict out;
  const std::size_t size = surface.size();
  std::vector<double> at, inwards;
  for (std::size_t i = 0; i < size; ++i) {
    at.insert(at.end(), {surface.x[i], surface.y[i], surface.z[i]});
    inwards.insert(inwards.end(), {surface.nx[i], surface.ny[i], surface.nz[i]});
  }
  out["points"] = to_numpy(std::move(at), {size, 3});
  out["inwards"] = to_numpy(std::move(inwards), {size, 3});
  out["share"] = to_numpy(std::move(surface.share), {size});
  out["area_m2"] = to_numpy(std::vector<double>{surface.area_m2}, {1});
  return out;
}

void bind_result(nb::module_& m) {
  nb::class_<TouchPlace>(m, "TouchPlace", "A force at a point of a link's surface that explains tau_ext.")
      .def_ro("link", &TouchPlace::link, "Number of the joint that carries the link.")
      .def_ro("probability", &TouchPlace::probability, "Probability that the touch is on this part of the link.")
      .def_ro("point", &TouchPlace::point, "Point in the base's frame, [m].")
      .def_ro("on_link", &TouchPlace::on_link, "Point in the link's frame, [m].")
      .def_ro("force", &TouchPlace::force, "Force that the environment exerts on the arm, along the base's axes, [N].")
      .def_ro("spread_m", &TouchPlace::spread_m,
           "Root mean square distance from the point, if the touch is at this place, [m].")
      .def_ro("guessed", &TouchPlace::guessed, "Whether the shape of the link is guessed.");
  nb::class_<Found>(m, "TouchPlaces", "Links and places that explain tau_ext, the most probable first.")
      .def_prop_ro("known", [](const Found& f) { return f.told.known; },
           "Whether the sample had torques with a standard error.")
      .def_prop_ro(
          "probability",
          [](const Found& f) {
            return std::vector<double>(f.told.probability.begin(), f.told.probability.begin() + f.joints);
          },
          "Probability of each link; they sum to 1.")
      .def_prop_ro(
          "ranked",
          [](const Found& f) {
            return std::vector<int>(f.told.ranked.begin(), f.told.ranked.begin() + (f.told.known ? f.joints : 0));
          },
          "Numbers of the links, the most probable first.")
      .def_prop_ro(
          "places",
          [](const Found& f) {
            return std::vector<TouchPlace>(f.told.place.begin(), f.told.place.begin() + f.told.places);
          },
          "Places, the most probable first.")
      .def_prop_ro(
          "best",
          [](const Found& f) -> std::optional<TouchPlace> {
            return f.told.best < 0 ? std::nullopt : std::optional(f.told.place[static_cast<std::size_t>(f.told.best)]);
          },
          "Most probable place on the most probable link, else on any link. None: no place.")
      .def_prop_ro("force_n", [](const Found& f) { return f.told.force_n; },
                   "Median of the force over all places and links, [N]; 0 without places.")
      .def_prop_ro(
          "force_interval_n", [](const Found& f) { return std::make_pair(f.told.force_low_n, f.told.force_high_n); },
          "The force is within these bounds with 90 %, [N].")
      .def_prop_ro("within_m", [](const Found& f) { return f.told.within_m; },
                   "The touch is within this distance of the best place with 90 %, [m].")
      .def_prop_ro("consistent", [](const Found& f) { return f.told.consistent; },
                   "Probability that a force at the first place leaves such a remainder or a larger one; NaN without places.")
      .def_prop_ro("at_frame", [](const Found& f) { return f.at_frame; },
                   "Probability of a force in any direction at the frame's origin, compared with a touch elsewhere on the "
                   "arm; both have the same prior probability. NaN without a frame.");
}

void bind_surfaces(nb::module_& m) {
  nb::class_<Capsule>(m, "Capsule",
      "Part of a link's shape: all points within radius_m of the line from start to end, [m] in the link's frame.")
      .def(
          "__init__",
          [](Capsule* c, int link, std::array<double, 3> start, std::array<double, 3> end, double radius_m) {
            new (c) Capsule{link, start, end, radius_m};
          },
          nb::arg("link"), nb::arg("start"), nb::arg("end"), nb::arg("radius_m"))
      .def_ro("link", &Capsule::link)
      .def_ro("start", &Capsule::start)
      .def_ro("end", &Capsule::end)
      .def_ro("radius_m", &Capsule::radius_m);
  m.def(
      "surface_of",
      [](const std::vector<Capsule>& capsules, int points) {
        check_points(points);
        return arrays_of(surface_of(capsules, points));
      },
      nb::arg("capsules"), nb::arg("points"),
      "Points spread evenly over the union of a link's capsules: points (n, 3), inwards (n, 3), share (n,) of the area, area_m2 (1,).");
  m.def(
      "guessed_surface",
      [](const Bundle& bundle, int link, int points) {
        check_points(points);
        if (link < 0 || link >= bundle.joints())
          throw Error("link = " + std::to_string(link) + " must be 0 to " + std::to_string(bundle.joints() - 1));
        return arrays_of(guessed_surface(bundle, link, points));
      },
      nb::arg("bundle"), nb::arg("link"), nb::arg("points"),
      "Points of shapes that a link may have, at most as many as given: points (n, 3), inwards (n, 3), share (n,), the "
      "probability of each, area_m2 (1,), the mean.");
}

}  // namespace

void bind_places(nb::module_& m) {
  bind_result(m);
  bind_surfaces(m);
  nb::class_<PlaceModel>(m, "PlaceModel",
      "Estimates which link is touched, and where; equations in touch_place.hpp. Use it from one thread at a time.")
      .def(nb::init<const Bundle&>(), nb::arg("bundle"), nb::call_guard<nb::gil_scoped_release>())
      .def_prop_ro("refused", &PlaceModel::refused, "Reason for which places cannot be estimated; empty: none.")
      .def_prop_ro(
          "guessed",
          [](const PlaceModel& self) {
            std::vector<int> links;
            for (int link = 0; link < self.joints(); ++link)
              if (self.guessed(link)) links.push_back(link);
            return links;
          },
          "Numbers of the links whose shapes are guessed, because the bundle has no capsule of them.")
      .def(
          "find",
          [](PlaceModel& self, const std::vector<double>& q, const std::vector<double>& tau_ext,
             const std::vector<double>& sigma_nm, const std::vector<double>& contact_sigma_nm, bool places, std::optional<int> link,
             const std::optional<std::string>& frame, const std::optional<std::vector<double>>& dq) {
            check(self, q, tau_ext, sigma_nm);
            if (!contact_sigma_nm.empty()) check(self, q, tau_ext, contact_sigma_nm);
            if (dq) check(self, *dq, tau_ext, sigma_nm);
            if (link && (*link < 0 || *link >= self.joints()))
              throw Error("link = " + std::to_string(*link) + " must be 0 to " + std::to_string(self.joints() - 1));
            const int at = frame ? frame_of(self.wrench_model(), *frame) : -1;
            Found found{self.joints(), {}, 0};
            self.rank(q, tau_ext, sigma_nm, contact_sigma_nm, found.told, dq ? std::span<const double>(*dq) : std::span<const double>());
            if (places) self.locate(found.told, link.value_or(-1));
            found.at_frame = self.at_frame(at);
            return found;
          },
          nb::arg("q"), nb::arg("tau_ext"), nb::arg("sigma_nm"), nb::arg("contact_sigma_nm") = std::vector<double>(), nb::arg("places") = true,
          nb::arg("link").none() = nb::none(), nb::arg("frame").none() = nb::none(),
          nb::arg("dq").none() = nb::none(),
          "Estimates the links with their probabilities and, with `places`, the contact places of a sample. "
          "contact_sigma_nm: of the estimate; empty: free motion. link: the touched link, if known; only its places are "
          "reported. frame: frame of at_frame. dq: the friction that a touch adds to moving joints is subtracted; None: "
          "joints at rest.");
}

}  // namespace tauext::bindings
