#include "network/sliding_lstm.hpp"

#include <algorithm>
#include <cstring>
#include <type_traits>

#include "chain/motion.hpp"
#include "network/lstm_lanes.hpp"

namespace tauext {

using namespace lanes;

namespace {

constexpr std::size_t round_up(std::size_t n, std::size_t to) noexcept { return (n + to - 1) / to * to; }
constexpr int kWidest = 16;

// Weights for one window at a time, with hidden units and outputs in the lanes. Row `r` of the gates is gate * padded +
// unit; sums have the same order as in lanes::step.
struct SingleWeights {
  int inputs, padded, outputs, rows, head_rows;
  Buffer gates;  // [inputs + padded + 1][rows]: the last line is the bias
  Buffer head;   // [padded + 1][head_rows]: the last line is the bias

  SingleWeights(const LstmShape& shape, std::span<const float> parameters)
      : inputs(shape.inputs),
        padded(padded_hidden(shape.hidden)),
        outputs(shape.outputs),
        rows(static_cast<int>(round_up(static_cast<std::size_t>(padded) * 4, kWidest))),
        head_rows(static_cast<int>(round_up(static_cast<std::size_t>(shape.outputs), kWidest))),
        gates(make_buffer(static_cast<std::size_t>(inputs + padded + 1) * rows)),
        head(make_buffer(static_cast<std::size_t>(padded + 1) * head_rows)) {
    const int F = inputs, H = shape.hidden;
    const float* w_x = parameters.data();
    const float* w_h = w_x + static_cast<std::ptrdiff_t>(4) * H * F;
    const float* b = w_h + static_cast<std::ptrdiff_t>(4) * H * H;
    const float* w_head = b + 4 * H;
    const float* b_head = w_head + static_cast<std::ptrdiff_t>(outputs) * H;
    for (int gate = 0; gate < 4; ++gate)
      for (int u = 0; u < H; ++u) {
        const int from = gate * H + u, to = gate * padded + u;
        for (int k = 0; k < F; ++k) gates[static_cast<std::size_t>(k) * rows + to] = w_x[from * F + k];
        for (int k = 0; k < H; ++k) gates[static_cast<std::size_t>(F + k) * rows + to] = w_h[from * H + k];
        gates[static_cast<std::size_t>(F + padded) * rows + to] = b[from];
      }
    for (int o = 0; o < outputs; ++o) {
      for (int k = 0; k < H; ++k) head[static_cast<std::size_t>(k) * head_rows + o] = w_head[o * H + k];
      head[static_cast<std::size_t>(padded) * head_rows + o] = b_head[o];
    }
  }
};

// sums[r] = start[r] + sum over k of x[k] weights[k][r], for N vectors from row `first` on.
template <int L, int N>
TAUEXT_INLINE void add_block(const float* start, const float* weights, int rows, int first, const float* x, int count,
                             float* sums) noexcept {
  V<L> sum[N];
#pragma GCC unroll 10
  for (int a = 0; a < N; ++a) sum[a] = load<L>(start + first + a * L);
  for (int k = 0; k < count; ++k) {
    const float* line = weights + static_cast<std::ptrdiff_t>(k) * rows + first;
#pragma GCC unroll 10
    for (int a = 0; a < N; ++a) sum[a] += load<L>(line + a * L) * x[k];
  }
#pragma GCC unroll 10
  for (int a = 0; a < N; ++a) store<L>(sums + first + a * L, sum[a]);
}

template <int L>
TAUEXT_INLINE void add(const float* start, const float* weights, int rows, const float* x, int count,
                       float* sums) noexcept {
  int r = 0;
  for (; r + 10 * L <= rows; r += 10 * L) add_block<L, 10>(start, weights, rows, r, x, count, sums);
  for (; r + 5 * L <= rows; r += 5 * L) add_block<L, 5>(start, weights, rows, r, x, count, sums);
  for (; r < rows; r += L) add_block<L, 1>(start, weights, rows, r, x, count, sums);
}

}  // namespace

struct SlidingLstm::Windows {
  // All state outside the buffers.
  struct Position {
    std::int64_t row = -1;           // last row of the stretch, -1 before the first
    std::int64_t advanced = -1;      // last row processed by the filling windows
    std::int64_t due = -1;           // row whose finished window is in due_h and due_c
    std::int64_t answered = -1;      // row whose answer is in `last`
    std::int64_t projected = -1;     // row whose projection is in `projection`
    std::int32_t ring_at = 0;        // ring index of the last row
    std::int32_t unused = 0;
  };
  static_assert(std::is_trivially_copyable_v<Position>);

