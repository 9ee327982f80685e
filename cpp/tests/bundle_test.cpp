#include "tauext/bundle.hpp"

#include <cmath>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>

#include "check.hpp"

using namespace tauext;

namespace {

std::string folder;

std::vector<char> read(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

void write(const std::string& path, const std::vector<char>& bytes) {
  std::ofstream(path, std::ios::binary).write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

// Two links, a random network with a window of 5 steps of 10 samples.
Bundle make_bundle() {
  Bundle b;
  b.name = "test";
  b.provenance = "{}";
  for (int i = 0; i < 2; ++i) {
    Link link;
    link.joint_name = i ? "elbow" : "shoulder";
    link.parent = i - 1;
    link.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    link.translation = {0.3 * i, 0, 0};
    link.mass = 5;
    link.com = {0.1, 0.02, 0};
    link.inertia = {0.1, 0.1, 0.1, 0, 0, 0};
    b.links.push_back(link);
  }
  b.gravity = {0, -9.81, 0};
  b.observer = {20.0, TorqueTiming::held, 1'000'000, 10};
  b.window_steps = 5;
  for (int c = 0; c < 4; ++c) b.inputs.push_back({c, 0});
  b.inputs.push_back({2, 1});
  b.inputs.push_back({3, 1});
  b.input_factors = {0.3f, 0.4f, 0.5f, 0.6f};
  b.shape = {6, 7, 2};
  std::mt19937 random(1);
  std::normal_distribution<float> normal(0, 0.4f);
  for (std::size_t k = 0; k < b.shape.parameter_count(); ++k) b.parameters.push_back(normal(random));
  b.output_scale_nm = {10, 5};
  b.limits = {0.02, {4, 2}, {8, 4}};
  for (int k = 0; k < 60; ++k) {
    b.reference.t_ns.push_back(k * 1'000'000);
    for (int j = 0; j < 2; ++j) {
      b.reference.q.push_back(std::sin(0.01 * k + j));
      b.reference.dq.push_back(10 * std::cos(0.01 * k + j));
      b.reference.tau.push_back(3.0 * j + 0.1 * k);
    }
  }
  answer_reference(b);
  return b;
}

void a_saved_bundle_loads_the_same_and_says_the_same() {
  const Bundle b = make_bundle();
  const std::string path = folder + "/same.tauext", again = folder + "/again.tauext";
  save(b, path);
  const Bundle loaded = load(path);
  save(loaded, again);
  CHECK(read(path) == read(again));
  const Reference& r = b.reference;
  const RecordingView view{60, 2, r.t_ns.data(), r.q.data(), r.dq.data(), r.tau.data()};
  const Estimates one = estimate(b, view, 1), two = estimate(loaded, view, 2);
  CHECK(one.residual == two.residual);
  CHECK(!std::filesystem::exists(path + ".part"));
}

void every_truncation_and_every_flipped_byte_is_refused() {
  const std::string path = folder + "/good.tauext", bad = folder + "/bad.tauext";
  save(make_bundle(), path);
  const std::vector<char> good = read(path);
  for (std::size_t size = 0; size < good.size(); size += 7) {
    write(bad, {good.begin(), good.begin() + static_cast<std::ptrdiff_t>(size)});
    CHECK_THROWS(load(bad), Error);
  }
  for (std::size_t at = 0; at < good.size(); at += 11) {
    if (at >= 12 && at < 16) continue;  // the minor version may differ
    std::vector<char> flipped = good;
    flipped[at] = static_cast<char>(flipped[at] ^ 0x10);
    write(bad, flipped);
    CHECK_THROWS(load(bad), Error);
  }
}

void refused(const char* part_of_message, const Bundle& b) {
  try {
    save(b, folder + "/refused.tauext");
    check::that(false, part_of_message, __FILE__, __LINE__);
  } catch (const Error& e) {
    if (!std::strstr(e.what(), part_of_message)) std::printf("message was: %s\n", e.what());
    check::that(std::strstr(e.what(), part_of_message) != nullptr, part_of_message, __FILE__, __LINE__);
  }
}

void contents_that_do_not_fit_are_refused_by_name() {
  Bundle b = make_bundle();
  b.parameters.pop_back();
  refused("parameters", b);
  b = make_bundle();
  b.parameters[3] = NAN;
  refused("parameters", b);
  b = make_bundle();
  b.limits.sliding_nm[1] = -1;
  refused("limits.sliding_nm", b);
  b = make_bundle();
  b.inputs[0].column = 4;
  refused("column 4", b);
  b = make_bundle();
  b.reference.network[0] += 0.1;
  refused("replaying its reference", b);
  b = make_bundle();
  b.links[1].mass *= 1.5;  // another robot than the one the reference was made with
  refused("replaying its reference", b);
  b = make_bundle();
  b.observer.gain_per_s = 0;
  refused("gain", b);
  b = make_bundle();
  b.reference = {};
  refused("reference is empty", b);
}

void the_plain_observer_needs_no_network() {
  Bundle b = make_bundle();
  b.shape = {};
  b.parameters.clear();
  answer_reference(b);
  save(b, folder + "/observer.tauext");
  CHECK(!load(folder + "/observer.tauext").has_network());
}

}  // namespace

int main() {
  folder = (std::filesystem::temp_directory_path() / ("tauext_bundle_test_" + std::to_string(std::random_device{}()))).string();
  std::filesystem::create_directory(folder);
  a_saved_bundle_loads_the_same_and_says_the_same();
  every_truncation_and_every_flipped_byte_is_refused();
  contents_that_do_not_fit_are_refused_by_name();
  the_plain_observer_needs_no_network();
  std::filesystem::remove_all(folder);
  return check::result();
}
