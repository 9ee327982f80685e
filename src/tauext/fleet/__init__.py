"""Many arms: their stages as tasks, a prior for the next arm.

In go folders of recordings, one an arm. Out come bundles, results and a fleet prior. It imports the
packages before it.
"""
