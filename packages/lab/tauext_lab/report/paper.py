"""The paper's published numbers, for comparison with ours.

Source: D. Lim, D. Kim, J. Park, "Momentum Observer-Based Collision Detection Using LSTM for Model Uncertainty
Learning", ICRA 2021: Table I, and the text for stiction, limit, collisions and delays. The observer's extremes are
of the real arm, from code for it ([Mocca2020], docs/references.md). Two joints everywhere; None where the paper gives
no number.
"""

JOINTS = 2

TABLE_I = {
    "exact": ((0.402, 0.262), (0.661, 0.369), (0.435, 0.136)),
    "mass": ((0.401, 0.256), (0.687, 0.365), (0.468, 0.132)),
    "com": ((0.392, 0.253), (0.680, 0.355), (0.458, 0.126)),
    "mass+com": ((0.415, 0.258), (0.681, 0.368), (0.464, 0.134)),
    "none": ((0.409, 0.259), (0.683, 0.376), (0.466, 0.141)),
}
"""L1 [N m], L2 [N m] and MSE [(N m)^2] of each case."""
L1_NM, L2_NM, MSE_NM2 = ({case: row[k] for case, row in TABLE_I.items()} for k in range(3))
RMSE_SLIDING_NM = {"exact": (0.418, None)}
RMSE_NEAR_STICTION_NM = {"exact": (1.344, None)}
LIMIT_SLIDING_NM = {"exact": (4.62, None)}
COLLISIONS = FOUND = 10
"""Collisions tried, and found in each of the five cases."""
DELAYS_AGAINST_SENSOR_MS = (3, 6, -1)
"""Joint 1 in three collisions, exact model; estimate and sensor at LIMIT_SLIDING_NM."""

OBSERVER_PEAK_NM = {
    "exact": (24.0, 14.0),
    "mass": (52.0, 22.0),
    "com": (37.0, 22.0),
    "mass+com": (59.0, 26.0),
    "none": (81.0, 29.0),
}
"""Largest observer output of the real arm in free motion."""
