#include "lstm_gradient.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <memory>
#include <numeric>
#include <utility>
#include <vector>

#include "network/lstm_lanes.hpp"

namespace tauext::learn {
namespace {

using namespace lanes;

// The upper (kLower: lower) of two rows, D apart, of an L x L square whose D x D blocks off the diagonal change places.
template <int L, int D, bool kLower, int... J>
TAUEXT_INLINE V<L> exchanged(V<L> upper, V<L> lower, std::integer_sequence<int, J...>) noexcept {
  return __builtin_shufflevector(upper, lower, (kLower ? (J & D ? J + L : J + D) : (J & D ? J - D + L : J))...);
}

// In log2(L) rounds: blocks of 1, 2, 4 ... change places.
template <int L, int D = 1>
TAUEXT_INLINE void transpose(V<L> (&square)[L]) noexcept {
  using Lanes = std::make_integer_sequence<int, L>;
#pragma GCC unroll 16
  for (int r = 0; r < L; ++r) {
    if (r & D) continue;
    const V<L> upper = square[r], lower = square[r + D];
    square[r] = exchanged<L, D, false>(upper, lower, Lanes{});
    square[r + D] = exchanged<L, D, true>(upper, lower, Lanes{});
  }
  if constexpr (2 * D < L) transpose<L, 2 * D>(square);
}

constexpr int kTimeBlock = 4;  // steps whose deltas and inputs stay in the first cache while the weight sums read them
constexpr int kInputTile = 5;  // inputs of a weight-gradient tile, at up to 5 vectors of deltas: 25 accumulators

// Sums over windows have one order for 8 and 16 lanes. Windows with equal place modulo kSumLanes share a sum of the
// head; those of one octet share a weight sum. So AVX2 and AVX-512, which fuse products and sums alike, train the same
// network to the last bit. SSE2 does not fuse.
constexpr int kSumLanes = 16, kOctet = 8, kOctets = kSumLanes / kOctet;

// Sequences in a chunk follow from the batch alone, never from the threads: a small batch is cut finer.
std::size_t chunk_size(std::size_t batch) noexcept { return batch >= 512 ? 64 : batch >= 256 ? 32 : 16; }

// One thread's memory: the history of one lane group, and the weight sums of one chunk.
template <int L>
struct Workspace {
  int F, P, O, T, K;  // K: inputs of a unit, x, h before and the 1 of the bias
  Buffer gates;       // [T][P][4]
  Buffer cells;       // [T + 1][P], zero first
  Buffer tanh_cells;  // [T][P]
  Buffer inputs;      // [T + 1][K], h zero first; behind the last step only h
  Buffer d_hidden, d_cell;
  Buffer deltas;       // [P][4] of one step
  Buffer delta_lines;  // [kTimeBlock][L][P * 4]: a line of deltas for each window, no longer a lane
  Buffer weight_sums;  // [kOctets][K][P * 4], numbers
  Buffer head_sums;    // [O][P + 1][kSumLanes], numbers
  double losses[kSumLanes] = {};

  Workspace(const Packed& w, int steps)
      : F(w.inputs), P(w.padded), O(w.outputs), T(steps), K(F + P + 1), gates(vectors(T, P * 4)),
        cells(vectors(T + 1, P)), tanh_cells(vectors(T, P)), inputs(vectors(T + 1, K)), d_hidden(vectors(1, P)),
        d_cell(vectors(1, P)), deltas(vectors(1, P * 4)), delta_lines(vectors(kTimeBlock, P * 4)),
        weight_sums(make_buffer(static_cast<std::size_t>(kOctets) * K * P * 4)),
        head_sums(make_buffer(static_cast<std::size_t>(O) * (P + 1) * kSumLanes)) {
    for (int t = 0; t <= T; ++t) store<L>(inputs_of(t) + (K - 1) * L, splat<L>(1.0f));
  }

