#include <algorithm>
#include <cmath>

#include "tauext/refit_motion.hpp"

namespace tauext {
namespace {

// Of a joint that slides at this speed: its presliding states are 1.
double friction_nm(const PriorSettings& prior, std::size_t joint, double speed) {
  double sum = 0;
  for (std::size_t m = 0; m < prior.terms.size(); ++m) {
    const Term& term = prior.terms[m];
    if (static_cast<std::size_t>(term.a) != joint) continue;
    const double weight = prior.weights[joint * prior.terms.size() + m];
    if (term.kind == TermKind::coulomb) sum += weight * std::tanh(speed / term.speed);
    if (term.kind == TermKind::presliding) sum += weight;
    if (term.kind == TermKind::viscous) sum += weight * speed;
  }
  return std::fabs(sum);
}

}  // namespace

// Through the friction at a slow and at a usual speed.
FrictionLine friction_line(const PriorSettings& prior, std::size_t joint) {
  constexpr double slow = 0.15, usual = 0.5;  // [rad/s]: where Coulomb terms have levelled off
  const double at_slow = friction_nm(prior, joint, slow), at_usual = friction_nm(prior, joint, usual);
  const double slope = std::max((at_usual - at_slow) / (usual - slow), 0.0);
  return {std::max(at_usual - slope * usual, 0.0), slope};
}

}  // namespace tauext
