// The file format of bundles alone. Whether a bundle can run is checked in stages/checked_bundle.cpp.
#pragma once
#include <span>
#include <vector>

#include "tauext/bundle.hpp"

namespace tauext {

// Bytes of a bundle that is not checked.
std::vector<char> encode(const Bundle& bundle);
// Checks the version, the checksum and every length against the remaining bytes, nothing else. Throws Error.
Bundle decode(std::span<const char> bytes);

}  // namespace tauext
