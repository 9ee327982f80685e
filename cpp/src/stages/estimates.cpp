#include <algorithm>

#include "stages/estimates.hpp"
#include "stages/observation.hpp"

namespace tauext {
namespace {

// Samples of a bundle without a network that pass the first half of the chain before the second.
constexpr std::size_t kBlock = 1024;

// Results of ObserveStage for each sample of a block, as columns.
struct Seen {
  struct Row {
    std::uint32_t causes, near_stiction;
    std::int32_t ticks;
    Passage passage;
    Health health;
    std::int8_t cause_joint;
    bool restarted, jumped, overflowed, judged, teaches;
  };
  std::vector<Row> rows;                        // (samples)
  std::vector<float> features;                  // (clock rows, columns)
  std::vector<double> residual, prior, doubt;   // (samples, joints)
  std::vector<double> friction;                 // (samples, Coulomb and viscous, joints), if the drift tracker needs it
  std::vector<double> memory_gap;               // (samples, joints), if the prior has branches
  std::vector<std::int64_t> judged_ends;        // clock rows of the samples that are judged
  RowCount at;
};

void observe_block(ObserveStage& stage, const RecordingView& recording, std::size_t begin, std::size_t end, Seen& seen) {
  const std::size_t N = end - begin, n = static_cast<std::size_t>(recording.joints), columns = stage.features().size();
  for (auto* torque : {&seen.residual, &seen.prior, &seen.doubt}) torque->assign(N * n, 0.0);
  seen.rows.clear();
  for (std::size_t k = 0; k < N; ++k) {
    const Observed& o = stage.step(recording.at(static_cast<std::int64_t>(begin + k)));
    seen.rows.push_back({o.causes, o.near_stiction, static_cast<std::int32_t>(o.ticks), o.passage, o.health,
                         static_cast<std::int8_t>(o.cause_joint), o.restarted, o.jumped, o.overflowed, o.judged, o.teaches});
    if (o.passage != Passage::entered) continue;
    const auto cells = static_cast<std::ptrdiff_t>(k * n);
    std::ranges::copy(o.residual, seen.residual.begin() + cells);
    std::ranges::copy(o.prior, seen.prior.begin() + cells);
    std::ranges::copy(o.doubt, seen.doubt.begin() + cells);
    if (!o.coulomb.empty()) {
      seen.friction.resize(2 * N * n);
      std::ranges::copy(o.coulomb, seen.friction.begin() + 2 * cells);
      std::ranges::copy(o.viscous, seen.friction.begin() + 2 * cells + static_cast<std::ptrdiff_t>(n));
    }
    if (!o.memory_gap.empty()) {
      seen.memory_gap.resize(N * n);
      std::ranges::copy(o.memory_gap, seen.memory_gap.begin() + cells);
    }
    if (columns == 0) continue;
    seen.at.add(o.restarted, o.ticks);
    // Bridged ticks hold the sample before.
    const std::size_t before = seen.features.size();
    for (std::int64_t held = 1; !o.restarted && held < o.ticks; ++held)
      for (std::size_t c = 0; c < columns; ++c) seen.features.push_back(seen.features[before - columns + c]);
    seen.features.insert(seen.features.end(), stage.features().begin(), stage.features().end());
    if (o.judged) seen.judged_ends.push_back(seen.at.row);
  }
}

// The network's outputs for the judged samples, (judged, joints); none without a network.
std::vector<float> predict_all(const Bundle& bundle, const Seen& seen, int threads) {
  if (!bundle.has_network()) return {};
  WindowRows windows = windows_of(bundle);
  windows.rows = seen.features.data();
  windows.row_count = seen.at.row + 1;
  std::vector<float> outputs(seen.judged_ends.size() * bundle.links.size());
  lstm_forward(bundle.shape, bundle.parameters, windows, seen.judged_ends, outputs, threads);
  return outputs;
}

// Declares contacts at their times.
class Declaring {
 public:
  Declaring(const Bundle& bundle, std::span<const TimedContact> contacts) : left_(contacts) {
    if (contacts.empty()) return;
    model_.emplace(bundle);
    contacts_.emplace(bundle, *model_);
  }
  // Before the sample at this time.
  DeclaredContacts* at(std::int64_t t_ns) {
    for (; !left_.empty() && left_.front().from_ns <= t_ns; left_ = left_.subspan(1)) {
      const TimedContact& one = left_.front();
      if (contacts_->start(one.contact, one.seconds) < 0)
        throw Error(contacts_->words(contacts_->fault(one.contact, one.seconds), one.contact, one.seconds));
    }
    return contacts_ ? &*contacts_ : nullptr;
  }

