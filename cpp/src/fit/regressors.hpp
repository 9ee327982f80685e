// Derivatives of a whole recording's residual, by the weights of a prior and by the parameters of the links.
#pragma once
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "chain/load_regressor.hpp"
#include "chain/momentum_observer.hpp"
#include "chain/motion.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"

namespace tauext {

// The terms of a prior passed through the observer's filter one by one, for the fit: (rows, terms), one row for each of
// `samples`, which rise. The same filter as Prior's: their weighted sum is the prior.
std::vector<double> prior_regressors(const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
                                     const RecordingView& recording, std::span<const std::int64_t> samples);

// Derivative of the unfiltered r by inertial parameters of the robot's links, for the fit: LoadRegressor's of each link
// about its origin, then its rotor inertia. A recording may come in parts, of which memory holds the rows of one.
class LinkRegressors {
 public:
  static constexpr int kParameters = LoadRegressor::kParameters + 1;

  // links, parameters: indices, each in the order of the columns. Throws Error if one does not exist.
  LinkRegressors(const Tree& tree, const ObserverSettings& settings, std::span<const int> links,
                 std::span<const int> parameters);

  // The next samples: (rows, joints, links x parameters), one row for each of `samples`, which rise.
  std::vector<double> rows(const RecordingView& part, std::span<const std::int64_t> samples);
  std::size_t columns() const noexcept { return columns_; }

 private:
  // A column of a joint that moves the link; those of other joints are zero.
  struct Cell {
    std::size_t link, parameter, joint, column;  // link: of links_
  };
  int joints_;
  std::size_t columns_;
  SampleClock clock_;
  std::vector<LoadRegressor> links_;
  std::vector<Cell> cells_;
  std::vector<MomentumObserver> filters_;  // of kMaxJoints cells each
};

}  // namespace tauext
