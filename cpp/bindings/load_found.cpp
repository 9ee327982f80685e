// Sums of weighing, and their result.
#include <nanobind/stl/array.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <map>

#include "arrays.hpp"
#include "load/weighing.hpp"
#include "tauext/bundle.hpp"

namespace tauext::bindings {
namespace {

constexpr std::size_t kSize = LoadSums::kColumns;

void add(LoadSums& sums, const Array<double, 3>& rows, const Array<double, 2>& sigma, const Array<double, 2>& worth) {
  const std::size_t N = rows.shape(0), n = static_cast<std::size_t>(sums.joints());
  if (rows.shape(1) != n || rows.shape(2) != kSize)
    throw Error("rows of a load must have the shape (rows, " + std::to_string(n) + ", " + std::to_string(kSize) + ")");
  for (const auto* one : {&sigma, &worth})
    if (one->shape(0) != N || one->shape(1) != n)
      throw Error("sigma and worth must have the shape (rows, " + std::to_string(n) + ")");
  std::vector<LoadSums::Row> row(n);
  for (std::size_t k = 0; k < N; ++k) {
    for (std::size_t j = 0; j < n; ++j)
      std::copy_n(rows.data() + (k * n + j) * kSize, kSize, row[j].begin());
    sums.add(row, {sigma.data() + k * n, n}, {worth.data() + k * n, n});
  }
  sums.end_block();
}

// (n, columns, columns), both triangles; of the blocks with the open one.
nb::ndarray<nb::numpy, double> squares(const LoadSums& sums, bool blocks) {
  std::vector<double> out;
  for (int joint = 0; joint < sums.joints(); ++joint) {
    const LoadSums::Joint& one = sums.joint(joint);
    for (std::size_t a = 0; a < kSize; ++a)
      for (std::size_t b = 0; b < kSize; ++b) {
        const std::size_t at = std::min(a, b) * kSize + std::max(a, b);
        out.push_back(blocks ? one.blocks[at] + one.open[a] * one.open[b] : one.whole[at]);
      }
  }
  return to_numpy(std::move(out), {static_cast<std::size_t>(sums.joints()), kSize, kSize});
}

nb::ndarray<nb::numpy, double> worth(const LoadSums& sums) {
  std::vector<double> out;
  for (int joint = 0; joint < sums.joints(); ++joint) out.push_back(sums.joint(joint).worth);
  const std::size_t n = out.size();
  return to_numpy(std::move(out), {n});
}

template <std::size_t N>
nb::ndarray<nb::numpy, double> square(const std::array<double, N>& values, std::size_t size) {
  return to_numpy(std::vector(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(size * size)), {size, size});
}

template <std::size_t N>
nb::ndarray<nb::numpy, double> numbers(const std::array<double, N>& values) {
  return to_numpy(std::vector(values.begin(), values.end()), {N});
}

void bind_sums(nb::module_& m) {
  auto sums = nb::class_<LoadSums>(m, "LoadSums",
       "Sums over rows from which a load is estimated; the attributes name the columns.");
  sums.def(nb::init<int>(), nb::arg("joints"))
      .def("add", &add, nb::arg("rows"), nb::arg("sigma"), nb::arg("worth"),
           "Adds consecutive rows, (rows, n, columns); sigma and worth (rows, n).")
      .def_prop_ro("rows", &LoadSums::rows, "Number of rows added.")
      .def_prop_ro("whole", [](const LoadSums& s) { return squares(s, false); },
           "Sum of worth z z^T / sigma^2, (n, columns, columns).", nb::rv_policy::move)
      .def_prop_ro("blocks", [](const LoadSums& s) { return squares(s, true); },
           "The same of the sums over blocks, (n, columns, columns).", nb::rv_policy::move)
      .def_prop_ro("worth", &worth, "Sum of the rows' worth, (n,).", nb::rv_policy::move);
  const std::pair<const char*, std::size_t> numbers[] = {
      {"LOAD", LoadSums::kLoad}, {"OFFSET", LoadSums::kOffset}, {"COULOMB", LoadSums::kCoulomb},
      {"BASE", LoadSums::kBase}, {"FRAME", LoadSums::kFrame},   {"GEAR", LoadSums::kGear},
      {"TAU_EXT", LoadSums::kTauExt}, {"COLUMNS", kSize}, {"BLOCK_ROWS", static_cast<std::size_t>(LoadSums::kBlockRows)}};
  for (const auto& [name, value] : numbers) sums.attr(name) = static_cast<int>(value);
  sums.attr("LEAST_ROWS") = kLeastLoadRows;
  sums.attr("ROUNDS") = kLoadRounds;
  sums.attr("LEAST_NOISE_SCALE") = kLeastNoiseScale;
  sums.attr("LEAST_CORRELATION") = kLeastCorrelation;
  sums.attr("LEAST_MASS_KG") = kLeastMass_kg;
  sums.attr("MASS_SHOWS") = kMassShows;
  sums.attr("SIGMA_OF_LIMIT") = kSigmaOfLimit;
  sums.attr("STAND_S") = Weighing::kStand_s;
  sums.attr("USUAL_REACH_M") = kUsualReach_m;
}

void bind_fit(nb::module_& m) {
  nb::class_<LoadFit>(m, "LoadFit", "Least-squares fit of one hypothesis: a load, a force, or no cause.")
      .def_prop_ro("values", [](const LoadFit& f) { return std::vector(f.values.begin(), f.values.begin() + f.size); },
                   "Mass and first moment of a load, or a force.")
      .def_prop_ro("covariance", [](const LoadFit& f) { return square(f.covariance, static_cast<std::size_t>(f.size)); },
                   "Covariance of the values.", nb::rv_policy::move)
      .def_prop_ro("correlation", [](const LoadFit& f) { return f.noise.correlation; },
                   "Number of rows that carry as much information as one independent row.")
      .def_ro("misfit", &LoadFit::misfit, "Squared standard errors per row that remain.")
      .def_ro("cost", &LoadFit::cost, "Sum of the independent squared errors that remain, and of the prior's penalty.");
  nb::class_<LoadFound>(m, "LoadFound",
                        "Result of weighing. All attributes but `load` describe what the arm carries beside the load that is set;\n"
                        "lengths and axes are those of the load frame.")
      .def_prop_ro("verdict", [](const LoadFound& f) { return std::string(name(f.verdict)); },
                   "`too little` (motion), `nothing`, `load`, `contact`, `lifts` or `unclear`.")
      .def_ro("load", &LoadFound::load, "Both loads together, for set_load().")
      .def_ro("mass_kg", &LoadFound::mass_kg, "Mass, [kg]; negative if the arm carries less than the load that is set.")
      .def_ro("mass_error_kg", &LoadFound::mass_error_kg,
              "Standard error of the mass from the errors of tau_ext in this motion, [kg].")
      .def_ro("constants_error_kg", &LoadFound::constants_error_kg,
              "Standard error of the mass from the torque constants, about the same share of every weight, [kg].")
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
           "Squared standard errors per row that the load leaves; 1 if nothing else acts.")
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
                   "Fits by hypothesis: load, base (force along the base's axes), frame (along the frame's axes), nothing.");
}

}  // namespace

