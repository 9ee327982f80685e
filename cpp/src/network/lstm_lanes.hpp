// The LSTM step on L windows at once, one window a SIMD lane; forward and gradient are both built from it.
//
// Vectors are the compiler's own (vector_size), so the same source becomes AVX-512, AVX2, SSE2 or NEON; every function
// here is inlined into a wrapper that names its instruction set (TAUEXT_TARGET_*). No lambda: it would not inherit the
// wrapper's instruction set.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <vector>

#include "network/lstm.hpp"
#include "tauext/settings.hpp"

#define TAUEXT_INLINE [[gnu::always_inline]] inline

namespace tauext::lanes {

template <int L>
struct Types {
  typedef float V __attribute__((vector_size(4 * L)));
  typedef std::int32_t I __attribute__((vector_size(4 * L)));
};
template <int L>
using V = typename Types<L>::V;

inline constexpr std::size_t kAlignment = 64;
inline constexpr int kUnits = 4;  // hidden units computed together: 16 accumulators, and the padding of H

struct Free {
  void operator()(float* p) const noexcept { std::free(p); }
};
using Buffer = std::unique_ptr<float[], Free>;

// Zeroed, aligned for the widest vector.
inline Buffer make_buffer(std::size_t floats) {
  const std::size_t bytes = (floats * sizeof(float) + kAlignment - 1) / kAlignment * kAlignment;
  void* memory = std::aligned_alloc(kAlignment, bytes ? bytes : kAlignment);
  if (!memory) throw std::bad_alloc();
  std::memset(memory, 0, bytes);
  return Buffer(static_cast<float*>(memory));
}

inline int padded_hidden(int hidden) noexcept { return (hidden + kUnits - 1) / kUnits * kUnits; }

// Weights in the order in which the step reads them. Padding units have zero weights, so they stay at zero and pass
// nothing on.
struct Packed {
  int inputs, hidden, padded, outputs;
  Buffer gates;      // [padded/kUnits][inputs + padded + 1][kUnits][4]: last row is the bias
  Buffer recurrent;  // [padded (unit)][4][padded (k)]: W_h for the backward pass
  Buffer head;       // [outputs][padded + 1]: last is the bias

  Packed(const LstmShape& shape, std::span<const float> parameters);
};

template <int L>
TAUEXT_INLINE V<L> splat(float x) noexcept {
  return x - V<L>{};
}
template <int L>
TAUEXT_INLINE V<L> load(const float* p) noexcept {
  V<L> v;
  __builtin_memcpy(&v, __builtin_assume_aligned(p, sizeof v), sizeof v);
  return v;
}
template <int L>
TAUEXT_INLINE V<L> load_anywhere(const float* p) noexcept {
  V<L> v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}
template <int L>
TAUEXT_INLINE void store(float* p, V<L> v) noexcept {
  __builtin_memcpy(__builtin_assume_aligned(p, sizeof v), &v, sizeof v);
}

// Where the activations saturate: exp(20) = 5e8, so that the error there is 2e-9. Defined in a file of its own, since gcc
// makes one operation of a comparison and a choice only where it does not know the limit's value.
extern const float kSaturation;

// Each x becomes 1 + exp(-scale x) = 1 + 2^y for x clamped to +-kSaturation, scale 1 or 2, NaN kept. y = n + f with f in
// [-1/2, 1/2]; the polynomial is the minimax of 2^f of degree 5 with 2^0 = 1, relative error 1.1e-7: what it adds to a
// sigmoid is a quarter of that at most, half a last bit, and to a tanh twice as much. N at a time, operation by operation:
// one alone leaves the processor waiting for its own results.
template <int L, int kScale, int N>
TAUEXT_INLINE void one_plus_exp_minus(V<L> (&x)[N]) noexcept {
  using I = typename Types<L>::I;
  constexpr float kToPower = -1.44269504f * kScale;
  const V<L> high = splat<L>(kSaturation), low = splat<L>(-kSaturation);
  // 1.5 * 2^23 + 127: adding it rounds y to n and leaves n + 127, the exponent of 2^n, in the low bits of the mantissa.
  const V<L> magic = splat<L>(12583039.0f);
  V<L> shifted[N], f[N], p[N];
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) x[k] = x[k] > high ? high : x[k];
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) x[k] = x[k] < low ? low : x[k];
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) shifted[k] = x[k] * kToPower + magic;
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) f[k] = x[k] * kToPower - (shifted[k] - magic);
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) p[k] = f[k] * 0.001326472731307149f + 0.009671512991189957f;
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) p[k] = p[k] * f[k] + 0.05550733581185341f;
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) p[k] = p[k] * f[k] + 0.24022242426872253f;
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) p[k] = p[k] * f[k] + 0.6931470036506653f;
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) p[k] = p[k] * f[k] + 1.0f;
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) x[k] = p[k] * (V<L>)((I)shifted[k] << 23) + 1.0f;
}

