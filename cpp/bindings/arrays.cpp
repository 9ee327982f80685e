// Checks and conversion of arguments, each problem in one sentence.
#include "arrays.hpp"

#include <cmath>
#include <limits>
#include <string>
#include <string_view>

namespace tauext::bindings {

namespace {

std::string text(nb::handle object) { return nb::cast<std::string>(nb::str(object)); }

std::string shape_of(std::size_t rows, std::size_t columns) {
  return "(" + std::to_string(rows) + ", " + std::to_string(columns) + ")";
}

void expect_shape(const char* name, const Array<double, 2>& signal, std::size_t rows, std::size_t columns) {
  const auto& array = signal.named(name);
  if (array.shape(0) != rows || array.shape(1) != columns)
    throw Error(std::string(name) + " has the shape " + shape_of(array.shape(0), array.shape(1)) + "; it must be " +
                shape_of(rows, columns) + ", a row for each of t_ns and a column for each joint");
}

nb::object converted(nb::handle object, std::string_view type, int dimensions, std::string& problem) {
  const nb::module_ numpy = nb::module_::import_("numpy");
  const std::string name(type);
  if (nb::isinstance(object, numpy.attr("ma").attr("MaskedArray"))) {
    problem = "is a masked array; give a plain one, with NaN for what is missing";
    return {};
  }
  const nb::object array = numpy.attr("asarray")(object);
  const std::string kind = text(array.attr("dtype").attr("kind"));
  const bool is_empty = nb::cast<std::size_t>(array.attr("size")) == 0, is_float = type.starts_with("float");
  const std::string kinds = is_float ? "fiu" : type == "uint8" ? "iub" : "iu";
  if (!is_empty && kinds.find(kind) == std::string::npos) {
    const bool is_one = nb::cast<int>(array.attr("ndim")) == 0;
    problem = (is_one ? "is of type " + type_of(object) : "holds " + text(array.attr("dtype"))) + "; it must be an array of " +
              (is_float ? "numbers" : "whole numbers") + " (" + name + ")";
    return {};
  }
  if (nb::cast<int>(array.attr("ndim")) != dimensions) {
    problem = "has the shape " + text(array.attr("shape")) + "; it must have " + std::to_string(dimensions) + " dimension" +
              (dimensions > 1 ? "s" : "");
    return {};
  }
  const nb::object made = numpy.attr("ascontiguousarray")(array, nb::arg("dtype") = name);
  if (!is_empty && type == "int64" && kind == "u" && nb::cast<std::int64_t>(made.attr("min")().attr("item")()) < 0) {
    problem = "holds numbers of 2^63 or more, beyond int64";
    return {};
  }
  return made;
}

}  // namespace

std::string type_of(nb::handle object) {
  return text(nb::steal(PyType_GetName(Py_TYPE(object.ptr()))));  // the stable ABI hides the fields of a type
}

bool is_numpy(nb::handle object) noexcept {
  static const PyTypeObject* type = nullptr;
  if (type == nullptr) {
    try {
      type = reinterpret_cast<const PyTypeObject*>(nb::object(nb::module_::import_("numpy").attr("ndarray")).release().ptr());
    } catch (nb::python_error& error) {
      error.discard_as_unraisable("numpy");
      return false;
    }
  }
  return Py_TYPE(object.ptr()) == type;
}

nb::object numpy_of(nb::handle object, std::string_view type, int dimensions, std::string& problem) noexcept {
  try {
    return converted(object, type, dimensions, problem);
  } catch (nb::python_error& error) {  // by the object's own conversion
    problem = "cannot be read as an array (" + text(error.value()) + ")";
  } catch (const std::exception& error) {
    problem = std::string("cannot be read as an array (") + error.what() + ")";
  }
  return {};
}

void read_whole(nb::handle object, std::int64_t& value, std::string& problem) noexcept {
  try {
    if (!PyIndex_Check(object.ptr()) || PyBool_Check(object.ptr())) {
      problem = "= " + text(nb::repr(object)) + " must be a whole number";
      return;
    }
    const nb::object whole = nb::steal(PyNumber_Index(object.ptr()));
    if (!whole.is_valid()) nb::raise_python_error();
    int beyond = 0;
    value = PyLong_AsLongLongAndOverflow(whole.ptr(), &beyond);
    if (beyond != 0) problem = "= " + text(nb::repr(object)) + " must be within -2^63 and 2^63 - 1";
  } catch (nb::python_error& error) {  // of an array of several numbers
    problem = "must be a whole number (" + text(error.value()) + ")";
  } catch (const std::exception& error) {
    problem = std::string("must be a whole number (") + error.what() + ")";
  }
}

void read_number(nb::handle object, double& value, std::string& problem) noexcept {
  value = PyFloat_AsDouble(object.ptr());
  if (!PyErr_Occurred()) return;
  PyErr_Clear();
  problem = "is of type " + type_of(object) + "; it must be a number";
}

void expect_temperatures(std::span<const double> celsius, std::size_t joints) {
  for (std::size_t k = 0; k < celsius.size(); ++k)
    if (std::isinf(celsius[k]))
      throw Error("temperature is infinite in column " + std::to_string(k % joints) + " of row " + std::to_string(k / joints) +
                  "; it must be in degrees Celsius, or NaN where it is unknown");
}

RecordingView view(const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
                   const Array<double, 2>& tau, int joints) {
  const std::size_t rows = t_ns.named("t_ns").shape(0), columns = q.named("q").shape(1);
  if (columns < 1 || columns > kMaxJoints) throw Error("recordings have 1 to 32 joints, not " + std::to_string(columns));
  if (joints > 0 && columns != static_cast<std::size_t>(joints))
    throw Error("q has " + std::to_string(columns) + " columns; it must have " + std::to_string(joints) + ", one for each joint");
  expect_shape("q", q, rows, columns);
  expect_shape("dq", dq, rows, columns);
  expect_shape("tau", tau, rows, columns);
  return {static_cast<std::int64_t>(rows), static_cast<int>(columns), t_ns.data(), q.data(), dq.data(), tau.data()};
}

RecordingView view(const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
                   const Array<double, 2>& tau, const Temperatures& temperature, int joints) {
  RecordingView out = view(t_ns, q, dq, tau, joints);
  if (!temperature) return out;
  const auto rows = static_cast<std::size_t>(out.samples), columns = static_cast<std::size_t>(out.joints);
  expect_shape("temperature", *temperature, rows, columns);
  expect_temperatures({temperature->data(), rows * columns}, columns);
  out.temperature = temperature->data();
  return out;
}

}  // namespace tauext::bindings
