// The file: "TAUEXT\r\n" | major u32 | minor u32 | payload bytes u64 | CRC-32 of the payload u32 | payload, little-endian.
// The payload is the fields of Bundle in the order of fields() below, which both reads and writes them: numbers as they
// are, a text or list as its length (u64) and its elements.
#include "bundle/bundle_file.hpp"

#include <array>
#include <bit>
#include <cstring>
#include <string>
#include <type_traits>
#include <utility>

namespace tauext {
namespace {

static_assert(std::endian::native == std::endian::little, "bundles are little-endian");

constexpr char kMagic[] = {'T', 'A', 'U', 'E', 'X', 'T', '\r', '\n'};
constexpr std::size_t kHeaderBytes = sizeof kMagic + 4 + 4 + 8 + 4;
constexpr std::uint32_t kMinor = 0;
// Numbers that development versions wrote before the first release; a later format takes a larger one.
constexpr std::uint32_t kLastDevelopmentMajor = 12;

class Writer {
 public:
  std::vector<char> bytes;
  void raw(const void* data, std::size_t size) {
    const char* from = static_cast<const char*>(data);
    bytes.insert(bytes.end(), from, from + size);
  }
  std::size_t length(std::size_t count, std::size_t) {
    const std::uint64_t n = count;
    raw(&n, sizeof n);
    return count;
  }
};

class Reader {
 public:
  explicit Reader(std::span<const char> payload) : left_(payload) {}
  void raw(void* data, std::size_t size) {
    if (size > left_.size()) throw Error("it ends in the middle of its contents");
    std::memcpy(data, left_.data(), size);
    left_ = left_.subspan(size);
  }
  // A length is checked against what is left before anything is allocated.
  std::size_t length(std::size_t, std::size_t element_bytes) {
    std::uint64_t n;
    raw(&n, sizeof n);
    if (n > left_.size() / element_bytes) throw Error("a length in it is larger than the file");
    return static_cast<std::size_t>(n);
  }
  bool done() const noexcept { return left_.empty(); }

