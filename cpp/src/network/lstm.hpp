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

// Rows of scaled features in time order; windows are read in place. A window of `length` network steps that ends at row
// e uses rows e - (length - 1) stride, ..., e - stride, e.
struct WindowRows {
  const float* rows = nullptr;  // (row_count, columns)
  std::int64_t row_count = 0;   // number of rows
  int columns = 0;              // values per row
  int stride = 1;  // rows per network step
  int length = 0;  // network steps in a window
  std::span<const LstmInput> inputs;  // which columns and lags form a network step

  int largest_lag() const noexcept;  // of the inputs, in network steps
  // Rows from a window's end back to its start.
  std::int64_t reach() const noexcept {
    return (static_cast<std::int64_t>(length) - 1 + largest_lag()) * stride;
  }
  // Throws Error if shape.inputs, a column, a lag or an end does not fit the rows.
  void validate(const LstmShape& shape, std::span<const std::int64_t> ends) const;
};

// Network output, scaled, for the window that ends at each row of `ends`: out (ends, outputs). Each window starts from
// zero state and is computed independently. So results do not depend on the batch or on `threads` (>= 1). Throws Error
// on wrong sizes.
void lstm_forward(const LstmShape& shape, std::span<const float> parameters, const WindowRows& windows,
                  std::span<const std::int64_t> ends, std::span<float> out, int threads);

// Torque of a scaled output, [N m]. A separate function, so that no caller fuses this product with its own sum: batch
// and monitor agree to the last bit.
double network_torque_nm(double scale_nm, float output) noexcept;

// Largest |input| for which no sum of the network can overflow. Throws Error if the parameters are too large for any
// input.
float largest_lstm_input(const LstmShape& shape, std::span<const float> parameters);

// Instruction set of the network's kernels: sse2, avx2 or avx512; neon on other processors than x86-64. The widest of
// the machine, unless the environment variable TAUEXT_SIMD selects another. Throws Error if the machine lacks the
// selected one.
std::string simd_in_use();

// sigmoid and tanh as the network computes them, to test their stated error: at most 5e-7 absolute.
void lstm_activations(std::span<const float> x, std::span<float> sigmoid, std::span<float> tanh);

}  // namespace tauext
