// Weighs a load from recordings: all of their rows at once, instead of the loop's one by one.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "chain/load_regressor.hpp"
#include "load/load_solve.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"

namespace tauext {

struct Bundle;

// A recording and its estimates at the rows that weigh.
struct WeighedMotion {
  RecordingView recording;                           // tau is not read
  std::span<const std::int64_t> samples;             // of the rows; they rise
  std::span<const double> tau_ext, sigma_nm, worth;  // (rows, joints), see LoadSums::add
};

// Worth of each sample of a recording (Standstill), (samples, joints). near_stiction: (samples, joints).
std::vector<double> worth_of_samples(std::span<const std::int64_t> t_ns, std::span<const std::uint8_t> near_stiction);

// The rows at `samples` of a recording about the load phi, (samples, joints); tau_ext is 0. Throws Error if something
// does not fit, or `samples` do not rise.
std::vector<LoadSums::Row> load_rows(const Bundle& bundle, const LoadFrame& frame, const LoadParameters& phi,
                                     const RecordingView& recording, std::span<const std::int64_t> samples);
LoadSums load_sums(const Bundle& bundle, const LoadFrame& frame, const LoadParameters& phi,
                   std::span<const WeighedMotion> motions);

// As weigh() of sums, which every round adds up again about the load found so far.
//  phi: the load as known before, all 0 if unknown
LoadFound weigh(const Bundle& bundle, const LoadFrame& frame, std::span<const WeighedMotion> motions, double reach_m,
                const LoadParameters& phi, const Load& set);

}  // namespace tauext
