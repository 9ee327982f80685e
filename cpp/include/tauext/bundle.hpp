// Everything the chain needs to run, in one file.
#pragma once
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "tauext/alarm.hpp"
#include "tauext/drift.hpp"
#include "tauext/limits.hpp"
#include "tauext/lstm.hpp"
#include "tauext/prior.hpp"
#include "tauext/residual.hpp"
#include "tauext/signal_watch.hpp"
#include "tauext/tree.hpp"

namespace tauext {

inline constexpr std::uint32_t kBundleMajor = 4;        // what is written
inline constexpr std::uint32_t kOldestBundleMajor = 3;  // what is still read; fields that it lacks keep their defaults

// A short stretch of free motion and what the chain said at its last sample; replayed at load.
struct Reference {
  std::vector<std::int64_t> t_ns;
  std::vector<double> q, dq, tau;         // (samples, joints)
  std::vector<double> residual, prior, network;  // (joints), [N m]
};
// Processors differ in the last bits (fused operations); a damaged or foreign network differs by far more.
inline constexpr double kReferenceTolerance = 1e-4;  // times the largest magnitude of the reference, at least 1 N m

// The network is absent where shape.hidden is 0: the plain observer.
struct Bundle {
  std::string name;
  std::string provenance;  // JSON, for people; nothing here reads it
  std::vector<Link> links;
  std::array<double, 3> gravity{};
  ObserverSettings observer;
  int window_steps = 0;                 // network steps in a window
  std::vector<LstmInput> inputs;        // columns of feature_rows()
  std::vector<float> input_factors;     // a column, 1 / largest magnitude in training
  LstmShape shape;
  std::vector<float> parameters;
  std::vector<double> output_scale_nm;  // a joint; 0 where the network did not earn its place
  PriorSettings prior;
  Limits limits;
  DriftSettings drift;
  SignalRanges signals;
  Reference reference;

  int joints() const noexcept { return static_cast<int>(links.size()); }
  bool has_network() const noexcept { return shape.hidden > 0; }
  // Of feature_rows(): q, dq and presliding states of every joint.
  int columns() const noexcept { return joints() * (2 + static_cast<int>(prior.widths_rad.size())); }
  // Throws Error, naming what does not fit.
  void validate() const;
};

// What the chain says of a recording, one row a sample.
struct Estimates {
  std::vector<double> residual;       // (samples, joints), [N m]
  std::vector<double> prior;          // (samples, joints), [N m]; 0 where there is none
  std::vector<double> network;        // (samples, joints), [N m]; NaN while warming up, 0 where there is no network
  std::vector<double> drift;          // (samples, joints), [N m]: what the tracker takes off; 0 where there is none
  std::vector<double> tau_ext;        // residual - (prior + network + drift); NaN while warming up
  std::vector<double> doubt;          // (samples, joints), [N m]: of the prior; 0 where there is none
  std::vector<double> limit_nm;       // (samples, joints): of a collision, raised by the doubt
  std::vector<std::uint8_t> near_stiction;  // (samples, joints)
  std::vector<std::uint8_t> healthy;  // (samples): observer warm and window full
  std::vector<std::uint8_t> detection;  // (samples): healthy, and some |tau_ext| over its limit
  std::vector<std::uint8_t> alarm;      // (samples): level of Alarm that is held at this sample, without latch
};

// The whole chain on a recording. Throws Error where the recording's joints, rate or times do not fit.
Estimates estimate(const Bundle& bundle, const RecordingView& recording, int threads);

// Fills the answers of bundle.reference from its samples. Throws Error where they are too few to fill a window.
void answer_reference(Bundle& bundle);

// All throw Error with the reason; save writes under a temporary name and renames. Every length is checked against what
// is there before it is used, the checksum before anything else, and the reference is replayed.
void save(const Bundle& bundle, const std::string& path);
Bundle load(const std::string& path);
std::vector<char> to_bytes(const Bundle& bundle);
Bundle from_bytes(std::span<const char> bytes);
// CRC-32 of zlib and Ethernet, continued from `crc`.
std::uint32_t crc32(std::span<const char> bytes, std::uint32_t crc = 0) noexcept;

}  // namespace tauext
