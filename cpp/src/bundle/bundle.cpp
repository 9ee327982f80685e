// Units of a bundle's input and estimates.
#include "tauext/bundle.hpp"

#include <algorithm>

#include "bundle/rules.hpp"

namespace tauext {
void TorqueUnits::validate(int joints, bool constants) const {
  if (given > TorqueUnit::recorded) throw Error("units.given is none of newton_metre, ampere, recorded");
  expect(relative_to >= -1 && relative_to < joints, "units.relative_to", relative_to,
         "-1 or one of " + std::to_string(joints) + " joints");
  if (!constants && relative_to >= 0) throw Error("units.relative_to needs torque constants, and there are none");
}

std::string Bundle::torque_unit(int joint) const {
  const bool slides = links.at(static_cast<std::size_t>(joint)).type == JointType::prismatic;
  if (units.given == TorqueUnit::newton_metre) return slides ? "N" : "N m";
  return units.given == TorqueUnit::ampere ? "A" : "recorded unit";
}

std::string Bundle::estimate_unit(int joint) const {
  const auto at = static_cast<std::size_t>(joint);
  const bool slides = links.at(at).type == JointType::prismatic;
  if (observer.nm_per_unit.empty() || observer.has_unknown_constant(at)) {
    const bool watts = observer.method == ResidualMethod::energy && units.given == TorqueUnit::newton_metre;
    const double times = observer.nm_per_unit.empty() ? 1.0 : observer.nm_per_unit.at(at);
    return (watts ? "W" : torque_unit(joint)) + (times == 1 ? "" : " / " + to_text(times));
  }
  if (units.relative_to >= 0) return "units of " + links[static_cast<std::size_t>(units.relative_to)].joint_name;
  if (observer.method == ResidualMethod::energy) return "W";
  return slides ? "N" : "N m";
}

bool Bundle::in_newtons(int joint) const {
  const std::string unit = estimate_unit(joint);
  return unit == "N m" || unit == "N" || unit == "W";
}

std::string Bundle::too_few_in_newtons(const std::string& why) const {
  int known = 0, other = -1;
  for (int j = 0; j < joints(); ++j) {
    known += in_newtons(j);
    if (other < 0 && !in_newtons(j)) other = j;
  }
  if (known >= std::min(kLeastInNewtons, joints())) return "";
  return (known == 0 ? "none" : "only " + std::to_string(known)) + " of " + std::to_string(joints()) +
         " joints in N m: joint '" + links[static_cast<std::size_t>(other)].joint_name + "' answers in " +
         estimate_unit(other) + ", and " + why;
}

std::vector<double> Bundle::most_units_per_nm() const {
  constexpr double kBeyond = 1.2;  // most_load_nm: this multiple of the largest weight torque in training
  std::vector<double> most(links.size(), 0.0);
  for (std::size_t j = 0; j < links.size(); ++j) {
    if (in_newtons(static_cast<int>(j))) continue;
    const double weighs = prior.most_load_nm.empty() ? 0.0 : prior.most_load_nm.at(j) / kBeyond;
    most[j] = 1 + std::min(signals.largest_torque_nm.at(j) / std::max(weighs, 1e-9), kAnyUnit);
  }
  return most;
}

void Bundle::assume_load() {
  load = assumed_load_settings(links, prior.corrected_links);
  if (!load.settable()) return;
  load.refused = too_few_in_newtons("the pull of a mass is in newtons");
  if (!load.settable()) load.link = -1;
}

}  // namespace tauext
