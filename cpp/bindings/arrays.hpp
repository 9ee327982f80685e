// Conversion between NumPy arrays and the core.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <array>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "tauext/sample.hpp"
#include "tauext/wrench.hpp"

namespace tauext::bindings {

namespace nb = nanobind;

struct AnyArray {};  // in signatures: an array of any type
using ArrayDict = nb::typed<nb::dict, nb::str, AnyArray>;

template <class T, int Dim>
using Array = nb::ndarray<const T, nb::numpy, nb::ndim<Dim>, nb::c_contig, nb::device::cpu>;

template <class T>
std::span<const T> span_of(const Array<T, 1>& a) {
  return {a.data(), a.shape(0)};
}

// Moves a vector to NumPy without a copy.
template <class T>
nb::ndarray<nb::numpy, T> to_numpy(std::vector<T>&& values, std::initializer_list<std::size_t> shape) {
  auto* owned = new std::vector<T>(std::move(values));
  nb::capsule owner(owned, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T>(owned->data(), shape, owner);
}

inline RecordingView view(const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
                   const Array<double, 2>& tau) {
  const auto N = t_ns.shape(0), n = q.shape(1);
  if (n < 1 || n > kMaxJoints) throw Error("recordings have 1 to 32 joints, not " + std::to_string(n));
  for (const Array<double, 2>* signal : {&q, &dq, &tau})
    if (signal->shape(0) != N || signal->shape(1) != n)
      throw Error("q, dq and tau must have the shape (" + std::to_string(N) + ", " + std::to_string(n) + ")");
  return {static_cast<std::int64_t>(N), static_cast<int>(n), t_ns.data(), q.data(), dq.data(), tau.data()};
}

// The same with the joint temperatures, [degC]; None: not measured.
using Temperatures = std::optional<Array<double, 2>>;
inline RecordingView view(const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
                   const Array<double, 2>& tau, const Temperatures& temperature) {
  RecordingView out = view(t_ns, q, dq, tau);
  if (!temperature) return out;
  if (temperature->shape(0) != t_ns.shape(0) || temperature->shape(1) != q.shape(1))
    throw Error("temperature must have the shape of q");
  out.temperature = temperature->data();
  return out;
}

// Python's Wrench: with the frame, the axes and, of a force without a moment, the point that it was estimated for.
struct FrameWrench : Wrench {
  std::string frame;
  WrenchAxes axes = WrenchAxes::base;
  std::optional<std::array<double, 3>> point;
};

void bind_coverage(nb::module_& m);
void bind_load(nb::module_& m);
void bind_load_found(nb::module_& m);
void bind_monitor(nb::module_& m);
void bind_refit(nb::module_& m);
void bind_places(nb::module_& m);
void bind_servo(nb::module_& m);
void bind_wrench(nb::module_& m);
// Number of the frame. Throws Error if the bundle has no wrench, or no such frame.
int frame_of(const WrenchModel& model, const std::string& name);

}  // namespace tauext::bindings

template <>
struct nanobind::detail::type_caster<tauext::bindings::AnyArray> {
  static constexpr auto Name = const_name("numpy.typing.NDArray[typing.Any]");
};
