// The many-to-one network at every sample, without recomputing its window.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>

#include "network/lstm.hpp"
#include "tauext/settings.hpp"

namespace tauext {

// A window of `length` network steps ends at every row and begins from zero state, so that length - 1 of a phase's
// windows are always filling. Each keeps its own state (h, c); a new row moves all of its phase by one step, and the one
// that it completes is the answer. An answer is then one network step; the other windows advance after it has left.
//
//   push(row) -> answer(out) -> advance()
//
// The arithmetic of a window is that of lstm_forward, in the same order: within one build the results are equal to the
// last bit. Memory: 2 * hidden * (length - 1) * stride floats; at NetworkRate::network_period without the stride.
class SlidingLstm {
 public:
  // inputs: columns of the rows that push() takes; see LstmInput. Allocates all there is. Throws Error on sizes that do
  // not fit or that need more than kMaxSlidingBytes.
  SlidingLstm(const LstmShape& shape, std::span<const float> parameters, std::span<const LstmInput> inputs, int columns,
              int stride, int length, NetworkRate rate);
  ~SlidingLstm();
  SlidingLstm(SlidingLstm&&) noexcept;
  SlidingLstm& operator=(SlidingLstm&&) noexcept;

  // The next row begins a new stretch without history.
  void restart() noexcept;
  // A new row, `ticks` (1 to stride + 1) after the last; the ticks between hold the last one. Of a stretch's first row
  // `ticks` is not looked at.
  void push(std::span<const float> row, std::int64_t ticks) noexcept;
  // The output for the window that ends at the last row, or at the last network period; false, and nothing written,
  // while none is full. Scaled units.
  bool answer(std::span<float> out) noexcept;
  // Work that the next row's answer does not wait for. push() does it first if it was left out.
  void advance() noexcept;

  // State as bytes, of this size, for the same sizes, rate and build.
  std::size_t state_bytes() const noexcept;
  void save(std::span<std::byte> state) const noexcept;
  void restore(std::span<const std::byte> state) noexcept;

 private:
  struct Windows;
  std::unique_ptr<Windows> windows_;
};
// Most memory that the states of a network may take.
inline constexpr std::size_t kMaxSlidingBytes = std::size_t{1} << 28;

}  // namespace tauext
