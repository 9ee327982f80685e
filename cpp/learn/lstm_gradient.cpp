#include "lstm_gradient.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "../src/lstm_lanes.hpp"

namespace tauext::learn {
namespace {

using namespace lanes;

constexpr int kTimeBlock = 4;  // steps whose deltas and inputs stay in the first cache while weight sums pass through
constexpr int kInputTile = 6;  // inputs of a weight-gradient tile; 4 gates x 6 inputs = 24 accumulators

// Sequences in a chunk follow from the batch alone, never from the threads: a small batch is cut finer.
std::size_t chunk_size(std::size_t batch) noexcept { return batch >= 512 ? 64 : batch >= 256 ? 32 : 16; }

int tiles(int inputs_with_bias) noexcept { return (inputs_with_bias + kInputTile - 1) / kInputTile; }

// One thread's memory: the history of one lane group, and the weight sums of one chunk, a lane each.
template <int L>
struct Workspace {
  int F, P, O, T, K, K_tiled;
  Buffer gates;      // [T][P][4]: gates on the way forward, deltas on the way back
  Buffer cells;      // [T + 1][P], zero first
  Buffer tanh_cells; // [T][P]
  Buffer inputs;     // [kTimeBlock][K_tiled]: x, h before, 1, zeros
  Buffer hidden, d_hidden, d_cell, d_y;
  Buffer weight_sums;  // [P][tile][4][kInputTile]
  Buffer head_sums;    // [O][P + 1]

  Workspace(const Packed& w, int steps)
      : F(w.inputs), P(w.padded), O(w.outputs), T(steps), K(F + P), K_tiled(tiles(K + 1) * kInputTile),
        gates(vectors(static_cast<std::size_t>(T) * P * 4)), cells(vectors(static_cast<std::size_t>(T + 1) * P)),
        tanh_cells(vectors(static_cast<std::size_t>(T) * P)),
        inputs(vectors(static_cast<std::size_t>(kTimeBlock) * K_tiled)), hidden(vectors(P)), d_hidden(vectors(P)),
        d_cell(vectors(P)), d_y(vectors(O)), weight_sums(vectors(weight_sum_vectors())),
        head_sums(vectors(static_cast<std::size_t>(O) * (P + 1))) {}

