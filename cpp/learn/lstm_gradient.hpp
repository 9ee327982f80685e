// Gradient of the network's mean squared error by backpropagation through time.
#pragma once
#include <cstdint>
#include <span>

#include "network/lstm.hpp"

namespace tauext::learn {

// Mean squared error over the last `targets` steps of the sequences that end at `ends`, and over the outputs.
//   loss = 1/(N targets O) sum over sequences, their last steps and outputs of (y_o - target_o)^2
// With targets = 1 a sequence is a window and teaches its last step (the paper's recipe); with more, its first
// length - targets steps are burn-in, and each of the others teaches a target of its own.
// target_rows (row_count, outputs) in scaled units stand beside the rows; NaN where a row has no target, which then counts
// as no error. gradient has the layout of the parameters (LstmShape). Rows are read in place; memory is one history of a
// lane group a thread, about 1 MB for 100 steps and 20 units.
// The batch is cut in fixed chunks whose sums are added in fixed order: the same bytes for any number of threads.
// Throws Error on sizes that do not fit.
double lstm_gradient(const LstmShape& shape, std::span<const float> parameters, const WindowRows& windows,
                     std::span<const std::int64_t> ends, std::span<const float> target_rows, int targets,
                     std::span<float> gradient, int threads);

}  // namespace tauext::learn
