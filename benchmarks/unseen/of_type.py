"""Arms of one type: links, gears and drives they share; friction, tool and constants are each arm's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tauext import _core
from unseen.arms import Maker, TrueArm, add_tool, true_arm

MASSES = (0.99, 1.01)
"""Of links from the same moulds."""
FRICTION = (0.7, 1.3)
"""Of a joint, by that of the type: all of it ..."""
APART = (0.9, 1.1)
"""... and its parts beside that."""
CONSTANTS = (0.92, 1.08)


def arm_of(maker: Maker, seed: int) -> TrueArm:
    """The arm that `seed` drew: of its type, where the maker names one."""
    rng = maker.random(seed, 0)
    return true_arm(maker, rng) if maker.type_seed is None else arm_of_type(maker, rng)


def arm_of_type(maker: Maker, rng: np.random.Generator) -> TrueArm:
    """One arm of the type that maker.type_seed drew.

    Ripple has the type's numbers of cycles; how large it is, and its phase, follow from how a gear was put together.
    """
    assert maker.type_seed is not None
    of_type = true_arm(maker, np.random.default_rng([maker.type_seed, 7]), tool=False)
    n = len(maker.joints)
    links = of_type.tree.links
    for link in links:
        share = rng.uniform(*MASSES)
        link.mass *= share
        link.inertia = [share * x for x in link.inertia]
    add_tool(links[-1], rng)
    friction = rng.uniform(*FRICTION, n)
    return replace(
        of_type,
        tree=_core.Tree(links, of_type.tree.gravity),
        coulomb_nm=of_type.coulomb_nm * friction * rng.uniform(*APART, n),
        viscous_nm_s_rad=of_type.viscous_nm_s_rad * friction * rng.uniform(*APART, n),
        asymmetry=rng.uniform(-0.05, 0.05, n),
        static_share=of_type.static_share * rng.uniform(0.97, 1.03, n),
        stribeck_rad_s=of_type.stribeck_rad_s * rng.uniform(*APART, n),
        presliding_rad=of_type.presliding_rad * rng.uniform(*APART, n),
        load_share=of_type.load_share * rng.uniform(*APART, n),
        warm_drop=rng.uniform(0.10, 0.15, n),
        warm_s=rng.uniform(180, 400),
        ripple_nm=of_type.ripple_nm * rng.uniform(0.5, 1.5, n),
        ripple_phase_rad=rng.uniform(0, 2 * np.pi, n),
        nm_per_ampere=np.array(maker.nm_per_ampere) * rng.uniform(*CONSTANTS, n),
    )