  Windows(const LstmShape& shape, std::span<const float> parameters, std::span<const LstmInput> map, int column_count,
          int row_stride, int window_length, NetworkRate at)
      : batch(shape, parameters),
        single(shape, parameters),
        inputs(map.begin(), map.end()),
        columns(column_count),
        stride(row_stride),
        length(window_length),
        every_sample(at == NetworkRate::every_sample),
        lane_width(lane_count()) {
    for (const LstmInput& input : inputs) largest_lag = std::max(largest_lag, input.lag);
    const auto P = static_cast<std::size_t>(single.padded);
    groups = static_cast<int>(round_up(static_cast<std::size_t>(length - 1), static_cast<std::size_t>(lane_width))) / lane_width;
    phase_floats = static_cast<std::size_t>(groups) * 2 * P * static_cast<std::size_t>(lane_width);
    const std::size_t states = phase_floats * static_cast<std::size_t>(every_sample ? stride : 1);
    // Rows pushed at once, and the earlier rows that the first of them needs.
    ring_rows = static_cast<std::int64_t>(largest_lag) * stride + std::max(stride, kMostBridged) + 2;
    const std::size_t ring_floats = static_cast<std::size_t>(ring_rows) * static_cast<std::size_t>(columns);
    if ((states + ring_floats) * sizeof(float) > kMaxSlidingBytes)
      throw Error("a network with " + std::to_string(shape.hidden) + " units, windows of " + std::to_string(length) +
                  " steps and " + std::to_string(stride) + " samples a step needs " +
                  std::to_string((states + ring_floats) * sizeof(float) >> 20) + " MB of state, more than " +
                  std::to_string(kMaxSlidingBytes >> 20));
    // One block, so that the state is saved and restored by one copy.
    const std::size_t P16 = round_up(P, kWidest);
    state_floats = states + ring_floats + 2 * P16 + static_cast<std::size_t>(single.head_rows);
    state = make_buffer(state_floats + kWidest);
    due_h = state.get() + states;
    due_c = due_h + P16;
    last = due_c + P16;
    ring = last + single.head_rows;
    const std::size_t R = static_cast<std::size_t>(single.rows) + kWidest;
    projection = make_buffer(R);
    sums = make_buffer(R);
    x = make_buffer(inputs.size());
    h = make_buffer(P16);
    c = make_buffer(P16);
    next_h = make_buffer(P * static_cast<std::size_t>(lane_width));
  }

  std::int64_t reach() const noexcept { return static_cast<std::int64_t>(length - 1 + largest_lag) * stride; }
  std::int64_t first_row_of(std::int64_t end) const noexcept {
    return end - static_cast<std::int64_t>(length - 1) * stride;
  }
  // The lane that stores h of the window ending at this row; c is `padded` lines further. The window that starts at the
  // row uses the same lane.
  float* lane_of(std::int64_t row) noexcept {
    const std::int64_t slot = row / stride % (length - 1);
    const std::int64_t phase = every_sample ? row % stride : 0;
    return state.get() + static_cast<std::size_t>(phase) * phase_floats +
           static_cast<std::size_t>(slot / lane_width * 2 * single.padded) * lane_width + slot % lane_width;
  }
  const float* ring_row(std::int64_t row, std::int64_t steps_back) const noexcept {
    std::int64_t at = position.ring_at - (position.row - row) - steps_back * stride;
    if (at < 0) at += ring_rows;
    return ring + at * columns;
  }

  template <int L>
  TAUEXT_INLINE void project(std::int64_t row) noexcept {
    for (std::size_t f = 0; f < inputs.size(); ++f) x[f] = ring_row(row, inputs[f].lag)[inputs[f].column];
    const float* bias = single.gates.get() + static_cast<std::ptrdiff_t>(single.inputs + single.padded) * single.rows;
    add<L>(bias, single.gates.get(), single.rows, x.get(), single.inputs, projection.get());
    position.projected = row;
  }

