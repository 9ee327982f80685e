// Rows to columns, in registers.
#pragma once
#include <utility>

#include "network/lstm_lanes.hpp"

namespace tauext::lanes {

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

}  // namespace tauext::lanes