  static Buffer vectors(std::size_t count) { return make_buffer(count * L); }
  std::size_t weight_sum_vectors() const noexcept { return static_cast<std::size_t>(P) * 4 * K_tiled; }
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
};

template <int L>
TAUEXT_INLINE void forward_with_history(const Job& job, const std::int64_t* ends, Workspace<L>& m) {
  const int P = m.P;
  float* in = m.inputs.get();
  std::memset(in + m.F * L, 0, sizeof(float) * P * L);
  for (int t = 0; t < m.T; ++t) {
    gather<L>(job.windows, ends, t, in);
    float* cell = m.cells.get() + static_cast<std::ptrdiff_t>(t) * P * L;
    step<L>(job.packed, in, in + m.F * L, cell, m.gates.get() + static_cast<std::ptrdiff_t>(t) * P * 4 * L, cell + P * L,
            m.tanh_cells.get() + static_cast<std::ptrdiff_t>(t) * P * L, m.hidden.get());
    std::memcpy(in + m.F * L, m.hidden.get(), sizeof(float) * P * L);
  }
}

// h = o tanh(c) of step t, whose gates are still gates; zero before the first.
template <int L>
TAUEXT_INLINE void hidden_of_step(int t, const Workspace<L>& m, float* h) noexcept {
  if (t < 0) {
    std::memset(h, 0, sizeof(float) * m.P * L);
    return;
  }
  const float* gate = m.gates.get() + static_cast<std::ptrdiff_t>(t) * m.P * 4 * L;
  const float* tanh_cell = m.tanh_cells.get() + static_cast<std::ptrdiff_t>(t) * m.P * L;
  for (int u = 0; u < m.P; ++u) store<L>(h + u * L, load<L>(gate + (u * 4 + 3) * L) * load<L>(tanh_cell + u * L));
}

// Loss of step t of the group's first `count` lanes; adds to dL/dh and to the head's sums.
template <int L>
TAUEXT_INLINE double head_backward(const Job& job, const std::int64_t* ends, int t, int count, Workspace<L>& m) {
  const int P = m.P, O = m.O;
  double loss = 0;
  const float scale = 2.0f / (static_cast<float>(job.ends.size()) * static_cast<float>(O) * static_cast<float>(job.targets));
  const std::int64_t back = static_cast<std::int64_t>(m.T - 1 - t) * job.windows.stride;
  hidden_of_step<L>(t, m, m.hidden.get());
  for (int o = 0; o < O; ++o) {
    const V<L> y = head<L>(job.packed, m.hidden.get(), o);
    V<L> d_y{};
    for (int l = 0; l < count; ++l) {
      const float error = y[l] - job.target_rows[(ends[l] - back) * O + o];
      if (std::isnan(error) && !std::isnan(y[l])) continue;  // this row has no target
      loss += static_cast<double>(error) * error;
      d_y[l] = scale * error;
    }
    const float* weights = job.packed.head.get() + static_cast<std::ptrdiff_t>(o) * (P + 1);
    float* sums = m.head_sums.get() + static_cast<std::ptrdiff_t>(o) * (P + 1) * L;
    for (int k = 0; k < P; ++k) {
      float* d_h = m.d_hidden.get() + k * L;
      store<L>(d_h, load<L>(d_h) + d_y * weights[k]);
      store<L>(sums + k * L, load<L>(sums + k * L) + d_y * load<L>(m.hidden.get() + k * L));
    }
    store<L>(sums + P * L, load<L>(sums + P * L) + d_y);
  }
  return loss;
}

// Turns the gates of step t into deltas, in place, and dL/dc of step t into that of step t - 1.
template <int L>
TAUEXT_INLINE void deltas(int t, Workspace<L>& m) {
  const int P = m.P;
  float* gate = m.gates.get() + static_cast<std::ptrdiff_t>(t) * P * 4 * L;
  const float* cell_before = m.cells.get() + static_cast<std::ptrdiff_t>(t) * P * L;
  const float* tanh_cell = m.tanh_cells.get() + static_cast<std::ptrdiff_t>(t) * P * L;
  for (int u = 0; u < P; ++u, gate += 4 * L) {
    const V<L> i = load<L>(gate), f = load<L>(gate + L), g = load<L>(gate + 2 * L), o = load<L>(gate + 3 * L);
    const V<L> tc = load<L>(tanh_cell + u * L), dh = load<L>(m.d_hidden.get() + u * L);
    const V<L> dc = load<L>(m.d_cell.get() + u * L) + dh * o * (1.0f - tc * tc);
    store<L>(gate, dc * g * i * (1.0f - i));
    store<L>(gate + L, dc * load<L>(cell_before + u * L) * f * (1.0f - f));
    store<L>(gate + 2 * L, dc * i * (1.0f - g * g));
    store<L>(gate + 3 * L, dh * tc * o * (1.0f - o));
    store<L>(m.d_cell.get() + u * L, dc * f);
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

// Adds delta x input over `steps` consecutive steps to the weight sums; delta (steps, P, 4), inputs (steps, K_tiled).
template <int L>
TAUEXT_INLINE void add_weight_sums(const float* delta, int steps, Workspace<L>& m) {
  constexpr int N = L == 16 ? kInputTile : kInputTile / 2;  // narrower machines have half the registers
  float* sums = m.weight_sums.get();
  for (int u = 0; u < m.P; ++u)
    for (int k = 0; k < m.K_tiled; k += N, sums += 4 * N * L) {
      V<L> sum[4 * N];
#pragma GCC unroll 24
      for (int a = 0; a < 4 * N; ++a) sum[a] = load<L>(sums + a * L);
      for (int s = 0; s < steps; ++s) {
        const float* d = delta + (static_cast<std::ptrdiff_t>(s) * m.P + u) * 4 * L;
        const float* x = m.inputs.get() + (static_cast<std::ptrdiff_t>(s) * m.K_tiled + k) * L;
        const V<L> d0 = load<L>(d), d1 = load<L>(d + L), d2 = load<L>(d + 2 * L), d3 = load<L>(d + 3 * L);
#pragma GCC unroll 6
        for (int a = 0; a < N; ++a) {
          const V<L> v = load<L>(x + a * L);
          sum[a] += d0 * v;
          sum[N + a] += d1 * v;
          sum[2 * N + a] += d2 * v;
          sum[3 * N + a] += d3 * v;
        }
      }
#pragma GCC unroll 24
      for (int a = 0; a < 4 * N; ++a) store<L>(sums + a * L, sum[a]);
    }
}

// The way back through a group's history; returns the loss of its first `count` lanes.
template <int L>
TAUEXT_INLINE double backward(const Job& job, const std::int64_t* ends, int count, Workspace<L>& m) {
  const int P = m.P;
  double loss = 0;
  std::memset(m.d_cell.get(), 0, sizeof(float) * P * L);
  std::memset(m.d_hidden.get(), 0, sizeof(float) * P * L);
  for (int block_end = m.T; block_end > 0;) {
    const int block_begin = std::max(0, block_end - kTimeBlock);
    for (int t = block_end; t-- > block_begin;) {
      float* x = m.inputs.get() + static_cast<std::ptrdiff_t>(t - block_begin) * m.K_tiled * L;
      gather<L>(job.windows, ends, t, x);
      hidden_of_step<L>(t - 1, m, x + m.F * L);
      store<L>(x + m.K * L, splat<L>(1.0f));
      for (int k = m.K + 1; k < m.K_tiled; ++k) store<L>(x + k * L, V<L>{});
      if (t >= m.T - job.targets) loss += head_backward<L>(job, ends, t, count, m);
      deltas<L>(t, m);
      if (t > 0)
        hidden_backward<L>(job.packed, m.gates.get() + static_cast<std::ptrdiff_t>(t) * P * 4 * L, m.d_hidden.get());
    }
    add_weight_sums<L>(m.gates.get() + static_cast<std::ptrdiff_t>(block_begin) * P * 4 * L, block_end - block_begin,
                       m);
    block_end = block_begin;
  }
  return loss;
}

// Sum over the lanes of vector `index`, in lane order.
template <int L>
TAUEXT_INLINE double lane_sum(const Buffer& sums, std::ptrdiff_t index) noexcept {
  double total = 0;
  for (int l = 0; l < L; ++l) total += sums[index * L + l];
  return total;
}

// Sums over the lanes into one chunk's gradient, in the order of the parameters.
template <int L>
TAUEXT_INLINE void reduce(const LstmShape& shape, const Workspace<L>& m, std::vector<double>& gradient) {
  constexpr int N = L == 16 ? kInputTile : kInputTile / 2;
  const int F = shape.inputs, H = shape.hidden, O = shape.outputs;
  double* w_x = gradient.data();
  double* w_h = w_x + static_cast<std::ptrdiff_t>(4) * H * F;
  double* b = w_h + static_cast<std::ptrdiff_t>(4) * H * H;
  double* w_head = b + 4 * H;
  double* b_head = w_head + static_cast<std::ptrdiff_t>(O) * H;
  for (int gate = 0; gate < 4; ++gate)
    for (int u = 0; u < H; ++u)
      for (int k = 0; k <= m.K; ++k) {
        const int row = gate * H + u;
        double* to = k < F            ? w_x + row * F + k
                     : k < F + H      ? w_h + row * H + (k - F)
                     : k == m.K       ? b + row
                                      : nullptr;  // padding
        if (to)
          *to = lane_sum<L>(m.weight_sums, static_cast<std::ptrdiff_t>(u) * 4 * m.K_tiled + (k / N) * 4 * N + gate * N +
                                               k % N);
      }
  for (int o = 0; o < O; ++o) {
    for (int k = 0; k < H; ++k) w_head[o * H + k] = lane_sum<L>(m.head_sums, o * (m.P + 1) + k);
    b_head[o] = lane_sum<L>(m.head_sums, o * (m.P + 1) + m.P);
  }
}

template <int L>
TAUEXT_INLINE void gradient_chunk(Job& job, int chunk) {
  Workspace<L> m(job.packed, job.windows.length);
  const std::size_t size = chunk_size(job.ends.size()), first = static_cast<std::size_t>(chunk) * size;
  const std::size_t last = std::min(first + size, job.ends.size());
  double loss = 0;
  for (std::size_t group = first; group < last; group += L) {
    const int count = static_cast<int>(std::min<std::size_t>(L, last - group));
    std::int64_t ends[L];
    for (int l = 0; l < L; ++l) ends[l] = job.ends[group + std::min(l, count - 1)];
    forward_with_history<L>(job, ends, m);
    loss += backward<L>(job, ends, count, m);
  }
  job.loss[chunk] = loss;
  reduce<L>(job.shape, m, job.gradient[chunk]);
}

TAUEXT_TARGET_16 void gradient_16(Job& job, int chunk) { gradient_chunk<16>(job, chunk); }
TAUEXT_TARGET_8 void gradient_8(Job& job, int chunk) { gradient_chunk<8>(job, chunk); }
void gradient_4(Job& job, int chunk) { gradient_chunk<4>(job, chunk); }

void gradient_any(int chunk, int, void* context) {
  auto& job = *static_cast<Job*>(context);
  const int count = lane_count();
  if (count == 16) return gradient_16(job, chunk);
  if (count == 8) return gradient_8(job, chunk);
  gradient_4(job, chunk);
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
          std::vector<std::vector<double>>(chunks, std::vector<double>(count))};
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