  // One network step of one window, in h and c.
  template <int L>
  TAUEXT_INLINE void single_step(std::int64_t row) noexcept {
    project<L>(row);
    const float* weights = single.gates.get() + static_cast<std::ptrdiff_t>(single.inputs) * single.rows;
    add<L>(projection.get(), weights, single.rows, h.get(), single.padded, sums.get());
    const int P = single.padded;
    for (int u = 0; u < P; u += L) {  // lanes past the last unit hold other gates' sums; their results are not used
      V<L> i[] = {load_anywhere<L>(sums.get() + u)}, f[] = {load_anywhere<L>(sums.get() + P + u)};
      V<L> g[] = {load_anywhere<L>(sums.get() + 2 * P + u)}, o[] = {load_anywhere<L>(sums.get() + 3 * P + u)};
      V<L> cell[1], tanh_cell[1], new_h[1];
      cell_step<L, false>(i, f, g, o, {load<L>(c.get() + u)}, cell, tanh_cell, new_h);
      store<L>(c.get() + u, cell[0]);
      store<L>(h.get() + u, new_h[0]);
    }
  }

  // h and c of the window ending at `end`, after the rows advanced so far.
  TAUEXT_INLINE void read_window(std::int64_t end, float* to_h, float* to_c) noexcept {
    const int P = single.padded;
    if (first_row_of(end) > position.advanced) {  // it has not started
      std::memset(to_h, 0, sizeof(float) * P);
      std::memset(to_c, 0, sizeof(float) * P);
      return;
    }
    const float* lane = lane_of(end);
    for (int u = 0; u < P; ++u) {
      to_h[u] = lane[u * lane_width];
      to_c[u] = lane[(P + u) * lane_width];
    }
  }

  template <int L>
  TAUEXT_INLINE void answer(std::int64_t end) noexcept {
    const int P = single.padded;
    if (position.due == end) {
      std::memcpy(h.get(), due_h, sizeof(float) * P);
      std::memcpy(c.get(), due_c, sizeof(float) * P);
    } else {
      // After a gap, bridged rows of the same phase may not have been processed yet.
      read_window(end, h.get(), c.get());
      const std::int64_t from = std::max(position.advanced + 1, first_row_of(end));
      for (std::int64_t row = end - (end - from) / stride * stride; row < end; row += stride) single_step<L>(row);
    }
    single_step<L>(end);
    const float* bias = single.head.get() + static_cast<std::ptrdiff_t>(P) * single.head_rows;
    add<L>(bias, single.head.get(), single.head_rows, h.get(), P, last);
    position.answered = end;
  }

  template <int L>
  TAUEXT_INLINE void advance() noexcept {
    const int P = single.padded;
    for (std::int64_t row = position.advanced + 1; row <= position.row; ++row) {
      if (!every_sample && row % stride != 0) continue;
      if (row < static_cast<std::int64_t>(largest_lag) * stride) continue;  // no window that is answered starts here
      if (position.projected != row) project<L>(row);
      float* lane = lane_of(row);
      for (int u = 0; u < 2 * P; ++u) lane[u * lane_width] = 0.0f;
      float* group = state.get() + static_cast<std::size_t>(every_sample ? row % stride : 0) * phase_floats;
      for (int g = 0; g < groups; ++g, group += 2 * P * L) {
        float* cells = group + P * L;
        step<L, Start::shared, false>(batch, nullptr, group, cells, nullptr, cells, nullptr, next_h.get(),
                                      {projection.get(), 0});
        std::memcpy(group, next_h.get(), sizeof(float) * P * L);
      }
    }
    position.advanced = position.row;
    const std::int64_t next = every_sample ? position.row + 1 : (position.row / stride + 1) * stride;
    if (position.due == next) return;
    read_window(next, due_h, due_c);
    position.due = next;
  }

  // Wrappers that name the instruction set; see lstm_lanes.hpp.
  TAUEXT_TARGET_16 void answer_16(std::int64_t end) noexcept { answer<16>(end); }
  TAUEXT_TARGET_8 void answer_8(std::int64_t end) noexcept { answer<8>(end); }
  void answer_4(std::int64_t end) noexcept { answer<4>(end); }
  TAUEXT_TARGET_16 void advance_16() noexcept { advance<16>(); }
  TAUEXT_TARGET_8 void advance_8() noexcept { advance<8>(); }
  void advance_4() noexcept { advance<4>(); }
  void answer_any(std::int64_t end) noexcept {
    if (lane_width == 16) return answer_16(end);
    if (lane_width == 8) return answer_8(end);
    answer_4(end);
  }
  void advance_any() noexcept {
    if (lane_width == 16) return advance_16();
    if (lane_width == 8) return advance_8();
    advance_4();
  }

