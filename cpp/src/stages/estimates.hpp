// The chain on a whole recording: the control loop's results, with the network evaluated in bulk.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "stages/judge_stage.hpp"
#include "tauext/bundle.hpp"
#include "tauext/declared_contact.hpp"

namespace tauext {

// Estimates of a new Monitor for a recording, one row per sample; fields as in Estimate.
struct Estimates {
  std::vector<double> residual, prior, network, drift, tau_ext, doubt, limit_nm, contact_limit_nm;  // (samples, joints), [N m]
  std::vector<double> sigma_nm, contact_sigma_nm, declared_nm;  // (samples, joints), [N m]
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
  std::vector<std::uint8_t> touch;                   // (samples): of Touch
  std::vector<std::uint8_t> declared;                // (samples): of Declared
  std::vector<std::int8_t> declared_contact;         // (samples): -1: none
  std::vector<double> declared_size, declared_sigma;  // (samples)
  std::vector<std::uint8_t> entered, restarted;      // (samples): the sample entered; the chain restarted at it
};

// A torque column of Estimates.
struct TorqueColumn {
  const char* name;
  std::vector<double> Estimates::*column;
  JointVector Estimate::*values;
};
inline constexpr std::array<TorqueColumn, 12> kTorqueColumns{{
    {"residual", &Estimates::residual, &Estimate::residual},
    {"prior", &Estimates::prior, &Estimate::prior},
    {"network", &Estimates::network, &Estimate::network},
    {"drift", &Estimates::drift, &Estimate::drift},
    {"tau_ext", &Estimates::tau_ext, &Estimate::tau_ext},
    {"doubt", &Estimates::doubt, &Estimate::doubt},
    {"sigma_nm", &Estimates::sigma_nm, &Estimate::sigma_nm},
    {"contact_sigma_nm", &Estimates::contact_sigma_nm, &Estimate::contact_sigma_nm},
    {"limit_scale", &Estimates::limit_scale, &Estimate::limit_scale},
    {"limit_nm", &Estimates::limit_nm, &Estimate::limit_nm},
    {"contact_limit_nm", &Estimates::contact_limit_nm, &Estimate::contact_limit_nm},
    {"declared_nm", &Estimates::declared_nm, &Estimate::declared_nm},
}};

// Equal to Monitor::step() for every sample, to the last bit, for any faults: times that go backwards, non-finite
// numbers, gaps, other rates. `outputs` of network_outputs() replace running the network. torques: names of the torque
// columns that are filled; empty: all of them, which take most of the memory. contacts: as by Monitor::expect_contact(), by rising
// time; their numbers are those of a monitor. Throws Error if the number of joints differs, or that of the outputs, a name is
// unknown, or a contact is refused.
Estimates estimate(const Bundle& bundle, const RecordingView& recording, int threads, std::span<const float> outputs = {},
                   std::span<const std::string> torques = {}, std::span<const TimedContact> contacts = {});

// The network's outputs for each judged sample, (judged, joints); none without a network. Limits, drift tracker and error
// scale do not change them.
std::vector<float> network_outputs(const Bundle& bundle, const RecordingView& recording, int threads);

// A motion as input of the error scale: dq and near_stiction (samples, joints), row-major; entered and restarted
// (samples), as from estimate().
struct MotionView {
  std::span<const std::int64_t> t_ns;
  std::span<const double> dq;
  std::span<const std::uint8_t> near_stiction, entered, restarted;
};

// Result of motion_errors(), one row for each requested row.
struct MotionErrors {
  std::vector<double> features;         // (rows, joints, features): for the fit, weights do not count
  std::vector<double> scale, sigma_nm;  // (rows, joints): without what doubt and unfamiliar motion add
};

// The bundle's error scale for a motion at ascending `rows`. Uses only speeds; the chain does not run. Throws Error if
// the bundle has no error scale or sizes do not fit.
MotionErrors motion_errors(const Bundle& bundle, const MotionView& motion, std::span<const std::int64_t> rows);

}  // namespace tauext
