// Robots: links, joints and their tree.
#include "tauext/tree.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"

namespace tauext::bindings {

void bind_tree(nb::module_& m) {
  nb::enum_<JointType>(m, "JointType", "Whether a joint rotates or translates its link.")
      .value("revolute", JointType::revolute)
      .value("prismatic", JointType::prismatic);
  nb::class_<Link>(m, "Link",
      "A moving link and the joint that carries it; the joint axis is the link frame's +z axis.")
      .def(nb::init<>())
      .def_rw("joint_name", &Link::joint_name, "Name of the joint in the robot file.")
      .def_rw("parent", &Link::parent, "Index of the parent link; -1: the base.")
      .def_rw("type", &Link::type, "Type of the joint.")
      .def_rw("rotation", &Link::rotation, "Parent from link at q = 0, row-major.")
      .def_rw("translation", &Link::translation, "Joint origin in the parent's frame, [m].")
      .def_rw("mass", &Link::mass, "[kg].")
      .def_rw("com", &Link::com, "Centre of mass in the link frame, [m].")
      .def_rw("inertia", &Link::inertia, "About the centre of mass, link axes: xx, yy, zz, xy, xz, yz, [kg m^2].")
      .def_rw("rotor_inertia", &Link::rotor_inertia, "Motor inertia times gear ratio squared, [kg m^2] or [kg].");
  nb::class_<Tree>(m, "Tree", "Kinematic tree of 1 to 32 moving joints, in any order.")
      .def(nb::init<std::vector<Link>, std::array<double, 3>>(), nb::arg("links"), nb::arg("gravity"))
      .def_prop_ro("size", &Tree::size, "Number of joints.")
      .def_prop_ro("links", [](const Tree& t) { return t.links(); }, "Links, as passed to the constructor.")
      .def_prop_ro("gravity", &Tree::gravity, "Acceleration of free fall in the base frame, [m/s^2].")
      .def(
          "momentum",
          [](const Tree& tree, const Array<double, 2>& q, const Array<double, 2>& dq) {
            const std::size_t N = q.shape(0), n = static_cast<std::size_t>(tree.size());
            if (q.shape(1) != n || dq.shape(1) != n || dq.shape(0) != N)
              throw Error("q and dq must have the shape (samples, " + std::to_string(n) + ")");
            std::vector<double> p(N * n), beta(N * n);
            {
              nb::gil_scoped_release released;
              for (std::size_t k = 0; k < N; ++k)
                tree.momentum(std::span(q.data() + k * n, n), std::span(dq.data() + k * n, n),
                              std::span(p).subspan(k * n, n), std::span(beta).subspan(k * n, n));
            }
            return std::pair(to_numpy(std::move(p), {N, n}), to_numpy(std::move(beta), {N, n}));
          },
          nb::arg("q"), nb::arg("dq"),
          "Generalised momentum p = M dq [N m s] and beta = g - C^T dq [N m] of states (samples, n).");
}

}  // namespace tauext::bindings