// The new cells and h of N units from their sums i, f, g, o and the cells before:
//   cell = sigmoid(f) c + sigmoid(i) tanh(g),  h = sigmoid(o) tanh(cell)
// with sigmoid(x) = 1 / (1 + exp(-x)) and tanh(x) = 2 / (1 + exp(-2 x)) - 1. Everything over one denominator: a division
// for the cell and one for h. The sums are overwritten: where kKeep by the gates, and tanh_cell is written only there.
template <int L, bool kKeep, int N>
TAUEXT_INLINE void cell_step(V<L> (&i)[N], V<L> (&f)[N], V<L> (&g)[N], V<L> (&o)[N], const V<L> (&before)[N],
                             V<L> (&cell)[N], V<L> (&tanh_cell)[N], V<L> (&h)[N]) noexcept {
  V<L> ac[N], r[N], e[N], q[N];
  one_plus_exp_minus<L, 1>(i);
  one_plus_exp_minus<L, 2>(g);
  one_plus_exp_minus<L, 1>(f);
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) {
    ac[k] = i[k] * g[k];
    r[k] = 1.0f / (ac[k] * f[k]);
  }
  one_plus_exp_minus<L, 1>(o);
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) {
    const V<L> added = (f[k] + f[k]) - f[k] * g[k];  // f (2 - g), but no product: only one way is left to fuse the next line
    cell[k] = (before[k] * ac[k] + added) * r[k];
    e[k] = cell[k];
  }
  one_plus_exp_minus<L, 2>(e);
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) q[k] = 1.0f / (o[k] * e[k]);
#pragma GCC unroll 4
  for (int k = 0; k < N; ++k) {
    const V<L> tanh_e = 2.0f - e[k];  // tanh(cell) e
    h[k] = tanh_e * q[k];
    if constexpr (kKeep) {
      const V<L> a = i[k], b = f[k], c = g[k], r_b = r[k] * b;
      i[k] = r_b * c;
      f[k] = r[k] * ac[k];
      g[k] = (2.0f - c) * (r_b * a);
      tanh_cell[k] = tanh_e * (q[k] * o[k]);
      o[k] = q[k] * e[k];
    }
  }
}

// Where the sums of a step begin. With the projection b + W_x x made beforehand the step's inputs are not read; the order
// of the additions is the same, and so is the result to the last bit.
enum class Start {
  inputs,  // at the bias; the inputs are added here
  rows,    // at projections of consecutive rows: (padded, 4) lines of `rows` values, whose first line begins at lane 0
  shared,  // at one projection for all lanes: (4, padded)
};
struct Projection {
  const float* values = nullptr;
  std::ptrdiff_t rows = 0;
};

// x (inputs) and h_before (padded) vectors. Writes c (padded) and h (padded); c_before may be c itself, h_before not h.
// For the backward pass kKeep also writes gates (padded, 4) and the tanh of the new c (padded).
template <int L, Start kStart = Start::inputs, bool kKeep = true>
TAUEXT_INLINE void step(const Packed& w, const float* x, const float* h_before, const float* c_before, float* gates,
                        float* c, float* tanh_c, float* h, Projection projection = {}) noexcept {
  const int K = w.inputs + w.padded;
  const float* weights = w.gates.get();
  for (int u = 0; u < w.padded; u += kUnits) {
    V<L> sum[4][kUnits];
    if constexpr (kStart == Start::inputs) {
      const float* bias = weights + static_cast<std::ptrdiff_t>(K) * kUnits * 4;
#pragma GCC unroll 16
      for (int a = 0; a < kUnits * 4; ++a) sum[a % 4][a / 4] = splat<L>(bias[a]);
      for (int k = 0; k < w.inputs; ++k) {
        const V<L> value = load<L>(x + k * L);
#pragma GCC unroll 16
        for (int a = 0; a < kUnits * 4; ++a) sum[a % 4][a / 4] += value * weights[k * kUnits * 4 + a];
      }
    } else {
#pragma GCC unroll 16
      for (int a = 0; a < kUnits * 4; ++a)
        sum[a % 4][a / 4] = kStart == Start::rows
                                ? load_anywhere<L>(projection.values + (u * 4 + a) * projection.rows)
                                : splat<L>(projection.values[(a % 4) * w.padded + u + a / 4]);
    }
    weights += static_cast<std::ptrdiff_t>(w.inputs) * kUnits * 4;
    for (int k = 0; k < w.padded; ++k) {
      const V<L> value = load<L>(h_before + k * L);
#pragma GCC unroll 16
      for (int a = 0; a < kUnits * 4; ++a) sum[a % 4][a / 4] += value * weights[a];
      weights += kUnits * 4;
    }
    weights += kUnits * 4;  // the bias row
    V<L> before[kUnits], cell[kUnits], t[kUnits], new_h[kUnits];
#pragma GCC unroll 4
    for (int a = 0; a < kUnits; ++a) before[a] = load<L>(c_before + (u + a) * L);
    cell_step<L, kKeep>(sum[0], sum[1], sum[2], sum[3], before, cell, t, new_h);
#pragma GCC unroll 4
    for (int a = 0; a < kUnits; ++a) {
      if constexpr (kKeep) {
        float* gate = gates + (u + a) * 4 * L;
        store<L>(gate, sum[0][a]);
        store<L>(gate + L, sum[1][a]);
        store<L>(gate + 2 * L, sum[2][a]);
        store<L>(gate + 3 * L, sum[3][a]);
        store<L>(tanh_c + (u + a) * L, t[a]);
      }
      store<L>(c + (u + a) * L, cell[a]);
      store<L>(h + (u + a) * L, new_h[a]);
    }
  }
}

