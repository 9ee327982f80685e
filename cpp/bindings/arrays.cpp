// Checks and conversion of arguments, each problem in one sentence.
#include "arrays.hpp"

#include <cmath>
#include <limits>
#include <string>
#include <string_view>

namespace tauext::bindings {

namespace {

// An argument that is taken only once no signature takes the call, not even by converting arguments.
struct Leftover {
  nb::object value;
};

}  // namespace
}  // namespace tauext::bindings

namespace nanobind::detail {

template <>
struct type_caster<tauext::bindings::Leftover> {
  NB_TYPE_CASTER(tauext::bindings::Leftover, const_name("object"))
  bool from_python(handle object, std::uint32_t flags, cleanup_list*) noexcept {
    value.value = borrow(object);
    return (flags & static_cast<std::uint32_t>(cast_flags::convert)) != 0;
  }
};

}  // namespace nanobind::detail

namespace tauext::bindings {

namespace {

std::string text(nb::handle object) { return nb::cast<std::string>(nb::str(object)); }

// An argument for a message: in one line, shortened.
std::string shown(nb::handle object) {
  constexpr int kMost = 40;
  try {
    const nb::object line = nb::str(" ").attr("join")(nb::repr(object).attr("split")());
    const std::string whole = text(line);
    return nb::len(line) <= kMost ? whole : text(line.attr("__getitem__")(nb::slice(0, kMost, 1))) + " ...";
  } catch (nb::python_error&) {  // an object without a representation
    return "an object of type " + type_of(object);
  }
}

std::string shown(const Leftover& first, const nb::args& args, const nb::kwargs& kwargs) {
  std::string out = first.value.is(nb::ellipsis()) ? "" : shown(first.value);
  for (const nb::handle value : args) out += (out.empty() ? "" : ", ") + shown(value);
  for (const auto& [name, value] : kwargs) out += (out.empty() ? "" : ", ") + text(name) + "=" + shown(value);
  return out;
}

// The signatures in a docstring of nanobind: `Load(mass: float)`, joined by `or`.
std::string signatures_of(nb::handle function, const std::string& name) {
  std::string out;
  for (const nb::handle line : text(function.attr("__doc__")).empty() ? nb::list() : nb::list(function.attr("__doc__").attr("split")("\n"))) {
    std::string one = text(line);
    if (one.empty()) break;
    one = one.substr(0, one.rfind(" -> "));
    for (const char* noise : {"self, ", "self", "tauext._core."})
      for (std::size_t at; (at = one.find(noise)) != std::string::npos;) one.erase(at, std::string(noise).size());
    out += (out.empty() ? "" : " or ") + name + one.substr(std::min(one.find('('), one.size()));
  }
  return out;
}

// The docstring without its signatures, and "" where overloads have several: one that all overloads share is shown once.
std::string doc_of(nb::handle function) {
  const std::string whole = function.is_none() ? "" : text(function.attr("__doc__"));
  const std::size_t at = whole.find("\n\n");
  return at == std::string::npos || whole.find("\nOverloaded function.\n") != std::string::npos ? "" : whole.substr(at + 2);
}

// Adds a signature that takes any arguments and throws Error.
void refuse_others(nb::handle owner, nb::handle function, const std::string& name, const std::string& shown_name) {
  const std::string help = "def " + name + "(...) raises CoreError for all other arguments", doc = doc_of(function);
  const std::string takes = function.is_none() ? "no call; other functions return it" : signatures_of(function, shown_name);
  const auto refuse = [=](const Leftover& first, const nb::args& args, const nb::kwargs& kwargs) {
    throw Error(shown_name + "(" + shown(first, args, kwargs) + ") must be " + takes);
  };
  const auto define = [&](const auto& call, const auto&... extra) {
    const auto add = [&](const auto&... more) {
      nb::cpp_function_def(call, nb::scope(owner), nb::sig(help.c_str()), nb::arg("first").none() = nb::ellipsis(), nb::arg("args"),
                           nb::arg("kwargs"), more...);
    };
    if (doc.empty()) add(extra...);
    else add(extra..., doc.c_str());
  };
  const bool is_method = function.is_none() || text(function.type().attr("__name__")) == "nb_method";
  if (is_method)
    define([=](nb::handle, const Leftover& first, const nb::args& args, const nb::kwargs& kwargs) { refuse(first, args, kwargs); },
           nb::is_method());
  else
    define(refuse);
}

// What is no member of an enumeration throws Error, too.
void refuse_others(const nb::object& enumeration, const std::string& name) {
  const std::string members = text(nb::str(", ").attr("join")(enumeration.attr("__members__")));
  const auto refuse = [=](const nb::args& given) {
    throw Error(name + "(" + shown(given[given.size() - 1]) + ") must be the number of one of " + members);
  };
  enumeration.attr("_missing_") = nb::module_::import_("builtins").attr("classmethod")(nb::cpp_function(refuse));
}

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
  const bool is_too_large = PyErr_ExceptionMatches(PyExc_OverflowError) != 0;
  PyErr_Clear();
  problem = is_too_large ? "is beyond 1.8e308, the largest number" : "is of type " + type_of(object) + "; it must be a number";
}

void refuse_wrong_arguments(nb::module_& m) {
  for (const nb::handle item : nb::cast<nb::dict>(m.attr("__dict__")).items()) {  // a copy: functions are replaced
    const std::string name = text(item[0]);
    const nb::object value = item[1];
    if (name.starts_with("_")) continue;
    if (nb::hasattr(value, "__members__")) refuse_others(value, name);
    else if (text(value.type().attr("__name__")) == "nb_func") refuse_others(m, value, name, name);
    if (!PyType_Check(value.ptr()) || !nb::type_check(value)) continue;
    nb::dict own;
    own.update(value.attr("__dict__"));
    if (text(own["__init__"].type().attr("__name__")) != "nb_method") refuse_others(value, nb::none(), "__init__", name);
    for (const nb::handle pair : own.items()) {
      const nb::object function = pair[1];
      const std::string of = text(pair[0]), kind = text(function.type().attr("__name__"));
      const bool is_function = kind == "nb_method" || kind == "nb_func";
      // step is called a thousand times a second, and all of its arguments take any object.
      if (is_function && of == "__init__") refuse_others(value, function, of, name);
      else if (is_function && of != "step" && !of.starts_with("_")) refuse_others(value, function, of, name + "." + of);
    }
  }
}

void expect_temperatures(std::span<const double> celsius, std::size_t joints) {
  for (std::size_t k = 0; k < celsius.size(); ++k)
    if (std::isinf(celsius[k]))
      throw Error("temperature is infinite in column " + std::to_string(k % joints) + " of row " + std::to_string(k / joints) +
                  "; it must be in degrees Celsius, or NaN where it is unknown");
}

std::vector<std::uint8_t> bits(const std::vector<std::uint32_t>& words, std::size_t joints) {
  std::vector<std::uint8_t> out;
  for (std::uint32_t word : words)
    for (std::size_t j = 0; j < joints; ++j) out.push_back(word >> j & 1);
  return out;
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
