// The chain on a whole recording: the control loop's answers, with the network's windows answered in bulk.
#pragma once
#include <cstdint>
#include <vector>

#include "tauext/bundle.hpp"
#include "tauext/judge_stage.hpp"

namespace tauext {

// What a newly made Monitor says of a recording, one row a sample; fields as in Estimate.
struct Estimates {
  std::vector<double> residual, prior, network, drift, tau_ext, doubt, limit_nm;  // (samples, joints), [N m]
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

}  // namespace tauext
