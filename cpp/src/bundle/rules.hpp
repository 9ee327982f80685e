// Validation rules for settings; each Error names the value.
#pragma once
#include <cmath>
#include <cstddef>
#include <string>
#include <type_traits>

#include "tauext/types.hpp"

namespace tauext {

template <class T>
void expect(bool ok, const std::string& what, T value, const std::string& rule) {
  if (ok) return;
  if constexpr (std::is_integral_v<T>)
    throw Error(what + " = " + std::to_string(value) + " must be " + rule);
  else
    throw Error(what + " = " + to_text(value) + " must be " + rule);
}

// Every value of a list.
template <class List, class Test>
void expect_each(const std::string& what, const List& list, Test ok, const std::string& rule) {
  for (const auto value : list) expect(ok(value), what, value, rule);
}

inline void expect_size(const std::string& what, std::size_t size, std::size_t wanted) {
  if (size != wanted)
    throw Error(what + " has " + std::to_string(size) + " values where " + std::to_string(wanted) + " belong");
}

template <class List>
void expect_finite(const std::string& what, const List& list) {
  for (const auto value : list)
    if (!std::isfinite(value)) throw Error(what + " holds a value that is not finite");
}

inline constexpr double kFarthestFrame_m = 1000;  // of a frame's origin from that of its link, along each axis

inline bool is_positive(double value) noexcept { return value > 0 && std::isfinite(value); }

}  // namespace tauext
