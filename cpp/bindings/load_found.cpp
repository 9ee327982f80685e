// Loads weighed from recordings, and torque constants by a known one.
#include <nanobind/stl/array.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <map>

#include "arrays.hpp"
#include "load/known_weight.hpp"
#include "tauext/bundle.hpp"

namespace tauext::bindings {
namespace {

// Of each recording t_ns, q, dq; of its rows the samples, tau_ext, sigma and worth.
using Motions = std::vector<std::tuple<Array<std::int64_t, 1>, Array<double, 2>, Array<double, 2>, Array<std::int64_t, 1>,
                                       Array<double, 2>, Array<double, 2>, Array<double, 2>>>;

std::vector<WeighedMotion> motions_of(const Motions& motions, int joints) {
  std::vector<WeighedMotion> out;
  for (const auto& [t_ns, q, dq, samples, tau_ext, sigma, worth] : motions) {
    for (const auto* one : {&tau_ext, &sigma, &worth})
      if (one->shape(0) != samples.shape(0) || one->shape(1) != static_cast<std::size_t>(joints))
        throw Error("tau_ext, sigma and worth of a motion must have the shape (rows, " + std::to_string(joints) + ")");
    const auto all = [](const Array<double, 2>& of) { return std::span(of.data(), of.size()); };
    out.push_back({view(t_ns, q, dq, q, joints), span_of(samples), all(tau_ext), all(sigma), all(worth)});
  }
  return out;
}

template <std::size_t N>
nb::ndarray<nb::numpy, double> square(const std::array<double, N>& values, std::size_t size) {
  return to_numpy(std::vector(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(size * size)), {size, size});
}

template <std::size_t N>
nb::ndarray<nb::numpy, double> numbers(const std::array<double, N>& values) {
  return to_numpy(std::vector(values.begin(), values.end()), {N});
}

void bind_fit(nb::module_& m) {
  nb::class_<LoadFit>(m, "LoadFit", "Least-squares fit of one hypothesis: a payload, a force, or no cause.")
      .def_prop_ro("values", [](const LoadFit& f) { return std::vector(f.values.begin(), f.values.begin() + f.size); },
                   "Mass and first moment of a payload, or a force.")
      .def_prop_ro("covariance", [](const LoadFit& f) { return square(f.covariance, static_cast<std::size_t>(f.size)); },
                   "Covariance of the values.", nb::rv_policy::move)
      .def_prop_ro("correlation", [](const LoadFit& f) { return f.noise.correlation; },
                   "Number of rows that carry as much information as one independent row.")
      .def_ro("misfit", &LoadFit::misfit, "Squared standard errors per row that remain.")
      .def_ro("cost", &LoadFit::cost, "Sum of the independent squared errors that remain, and of the prior's penalty.");
  auto found = nb::class_<LoadFound>(m, "LoadFound",
                        "Result of a payload identification. All attributes but `load` describe what the arm carries beside the payload that is set;\n"
                        "lengths and axes are those of the load frame.");
  found.attr("LEAST_ROWS") = kLeastLoadRows;
  found.attr("MASS_SHOWS") = kMassShows;
  found.attr("SIGMA_OF_LIMIT") = kSigmaOfLimit;
  found.attr("USUAL_REACH_M") = kUsualReach_m;
  found.def_prop_ro("verdict", [](const LoadFound& f) { return std::string(name(f.verdict)); },
                   "`too little` (motion), `nothing`, `load`, `contact`, `lifts` or `unclear`.")
      .def_ro("load", &LoadFound::load, "Both payloads together, for set_load().")
      .def_ro("mass_kg", &LoadFound::mass_kg, "Mass, [kg]; negative if the arm carries less than the payload that is set.")
      .def_ro("mass_error_kg", &LoadFound::mass_error_kg,
              "Standard error of the mass from the errors of tau_ext in this motion, [kg].")
      .def_ro("constants_error_kg", &LoadFound::constants_error_kg,
              "Standard error of the mass from the torque constants, about the same share of every weight, [kg].")
      .def_prop_ro("mass_by_constant_kg", [](const LoadFound& f) { return numbers(f.mass_by_constant_kg); },
                   "Change of the mass with each joint's torque, for all of it, (32,), [kg].", nb::rv_policy::move)
      .def_prop_ro("com_m", [](const LoadFound& f) { return numbers(f.com_m); },
           "Centre of mass, (3,), [m].", nb::rv_policy::move)
      .def_prop_ro("com_error_m", [](const LoadFound& f) { return numbers(f.com_error_m); },
           "Standard errors of the centre of mass, with those of the torque constants, (3,), [m].", nb::rv_policy::move)
      .def_prop_ro("com_covariance", [](const LoadFound& f) { return square(f.com_covariance, 3); },
           "Covariance of the centre of mass, (3, 3), [m^2].", nb::rv_policy::move)
      .def_prop_ro("covariance", [](const LoadFound& f) { return square(f.covariance, 4); },
                   "Covariance of mass and first moment, (4, 4).", nb::rv_policy::move)
      .def_prop_ro("phi", [](const LoadFound& f) { return numbers(f.phi); },
                   "Mass, first moment and inertia about the frame's origin, (10,).", nb::rv_policy::move)
      .def_ro("seconds", &LoadFound::seconds, "Duration of the motion, [s].")
      .def_ro("reach_m", &LoadFound::reach_m, "Bound of the search: the centre of mass is within it, [m].")
      .def_ro("misfit", &LoadFound::misfit,
           "Squared standard errors per row that the payload leaves; 1 if nothing else acts.")
      .def_ro("mass_seen", &LoadFound::mass_seen, "False: the motion does not separate the mass from its lever.")
      .def_ro("at_bound", &LoadFound::at_bound, "Whether the centre of mass is at reach_m.")
      .def_prop_ro("unseen",
                   [](const LoadFound& f) {
                     std::vector<nb::ndarray<nb::numpy, double>> out;
                     for (int k = 0; k < f.unseen_count; ++k) out.push_back(numbers(f.unseen[static_cast<std::size_t>(k)]));
                     return out;
                   },
                   "Directions of the centre of mass that the motion did not determine, unit vectors.", nb::rv_policy::move)
      .def_prop_ro("fits",
                   [](const LoadFound& f) {
                     constexpr const char* names[] = {"load", "base", "frame", "nothing"};
                     std::map<std::string, LoadFit> out;
                     for (std::size_t k = 0; k < f.fits.size(); ++k) out.emplace(names[k], f.fits[k]);
                     return out;
                   },
                   "Fits by hypothesis: payload, base (force along the base's axes), frame (along the frame's axes), nothing.");
}

void bind_known_weight(nb::module_& m) {
  nb::class_<KnownWeight>(m, "KnownWeight", "Factors on a bundle's torques, found by a payload of known mass.")
      .def_prop_ro("factors", [](const KnownWeight& k) { return to_numpy(std::vector(k.factors), {k.factors.size()}); },
                   "Of each joint, (n,).", nb::rv_policy::move)
      .def_prop_ro("errors", [](const KnownWeight& k) { return to_numpy(std::vector(k.errors), {k.errors.size()}); },
                   "Standard errors of the factors, (n,).", nb::rv_policy::move)
      .def_ro("shows", &KnownWeight::shows, "Whether a factor was found at the joint itself; the others follow the common one.")
      .def_ro("common", &KnownWeight::common, "Factor of all joints together.")
      .def_ro("common_error", &KnownWeight::common_error, "Standard error of the common factor.")
      .def_prop_ro("com_m", [](const KnownWeight& k) { return numbers(k.com_m); }, "Centre of mass, (3,), [m].",
                   nb::rv_policy::move);
  m.def(
      "weigh_known",
      [](const Bundle& bundle, const LoadFrame& frame, const Motions& motions, double mass_kg, const LoadParameters& first,
         const std::vector<bool>& skipped, const std::optional<std::array<double, 3>>& com_m, double reach_m) {
        if (skipped.size() != bundle.links.size()) throw Error("skipped must have one value for each joint");
        const std::vector<WeighedMotion> views = motions_of(motions, bundle.joints());
        const nb::gil_scoped_release released;
        return weigh_known(bundle, frame, views, {mass_kg, com_m, reach_m}, first, skipped);
      },
      nb::arg("bundle"), nb::arg("frame"), nb::arg("motions"), nb::arg("mass_kg"), nb::arg("first"), nb::arg("skipped"),
      nb::arg("com_m") = nb::none(), nb::arg("reach_m") = kUsualReach_m,
      "Torque constants by a payload of known mass; see known_weight.hpp. first (10,): the payload as identified. skipped: joints\n"
      "whose rows have no worth. Raises CoreError if the motion does not determine the common factor to 3 %.");
  m.def(
      "scaled_bundle",
      [](Bundle bundle, double factor) {
        scale_torques(bundle, factor);
        answer_reference(bundle);
        return bundle;
      },
      nb::arg("bundle"), nb::arg("factor"),
      "The bundle with all torques that it reads, estimates or compares with times the factor; masses of its model, too.");
  m.def(
      "corrected_bundle",
      [](Bundle bundle, const KnownWeight& known) {
        correct_torques(bundle, known);
        answer_reference(bundle);
        return bundle;
      },
      nb::arg("bundle"), nb::arg("known"),
      "The bundle scaled by the common factor, which is then known to the error of the identification.");
}

}  // namespace

void bind_load_found(nb::module_& m) {
  bind_fit(m);
  m.def(
      "worth_of_samples",
      [](const Array<std::int64_t, 1>& t_ns, const Array<std::uint8_t, 2>& near_stiction) {
        if (near_stiction.shape(0) != t_ns.shape(0)) throw Error("near_stiction must have the shape (samples, n)");
        return to_numpy(worth_of_samples(span_of(t_ns), {near_stiction.data(), near_stiction.size()}),
                        {t_ns.shape(0), near_stiction.shape(1)});
      },
      nb::arg("t_ns"), nb::arg("near_stiction"),
      "Weight of each sample in a payload identification, (samples, n): 1 while a joint slides, less the longer it has stood.");
  m.def(
      "weigh_load",
      [](const Bundle& bundle, const LoadFrame& frame, const Motions& motions, double reach_m, const LoadParameters& phi,
         const Load& set) {
        if (!(reach_m > 0)) throw Error("the reach of a payload = " + to_text(reach_m) + " m must be above 0");
        const std::vector<WeighedMotion> views = motions_of(motions, bundle.joints());
        const nb::gil_scoped_release released;
        return weigh(bundle, frame, views, reach_m, phi, set);
      },
      nb::arg("bundle"), nb::arg("frame"), nb::arg("motions"), nb::arg("reach_m") = kUsualReach_m,
      nb::arg("phi") = LoadParameters{}, nb::arg("set") = Load{},
      "Estimates the payload from recordings, beside one that is set. motions: of each recording t_ns, q, dq; of its rows the\n"
      "samples, tau_ext, sigma and worth. phi (10,): the payload as known before.");
  bind_known_weight(m);
}

}  // namespace tauext::bindings
