// Regressors of a load, for its identification.
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"
#include "chain/load_regressor.hpp"
#include "load/recorded_load.hpp"
#include "prior/prior.hpp"
#include "tauext/bundle.hpp"

namespace tauext::bindings {

void bind_load(nb::module_& m) {
  nb::class_<LoadFrame>(m, "LoadFrame", "Frame of a payload on a link, in the link's frame; rotation link from frame.")
      .def(
          "__init__",
          [](LoadFrame* f, int link, std::array<double, 9> rotation, std::array<double, 3> translation) {
            new (f) LoadFrame{link, rotation, translation};
          },
          nb::arg("link"), nb::arg("rotation") = LoadFrame().rotation, nb::arg("translation") = LoadFrame().translation)
      .def_ro("link", &LoadFrame::link)
      .def_ro("rotation", &LoadFrame::rotation)
      .def_ro("translation", &LoadFrame::translation);
  m.def(
      "load_columns",
      [](const Tree& tree, const LoadFrame& frame, const Array<double, 2>& q, const Array<double, 2>& dq) {
        const std::size_t N = q.shape(0), n = static_cast<std::size_t>(tree.size()), M = LoadRegressor::kParameters;
        if (q.shape(1) != n || dq.shape(1) != n || dq.shape(0) != N)
          throw Error("q and dq must have the shape (samples, " + std::to_string(n) + ")");
        LoadRegressor regressor(tree, frame);
        std::vector<double> p, beta;
        {
          nb::gil_scoped_release released;
          for (std::size_t k = 0; k < N; ++k) {
            regressor.compute({q.data() + k * n, n}, {dq.data() + k * n, n});
            for (std::size_t j = 0; j < n; ++j)
              for (std::size_t c = 0; c < M; ++c) {
                p.push_back(regressor.momentum()[c][j]);
                beta.push_back(regressor.beta()[c][j]);
              }
          }
        }
        return std::pair(to_numpy(std::move(p), {N, n, M}), to_numpy(std::move(beta), {N, n, M}));
      },
      nb::arg("tree"), nb::arg("frame"), nb::arg("q"), nb::arg("dq"),
      "Contribution of each unit parameter of a payload (m, h, I about the frame's origin) to p and beta: (samples, n, 10).");
  m.def(
      "load_rows",
      [](const Bundle& bundle, const LoadFrame& frame, const LoadParameters& phi, const Array<std::int64_t, 1>& t_ns,
         const Array<double, 2>& q, const Array<double, 2>& dq, const Array<std::int64_t, 1>& samples) {
        std::vector<double> out;
        for (const LoadSums::Row& row : load_rows(bundle, frame, phi, view(t_ns, q, dq, q), span_of(samples)))
          out.insert(out.end(), row.begin(), row.end());
        return to_numpy(std::move(out), {samples.shape(0), q.shape(1), std::size_t{LoadSums::kColumns}});
      },
      nb::arg("bundle"), nb::arg("frame"), nb::arg("phi"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("samples"),
      "Rows by which a payload is identified, (samples, n, 20): contributions to tau_ext of a unit of m, h, I (10), offset, Coulomb\n"
      "friction, a force along the base's axes (3) and along the frame's (3), what gears add, and 0.");
  m.def("load_friction_shares", [](const Bundle& bundle) { return load_friction_shares(bundle.prior, bundle.joints()); },
        nb::arg("bundle"), "Share of a payload's torque that it adds to each joint's friction, from the prior.");
}

}  // namespace tauext::bindings
