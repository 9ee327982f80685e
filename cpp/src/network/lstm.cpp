#include "network/lstm.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <string>

#include "network/lstm_lanes.hpp"
#include "network/widest_simd.hpp"

namespace tauext {

// A gate sums b + W_x x + W_h h with |h| <= 1, the head b + W h; the sum of the magnitudes bounds both.
float largest_lstm_input(const LstmShape& shape, std::span<const float> parameters) {
  constexpr double kLargestSum = 1e37;  // a float holds 3.4e38
  const auto F = static_cast<std::size_t>(shape.inputs), H = static_cast<std::size_t>(shape.hidden),
             O = static_cast<std::size_t>(shape.outputs);
  const float* w_x = parameters.data();
  const float* w_h = w_x + 4 * H * F;
  const float* b = w_h + 4 * H * H;
  const float* w_head = b + 4 * H;
  const float* b_head = w_head + O * H;
  const auto magnitude = [](const float* values, std::size_t count) {
    double sum = 0;
    for (std::size_t k = 0; k < count; ++k) sum += std::fabs(static_cast<double>(values[k]));
    return sum;
  };
  double largest = 1.0, beside = 0.0;
  for (std::size_t row = 0; row < 4 * H; ++row) {
    largest = std::max(largest, magnitude(w_x + row * F, F));
    beside = std::max(beside, magnitude(w_h + row * H, H) + std::fabs(static_cast<double>(b[row])));
  }
  for (std::size_t o = 0; o < O; ++o)
    beside = std::max(beside, magnitude(w_head + o * H, H) + std::fabs(static_cast<double>(b_head[o])));
  if (!(beside <= kLargestSum && largest <= kLargestSum))
    throw Error("parameters are so large that the network overflows");
  return static_cast<float>(kLargestSum / largest);
}

int WindowRows::largest_lag() const noexcept {
  int lag = 0;
  for (const LstmInput& input : inputs) lag = std::max(lag, input.lag);
  return lag;
}

void WindowRows::validate(const LstmShape& shape, std::span<const std::int64_t> ends) const {
  if (columns < 1 || row_count < 0 || stride < 1 || length < 1)
    throw Error("windows need at least one column, a stride and a length of at least 1");
  if (static_cast<int>(inputs.size()) != shape.inputs)
    throw Error("the network has " + std::to_string(shape.inputs) + " inputs, the windows " +
                std::to_string(inputs.size()));
  for (const LstmInput& input : inputs)
    if (input.column < 0 || input.column >= columns || input.lag < 0 || input.lag > kMaxWindowSteps)
      throw Error("input column " + std::to_string(input.column) + " with lag " + std::to_string(input.lag) +
                  " does not exist in rows of " + std::to_string(columns) + " columns");
  const std::int64_t first = reach();
  for (std::int64_t end : ends)
    if (end < first || end >= row_count)
      throw Error("a window cannot end at row " + std::to_string(end) + ": it reaches back " + std::to_string(first) +
                  " rows and there are " + std::to_string(row_count));
}

namespace lanes {

Packed::Packed(const LstmShape& shape, std::span<const float> parameters)
    : inputs(shape.inputs), hidden(shape.hidden), padded(padded_hidden(shape.hidden)), outputs(shape.outputs) {
  const int F = inputs, H = hidden, P = padded, K = F + P;
  gates = make_buffer(static_cast<std::size_t>(P) * (K + 1) * 4);
  recurrent = make_buffer(static_cast<std::size_t>(P) * 4 * P);
  head = make_buffer(static_cast<std::size_t>(outputs) * (P + 1));
  const float* w_x = parameters.data();
  const float* w_h = w_x + static_cast<std::ptrdiff_t>(4) * H * F;
  const float* b = w_h + static_cast<std::ptrdiff_t>(4) * H * H;
  const float* w_head = b + 4 * H;
  const float* b_head = w_head + static_cast<std::ptrdiff_t>(outputs) * H;
  for (int u = 0; u < H; ++u)
    for (int gate = 0; gate < 4; ++gate) {
      float* block = gates.get() + static_cast<std::ptrdiff_t>(u / kUnits) * (K + 1) * kUnits * 4;
      const int at = (u % kUnits) * 4 + gate, row = gate * H + u;
      for (int k = 0; k < F; ++k) block[k * kUnits * 4 + at] = w_x[row * F + k];
      for (int k = 0; k < H; ++k) block[(F + k) * kUnits * 4 + at] = w_h[row * H + k];
      block[K * kUnits * 4 + at] = b[row];
      for (int k = 0; k < H; ++k) recurrent[(u * 4 + gate) * P + k] = w_h[row * H + k];
    }
  for (int o = 0; o < outputs; ++o) {
    for (int k = 0; k < H; ++k) head[o * (P + 1) + k] = w_head[o * H + k];
    head[o * (P + 1) + P] = b_head[o];
  }
}

namespace {
std::atomic<int> lane_limit{0};

struct Kernels {
  const char* name;
  int lanes;
};
// For this architecture, the narrowest first.
#if defined(__x86_64__)
constexpr Kernels kKernels[] = {{"sse2", 4}, {"avx2", 8}, {"avx512", 16}};
int usable_kernels() noexcept { return 1 + static_cast<int>(widest_simd()); }
#else
constexpr Kernels kKernels[] = {{"neon", 4}};
int usable_kernels() noexcept { return 1; }
#endif

// A narrower set is for comparing machines and for debugging. A wider one than the machine's is refused here: it would
// cause an illegal instruction later.
int chosen_lanes() {
  const int usable = usable_kernels();
  const char* asked = std::getenv("TAUEXT_SIMD");
  if (!asked || !*asked) return kKernels[usable - 1].lanes;
  std::string choices;
  for (int k = 0; k < usable; ++k) {
    if (std::strcmp(asked, kKernels[k].name) == 0) return kKernels[k].lanes;
    choices += (k ? ", " : "") + std::string(kKernels[k].name);
  }
  throw Error("TAUEXT_SIMD = " + std::string(asked) + " must be one of the instruction sets of this processor: " + choices);
}
}  // namespace

int lane_count() {
  static const int machine = chosen_lanes();
  const int limit = lane_limit.load(std::memory_order_relaxed);
  return limit ? std::min(limit, machine) : machine;
}

void limit_lane_count(int lanes) noexcept { lane_limit.store(lanes, std::memory_order_relaxed); }

}  // namespace lanes

std::string simd_in_use() {
  const int lanes = lanes::lane_count();
  for (const lanes::Kernels& kernels : lanes::kKernels)
    if (kernels.lanes == lanes) return kernels.name;
  return {};
}

namespace {

using namespace lanes;

constexpr int kWindowsPerChunk = 256;

struct Forward {
  const LstmShape& shape;
  const Packed packed;
  const WindowRows& windows;
  std::span<const std::int64_t> ends;
  std::span<float> out;
};

// b + W_x x of rows first .. last, into out: (padded, 4) lines of `rows` values.
template <int L>
TAUEXT_INLINE void project(const Packed& w, const WindowRows& windows, std::int64_t first, std::int64_t last, float* in,
                           float* out, std::ptrdiff_t rows) noexcept {
  const std::ptrdiff_t bias_row = w.inputs + w.padded;
  for (std::int64_t row = first; row <= last; row += L) {
    gather_rows<L>(windows, row, last, in);
    for (int u = 0; u < w.padded; ++u) {
      const float* block = w.gates.get() + (u / kUnits) * (bias_row + 1) * kUnits * 4 + (u % kUnits) * 4;
#pragma GCC unroll 4
      for (int gate = 0; gate < 4; ++gate) {
        V<L> sum = splat<L>(block[bias_row * kUnits * 4 + gate]);
        for (int k = 0; k < w.inputs; ++k) sum += load<L>(in + k * L) * block[k * kUnits * 4 + gate];
        store<L>(out + (u * 4 + gate) * rows + (row - first), sum);
      }
    }
  }
}

// Windows that end at consecutive rows, as in the evaluation of a recording, share the projection of their inputs.
template <int L>
TAUEXT_INLINE void forward_chunk(const Forward& job, int chunk) {
  const Packed& w = job.packed;
  const WindowRows& windows = job.windows;
  const int F = w.inputs, P = w.padded, O = w.outputs;
  const auto first = static_cast<std::size_t>(chunk) * kWindowsPerChunk;
  const std::size_t last = std::min(first + kWindowsPerChunk, job.ends.size());
  // Worth it if the windows have more steps than there are rows under them.
  const std::int64_t windows_here = static_cast<std::int64_t>(last - first);
  bool consecutive = (windows_here - 1) * windows.length >= static_cast<std::int64_t>(windows.length - 1) * windows.stride;
  for (std::size_t k = first + 1; k < last; ++k) consecutive = consecutive && job.ends[k] == job.ends[k - 1] + 1;

  const Buffer in = make_buffer(static_cast<std::size_t>(F) * L), c = make_buffer(static_cast<std::size_t>(P) * L);
  Buffer h = make_buffer(static_cast<std::size_t>(P) * L), next_h = make_buffer(static_cast<std::size_t>(P) * L);
  const std::int64_t back = static_cast<std::int64_t>(windows.length - 1) * windows.stride;
  const std::int64_t first_row = job.ends[first] - back;
  // Lines are padded to whole vectors, plus one for the lanes past the last window.
  const std::ptrdiff_t rows = (job.ends[last - 1] - first_row + 1 + 2 * L - 1) / L * L;
  Buffer projected;
  if (consecutive) {
    projected = make_buffer(static_cast<std::size_t>(P) * 4 * static_cast<std::size_t>(rows));
    project<L>(w, windows, first_row, job.ends[last - 1], in.get(), projected.get(), rows);
  }
  for (std::size_t group = first; group < last; group += L) {
    std::int64_t ends[L];
    for (int l = 0; l < L; ++l) ends[l] = job.ends[std::min(group + l, last - 1)];
    std::memset(h.get(), 0, sizeof(float) * P * L);
    std::memset(c.get(), 0, sizeof(float) * P * L);
    for (int t = 0; t < windows.length; ++t) {
      if (consecutive) {
        const std::ptrdiff_t row = job.ends[group] - first_row - back + static_cast<std::ptrdiff_t>(t) * windows.stride;
        step<L, Start::rows, false>(w, nullptr, h.get(), c.get(), nullptr, c.get(), nullptr, next_h.get(),
                                    {projected.get() + row, rows});
      } else {
        gather<L>(windows, ends, t, in.get());
        step<L, Start::inputs, false>(w, in.get(), h.get(), c.get(), nullptr, c.get(), nullptr, next_h.get());
      }
      std::swap(h, next_h);
    }
    for (int o = 0; o < O; ++o) {
      const V<L> y = head<L>(w, h.get(), o);
      for (int l = 0; l < L && group + l < last; ++l) job.out[(group + l) * O + o] = y[l];
    }
  }
}

TAUEXT_TARGET_16 void forward_16(const Forward& job, int chunk) { forward_chunk<16>(job, chunk); }
TAUEXT_TARGET_8 void forward_8(const Forward& job, int chunk) { forward_chunk<8>(job, chunk); }
void forward_4(const Forward& job, int chunk) { forward_chunk<4>(job, chunk); }

void forward_any(int chunk, int, void* context) {
  const auto& job = *static_cast<const Forward*>(context);
  const int count = lane_count();
  if (count == 16) return forward_16(job, chunk);
  if (count == 8) return forward_8(job, chunk);
  forward_4(job, chunk);
}

template <int L>
TAUEXT_INLINE void activations(std::span<const float> x, std::span<float> sigmoid, std::span<float> tanh) {
  for (std::size_t k = 0; k < x.size(); ++k) {
    V<L> i[] = {splat<L>(x[k])}, f[] = {i[0]}, g[] = {i[0]}, o[] = {i[0]}, cell[1], tanh_cell[1], h[1];
    cell_step<L, true>(i, f, g, o, {V<L>{}}, cell, tanh_cell, h);
    sigmoid[k] = i[0][0];
    tanh[k] = g[0][0];
  }
}

using Floats = std::span<float>;
TAUEXT_TARGET_16 void activations_16(std::span<const float> x, Floats s, Floats t) { activations<16>(x, s, t); }
TAUEXT_TARGET_8 void activations_8(std::span<const float> x, Floats s, Floats t) { activations<8>(x, s, t); }
void activations_4(std::span<const float> x, Floats s, Floats t) { activations<4>(x, s, t); }

}  // namespace

void lstm_forward(const LstmShape& shape, std::span<const float> parameters, const WindowRows& windows,
                  std::span<const std::int64_t> ends, std::span<float> out, int threads) {
  shape.validate();
  windows.validate(shape, ends);
  if (parameters.size() != shape.parameter_count())
    throw Error("the network has " + std::to_string(shape.parameter_count()) + " parameters, not " +
                std::to_string(parameters.size()));
  if (out.size() != ends.size() * shape.outputs) throw Error("the output needs one row a window");
  Forward job{shape, Packed(shape, parameters), windows, ends, out};
  const int chunks = static_cast<int>((ends.size() + kWindowsPerChunk - 1) / kWindowsPerChunk);
  parallel_chunks(chunks, threads, forward_any, &job);
}

[[gnu::noinline]] double network_torque_nm(double scale_nm, float output) noexcept {
  return scale_nm * static_cast<double>(output);
}

void lstm_activations(std::span<const float> x, std::span<float> sigmoid, std::span<float> tanh) {
  const int count = lane_count();
  if (count == 16) return activations_16(x, sigmoid, tanh);
  if (count == 8) return activations_8(x, sigmoid, tanh);
  activations_4(x, sigmoid, tanh);
}

}  // namespace tauext
