// Whether an error is thrown for the reason that its message names.
#pragma once
#include <cstdio>
#include <cstring>

#include "check.hpp"
#include "tauext/types.hpp"

// `make` must throw an Error whose message holds the part.
template <class Make>
void refused(const char* part_of_message, Make make) {
  try {
    make();
    check::that(false, part_of_message, __FILE__, __LINE__);
  } catch (const tauext::Error& e) {
    const bool named = std::strstr(e.what(), part_of_message) != nullptr;
    if (!named) std::printf("message was: %s\n", e.what());
    check::that(named, part_of_message, __FILE__, __LINE__);
  }
}
