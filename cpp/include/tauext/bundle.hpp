// Everything the chain needs to run, in one file.
#pragma once
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "tauext/load.hpp"
#include "tauext/servo_input.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/wrench.hpp"

namespace tauext {

inline constexpr std::uint32_t kBundleMajor = 1;  // format of bundles: the only one that is written and read

// A short stretch of free motion and the chain's estimate at its last sample; replayed at load.
struct Reference {
  std::vector<std::int64_t> t_ns;         // (samples)
  std::vector<double> q, dq, tau;         // (samples, joints)
  std::vector<double> residual, prior, network;  // (joints), [N m]
};
// Processors differ in the last bits (fused operations); a damaged or foreign network differs by far more.
inline constexpr double kReferenceTolerance = 1e-4;  // times the largest magnitude of the reference, at least 1 N m

// What a number of tau stands for, and what a number of the answer does. Torque constants, which turn the one into the
// other, stand in ObserverSettings.
enum class TorqueUnit : std::uint8_t {  // the numbers stand in bundles
  newton_metre = 0,                     // N at a sliding joint
  ampere = 1,
  recorded = 2,                         // as in the recordings; the unit is unknown
};
// Which units a bundle takes and answers in.
struct TorqueUnits {
  TorqueUnit given = TorqueUnit::newton_metre;  // of the tau that the chain is given
  int relative_to = -1;               // the joint in whose given unit torques are answered; -1: N m
  std::vector<std::uint8_t> unknown = {};  // a joint: 1 where its constant is not known, so that it answers in its given unit;
                                      // empty: none is

  // Throws Error, naming what does not fit; `constants`: the bundle has torque constants.
  void validate(int joints, bool constants) const;
};

// Plain content of a bundle. Call validate() after a change and before use. The network is absent where
// shape.hidden is 0: the plain observer.
struct Bundle {
  std::string name;                     // what it calls itself; its file may have another name
  std::string provenance;               // JSON, for people; nothing here reads it
  std::vector<Link> links;              // of the estimated model, in the order of the joints
  std::array<double, 3> gravity{};      // in the base frame, [m/s^2]
  ObserverSettings observer;            // gain, torque timing, sample period, rate of the network, torque constants
  int window_steps = 0;                 // network steps in a window
  std::vector<LstmInput> inputs;        // columns of feature_rows()
  std::vector<float> input_factors;     // a column, 1 / largest magnitude in training
  LstmShape shape;                      // of the network
  std::vector<float> parameters;        // its weights, in LstmShape's order
  std::vector<double> output_scale_nm;  // a joint; 0 where the network did not earn its place
  PriorSettings prior;                  // what physics expects of r; may be empty
  Limits limits;                        // of contact and collision, in usual motion where there is an error scale
  DriftSettings drift;                  // tracker of slow changes; may be off
  ErrorScaleSettings error_scale;       // how limits follow the motion; may be off
  CoverageSettings coverage;            // motion that occurred in training; may be empty
  SignalRanges signals;                 // beyond which a sample is a fault
  TorqueUnits units;                    // of tau and of the answers
  LoadSettings load;                    // where a load is fixed, and bounds on loads
  WrenchSettings wrench;                // of forces and moments at frames
  std::vector<Capsule> capsules;        // shapes of links
  ServoSettings servo;                  // what makes dq and tau of a servo's signals, ahead of the chain; may be off
  Reference reference;                  // replayed at load

  int joints() const noexcept { return static_cast<int>(links.size()); }  // how many
  bool has_network() const noexcept { return shape.hidden > 0; }          // or observer and prior alone
  // Of feature_rows(): q, dq and presliding states of every joint.
  int columns() const noexcept { return joints() * (2 + static_cast<int>(prior.widths_rad.size())); }
  // Unit of the tau that is given of a joint, and of the torques that are answered: "N m", "N", "A", "recorded unit",
  // "units of JOINT", or "W" of the energy observer. Throws std::out_of_range where there is no such joint.
  std::string torque_unit(int joint) const;
  std::string estimate_unit(int joint) const;
  // Whether the joint answers in N m, N or W: there a mass or a force appears in proportion to its lever.
  bool in_newtons(int joint) const;
  // Fewer joints in N m than this, or than all of a shorter arm, determine neither a mass nor a force.
  static constexpr int kLeastInNewtons = 3;
  // Empty where enough joints answer in N m; else a sentence that ends in `why`.
  std::string too_few_in_newtons(const std::string& why) const;
  // A joint: so many of its own units a load makes of a newton metre at most; 0 where it answers in N m. What the arm itself
  // weighs there took no more than the largest torque of training, of either sign; and the model takes off one unit for
  // each newton metre. kAnyUnit where the arm's weight at the joint is unknown.
  static constexpr double kAnyUnit = 1e6;
  std::vector<double> most_units_per_nm() const;
  // Throws Error, naming what does not fit.
  void validate() const;
  // Sets the default load settings: see assumed_load_settings(). No load can be set where too few joints answer in N m.
  void assume_load();
};

// Fills the answers of bundle.reference from its samples. Throws Error where they are too few to fill a window.
void answer_reference(Bundle& bundle);

// All throw Error with the reason; save_bundle writes under a temporary name and renames. Every length is checked against what
// is there before it is used, the checksum before anything else, and the reference is replayed.
void save_bundle(const Bundle& bundle, const std::string& path);
Bundle load_bundle(const std::string& path);
std::vector<char> to_bytes(const Bundle& bundle);
Bundle from_bytes(std::span<const char> bytes);
// CRC-32 of zlib and Ethernet, continued from `crc`.
std::uint32_t crc32(std::span<const char> bytes, std::uint32_t crc = 0) noexcept;

}  // namespace tauext
