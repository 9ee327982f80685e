// Many-to-one LSTM with a linear head, evaluated on windows that are read in place.
#pragma once
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "tauext/settings.hpp"
#include "tauext/types.hpp"

namespace tauext {

// Rows of scaled features in time order, from which windows are read in place: a window of `length` network steps that
// ends at row e takes the rows e - (length - 1) stride, ..., e - stride, e.
struct WindowRows {
  const float* rows = nullptr;  // (row_count, columns)
  std::int64_t row_count = 0;   // rows that there are
  int columns = 0;              // numbers in a row
  int stride = 1;  // rows per network step
  int length = 0;  // network steps in a window
  std::span<const LstmInput> inputs;  // what a network step reads of them

  int largest_lag() const noexcept;  // of the inputs, in network steps
  // Rows before its end that a window reaches back to.
  std::int64_t reach() const noexcept {
    return (static_cast<std::int64_t>(length) - 1 + largest_lag()) * stride;
  }
  // Throws Error where shape.inputs, a column, a lag or an end does not fit the rows.
  void validate(const LstmShape& shape, std::span<const std::int64_t> ends) const;
};

// Output of the network on the window that ends at each row of `ends`: out (ends, outputs), scaled units.
// Each window starts from zero state. Every window's arithmetic is the same wherever it stands in `ends`, so the result
// does not depend on the batch or on `threads` (>= 1). Throws Error on sizes that do not fit.
void lstm_forward(const LstmShape& shape, std::span<const float> parameters, const WindowRows& windows,
                  std::span<const std::int64_t> ends, std::span<float> out, int threads);

// What a scaled output stands for, [N m]. A function of its own, so that no caller fuses its product with a sum of its
// own: batch and monitor must agree to the last bit.
double network_torque_nm(double scale_nm, float output) noexcept;

// The largest |input| with which no sum of the network can overflow, so that its answer is finite whatever it is given.
// Throws Error where parameters are so large that there is none.
float largest_lstm_input(const LstmShape& shape, std::span<const float> parameters);

// Instruction set of the network's kernels in this process: sse2, avx2 or avx512; neon on other processors than x86-64. It
// is the widest of the machine, or the one that the environment variable TAUEXT_SIMD asks for. Throws Error where this
// machine has none of that name.
std::string simd_in_use();

// sigmoid and tanh as the network computes them, for the test of their stated error: at most 5e-7 absolute.
void lstm_activations(std::span<const float> x, std::span<float> sigmoid, std::span<float> tanh);

}  // namespace tauext
