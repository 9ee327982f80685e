// Regressors of a load, for its identification.
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"
#include "chain/load_regressor.hpp"
#include "load/load_columns.hpp"
#include "tauext/bundle.hpp"

namespace tauext::bindings {

void bind_load(nb::module_& m) {
  nb::class_<LoadFrame>(m, "LoadFrame", "Frame of a load on a link, in the link's frame; rotation link from frame.")
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
      "Contribution of each unit parameter of a load (m, h, I about the frame's origin) to p and beta: (samples, n, 10).");
  m.def(
      "load_rows",
      [](const Bundle& bundle, const LoadFrame& frame, const std::vector<double>& phi,
         const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
         const Array<std::int64_t, 1>& samples) {
        const RecordingView recording = view(t_ns, q, dq, q);
        LoadRows rows;
        {
          nb::gil_scoped_release released;
          rows = load_rows(bundle, frame, phi, recording, span_of(samples));
        }
        const std::size_t N = samples.shape(0), n = q.shape(1);
        ArrayDict out;
        out["load"] = to_numpy(std::move(rows.load), {N, n, static_cast<std::size_t>(LoadColumns::kParameters)});
        out["frame_forces"] = to_numpy(std::move(rows.frame_forces), {N, n, 3});
        out["base_forces"] = to_numpy(std::move(rows.base_forces), {N, n, 3});
        out["offset"] = to_numpy(std::move(rows.offset), {N, n});
        out["coulomb"] = to_numpy(std::move(rows.coulomb), {N, n});
        return out;
      },
      nb::arg("bundle"), nb::arg("frame"), nb::arg("phi"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"),
      nb::arg("samples"),
           "Contribution of a unit load, or of a unit force on it, to the bundle's tau_ext; see load_columns.hpp.");
  m.def("load_friction_shares", [](const Bundle& bundle) { return load_friction_shares(bundle.prior, bundle.joints()); },
        nb::arg("bundle"), "Share of a load's torque that it adds to each joint's friction, from the prior.");
}

}  // namespace tauext::bindings
