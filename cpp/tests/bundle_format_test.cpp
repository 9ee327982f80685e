// The format is read and written without the chain: this program is linked with the layer bundle alone.
#include "bundle/bundle_file.hpp"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "check.hpp"
#include "refused.hpp"

using namespace tauext;

namespace {

// No monitor can run this one: it has no reference, and its gain is below 0.
Bundle made() {
  Bundle b;
  b.name = "format";
  b.links = {Link{"shoulder", -1, JointType::revolute, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0.1}, 2.5, {}, {}, 0.25},
             Link{"slide", 0, JointType::prismatic, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {}, 1.5, {0.1, 0.2, 0.3}, {}, 0}};
  b.gravity = {0, 0, -9.81};
  b.observer.gain_per_s = -7;
  b.observer.nm_per_unit = {0.5, 2};
  b.units.given = TorqueUnit::ampere;
  b.inputs = {{3, 1}};
  b.parameters = {0.5F, -0.25F};
  b.prior.terms = {{TermKind::coulomb, 1, 0, 0, 0, 0.03}};
  b.prior.weights = {0, -3};
  b.coverage.seen = {1, std::uint64_t{1} << 63};
  b.wrench.frames = {{"tool", 1, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0.2}}};
  b.capsules = {{1, {0, 0, 0}, {0, 0, 0.3}, 0.05}};
  b.servo.joints = {ServoConstants{}, ServoConstants{}};
  return b;
}

void fields_are_those_that_were_written() {
  const std::vector<char> bytes = encode(made());
  const Bundle read = decode(bytes);
  CHECK(read.name == "format" && read.joints() == 2);
  CHECK(read.links[1].joint_name == "slide" && read.links[1].type == JointType::prismatic && read.links[1].com[2] == 0.3);
  CHECK(read.observer.gain_per_s == -7 && read.observer.nm_per_unit == std::vector<double>({0.5, 2}));
  CHECK(read.inputs.size() == 1 && read.inputs[0].column == 3 && read.inputs[0].lag == 1);
  CHECK(read.prior.terms[0].kind == TermKind::coulomb && read.prior.terms[0].speed == 0.03);
  CHECK(read.coverage.seen[1] == std::uint64_t{1} << 63);
  CHECK(read.wrench.frames[0].name == "tool" && read.capsules[0].radius_m == 0.05 && read.servo.joints.size() == 2);
  CHECK(read.torque_unit(0) == "A" && read.estimate_unit(1) == "N" && read.in_newtons(1));
  CHECK(encode(read) == bytes);
}

// CRC-32 bit by bit, over the payload behind the 28 bytes of the header.
void the_header_is_the_documented_one() {
  const std::vector<char> bytes = encode(made());
  std::uint32_t version[2], stored, crc = ~std::uint32_t{0};
  std::uint64_t size;
  std::memcpy(version, bytes.data() + 8, 8);
  std::memcpy(&size, bytes.data() + 16, 8);
  std::memcpy(&stored, bytes.data() + 24, 4);
  for (std::size_t k = 28; k < bytes.size(); ++k) {
    crc ^= static_cast<unsigned char>(bytes[k]);
    for (int bit = 0; bit < 8; ++bit) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0u);
  }
  CHECK(std::memcmp(bytes.data(), "TAUEXT\r\n", 8) == 0);
  CHECK(version[0] == kBundleMajor && version[1] == 0 && size == bytes.size() - 28 && stored == ~crc);
}

void damage_is_refused_with_its_reason() {
  std::vector<char> bytes = encode(made());
  refused("it is not a tauext bundle", [&] { decode(std::span(bytes).first(20)); });
  refused("truncated", [&] { decode(std::span(bytes).first(bytes.size() - 1)); });
  bytes.back() = static_cast<char>(~bytes.back());
  refused("checksum", [&] { decode(bytes); });
  bytes[8] = 100;
  refused("made by a newer tauext", [&] { decode(bytes); });
}

}  // namespace

int main() {
  fields_are_those_that_were_written();
  the_header_is_the_documented_one();
  damage_is_refused_with_its_reason();
  return check::result();
}
