// The chain on a whole recording: the control loop's answers, with the network's windows answered in bulk.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "tauext/bundle.hpp"
#include "tauext/judge_stage.hpp"

namespace tauext {

// What a newly made Monitor says of a recording, one row a sample; fields as in Estimate.
struct Estimates {
  std::vector<double> residual, prior, network, drift, tau_ext, doubt, sigma_nm, limit_nm;  // (samples, joints), [N m]
  std::vector<double> limit_scale;                   // (samples, joints)
  std::vector<double> unfamiliar;                    // (samples)
  std::vector<std::uint8_t> unseen;                  // (samples): of Unseen
  std::vector<std::int8_t> unseen_joint, unseen_other;  // (samples): -1: none
  std::vector<std::uint8_t> near_stiction;           // (samples, joints)
  std::vector<std::uint8_t> health;                  // (samples): of Health
  std::vector<std::uint32_t> causes;                 // (samples)
  std::vector<std::int8_t> cause_joint, alarm_joint;  // (samples): -1: none
  std::vector<std::uint8_t> detection;               // (samples)
  std::vector<std::uint8_t> alarm, held_alarm;       // (samples): of Alarm, latched and not
};

// Equal to Monitor::step() for sample after sample, to the last bit, whatever is wrong with them: times that go backwards,
// numbers that are not finite, gaps, another rate. Throws Error where the joints differ.
Estimates estimate(const Bundle& bundle, const RecordingView& recording, int threads);

// The features of the error scale as they stand at each of `samples`, which rise: (samples, joints, features). For its
// fit; weights do not count. Throws Error where the bundle has no error scale, or the joints differ.
std::vector<double> motion_features(const Bundle& bundle, const RecordingView& recording,
                                    std::span<const std::int64_t> samples);

}  // namespace tauext
