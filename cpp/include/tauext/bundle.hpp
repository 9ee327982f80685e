// A bundle: all settings and weights of the chain, in one file.
#pragma once
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "tauext/link.hpp"
#include "tauext/load.hpp"
#include "tauext/settings.hpp"

namespace tauext {

inline constexpr std::uint32_t kBundleMajor = 1;  // version of the bundle format that is written and read

// A section of free motion with the chain's estimate at its last sample. Loading a bundle replays it.
struct Reference {
  std::vector<std::int64_t> t_ns;         // (samples)
  std::vector<double> q, dq, tau;         // (samples, joints)
  std::vector<double> residual, prior, network;  // (joints), [N m]
};
// Processors differ in the last bits (fused operations); a damaged or foreign network differs by far more.
inline constexpr double kReferenceTolerance = 1e-4;  // relative to the largest value of the reference, at least 1 N m

// Unit of tau. The torque constants between the input unit and N m are in ObserverSettings. Bundles store these
// numbers.
enum class TorqueUnit : std::uint8_t {
  newton_metre = 0,                     // N at a prismatic joint
  ampere = 1,
  recorded = 2,                         // as in the recordings; unit unknown
};
// Units of a bundle's input and of its estimates.
struct TorqueUnits {
  TorqueUnit given = TorqueUnit::newton_metre;  // of the input tau
  int relative_to = -1;               // joint in whose input unit torques are estimated; -1: N m

  // Throws Error with the invalid field. constants: whether the bundle has torque constants.
  void validate(int joints, bool constants) const;
};

// Content of a bundle. Call validate() after a change and before use. With shape.hidden = 0 there is no network.
struct Bundle {
  std::string name;                     // name of the bundle; its file may have another name
  std::string provenance;               // JSON for people: what made the bundle; the core does not read it
  std::vector<Link> links;              // of the estimated model, in the order of the joints
  std::array<double, 3> gravity{};      // in the base frame, [m/s^2]
  ObserverSettings observer;            // gain, torque timing, sample period, rate of the network, torque constants
  int window_steps = 0;                 // network steps in a window
  std::vector<LstmInput> inputs;        // inputs of the network: columns of feature_rows()
  std::vector<float> input_factors;     // per column: 1 / largest absolute value in training
  LstmShape shape;                      // of the network
  std::vector<float> parameters;        // weights of the network, in LstmShape's order
  std::vector<double> output_scale_nm;  // per joint: torque of an output of 1; 0: the network is switched off
  PriorSettings prior;                  // r expected from physics; may be empty
  Limits limits;                        // of contact and collision; in usual motion if there is an error scale
  DriftSettings drift;                  // tracker of slow changes; may be off
  ErrorScaleSettings error_scale;       // how thresholds follow the motion; may be off
  CoverageSettings coverage;            // motion of the training recordings; may be empty
  SignalRanges signals;                 // ranges of the signals; samples outside are faults
  TorqueUnits units;                    // of the input tau and of the estimates
  LoadSettings load;                    // load frame, and bounds on payloads
  WrenchSettings wrench;                // error model of forces and moments at frames
  std::vector<Capsule> capsules;        // shapes of the links
  ServoSettings servo;                  // computes dq and tau from servo signals before the chain; may be off
  Reference reference;                  // replayed at load

  int joints() const noexcept { return static_cast<int>(links.size()); }  // number of joints
  bool has_network() const noexcept { return shape.hidden > 0; }          // false: observer and prior only
  // Number of columns of feature_rows(): q, dq and presliding states of every joint.
  int columns() const noexcept { return joints() * (2 + static_cast<int>(prior.widths_rad.size())); }
  // Units of the input tau and of the estimated torques of a joint: "N m", "N", "A", "recorded unit", "units of JOINT",
  // or "W" for the energy observer. Both throw std::out_of_range for an unknown joint.
  std::string torque_unit(int joint) const;
  std::string estimate_unit(int joint) const;
  // Whether the joint's estimates are in N m, N or W. Only then are they proportional to a mass or a force.
  bool in_newtons(int joint) const;
  // With fewer joints in N m than this (on shorter arms: than all), neither masses nor forces can be determined.
  static constexpr int kLeastInNewtons = 3;
  // Empty if enough joints are in N m; else a sentence that ends with `why`.
  std::string too_few_in_newtons(const std::string& why) const;
  // Per joint: bound on the change of its estimate, in its own unit, per N m of a payload; 0 for joints in N m. In
  // training, the arm's own weight at the joint took no more than the largest torque, of either sign; in addition the
  // model subtracts one unit per N m. kAnyUnit if the arm's weight at the joint is unknown.
  static constexpr double kAnyUnit = 1e6;
  std::vector<double> most_units_per_nm() const;
  // Throws Error with the field that is invalid, or that keeps the chain from running its reference.
  void validate() const;
  // Sets the default payload settings, see assumed_load_settings(). Payloads are refused if too few joints are in N m.
  void assume_load();
};

// Computes the estimates of bundle.reference from its samples. Throws Error if they do not fill a window.
void answer_reference(Bundle& bundle);

// Write and read bundles. All throw Error with the reason. save_bundle writes to a temporary name and renames it.
// Reading checks the checksum first, then every length against the remaining bytes, and replays the reference.
void save_bundle(const Bundle& bundle, const std::string& path);
Bundle load_bundle(const std::string& path);
std::vector<char> to_bytes(const Bundle& bundle);
Bundle from_bytes(std::span<const char> bytes);
// Checksum of all that tau_ext is made of, drift excluded: model, observer, units, prior, network. Bundles that differ in
// thresholds, drift settings, coverage or names alone have the same.
std::uint32_t model_digest(const Bundle& bundle);
// CRC-32 as in zlib and Ethernet, continued from `crc`.
std::uint32_t crc32(std::span<const char> bytes, std::uint32_t crc = 0) noexcept;

}  // namespace tauext