// Inputs of L consecutive rows from `first` on into in (inputs, L); rows past `last` repeat it.
template <int L>
TAUEXT_INLINE void gather_rows(const WindowRows& windows, std::int64_t first, std::int64_t last, float* in) noexcept {
  const int F = static_cast<int>(windows.inputs.size());
  for (int f = 0; f < F; ++f) {
    const LstmInput input = windows.inputs[f];
    const std::int64_t lag = static_cast<std::int64_t>(input.lag) * windows.stride;
    for (int l = 0; l < L; ++l) {
      const std::int64_t row = first + l < last ? first + l : last;
      in[f * L + l] = windows.rows[(row - lag) * windows.columns + input.column];
    }
  }
}

// Inputs of network step t of L windows into in (inputs, L).
template <int L>
TAUEXT_INLINE void gather(const WindowRows& windows, const std::int64_t* ends, int t, float* in) noexcept {
  const std::int64_t back = static_cast<std::int64_t>(windows.length - 1 - t) * windows.stride;
  const float* row[L];
  for (int l = 0; l < L; ++l) row[l] = windows.rows + (ends[l] - back) * windows.columns;
  const int F = static_cast<int>(windows.inputs.size());
  for (int f = 0; f < F; ++f) {
    const LstmInput input = windows.inputs[f];
    const std::int64_t at = input.column - static_cast<std::int64_t>(input.lag) * windows.stride * windows.columns;
    for (int l = 0; l < L; ++l) in[f * L + l] = row[l][at];
  }
}

// Output o of the head for h (padded).
template <int L>
TAUEXT_INLINE V<L> head(const Packed& w, const float* h, int o) noexcept {
  const float* weights = w.head.get() + static_cast<std::ptrdiff_t>(o) * (w.padded + 1);
  V<L> sum = splat<L>(weights[w.padded]);
  for (int k = 0; k < w.padded; ++k) sum += load<L>(h + k * L) * weights[k];
  return sum;
}

// Lanes of the kernels in use: 16, 8 or 4, the widest of this machine unless the environment variable TAUEXT_SIMD asks for
// fewer. The first call reads the variable, so loaders make it and no control loop does. Throws Error on a value that this
// machine has no kernels for.
int lane_count();
// For tests: fewer lanes than this machine has; 0 takes it back.
void limit_lane_count(int lanes) noexcept;

// Runs body(chunk) for chunk = 0 .. chunks - 1 on `threads` threads, the caller's among them. Which thread takes which
// chunk is left open: a chunk must write only what is its own. The first exception is thrown again here.
void parallel_chunks(int chunks, int threads, void (*body)(int chunk, int thread, void* context), void* context);

}  // namespace tauext::lanes

// The instruction set of the wrapper around a 16- and an 8-lane instance; lane_count() chooses at run time. Explicit
// wrappers rather than target_clones, because the number of lanes, and with it the register tiling, differs.
#if defined(__x86_64__)
// The features of an architecture are named one by one: zig's clang switches off on its command line whatever the oldest
// processor lacks; there `arch` loses to the command line, and a name does not.
#define TAUEXT_FEATURES_8 "avx,avx2,bmi,bmi2,f16c,fma,lzcnt,movbe"
#define TAUEXT_FEATURES_16 TAUEXT_FEATURES_8 ",avx512f,avx512bw,avx512cd,avx512dq,avx512vl"
#define TAUEXT_TARGET_16 [[gnu::target("arch=x86-64-v4," TAUEXT_FEATURES_16)]]
#define TAUEXT_TARGET_8 [[gnu::target("arch=x86-64-v3," TAUEXT_FEATURES_8)]]
#else
#define TAUEXT_TARGET_16
#define TAUEXT_TARGET_8
#endif
