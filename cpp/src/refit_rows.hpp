// What a refit works on: errors of today's motion and the filtered terms that could explain them.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/refit.hpp"

namespace tauext {

// A network period apart, of all sources one after the other. Columns of a joint stand in one row each, (rows).
struct RefitRows {
  struct Joint {
    std::vector<double> error;           // residual - prior - network
    std::vector<double> sigma;           // as the motion announces it, or a quarter of the limit where nobody knows
    std::vector<double> limit;           // collision limit as it follows the motion, without doubt
    std::vector<double> doubt;
    std::vector<std::uint8_t> near_stiction;
    std::vector<std::uint8_t> shows;     // friction: it moved within the last kStoodS
    std::vector<double> network;         // what it says; empty: there is none
    double moved_s = 0;
  };
  std::vector<std::int64_t> t_ns;
  std::vector<int> source;
  std::vector<Joint> joints;
  std::vector<Term> terms;               // own terms of all joints, of kinds that may change ...
  std::vector<std::size_t> places;       // ... and where they stand in the prior
  std::vector<double> values;            // (rows, terms)
  double period_s = 0;
  bool knows_sigma = false;

  std::size_t size() const noexcept { return t_ns.size(); }
};

// Terms of a joint alone that friction is made of, or that may change with it.
bool may_change(const Term& term) noexcept;
// Throws Error where sources do not fit or hold too little.
RefitRows refit_rows(const Bundle& bundle, std::span<const RefitSource> sources, int threads);

}  // namespace tauext