 private:
  std::span<const char> left_;
};

template <class File, class T>
  requires(std::is_arithmetic_v<T> || std::is_enum_v<T>)
void field(File& file, T& value) {
  file.raw(&value, sizeof value);
}
template <class File, class T, std::size_t N>
void field(File& file, std::array<T, N>& values) {
  file.raw(values.data(), sizeof values);
}
template <class File>
void field(File& file, std::string& text) {
  text.resize(file.length(text.size(), 1));
  file.raw(text.data(), text.size());
}
template <class File, class... Parts>
void fields(File& file, Parts&... parts) {
  (field(file, parts), ...);
}
template <class File>
void field(File& file, LstmInput& input) {
  fields(file, input.column, input.lag);
}
template <class File>
void field(File& file, Link& link) {
  fields(file, link.joint_name, link.parent, link.type, link.rotation, link.translation, link.mass, link.com,
         link.inertia, link.rotor_inertia);
}
template <class File>
void field(File& file, WrenchFrame& frame) {
  fields(file, frame.name, frame.link, frame.rotation, frame.translation);
}
template <class File>
void field(File& file, Capsule& capsule) {
  fields(file, capsule.link, capsule.start, capsule.end, capsule.radius_m);
}
template <class File>
void field(File& file, ServoConstants& joint) {
  fields(file, joint.volts, joint.ohm, joint.back_emf_v_s, joint.nm_per_ampere, joint.duty_per_rad, joint.most_duty,
         joint.count_rad);
}
template <class File>
void field(File& file, Term& term) {
  fields(file, term.kind, term.a, term.b, term.c, term.form, term.speed);
}
template <class File, class T>
void field(File& file, std::vector<T>& list) {
  constexpr std::size_t least_bytes = std::is_arithmetic_v<T> ? sizeof(T) : 8;
  list.resize(file.length(list.size(), least_bytes));
  for (T& element : list) field(file, element);
}

template <class File>
void field(File& file, Bundle& b) {
  fields(file, b.name, b.provenance, b.links, b.gravity);
  fields(file, b.observer.gain_per_s, b.observer.timing, b.observer.sample_period_ns, b.observer.network_stride,
         b.observer.method, b.observer.high_pass_per_s, b.observer.low_pass_per_s, b.observer.nm_per_unit);
  fields(file, b.units.given, b.units.relative_to, b.observer.unknown_constant);
  fields(file, b.window_steps, b.inputs, b.input_factors);
  fields(file, b.shape.inputs, b.shape.hidden, b.shape.outputs);
  fields(file, b.parameters, b.output_scale_nm);
  fields(file, b.prior.widths_rad, b.prior.terms, b.prior.weights, b.prior.corrected_links);
  fields(file, b.limits.near_stiction_rad_s, b.limits.region_width);
  for (Level* level : {&b.limits.collision, &b.limits.contact}) {
    fields(file, level->sliding_nm, level->near_stiction_nm, level->hold_s);
  }
  fields(file, b.limits.contact_release_s, b.limits.after_contact_factor, b.limits.near_memory_s, b.limits.declared_spread);
  fields(file, b.drift.time_constant_s, b.drift.size_nm, b.drift.rate_share_per_s, b.drift.freeze_share,
         b.drift.freeze_s, b.drift.freeze_floor_nm);
  fields(file, b.error_scale.features, b.error_scale.limit_weights, b.error_scale.largest, b.error_scale.sigma_weights,
         b.error_scale.sigma_near_weights, b.error_scale.largest_sigma);
  fields(file, b.coverage.fastest_rad_s, b.coverage.turns, b.coverage.centre_rad, b.coverage.span_rad, b.coverage.seen,
         b.coverage.reach, b.coverage.seen_together, b.coverage.reach_together);
  fields(file, b.signals.torque_limit_nm, b.signals.largest_torque_nm, b.signals.possible_torque_nm,
         b.signals.possible_speed_rad_s, b.signals.rate_tolerance);
  field(file, b.prior.branches);
  fields(file, b.load.frame, b.load.link, b.load.rotation, b.load.translation, b.load.largest_mass_kg,
         b.load.largest_reach_m, b.load.refused);
  field(file, b.drift.friction_share);
  field(file, b.prior.most_load_nm);
  fields(file, b.prior.temperature.reference_c, b.prior.temperature.reach_k, b.prior.temperature.coulomb_per_10k,
         b.prior.temperature.viscous_per_10k);
  fields(file, b.wrench.frames, b.wrench.correlation, b.wrench.torque_share, b.wrench.common_share, b.wrench.radius,
         b.wrench.residual_radius);
  field(file, b.capsules);
  fields(file, b.servo.torque_from, b.servo.velocity_steps, b.servo.sample_period_ns, b.servo.goal_delay_ns,
         b.servo.joints);
  fields(file, b.reference.t_ns, b.reference.q, b.reference.dq, b.reference.tau, b.reference.residual,
         b.reference.prior, b.reference.network);
}

// At the end, only in bundles that a known weight corrected.
template <class File>
void of_known_weight(File& file, Bundle& b) {
  fields(file, b.wrench.torque_factor, b.wrench.torque_correlation);
}

}  // namespace

std::uint32_t crc32(std::span<const char> bytes, std::uint32_t crc) noexcept {
  static constexpr auto table = [] {
    std::array<std::uint32_t, 256> of_byte{};
    for (std::uint32_t byte = 0; byte < 256; ++byte) {
      std::uint32_t& value = of_byte[byte] = byte;
      for (int bit = 0; bit < 8; ++bit) value = (value >> 1) ^ (0xEDB88320u & (0u - (value & 1u)));
    }
    return of_byte;
  }();
  crc = ~crc;
  for (char byte : bytes) crc = (crc >> 8) ^ table[(crc ^ static_cast<unsigned char>(byte)) & 0xffu];
  return ~crc;
}

std::vector<char> encode(const Bundle& bundle) {
  Writer payload, file;
  field(payload, const_cast<Bundle&>(bundle));  // a Writer only reads
  if (!bundle.wrench.torque_factor.empty()) of_known_weight(payload, const_cast<Bundle&>(bundle));
  const std::uint32_t version[] = {kBundleMajor, kMinor};
  const std::uint64_t size = payload.bytes.size();
  const std::uint32_t crc = crc32(payload.bytes);
  file.raw(kMagic, sizeof kMagic);
  file.raw(version, sizeof version);
  file.raw(&size, sizeof size);
  file.raw(&crc, sizeof crc);
  file.raw(payload.bytes.data(), payload.bytes.size());
  return std::move(file.bytes);
}

std::uint32_t model_digest(const Bundle& bundle) {
  Bundle model;
  model.links = bundle.links;
  model.gravity = bundle.gravity;
  model.observer = bundle.observer;
  model.units = bundle.units;
  model.window_steps = bundle.window_steps;
  model.inputs = bundle.inputs;
  model.input_factors = bundle.input_factors;
  model.shape = bundle.shape;
  model.parameters = bundle.parameters;
  model.output_scale_nm = bundle.output_scale_nm;
  model.prior = bundle.prior;
  model.servo = bundle.servo;
  Writer payload;
  field(payload, model);
  return crc32(payload.bytes);
}

Bundle decode(std::span<const char> bytes) {
  if (bytes.size() < kHeaderBytes || std::memcmp(bytes.data(), kMagic, sizeof kMagic) != 0)
    throw Error("it is not a tauext bundle");
  std::uint32_t version[2], crc;
  std::uint64_t size;
  std::memcpy(version, bytes.data() + 8, 8);
  std::memcpy(&size, bytes.data() + 16, 8);
  std::memcpy(&crc, bytes.data() + 24, 4);
  if (version[0] > kLastDevelopmentMajor)
    throw Error("its format is version " + std::to_string(version[0]) + ", this program reads version " +
                std::to_string(kBundleMajor) + "; it was made by a newer tauext");
  if (version[0] != kBundleMajor) throw Error("made by a development version before 0.1.0; train it again");
  const std::span<const char> payload = bytes.subspan(kHeaderBytes);
  if (payload.size() != size)
    throw Error("it is truncated or has something appended: " + std::to_string(payload.size()) + " bytes where " +
                std::to_string(size) + " belong");
  if (crc32(payload) != crc) throw Error("its checksum does not match: it is damaged");
  Reader reader(payload);
  Bundle bundle;
  field(reader, bundle);
  const auto unknown = [] { return Error("it has contents of a later version"); };
  try {
    if (!reader.done()) of_known_weight(reader, bundle);
  } catch (const Error&) {
    throw unknown();
  }
  if (!reader.done()) throw unknown();
  return bundle;
}

}  // namespace tauext