  Packed batch;
  SingleWeights single;
  std::vector<LstmInput> inputs;
  int columns, stride, length;
  bool every_sample;
  int lane_width;
  int largest_lag = 0, groups = 0;
  std::int64_t ring_rows = 0;
  std::size_t phase_floats = 0, state_floats = 0;
  Position position;
  Buffer state;  // filling windows [phase][group][h, c][padded][lane] | due_h | due_c | last | ring
  float *due_h = nullptr, *due_c = nullptr, *last = nullptr, *ring = nullptr;
  Buffer projection, sums, x, h, c, next_h;  // valid within one call, except for the projection
};

SlidingLstm::SlidingLstm(const LstmShape& shape, std::span<const float> parameters, std::span<const LstmInput> inputs,
                         int columns, int stride, int length, NetworkRate rate) {
  shape.validate();
  WindowRows{nullptr, 0, columns, stride, length, inputs}.validate(shape, {});
  if (parameters.size() != shape.parameter_count())
    throw Error("the network has " + std::to_string(shape.parameter_count()) + " parameters, not " +
                std::to_string(parameters.size()));
  if (length > kMaxWindowSteps || stride > kMaxNetworkStride)
    throw Error("a window of " + std::to_string(length) + " steps of " + std::to_string(stride) +
                " samples is longer than " + std::to_string(kMaxWindowSteps) + " of " +
                std::to_string(kMaxNetworkStride));
  windows_ = std::make_unique<Windows>(shape, parameters, inputs, columns, stride, length, rate);
}
SlidingLstm::~SlidingLstm() = default;
SlidingLstm::SlidingLstm(SlidingLstm&&) noexcept = default;
SlidingLstm& SlidingLstm::operator=(SlidingLstm&&) noexcept = default;

// Filling windows and ring keep stale values: later windows do not read them.
void SlidingLstm::restart() noexcept { windows_->position = {}; }

void SlidingLstm::push(std::span<const float> row, std::int64_t ticks) noexcept {
  advance();
  Windows& w = *windows_;
  Windows::Position& at = w.position;
  const float* held = w.ring + static_cast<std::ptrdiff_t>(at.ring_at) * w.columns;
  for (std::int64_t tick = at.row < 0 ? 1 : ticks; tick > 0; --tick) {
    if (++at.ring_at == w.ring_rows) at.ring_at = 0;
    std::memcpy(w.ring + static_cast<std::ptrdiff_t>(at.ring_at) * w.columns, tick > 1 ? held : row.data(),
                sizeof(float) * static_cast<std::size_t>(w.columns));
    ++at.row;
  }
}

bool SlidingLstm::answer(std::span<float> out) noexcept {
  Windows& w = *windows_;
  const std::int64_t row = w.position.row, end = w.every_sample ? row : row - row % w.stride;
  if (row < 0 || end < w.reach()) return false;
  if (w.position.answered != end) {
    if (end <= w.position.advanced) return false;  // its slot belongs to the next window
    w.answer_any(end);
  }
  std::memcpy(out.data(), w.last, sizeof(float) * static_cast<std::size_t>(w.single.outputs));
  return true;
}

void SlidingLstm::advance() noexcept {
  Windows& w = *windows_;
  if (w.position.advanced == w.position.row) return;
  if (w.length == 1) {
    w.position.advanced = w.position.row;  // a window of a single row leaves nothing to fill
    return;
  }
  w.advance_any();
}

std::size_t SlidingLstm::state_bytes() const noexcept {
  return sizeof(Windows::Position) + windows_->state_floats * sizeof(float);
}

void SlidingLstm::save(std::span<std::byte> state) const noexcept {
  std::memcpy(state.data(), &windows_->position, sizeof(Windows::Position));
  std::memcpy(state.data() + sizeof(Windows::Position), windows_->state.get(), windows_->state_floats * sizeof(float));
}

void SlidingLstm::restore(std::span<const std::byte> state) noexcept {
  std::memcpy(&windows_->position, state.data(), sizeof(Windows::Position));
  std::memcpy(windows_->state.get(), state.data() + sizeof(Windows::Position), windows_->state_floats * sizeof(float));
  windows_->position.projected = -1;
}

}  // namespace tauext
