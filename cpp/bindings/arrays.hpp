// Conversion between NumPy arrays and the core.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>  // in every file: without it, text would be cast as a class of ours

#include <array>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "tauext/declared_contact.hpp"
#include "tauext/sample.hpp"
#include "tauext/wrench.hpp"

namespace tauext::bindings {

namespace nb = nanobind;

struct AnyArray {};  // in signatures: an array of any type
using ArrayDict = nb::typed<nb::dict, nb::str, AnyArray>;

// An argument of any type. What is wrong with it is thrown where it is used, in one sentence, instead of nanobind's list of
// signatures: casters must not throw.
template <class T>
class Given {
 public:
  // The value. Throws Error, with the name, if there is none.
  const T& named(const char* name) const {
    if (!problem_.empty()) throw Error(name + (" " + problem_));
    return value_;
  }

 protected:
  template <class, class> friend struct nb::detail::type_caster;
  T value_{};
  std::string problem_;
};

using Whole = Given<std::int64_t>;  // a time in ns, for instance
using Number = Given<double>;

template <class T, int Dim>
using NumPy = nb::ndarray<const T, nb::numpy, nb::ndim<Dim>, nb::c_contig, nb::device::cpu>;

// An array of T: of NumPy, of another library, or a list; converted where order, byte order or width differ.
template <class T, int Dim>
class Array : public Given<NumPy<T, Dim>> {
 public:
  const T* data() const { return plain().data(); }
  std::size_t shape(std::size_t k) const { return plain().shape(k); }
  std::size_t size() const { return plain().size(); }

 private:
  const NumPy<T, Dim>& plain() const { return this->named("an array"); }
};

template <class T>
std::span<const T> span_of(const Array<T, 1>& a) {
  return {a.data(), a.shape(0)};
}

std::string type_of(nb::handle object);  // the name of the object's type
bool is_numpy(nb::handle object) noexcept;  // an array of NumPy itself, no subclass such as a masked array
// The object as an array of NumPy, as a whole number, as a number. The problem is set where it cannot be one.
nb::object numpy_of(nb::handle object, std::string_view type, int dimensions, std::string& problem) noexcept;
void read_whole(nb::handle object, std::int64_t& value, std::string& problem) noexcept;
void read_number(nb::handle object, double& value, std::string& problem) noexcept;

// Whatever a public function or constructor takes by none of its signatures throws Error in one sentence, instead of a
// TypeError with a list of signatures.
void refuse_wrong_arguments(nb::module_& m);

// Moves a vector to NumPy without a copy.
template <class T>
nb::ndarray<nb::numpy, T> to_numpy(std::vector<T>&& values, std::initializer_list<std::size_t> shape) {
  auto* owned = new std::vector<T>(std::move(values));
  nb::capsule owner(owned, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T>(owned->data(), shape, owner);
}

// The bits of the joints, (words, joints).
std::vector<std::uint8_t> bits(const std::vector<std::uint32_t>& words, std::size_t joints);

// Signals of a recording; joints: of the monitor or bundle, 0: any. Throws Error.
RecordingView view(const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
                   const Array<double, 2>& tau, int joints = 0);

// The same with the joint temperatures, [degC]; None: not measured, NaN: unknown.
using Temperatures = std::optional<Array<double, 2>>;
RecordingView view(const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
                   const Array<double, 2>& tau, const Temperatures& temperature, int joints = 0);

// Throws Error for an infinite temperature. celsius: (rows, joints).
void expect_temperatures(std::span<const double> celsius, std::size_t joints);

// Python's Wrench: with the frame, the axes and, of a force without a moment, the point that it was estimated for.
struct FrameWrench : Wrench {
  std::string frame;
  WrenchAxes axes = WrenchAxes::base;
  std::optional<std::array<double, 3>> point;
};

// Python's ToolForce: its wrench with the frame's name.
struct FrameToolForce : ToolForce {
  FrameWrench at;
};

// Python's DeclaredContact: with the names of the frame or joint, whose numbers only a monitor has.
struct NamedContact : DeclaredContact {
  std::string frame_name, joint_name;
  bool operator==(const NamedContact&) const = default;
};
// With the numbers. Throws Error if there is no such frame or joint.
DeclaredContact contact_of(const WrenchModel& model, const NamedContact& named);

void bind_bundle(nb::module_& m);
void bind_contact(nb::module_& m);
void bind_coverage(nb::module_& m);
void bind_estimate(nb::module_& m);
void bind_estimates(nb::module_& m);
void bind_flights(nb::module_& m);
void bind_load(nb::module_& m);
void bind_load_found(nb::module_& m);
void bind_lstm(nb::module_& m);
void bind_monitor(nb::module_& m);
void bind_observer(nb::module_& m);
void bind_places(nb::module_& m);
void bind_refit(nb::module_& m);
void bind_servo(nb::module_& m);
void bind_tree(nb::module_& m);
void bind_wrench(nb::module_& m);
// Number of the frame. Throws Error if the bundle has no wrench, or no such frame.
int frame_of(const WrenchModel& model, const std::string& name);

}  // namespace tauext::bindings

namespace nanobind::detail {

template <>
struct type_caster<tauext::bindings::AnyArray> {
  static constexpr auto Name = const_name("numpy.typing.NDArray[typing.Any]");
};

template <>
struct type_caster<tauext::bindings::Whole> {
  NB_TYPE_CASTER(tauext::bindings::Whole, const_name("int"))
  bool from_python(handle object, std::uint32_t, cleanup_list*) noexcept {
    tauext::bindings::read_whole(object, value.value_, value.problem_);
    return true;
  }
};

template <>
struct type_caster<tauext::bindings::Number> {
  NB_TYPE_CASTER(tauext::bindings::Number, const_name("float"))
  bool from_python(handle object, std::uint32_t, cleanup_list*) noexcept {
    tauext::bindings::read_number(object, value.value_, value.problem_);
    return true;
  }
};

template <class T, int Dim>
struct type_caster<tauext::bindings::Array<T, Dim>> {
  using NumPyCaster = make_caster<tauext::bindings::NumPy<T, Dim>>;
  using Given = tauext::bindings::Array<T, Dim>;
  NB_TYPE_CASTER(Given, const_name("numpy.typing.ArrayLike"))
  bool from_python(handle object, std::uint32_t, cleanup_list* cleanup) noexcept {
    NumPyCaster caster;
    if (tauext::bindings::is_numpy(object) && caster.from_python(object, 0, cleanup)) {
      value.value_ = std::move(caster.value);
      return true;
    }
    const nanobind::object converted = tauext::bindings::numpy_of(object, std::string_view(dtype_traits<T>::name.text), Dim, value.problem_);
    if (!value.problem_.empty()) return true;
    if (caster.from_python(converted, 0, cleanup)) value.value_ = std::move(caster.value);
    else value.problem_ = "cannot be converted";
    return true;
  }
};

}  // namespace nanobind::detail