  // Sums at zero; the history is written before it is read.
  void begin_chunk() noexcept {
    std::memset(weight_sums.get(), 0, sizeof(float) * kOctets * K * P * 4);
    std::memset(head_sums.get(), 0, sizeof(float) * O * (P + 1) * kSumLanes);
    std::fill(std::begin(losses), std::end(losses), 0.0);
  }
  static Buffer vectors(int lines, int of) { return make_buffer(static_cast<std::size_t>(lines) * of * L); }
  float* gates_of(int t) const noexcept { return gates.get() + static_cast<std::ptrdiff_t>(t) * P * 4 * L; }
  float* cells_before(int t) const noexcept { return cells.get() + static_cast<std::ptrdiff_t>(t) * P * L; }
  float* tanh_cells_of(int t) const noexcept { return tanh_cells.get() + static_cast<std::ptrdiff_t>(t) * P * L; }
  float* inputs_of(int t) const noexcept { return inputs.get() + static_cast<std::ptrdiff_t>(t) * K * L; }
  float* hidden_before(int t) const noexcept { return inputs_of(t) + F * L; }
};

struct Job {
  const LstmShape& shape;
  const Packed packed;
  const WindowRows& windows;
  std::span<const std::int64_t> ends;
  std::span<const float> target_rows;
  int targets;
  std::vector<double> loss;                   // a chunk
  std::vector<std::vector<double>> gradient;  // a chunk, layout of the parameters
  std::vector<std::shared_ptr<void>> workspaces;  // a thread, its Workspace<L> from its first chunk on
};

template <int L>
TAUEXT_INLINE void forward_with_history(const Job& job, const std::int64_t* ends, Workspace<L>& m) {
  for (int t = 0; t < m.T; ++t) {
    gather<L>(job.windows, ends, t, m.inputs_of(t));
    step<L>(job.packed, m.inputs_of(t), m.hidden_before(t), m.cells_before(t), m.gates_of(t), m.cells_before(t + 1),
            m.tanh_cells_of(t), m.hidden_before(t + 1));
  }
}

// Adds the loss of step t of the group's first `count` lanes to the losses, and to dL/dh and the head's sums; `at`: where
// the group's first lane stands among the sums.
template <int L>
TAUEXT_INLINE void head_backward(const Job& job, const std::int64_t* ends, int t, int count, int at, Workspace<L>& m) {
  const int P = m.P, O = m.O;
  const float scale = 2.0f / (static_cast<float>(job.ends.size()) * static_cast<float>(O) * static_cast<float>(job.targets));
  const std::int64_t back = static_cast<std::int64_t>(m.T - 1 - t) * job.windows.stride;
  const float* hidden = m.hidden_before(t + 1);
  for (int o = 0; o < O; ++o) {
    const V<L> y = head<L>(job.packed, hidden, o);
    V<L> d_y{};
    for (int l = 0; l < count; ++l) {
      const float error = y[l] - job.target_rows[(ends[l] - back) * O + o];
      if (std::isnan(error) && !std::isnan(y[l])) continue;  // this row has no target
      m.losses[at + l] += static_cast<double>(error) * error;
      d_y[l] = scale * error;
    }
    const float* weights = job.packed.head.get() + static_cast<std::ptrdiff_t>(o) * (P + 1);
    float* sums = m.head_sums.get() + static_cast<std::ptrdiff_t>(o) * (P + 1) * kSumLanes + at;
    for (int k = 0; k < P; ++k) {
      float* d_h = m.d_hidden.get() + k * L;
      store<L>(d_h, load<L>(d_h) + d_y * weights[k]);
      store<L>(sums + k * kSumLanes, load<L>(sums + k * kSumLanes) + d_y * load<L>(hidden + k * L));
    }
    store<L>(sums + P * kSumLanes, load<L>(sums + P * kSumLanes) + d_y);
  }
}

// Deltas of step t, and dL/dc of step t into that of step t - 1. The deltas are written twice: as they are, a window a
// lane, and a line for each window into lines (L, P * 4).
template <int L>
TAUEXT_INLINE void deltas(int t, Workspace<L>& m, float* lines) {
  const int P = m.P;
  const float *gate = m.gates_of(t), *cell_before = m.cells_before(t), *tanh_cell = m.tanh_cells_of(t);
  float* delta = m.deltas.get();
  for (int u = 0; u < P; u += L / 4) {
    V<L> square[L];
#pragma GCC unroll 4
    for (int a = 0; a < L / 4; ++a, gate += 4 * L) {
      const V<L> i = load<L>(gate), f = load<L>(gate + L), g = load<L>(gate + 2 * L), o = load<L>(gate + 3 * L);
      const V<L> tc = load<L>(tanh_cell + (u + a) * L), dh = load<L>(m.d_hidden.get() + (u + a) * L);
      const V<L> dc = load<L>(m.d_cell.get() + (u + a) * L) + dh * o * (1.0f - tc * tc);
      square[a * 4] = dc * g * i * (1.0f - i);
      square[a * 4 + 1] = dc * load<L>(cell_before + (u + a) * L) * f * (1.0f - f);
      square[a * 4 + 2] = dc * i * (1.0f - g * g);
      square[a * 4 + 3] = dh * tc * o * (1.0f - o);
      store<L>(m.d_cell.get() + (u + a) * L, dc * f);
    }
#pragma GCC unroll 16
    for (int r = 0; r < L; ++r) store<L>(delta + (u * 4 + r) * L, square[r]);
    transpose<L>(square);
#pragma GCC unroll 16
    for (int l = 0; l < L; ++l) store<L>(lines + l * P * 4 + u * 4, square[l]);
  }
}

// dL/dh_k of the step before for k = first .. first + N - 1.
template <int L, int N>
TAUEXT_INLINE void hidden_backward_block(const Packed& w, const float* delta, int first, float* d_hidden) {
  V<L> sum[N];
#pragma GCC unroll 20
  for (int k = 0; k < N; ++k) sum[k] = V<L>{};
  const float* weights = w.recurrent.get() + first;
  for (int row = 0; row < 4 * w.padded; ++row, weights += w.padded) {
    const V<L> d = load<L>(delta + row * L);
#pragma GCC unroll 20
    for (int k = 0; k < N; ++k) sum[k] += d * weights[k];
  }
#pragma GCC unroll 20
  for (int k = 0; k < N; ++k) store<L>(d_hidden + (first + k) * L, sum[k]);
}

template <int L>
TAUEXT_INLINE void hidden_backward(const Packed& w, const float* delta, float* d_hidden) {
  int k = 0;
  if constexpr (L == 16)
    for (; k + 20 <= w.padded; k += 20) hidden_backward_block<L, 20>(w, delta, k, d_hidden);
  for (; k + 8 <= w.padded; k += 8) hidden_backward_block<L, 8>(w, delta, k, d_hidden);
  for (; k < w.padded; k += kUnits) hidden_backward_block<L, kUnits>(w, delta, k, d_hidden);
}

// Adds delta x input over an octet's windows and `steps` steps to its weight sums: N inputs from `k` on, M vectors of
// deltas from `row` on. `lane`: the octet's first, `to`: its sums. Each tile's sum starts at zero, for less rounding.
template <int L, int M, int N>
TAUEXT_INLINE void add_weight_tile(int steps, const float* inputs, int k, int row, int lane, float* to,
                                   const Workspace<L>& m) noexcept {
  V<L> sum[N][M];
#pragma GCC unroll 25
  for (int a = 0; a < N * M; ++a) sum[a / M][a % M] = V<L>{};
  for (int s = 0; s < steps; ++s) {
    const float* x = inputs + (static_cast<std::ptrdiff_t>(s) * m.K + k) * L + lane;
    const float* line = m.delta_lines.get() + (static_cast<std::ptrdiff_t>(s) * L + lane) * m.P * 4 + row;
    for (int l = 0; l < std::min(L, kOctet); ++l, ++x, line += m.P * 4) {
      V<L> d[M];
#pragma GCC unroll 5
      for (int b = 0; b < M; ++b) d[b] = load<L>(line + b * L);
#pragma GCC unroll 25
      for (int a = 0; a < N * M; ++a) sum[a / M][a % M] += d[a % M] * x[a / M * L];
    }
  }
#pragma GCC unroll 25
  for (int a = 0; a < N * M; ++a) {
    float* at = to + static_cast<std::ptrdiff_t>(k + a / M) * m.P * 4 + row + a % M * L;
    store<L>(at, load<L>(at) + sum[a / M][a % M]);
  }
}

template <int L, int M>
TAUEXT_INLINE void add_weight_rows(int steps, const float* inputs, int row, int lane, float* to,
                                   const Workspace<L>& m) noexcept {
  int k = 0;
  for (; k + kInputTile <= m.K; k += kInputTile) add_weight_tile<L, M, kInputTile>(steps, inputs, k, row, lane, to, m);
  for (; k + 2 <= m.K; k += 2) add_weight_tile<L, M, 2>(steps, inputs, k, row, lane, to, m);
  for (; k < m.K; ++k) add_weight_tile<L, M, 1>(steps, inputs, k, row, lane, to, m);
}

// Adds delta x input over `steps` consecutive steps; inputs (steps, K).
template <int L>
TAUEXT_INLINE void add_weight_sums(int steps, const float* inputs, int at, Workspace<L>& m) noexcept {
  constexpr int kVectors = L == 16 ? 5 : 2;  // narrower machines have half the registers
  for (int lane = 0; lane < L; lane += kOctet) {
    float* to = m.weight_sums.get() + static_cast<std::ptrdiff_t>((at + lane) / kOctet) * m.K * m.P * 4;
    int row = 0;
    for (; row + kVectors * L <= m.P * 4; row += kVectors * L)
      add_weight_rows<L, kVectors>(steps, inputs, row, lane, to, m);
    for (; row < m.P * 4; row += L) add_weight_rows<L, 1>(steps, inputs, row, lane, to, m);
  }
}

// The way back through a group's history, of which the first `count` lanes count.
template <int L>
TAUEXT_INLINE void backward(const Job& job, const std::int64_t* ends, int count, int at, Workspace<L>& m) {
  const int P = m.P;
  std::memset(m.d_cell.get(), 0, sizeof(float) * P * L);
  std::memset(m.d_hidden.get(), 0, sizeof(float) * P * L);
  for (int block_end = m.T; block_end > 0;) {
    const int block_begin = std::max(0, block_end - kTimeBlock);
    for (int t = block_end; t-- > block_begin;) {
      if (t >= m.T - job.targets) head_backward<L>(job, ends, t, count, at, m);
      deltas<L>(t, m, m.delta_lines.get() + static_cast<std::ptrdiff_t>(t - block_begin) * P * 4 * L);
      if (t > 0) hidden_backward<L>(job.packed, m.deltas.get(), m.d_hidden.get());
    }
    add_weight_sums<L>(block_end - block_begin, m.inputs_of(block_begin), at, m);
    block_end = block_begin;
  }
}

// Sum of `count` numbers from `first` on, `apart` from each other, in their order.
double sum_of(const Buffer& sums, std::ptrdiff_t first, int count, std::ptrdiff_t apart) noexcept {
  double total = 0;
  for (int k = 0; k < count; ++k) total += sums[first + k * apart];
  return total;
}

// Sums over lanes and octets into one chunk's gradient, in the order of the parameters.
template <int L>
TAUEXT_INLINE void reduce(const LstmShape& shape, const Workspace<L>& m, std::vector<double>& gradient) {
  const int F = shape.inputs, H = shape.hidden, O = shape.outputs;
  double* w_x = gradient.data();
  double* w_h = w_x + static_cast<std::ptrdiff_t>(4) * H * F;
  double* b = w_h + static_cast<std::ptrdiff_t>(4) * H * H;
  double* w_head = b + 4 * H;
  double* b_head = w_head + static_cast<std::ptrdiff_t>(O) * H;
  for (int gate = 0; gate < 4; ++gate)
    for (int u = 0; u < H; ++u)
      for (int k = 0; k < m.K; ++k) {
        const int row = gate * H + u;
        double* to = k < F          ? w_x + row * F + k
                     : k < F + H    ? w_h + row * H + (k - F)
                     : k == m.K - 1 ? b + row
                                    : nullptr;  // padding
        const std::ptrdiff_t apart = static_cast<std::ptrdiff_t>(m.K) * m.P * 4;
        if (to) *to = sum_of(m.weight_sums, (static_cast<std::ptrdiff_t>(k) * m.P + u) * 4 + gate, kOctets, apart);
      }
  for (int o = 0; o < O; ++o) {
    const std::ptrdiff_t first = static_cast<std::ptrdiff_t>(o) * (m.P + 1) * kSumLanes;
    for (int k = 0; k < H; ++k) w_head[o * H + k] = sum_of(m.head_sums, first + k * kSumLanes, kSumLanes, 1);
    b_head[o] = sum_of(m.head_sums, first + m.P * kSumLanes, kSumLanes, 1);
  }
}

template <int L>
TAUEXT_INLINE void gradient_chunk(Job& job, int chunk, int thread) {
  std::shared_ptr<void>& own = job.workspaces[static_cast<std::size_t>(thread)];
  if (!own) own = std::make_shared<Workspace<L>>(job.packed, job.windows.length);
  Workspace<L>& m = *static_cast<Workspace<L>*>(own.get());
  m.begin_chunk();
  const std::size_t size = chunk_size(job.ends.size()), first = static_cast<std::size_t>(chunk) * size;
  const std::size_t last = std::min(first + size, job.ends.size());
  for (std::size_t group = first; group < last; group += L) {
    const int count = static_cast<int>(std::min<std::size_t>(L, last - group));
    std::int64_t ends[L];
    for (int l = 0; l < L; ++l) ends[l] = job.ends[group + std::min(l, count - 1)];
    forward_with_history<L>(job, ends, m);
    backward<L>(job, ends, count, static_cast<int>((group - first) % kSumLanes), m);
  }
  job.loss[chunk] = std::accumulate(std::begin(m.losses), std::end(m.losses), 0.0);
  reduce<L>(job.shape, m, job.gradient[chunk]);
}

TAUEXT_TARGET_16 void gradient_16(Job& job, int chunk, int thread) { gradient_chunk<16>(job, chunk, thread); }
TAUEXT_TARGET_8 void gradient_8(Job& job, int chunk, int thread) { gradient_chunk<8>(job, chunk, thread); }
void gradient_4(Job& job, int chunk, int thread) { gradient_chunk<4>(job, chunk, thread); }

void gradient_any(int chunk, int thread, void* context) {
  auto& job = *static_cast<Job*>(context);
  const int count = lane_count();
  if (count == 16) return gradient_16(job, chunk, thread);
  if (count == 8) return gradient_8(job, chunk, thread);
  gradient_4(job, chunk, thread);
}

}  // namespace

double lstm_gradient(const LstmShape& shape, std::span<const float> parameters, const WindowRows& windows,
                     std::span<const std::int64_t> ends, std::span<const float> target_rows, int targets,
                     std::span<float> gradient, int threads) {
  shape.validate();
  windows.validate(shape, ends);
  const std::size_t count = shape.parameter_count();
  if (parameters.size() != count || gradient.size() != count)
    throw Error("the network has " + std::to_string(count) + " parameters, not " + std::to_string(parameters.size()));
  if (ends.empty()) throw Error("a gradient needs at least one window");
  if (target_rows.size() != static_cast<std::size_t>(windows.row_count) * shape.outputs)
    throw Error("the targets need one row beside each row of features");
  if (targets < 1 || targets > windows.length)
    throw Error("targets = " + std::to_string(targets) + " must be 1 to the sequence's length of " +
                std::to_string(windows.length));
  const auto chunks = (ends.size() - 1) / chunk_size(ends.size()) + 1;
  Job job{shape,
          Packed(shape, parameters),
          windows,
          ends,
          target_rows,
          targets,
          std::vector<double>(chunks),
          std::vector<std::vector<double>>(chunks, std::vector<double>(count)),
          std::vector<std::shared_ptr<void>>(static_cast<std::size_t>(std::max(threads, 1)))};
  parallel_chunks(static_cast<int>(chunks), threads, gradient_any, &job);
  double loss = 0;
  for (double part : job.loss) loss += part;
  for (std::size_t k = 0; k < count; ++k) {
    double sum = 0;
    for (const auto& part : job.gradient) sum += part[k];
    gradient[k] = static_cast<float>(sum);
  }
  return loss / (static_cast<double>(ends.size()) * shape.outputs * targets);
}

}  // namespace tauext::learn
