// Contacts that the task means.
#include "tauext/declared_contact.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>

#include <limits>
#include <tuple>
#include <utility>

#include "arrays.hpp"
#include "tauext/estimate.hpp"

namespace tauext::bindings {
namespace {

constexpr double kDegree = 3.14159265358979323846 / 180;
constexpr double kInfinite = std::numeric_limits<double>::infinity();

std::string repr(const NamedContact& c) {
  std::string out = "<DeclaredContact " + (c.joint_name.empty() ? "at " + c.frame_name : "of " + c.joint_name);
  if (c.at_most_n > 0) out += ", at most " + to_text(c.at_most_n) + " N";
  if (c.at_most_nm > 0) out += ", at most " + to_text(c.at_most_nm) + (c.joint_name.empty() ? " N m" : "");
  return out + ">";
}

void bind_tool_force(nb::module_& m) {
  nb::class_<FrameToolForce>(m, "ToolForce", "The force at the tool as a sensor would measure it; see Monitor.tool_force().")
      .def_ro("wrench", &FrameToolForce::at, "Force and moment with covariance; known is false without a tool's frame or torques.")
      .def_ro("declared", &FrameToolForce::declared, "Whether an expected contact at a frame is in effect.")
      .def_ro("motion_n", &FrameToolForce::motion_n, "Standard error of the force along itself by errors of free motion, [N].")
      .def_ro("rest_n", &FrameToolForce::rest_n, "The same by friction that resting joints hide, and by lag, [N].")
      .def_ro("constants_n", &FrameToolForce::constants_n, "The same by torque constants and gear friction under the load, [N].");
}

}  // namespace

DeclaredContact contact_of(const WrenchModel& model, const NamedContact& named) {
  DeclaredContact contact = named;
  if (named.frame_name.empty() == named.joint_name.empty()) throw Error("an expected contact needs a frame or a joint, and not both");
  if (!named.frame_name.empty()) {
    if (!model.refused().empty()) throw Error("no contact at a frame can be expected: " + model.refused());
    contact.frame = frame_of(model, named.frame_name);
    return contact;
  }
  std::string known;
  for (std::size_t j = 0; j < model.links().size(); ++j) {
    const std::string& name = model.links()[j].joint_name;
    if (name == named.joint_name) contact.joint = static_cast<int>(j);
    known += (j ? ", " : "") + name;
  }
  if (contact.joint < 0) throw Error("joint = '" + named.joint_name + "' of an expected contact must be one of " + known);
  return contact;
}

void bind_contact(nb::module_& m) {
  nb::enum_<Declared>(m, "Declared", "What an expected contact explains of a sample.")
      .value("none", Declared::none, "No expected contact is in effect, or there is no torque.")
      .value("within", Declared::within, "In effect; what its bounds admit is explained.")
      .value("beyond", Declared::beyond, "The force or torque is larger than declared by more than two standard errors.")
      .value("moved", Declared::moved, "The point moved farther along the axis than declared: nothing is explained until the force has gone.");
  nb::class_<NamedContact>(
      m, "DeclaredContact",
      "What the task means the environment to exert: at a frame a force within a cone and a moment, or a torque of one joint.\n"
      "For Monitor.expect_contact().")
      .def(
          "__init__",
          [](NamedContact* to, const std::string& frame, const std::string& joint, const std::array<double, 3>& point,
             const std::array<double, 3>& axis, WrenchAxes axes, const Number& half_angle_deg, const Number& at_most_n,
             const Number& at_most_nm, const Number& at_most_travel_m,
             const std::optional<std::pair<std::array<double, 3>, std::array<double, 3>>>& box) {
            NamedContact made;
            made.frame_name = frame;
            made.joint_name = joint;
            made.point = point;
            made.axis = axis;
            made.axes = axes;
            made.half_angle_rad = kDegree * half_angle_deg.named("half_angle_deg");
            made.at_most_n = at_most_n.named("at_most_n");
            made.at_most_nm = at_most_nm.named("at_most_nm");
            made.at_most_travel_m = at_most_travel_m.named("at_most_travel_m");
            made.boxed = box.has_value();
            if (box) std::tie(made.lowest_m, made.highest_m) = *box;
            new (to) NamedContact(std::move(made));
          },
          nb::kw_only(), nb::arg("frame") = "", nb::arg("joint") = "", nb::arg("point") = std::array<double, 3>{},
          nb::arg("axis") = std::array<double, 3>{}, nb::arg("axes") = WrenchAxes::frame, nb::arg("half_angle_deg") = 0.0,
          nb::arg("at_most_n") = 0.0, nb::arg("at_most_nm") = 0.0, nb::arg("at_most_travel_m") = kInfinite, nb::arg("box") = nb::none(),
          "frame or joint: its name. point: where the force acts, [m] along the frame's own axes. axis: direction of the force on\n"
          "the arm, along `axes`, of any length; zeros: any direction. half_angle_deg: of the cone around it, 0 to 90. at_most_n,\n"
          "at_most_nm: largest force and moment; with a joint, at_most_nm is its largest torque, in the joint's unit, and the sign of\n"
          "axis[0] admits one sign only. at_most_travel_m: largest way of the point along the axis during the contact. box: lowest\n"
          "and highest corner in the base's axes, [m], in which the frame's origin is while the contact is in effect.")
      .def_ro("frame", &NamedContact::frame_name, "Name of the frame; empty: of a joint.")
      .def_ro("joint", &NamedContact::joint_name, "Name of the joint; empty: at a frame.")
      .def_ro("point", &NamedContact::point, "Where the force acts, [m] along the frame's own axes.")
      .def_ro("axis", &NamedContact::axis, "Direction of the force on the arm; zeros: any.")
      .def_ro("axes", &NamedContact::axes, "Axes of `axis`.")
      .def_prop_ro("half_angle_deg", [](const NamedContact& c) { return c.half_angle_rad / kDegree; }, "Of the cone.")
      .def_ro("at_most_n", &NamedContact::at_most_n, "Largest force, [N].")
      .def_ro("at_most_nm", &NamedContact::at_most_nm, "Largest moment, [N m]; of a joint its torque.")
      .def_ro("at_most_travel_m", &NamedContact::at_most_travel_m, "Largest way along the axis, [m].")
      .def_prop_ro(
          "box",
          [](const NamedContact& c) {
            return c.boxed ? std::optional(std::pair(c.lowest_m, c.highest_m)) : std::nullopt;
          },
          "Lowest and highest corner, [m]; None: anywhere.")
      .def(
          "__eq__", [](const NamedContact& a, nb::handle b) { return nb::isinstance<NamedContact>(b) && a == nb::cast<const NamedContact&>(b); },
          nb::arg("other").none(), nb::sig("def __eq__(self, other: object, /) -> bool"))
      .def("__repr__", &repr);
  bind_tool_force(m);
}

}  // namespace tauext::bindings