void bind_load_found(nb::module_& m) {
  bind_sums(m);
  bind_fit(m);
  m.def(
      "weigh_load",
      [](const Bundle& bundle, const LoadSums& sums, double reach_m, const LoadParameters& phi, const Load& set, int rounds) {
        if (sums.joints() != bundle.joints()) throw Error("the sums are of an arm with another number of joints");
        if (!(reach_m > 0)) throw Error("the reach of a load = " + to_text(reach_m) + " m must be above 0");
        WeighSettings settings = Weighing::settings_of(bundle);
        settings.reach_m = reach_m;
        return weigh(sums, settings, set, phi, rounds);
      },
      nb::arg("bundle"), nb::arg("sums"), nb::arg("reach_m") = kUsualReach_m,
      nb::arg("phi") = LoadParameters{}, nb::arg("set") = Load{}, nb::arg("rounds") = kLoadRounds,
      "Estimates the load from the sums, beside one that is set. phi (10,): its parameters as known so far.");
  m.def(
      "weigh_sizes",
      [](const Bundle& bundle) {
        const WeighSettings settings = Weighing::settings_of(bundle);
        std::vector<double> out;
        for (std::size_t j = 0; j < bundle.links.size(); ++j) {
          out.push_back(settings.offset_nm[j]);
          out.push_back(settings.coulomb_nm[j]);
        }
        return to_numpy(std::move(out), {bundle.links.size(), 2});
      },
      nb::arg("bundle"),
           "Standard deviations of each joint's offset and Coulomb friction in the fit of a load, (n, 2), [N m].");
  m.def(
      "load_parameters",
      [](const std::array<double, 4>& found, double reach_m) { return numbers(beside(found, {}, reach_m)); },
      nb::arg("found"), nb::arg("reach_m"),
      "phi (10,) of a mass and a first moment: mass at least 0, centre within the reach, inertia of a ball.");
  m.def("loads_together", &together, nb::arg("a"), nb::arg("b"), "Combines two bodies into one load.");
}

}  // namespace tauext::bindings
