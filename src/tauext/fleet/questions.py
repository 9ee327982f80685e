"""What is believed of each table before it is seen; logarithms, that is shares, unless another unit stands there."""

from tauext.fleet.odds import Question

OWN_FRICTION = Question(arm_spread=0.08, joint_spread=0.05, jump=0.35, common=0.3, apart=0.1)
"""From one date to another. Friction of gears falls by 1 to 2 % a kelvin, so halls and warm-up move all joints of an
arm by some 8 %, a cold morning by 30 %; a joint by itself does half of that. Wear is felt from a tenth on, and is
mended before friction doubles."""
FLEET_FRICTION = Question(arm_spread=0.1, joint_spread=0.2, jump=0.35, common=3.0, apart=3.0)
"""Of one arm beside others of its type: healthy gears differ by 0.7 to 1.3. What the type has is whatever it is."""
OWN_CONSTANT = Question(arm_spread=0.005, joint_spread=0.01, jump=0.1, common=0.02, apart=0.02, odd_arm=0.05)
"""A motor's magnets lose 0.1 to 0.2 % a kelvin; another drive, or another number in its software, is a tenth off."""
FLEET_CONSTANT = Question(arm_spread=0.01, joint_spread=0.05, jump=0.15, common=3.0, apart=3.0, odd_arm=0.1)
"""Makers keep torque constants, gear losses included, to some 5 %."""
OWN_TOOL = Question(arm_spread=0.0, joint_spread=0.05, jump=0.7, common=0.02, apart=0.02)
"""Kilograms. The same tool weighs the same, as far as gravity is known; another one differs by some hundred grams."""
FLEET_TOOL = Question(arm_spread=0.0, joint_spread=0.2, jump=0.7, common=3.0, apart=3.0)
"""Kilograms. Arms of one type may carry tools that differ by some hundred grams."""
OWN_SHARE, FLEET_SHARE = 0.1, 0.05
"""Standard deviation of what a torque's scale may be off by when tools are weighed: by the date, and by training."""
