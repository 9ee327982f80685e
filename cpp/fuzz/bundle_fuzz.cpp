// Feeds bundles of any content to the reader: it must answer with a bundle or an Error, and allocate in proportion to
// the file. The input is a payload; it gets a right header, since no fuzzer guesses a checksum. `make test-all
// PARTS=fuzz` runs it.
//
// cpp/fuzz/corpus holds payloads of a few made bundles and what runs have found, as little of it as covers the same.
// After a change of the format:
//   bundle_fuzz -write_seeds=cpp/fuzz/corpus
//   bundle_fuzz -merge=1 -use_counters=0 cpp/fuzz/corpus build/fuzz/found
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <new>
#include <string>
#include <vector>

#include "made_bundle.hpp"
#include "stages/estimates.hpp"
#include "tauext/monitor.hpp"

namespace {

constexpr std::size_t kHeaderBytes = 28;  // see bundle.cpp

std::vector<char> with_header(std::span<const char> payload) {
  const std::uint32_t version[] = {tauext::kBundleMajor, 0}, crc = tauext::crc32(payload);
  const std::uint64_t size = payload.size();
  std::vector<char> bytes(kHeaderBytes + payload.size());
  std::memcpy(bytes.data(), "TAUEXT\r\n", 8);
  std::memcpy(bytes.data() + 8, version, 8);
  std::memcpy(bytes.data() + 16, &size, 8);
  std::memcpy(bytes.data() + 24, &crc, 4);
  std::memcpy(bytes.data() + kHeaderBytes, payload.data(), payload.size());
  return bytes;
}

void expect(bool ok, const char* what) {
  if (ok) return;
  std::fprintf(stderr, "%s\n", what);
  std::abort();
}

// An accepted bundle must run, with equal results by sample and in bulk, and without NaN in a healthy estimate.
void run(const tauext::Bundle& bundle) {
  constexpr std::int64_t samples = 20;
  tauext::Monitor monitor(bundle);
  const auto n = static_cast<std::size_t>(monitor.joints());
  const std::int64_t period_ns = std::min(monitor.sample_period_ns(), std::int64_t{1} << 40);
  std::vector<std::int64_t> t_ns;
  std::vector<double> q(samples * n), dq(samples * n), tau(samples * n);
  for (std::int64_t k = 0; k < samples; ++k) {
    const auto at = static_cast<std::size_t>(k) * n;
    made::signal(k, monitor.joints(), &q[at], &dq[at], &tau[at]);
    t_ns.push_back(k == 15 ? k * period_ns / 2 : k * period_ns);
  }
  const tauext::RecordingView view{samples, monitor.joints(), t_ns.data(), q.data(), dq.data(), tau.data()};
  const tauext::Estimates bulk = tauext::estimate(bundle, view, 1);
  for (std::int64_t k = 0; k < samples; ++k) {
    const tauext::Estimate& e = monitor.step(view.at(k));
    const auto row = static_cast<std::size_t>(k);
    expect(static_cast<std::uint8_t>(e.health) == bulk.health[row] && e.causes == bulk.causes[row], "health differs");
    for (std::size_t j = 0; j < n; ++j) {
      const double one = e.tau_ext[j], other = bulk.tau_ext[row * n + j];
      expect(one == other || (std::isnan(one) && std::isnan(other)), "tau_ext differs");
      expect(e.health != tauext::Health::ok || std::isfinite(one), "tau_ext is not finite, and health is ok");
    }
  }
}

void read(std::span<const char> bytes) {
  try {
    run(tauext::from_bytes(bytes));
  } catch (const tauext::Error&) {  // as it should
  } catch (const std::bad_alloc&) {  // a size within the limits may still be more than there is
  }
}

void write_seed(const std::string& path, const tauext::Bundle& bundle) {
  const std::vector<char> bytes = tauext::to_bytes(bundle);
  std::ofstream file(path, std::ios::binary);
  file.write(bytes.data() + kHeaderBytes, static_cast<std::streamsize>(bytes.size() - kHeaderBytes));
  if (!file.flush()) {
    std::fprintf(stderr, "%s: cannot be written\n", path.c_str());
    std::exit(1);
  }
}

void write_seeds(const std::string& folder) {
  write_seed(folder + "/observer", made::bundle(1, 0, 1, 1, 1));
  write_seed(folder + "/network", made::bundle(2, 3, 2, 2, 1));
  write_seed(folder + "/one_step_window", made::bundle(1, 2, 1, 3, 1));
  tauext::Bundle b = made::bundle(3, 0, 1, 1, 1);
  b.links[1].type = tauext::JointType::prismatic;
  b.links[2].parent = 0;
  b.observer.timing = tauext::TorqueTiming::instant;
  b.reference.t_ns[1] = 2 * made::kPeriodNs;  // a bridged tick
  tauext::answer_reference(b);
  write_seed(folder + "/branched", b);
  b = made::bundle(2, 0, 1, 1, 1);
  b.observer.method = tauext::ResidualMethod::velocity;
  b.observer.high_pass_per_s = 1;
  b.observer.low_pass_per_s = 50;
  tauext::answer_reference(b);
  write_seed(folder + "/velocity", b);
  b = made::bundle(2, 0, 1, 1, 1);
  b.observer.nm_per_unit = {2, -0.5};
  b.observer.unknown_constant = {0, 1};
  b.units = {tauext::TorqueUnit::ampere, 0};
  tauext::answer_reference(b);
  write_seed(folder + "/amperes", b);
  b = made::bundle(2, 3, 2, 2, 1);
  b.prior.widths_rad = {1e-3, 3e-3};
  for (int kind = 0; kind <= static_cast<int>(tauext::TermKind::momentum); ++kind)
    b.prior.terms.push_back({static_cast<tauext::TermKind>(kind), kind % 2, 1, 0, 0, 0.1});
  b.prior.weights.assign(2 * b.prior.terms.size(), 0.3);
  b.prior.corrected_links = b.links;
  b.prior.corrected_links[1].mass *= 0.9;
  b.limits.region_width = 1;
  b.input_factors.resize(static_cast<std::size_t>(b.columns()), 1.0f);
  tauext::answer_reference(b);
  write_seed(folder + "/prior", b);
}

}  // namespace

extern "C" int LLVMFuzzerInitialize(int* argc, char*** argv) {
  const char option[] = "-write_seeds=";
  for (int i = 1; i < *argc; ++i)
    if (std::strncmp((*argv)[i], option, sizeof option - 1) == 0) {
      write_seeds((*argv)[i] + sizeof option - 1);
      std::exit(0);
    }
  return 0;
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const std::span<const char> payload(reinterpret_cast<const char*>(data), size);
  read(with_header(payload));
  read(payload);
  return 0;
}
