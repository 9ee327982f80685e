// Only bundles that run are written and read: the stages accept their settings, and replaying the reference gives its
// estimates.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "bundle/bundle_file.hpp"
#include "bundle/rules.hpp"
#include "network/lstm.hpp"
#include "stages/observation.hpp"
#include "stages/residual.hpp"
#include "tauext/bundle.hpp"

namespace tauext {
namespace {

// Times a network's answer, which may be the largest float, it is still far from overflowing.
constexpr double kLargestScaleNm = 1e200;

// Residual, prior and network at the reference's last sample.
struct Answer {
  std::vector<double> residual, prior, network;
};

Answer replay(const Bundle& b) {
  const Reference& ref = b.reference;
  const RecordingView view{static_cast<std::int64_t>(ref.t_ns.size()), b.joints(), ref.t_ns.data(),
                           ref.q.data(), ref.dq.data(), ref.tau.data()};
  const Observation observation = observe(Tree(b.links, b.gravity), b.observer, b.prior, view);
  const std::size_t last = ref.t_ns.size() - 1, n = b.links.size();
  Answer answer{{observation.residual.end() - static_cast<std::ptrdiff_t>(n), observation.residual.end()},
                std::vector<double>(n, 0.0),
                std::vector<double>(n, 0.0)};
  if (!b.prior.empty()) std::copy(observation.prior.end() - static_cast<std::ptrdiff_t>(n), observation.prior.end(), answer.prior.begin());
  if (b.has_network()) {
    const std::vector<float> rows = feature_rows(view, observation, b.input_factors);
    WindowRows windows = windows_of(b);
    windows.rows = rows.data();
    windows.row_count = observation.row_count;
    std::vector<float> y(n);
    lstm_forward(b.shape, b.parameters, windows, std::span(&observation.row[last], 1), y, 1);
    for (std::size_t j = 0; j < n; ++j) answer.network[j] = network_torque_nm(b.output_scale_nm[j], y[j]);
  }
  return answer;
}

// Whoever writes a reference takes it from a recording without gaps; rows for the ticks of long ones would fill memory.
void expect_regular(const Bundle& b) {
  const std::vector<std::int64_t>& t_ns = b.reference.t_ns;
  for (std::size_t k = 1; k < t_ns.size(); ++k)
    if (t_ns[k] <= t_ns[k - 1]) throw Error("the times of its reference do not increase");
  const double ticks = static_cast<double>(elapsed_ns(t_ns.back(), t_ns.front())) / static_cast<double>(b.observer.sample_period_ns);
  const double samples = static_cast<double>(t_ns.size());
  if (ticks > 2.0 * samples) throw Error("its reference of " + to_text(samples) + " samples has gaps");
}

void expect_names(const std::vector<Link>& links) {
  for (std::size_t k = 0; k < links.size(); ++k) {
    const std::string& name = links[k].joint_name;
    if (name.empty()) throw Error("joint " + std::to_string(k) + " has no name");
    // A terminal takes these, and in UTF-8 those from U+0080 to U+009F, for commands.
    for (std::size_t c = 0; c < name.size(); ++c) {
      const auto byte = static_cast<unsigned char>(name[c]);
      const auto next = c + 1 < name.size() ? static_cast<unsigned char>(name[c + 1]) : 0U;
      if (byte < 0x20 || byte == 0x7f || (byte == 0xc2 && next >= 0x80 && next < 0xa0))
        throw Error("the name of joint " + std::to_string(k) + " holds a character that cannot be printed");
    }
    for (std::size_t other = 0; other < k; ++other)
      if (links[k].joint_name == links[other].joint_name)
        throw Error("two joints are named '" + links[k].joint_name + "'");
  }
}

void expect_reference(const Bundle& b) {
  const Answer answer = replay(b);
  double scale = 1.0;
  for (const auto* list : {&b.reference.residual, &b.reference.prior, &b.reference.network})
    for (double value : *list) scale = std::max(scale, std::fabs(value));
  for (std::size_t j = 0; j < b.links.size(); ++j) {
    const double error = std::max({std::fabs(answer.residual[j] - b.reference.residual[j]),
                                   std::fabs(answer.prior[j] - b.reference.prior[j]),
                                   std::fabs(answer.network[j] - b.reference.network[j])});
    if (!(error <= kReferenceTolerance * scale))
      throw Error("joint '" + b.links[j].joint_name + "': replaying its reference differs by " + to_text(error) +
                  " N m, more than " + to_text(kReferenceTolerance * scale));
  }
}

}  // namespace

void Bundle::validate() const {
  const Tree tree(links, gravity);
  const auto n = links.size();
  expect_names(links);
  const ResidualStage probe(tree, observer, prior);
  if (observer.timing > TorqueTiming::averaged) throw Error("its torque timing is none of held, instant, averaged");
  if (has_network()) {
    shape.validate();
    expect_size("shape.outputs", static_cast<std::size_t>(shape.outputs), n);
    expect_size("parameters", parameters.size(), shape.parameter_count());
    expect_finite("parameters", parameters);
    expect_size("input_factors", input_factors.size(), static_cast<std::size_t>(columns()));
    expect_each("input_factors", input_factors, is_positive, "> 0");
    expect_size("output_scale_nm", output_scale_nm.size(), n);
    expect_each("output_scale_nm", output_scale_nm, [](double scale) { return scale >= 0 && scale <= kLargestScaleNm; },
                "0 to 1e200");
    largest_lstm_input(shape, parameters);
    expect(window_steps >= 1 && window_steps <= kMaxWindowSteps, "window_steps", window_steps,
           "1 to " + std::to_string(kMaxWindowSteps));
    windows_of(*this).validate(shape, {});
  }
  limits.validate(joints(), static_cast<int>(prior.widths_rad.size()));
  drift.validate(joints());
  error_scale.validate(joints());
  coverage.validate(joints());
  signals.validate(joints());
  units.validate(joints(), !observer.nm_per_unit.empty());
  load.validate(joints());
  wrench.validate(joints());
  validate_capsules(capsules, joints());
  if (servo.on()) {
    servo.validate();
    expect_size("servo.joints", servo.joints.size(), links.size());
  }
  if (load.settable() && !tree.has_mass() && prior.corrected_links.empty())
    throw Error("its payloads can be set, but no model can carry one");
  const auto samples = reference.t_ns.size();
  if (samples == 0) throw Error("its reference is empty");
  expect_size("reference.q", reference.q.size(), samples * n);
  expect_size("reference.dq", reference.dq.size(), samples * n);
  expect_size("reference.tau", reference.tau.size(), samples * n);
  expect_size("reference.residual", reference.residual.size(), n);
  expect_size("reference.prior", reference.prior.size(), n);
  expect_size("reference.network", reference.network.size(), n);
  for (const auto* list : {&reference.q, &reference.dq, &reference.tau}) expect_finite("reference", *list);
  for (const auto* list : {&reference.residual, &reference.prior, &reference.network}) expect_finite("reference", *list);
  expect_regular(*this);
  expect_reference(*this);
}

void answer_reference(Bundle& bundle) {
  Answer answer = replay(bundle);
  bundle.reference.residual = std::move(answer.residual);
  bundle.reference.prior = std::move(answer.prior);
  bundle.reference.network = std::move(answer.network);
}

std::vector<char> to_bytes(const Bundle& bundle) {
  bundle.validate();
  return encode(bundle);
}

Bundle from_bytes(std::span<const char> bytes) {
  simd_in_use();  // a wrong TAUEXT_SIMD is refused here for every bundle, and never in a control loop
  Bundle bundle = decode(bytes);
  bundle.validate();
  return bundle;
}

void save_bundle(const Bundle& bundle, const std::string& path) {
  const std::vector<char> bytes = to_bytes(bundle);
  const std::string temporary = path + ".part";
  {
    std::ofstream file(temporary, std::ios::binary | std::ios::trunc);
    file.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    file.flush();
    if (!file) {
      std::remove(temporary.c_str());
      throw Error(path + ": cannot be written");
    }
  }
  std::error_code problem;
  std::filesystem::rename(temporary, path, problem);
  if (problem) {
    std::remove(temporary.c_str());
    throw Error((path.empty() ? "''" : path) + ": cannot be written as a bundle (" + problem.message() + ")");
  }
}

Bundle load_bundle(const std::string& path) {
  std::error_code ignored;
  if (std::filesystem::is_directory(path, ignored)) throw Error(path + ": is a folder; a bundle is a file");
  std::ifstream file(path, std::ios::binary);
  if (!file) throw Error(path + ": cannot be opened");
  const std::vector<char> bytes((std::istreambuf_iterator<char>(file)), {});
  try {
    return from_bytes(bytes);
  } catch (const Error& e) {
    throw Error(path + ": " + e.what());
  }
}

}  // namespace tauext
