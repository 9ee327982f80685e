// Groups of the prior's terms by kind, and the rule of presliding states.
#pragma once
#include <span>

#include "tauext/settings.hpp"

namespace tauext {

// Kind of a term: load on the gear, presliding state, or generalised momentum.
inline bool is_load(const Term& term) noexcept {
  return term.kind == TermKind::load || term.kind == TermKind::load_presliding;
}
inline bool is_presliding(const Term& term) noexcept {
  return term.kind == TermKind::presliding || term.kind == TermKind::load_presliding;
}
// Whether the term depends on a presliding state.
inline bool has_width(const Term& term) noexcept { return is_presliding(term) || term.kind == TermKind::backlash; }
// Load-dependent friction, at any speed.
inline bool is_coulomb(const Term& term) noexcept {
  return term.kind == TermKind::coulomb || term.kind == TermKind::local_memory || is_load(term) || is_presliding(term);
}
inline bool is_momentum(const Term& term) noexcept { return term.kind == TermKind::momentum; }

inline constexpr int kMaxWidths = 8;  // presliding states of a joint

// Throws Error unless 1 to kMaxJoints joints have 0 to kMaxWidths widths [rad], > 0 and rising, and branches (joints,
// widths), >= 0, that sum to 1 or 0 at each joint, or none.
void validate_presliding(int joints, std::span<const double> widths, std::span<const double> branches);

}  // namespace tauext
