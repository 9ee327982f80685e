// Gradient of the network's mean squared error by backpropagation through time.
#pragma once
#include <cstdint>
#include <span>

#include "tauext/lstm.hpp"

namespace tauext::learn {

// Mean squared error over the windows that end at `ends` and over the outputs, and its gradient.
//   loss = 1/(N O) sum_k sum_o (y_o(k) - target_o(k))^2
// targets (ends, outputs) in scaled units; gradient has the layout of the parameters (LstmShape). Windows are read in
// place; memory is one history of a lane group a thread, about 1 MB at 100 steps and 20 units.
// The batch is cut in fixed chunks whose sums are added in fixed order: the same bytes for any number of threads.
// Throws Error on sizes that do not fit.
double lstm_gradient(const LstmShape& shape, std::span<const float> parameters, const WindowRows& windows,
                     std::span<const std::int64_t> ends, std::span<const float> targets, std::span<float> gradient,
                     int threads);

}  // namespace tauext::learn