 private:
  std::span<const TimedContact> left_;
  std::optional<WrenchModel> model_;
  std::optional<DeclaredContacts> contacts_;
};

void judge_block(JudgeStage& stage, const RecordingView& recording, std::size_t begin, const Seen& seen,
                 std::span<const float> outputs, Declaring& contacts, Estimates& out) {
  const auto n = static_cast<std::size_t>(recording.joints);
  Observed o;
  for (std::size_t r = 0, judged = 0; r < seen.rows.size(); ++r) {
    const Seen::Row& row = seen.rows[r];
    const std::size_t k = begin + r;
    const Sample sample = recording.at(static_cast<std::int64_t>(k));
    o.t_ns = sample.t_ns;
    o.passage = row.passage;
    o.health = row.health;
    o.causes = row.causes;
    o.cause_joint = row.cause_joint;
    o.restarted = row.restarted;
    o.jumped = row.jumped;
    o.ticks = row.ticks;
    o.overflowed = row.overflowed;
    o.judged = row.judged;
    o.teaches = row.teaches;
    o.near_stiction = row.near_stiction;
    o.residual = std::span(seen.residual).subspan(r * n, n);
    o.prior = std::span(seen.prior).subspan(r * n, n);
    o.doubt = std::span(seen.doubt).subspan(r * n, n);
    if (!seen.friction.empty()) {
      o.coulomb = std::span(seen.friction).subspan(2 * r * n, n);
      o.viscous = std::span(seen.friction).subspan((2 * r + 1) * n, n);
    }
    if (!seen.memory_gap.empty()) o.memory_gap = std::span(seen.memory_gap).subspan(r * n, n);
    const bool entered = row.passage == Passage::entered;
    const std::span<const float> network =
        entered && row.judged && !outputs.empty() ? outputs.subspan(n * judged, n) : std::span<const float>();
    judged += entered && row.judged;
    const Estimate& e = stage.step(o, sample, network, nullptr, contacts.at(sample.t_ns));
    for (const TorqueColumn& one : kTorqueColumns)
      if (std::vector<double>& column = out.*one.column; !column.empty())
        std::copy_n((e.*one.values).begin(), n, column.begin() + static_cast<std::ptrdiff_t>(k * n));
    for (std::size_t j = 0; j < n; ++j) out.near_stiction[k * n + j] = e.near_stiction >> j & 1;
    out.health[k] = static_cast<std::uint8_t>(e.health);
    out.causes[k] = e.causes;
    out.cause_joint[k] = static_cast<std::int8_t>(e.cause_joint);
    out.alarm_joint[k] = static_cast<std::int8_t>(e.alarm_joint);
    out.detection[k] = e.detection;
    out.unfamiliar[k] = e.unfamiliar;
    out.unseen[k] = static_cast<std::uint8_t>(e.unseen);
    out.unseen_joint[k] = static_cast<std::int8_t>(e.unseen_joint);
    out.unseen_other[k] = static_cast<std::int8_t>(e.unseen_other);
    out.alarm[k] = static_cast<std::uint8_t>(e.alarm);
    out.held_alarm[k] = static_cast<std::uint8_t>(e.held_alarm);
    out.touch[k] = static_cast<std::uint8_t>(e.touch);
    out.declared[k] = static_cast<std::uint8_t>(e.declared);
    out.declared_contact[k] = static_cast<std::int8_t>(e.declared_contact);
    out.declared_size[k] = e.declared_size;
    out.declared_sigma[k] = e.declared_sigma;
    stage.advance(sample.q, sample.dq);
    out.entered[k] = entered;
    out.restarted[k] = row.restarted;
  }
}

void expect_joints(const Bundle& bundle, const RecordingView& recording) {
  if (recording.joints != bundle.joints())
    throw Error("the bundle has " + std::to_string(bundle.joints()) + " joints, the recording " +
                std::to_string(recording.joints));
}

}  // namespace

std::vector<float> network_outputs(const Bundle& bundle, const RecordingView& recording, int threads) {
  expect_joints(bundle, recording);
  if (!bundle.has_network()) return {};
  ObserveStage observe(bundle, 1);
  Seen seen;
  observe_block(observe, recording, 0, static_cast<std::size_t>(recording.samples), seen);
  return predict_all(bundle, seen, threads);
}

Estimates estimate(const Bundle& bundle, const RecordingView& recording, int threads, std::span<const float> outputs,
                   std::span<const std::string> torques, std::span<const TimedContact> contacts) {
  expect_joints(bundle, recording);
  const auto N = static_cast<std::size_t>(recording.samples), n = static_cast<std::size_t>(recording.joints);
  Estimates out;
  for (const std::string& name : torques)
    if (std::ranges::none_of(kTorqueColumns, [&](const TorqueColumn& one) { return name == one.name; }))
      throw Error("there is no torque column '" + name + "'");
  for (const TorqueColumn& one : kTorqueColumns)
    if (torques.empty() || std::ranges::find(torques, one.name) != torques.end()) (out.*one.column).resize(N * n);
  out.near_stiction.resize(N * n);
  for (auto* flags : {&out.health, &out.detection, &out.alarm, &out.held_alarm, &out.unseen, &out.touch, &out.declared, &out.entered,
                      &out.restarted})
    flags->resize(N);
  for (auto* which : {&out.cause_joint, &out.alarm_joint, &out.unseen_joint, &out.unseen_other, &out.declared_contact}) which->resize(N);
  for (auto* numbers : {&out.unfamiliar, &out.declared_size, &out.declared_sigma}) numbers->resize(N);
  out.causes.resize(N);
  ObserveStage observe(bundle, 1);
  JudgeStage judge(bundle);
  Declaring declaring(bundle, contacts);
  Seen seen;
  const std::size_t block = bundle.has_network() ? N : kBlock;  // the network's windows reach across blocks
  for (std::size_t begin = 0; begin < N; begin += block) {
    observe_block(observe, recording, begin, std::min(begin + block, N), seen);
    if (!outputs.empty() && (!bundle.has_network() || outputs.size() != seen.judged_ends.size() * n))
      throw Error("the outputs are not of this bundle's network for this recording");
    if (outputs.empty())
      judge_block(judge, recording, begin, seen, predict_all(bundle, seen, threads), declaring, out);
    else
      judge_block(judge, recording, begin, seen, outputs, declaring, out);
  }
  return out;
}

MotionErrors motion_errors(const Bundle& bundle, const MotionView& motion, std::span<const std::int64_t> rows) {
  if (!bundle.error_scale.on()) throw Error("the bundle has no error scale");
  const auto n = static_cast<std::size_t>(bundle.joints()), samples = motion.t_ns.size();
  if (motion.dq.size() != samples * n || motion.near_stiction.size() != samples * n ||
      motion.entered.size() != samples || motion.restarted.size() != samples)
    throw Error("dq and near_stiction must hold a value a sample and joint, entered and restarted one a sample");
  const int features = static_cast<int>(bundle.error_scale.features.size());
  ErrorScale stage(bundle.error_scale, bundle.joints(), bundle.observer.gain_per_s);
  MotionErrors out;
  std::vector<double> scale(n, 1.0), sigma_nm(n);
  std::size_t next = 0;
  for (std::size_t k = 0; k < samples && next < rows.size(); ++k) {
    std::uint32_t near = 0;
    for (std::size_t j = 0; j < n; ++j) near |= std::uint32_t{motion.near_stiction[k * n + j] != 0} << j;
    if (motion.entered[k] != 0) {
      if (motion.restarted[k] != 0) stage.restart();
      stage.step(motion.t_ns[k], motion.dq.subspan(k * n, n), near, scale, sigma_nm);
    }
    if (rows[next] != static_cast<std::int64_t>(k)) continue;
    ++next;
    for (int j = 0; j < bundle.joints(); ++j)
      for (int m = 0; m < features; ++m) out.features.push_back(stage.feature(j, m));
    out.scale.insert(out.scale.end(), scale.begin(), scale.end());
    out.sigma_nm.insert(out.sigma_nm.end(), sigma_nm.begin(), sigma_nm.end());
  }
  if (next != rows.size()) throw Error("rows must be ascending and within the motion");
  return out;
}

}  // namespace tauext
