// The network: windows of rows in, outputs or a gradient out.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"
#include "lstm_gradient.hpp"
#include "network/lstm.hpp"

namespace tauext::bindings {
namespace {

// Rows of the windows, with the inputs that they refer to.
struct PythonWindows {
  std::vector<LstmInput> inputs;
  WindowRows rows;

  PythonWindows(const Array<float, 2>& features, int stride, int length, const std::vector<std::pair<int, int>>& map) {
    for (const auto& [column, lag] : map) inputs.push_back({column, lag});
    rows = {features.data(), static_cast<std::int64_t>(features.shape(0)), static_cast<int>(features.shape(1)), stride,
            length, inputs};
  }
};

void bind_passes(nb::module_& m) {
  m.def(
      "lstm_forward",
      [](const LstmShape& shape, const Array<float, 1>& parameters, const Array<float, 2>& rows, int stride, int length,
         const std::vector<std::pair<int, int>>& inputs, const Array<std::int64_t, 1>& ends, int threads) {
        const PythonWindows windows(rows, stride, length, inputs);
        std::vector<float> out(ends.shape(0) * shape.outputs);
        {
          nb::gil_scoped_release released;
          lstm_forward(shape, span_of(parameters), windows.rows, span_of(ends), out, threads);
        }
        return to_numpy(std::move(out), {ends.shape(0), static_cast<std::size_t>(shape.outputs)});
      },
      nb::arg("shape"), nb::arg("parameters"), nb::arg("rows"), nb::arg("stride"), nb::arg("length"), nb::arg("inputs"),
      nb::arg("ends"), nb::arg("threads"), "Output of the windows that end at `ends`: (ends, outputs), scaled units.");
  m.def(
      "lstm_gradient",
      [](const LstmShape& shape, const Array<float, 1>& parameters, const Array<float, 2>& rows, int stride, int length,
         const std::vector<std::pair<int, int>>& inputs, const Array<std::int64_t, 1>& ends,
         const Array<float, 2>& target_rows, int targets, int threads) {
        const PythonWindows windows(rows, stride, length, inputs);
        if (target_rows.shape(1) != static_cast<std::size_t>(shape.outputs))
          throw Error("target_rows must have the shape (rows, " + std::to_string(shape.outputs) + ")");
        std::vector<float> gradient(shape.parameter_count());
        double loss;
        {
          nb::gil_scoped_release released;
          loss = learn::lstm_gradient(shape, span_of(parameters), windows.rows, span_of(ends),
                                      {target_rows.data(), target_rows.size()}, targets, gradient, threads);
        }
        return std::pair(loss, to_numpy(std::move(gradient), {shape.parameter_count()}));
      },
      nb::arg("shape"), nb::arg("parameters"), nb::arg("rows"), nb::arg("stride"), nb::arg("length"), nb::arg("inputs"),
      nb::arg("ends"), nb::arg("target_rows"), nb::arg("targets"), nb::arg("threads"),
      "Mean squared error over the last `targets` steps of each sequence, and its gradient.");
}

}  // namespace

void bind_lstm(nb::module_& m) {
  nb::class_<LstmShape>(m, "LstmShape",
      "Sizes of the network; parameters are W_x, W_h, b, W_head, b_head, with gates in the order i, f, g, o.")
      .def(
          "__init__",
          [](LstmShape* s, int inputs, int hidden, int outputs) {
            LstmShape shape{inputs, hidden, outputs};
            shape.validate();
            new (s) LstmShape(shape);
          },
          nb::arg("inputs"), nb::arg("hidden"), nb::arg("outputs"))
      .def_ro("inputs", &LstmShape::inputs)
      .def_ro("hidden", &LstmShape::hidden)
      .def_ro("outputs", &LstmShape::outputs)
      .def_prop_ro("parameter_count", &LstmShape::parameter_count);
  bind_passes(m);
  m.def(
      "lstm_activations",
      [](const Array<float, 1>& x) {
        const std::size_t N = x.shape(0);
        std::vector<float> sigmoid(N), tangent(N);
        lstm_activations(span_of(x), sigmoid, tangent);
        return std::pair(to_numpy(std::move(sigmoid), {N}), to_numpy(std::move(tangent), {N}));
      },
      nb::arg("x"), "sigmoid(x) and tanh(x) as the network computes them.");
  m.def("simd_in_use", &simd_in_use,
        "Instruction set of the network's kernels: the widest of this machine, or that of the environment variable "
        "TAUEXT_SIMD. Raises CoreError if this machine lacks it.");
}

}  // namespace tauext::bindings
